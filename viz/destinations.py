"""Where a stream goes: a file and viewers, neither of which can stop, delay or outlast the run."""

from __future__ import annotations

import logging
import os
import queue
import sys
import threading
from collections.abc import Callable
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from modeler.system.regular_files import PIECE_BYTES, create_regular
from modeler.types import InputError

if TYPE_CHECKING:
    import rerun as rr

_log = logging.getLogger(__name__)

_PATIENCE_S: Final = 5.0  # at the end, until viewers have received all data
_DISK_PATIENCE_S: Final = 60.0  # with a disk that takes nothing
_STOP_S: Final = 1.0  # until Rerun notices that a viewer has been ended
_QUEUED: Final = 100  # steps that viewers are behind at most, besides those that Rerun keeps
_BEGINNING: Final = 4096  # bytes that must fit on the disk to begin with


@final
class RecordingFile:
    """A file that Rerun writes through a pipe: Rerun 0.41 waits for ever at the end of a file that it could not write.

    What the disk does not take is dropped; the file then ends there. If it is moved or removed meanwhile, it is written
    once more in its place, unless something else is there.
    """

    def __init__(self, path: Path) -> None:
        """Create the file, or empty it."""
        self.path = path
        self.error: OSError | None = None
        """Why the file is cut off, if it is."""
        self.went_away = False
        """Whether it was moved or removed meanwhile."""
        try:
            create_regular(path)
            path.write_bytes(bytes(_BEGINNING))
            self._file = path.open("r+b", buffering=0)
            self._file.truncate(0)
        except OSError as error:
            raise InputError(f"{path}: cannot write the recording ({error.strerror}); choose another folder") from error
        self._source, self._written = -1, 0
        self._copying = threading.Thread(target=self._copy, daemon=True, name="recording")

    def attach(self, recording: rr.RecordingStream) -> None:
        """Have a stream written to the file."""
        import rerun as rr

        self._source, sink = os.pipe()
        try:
            # A footer lists all pieces, each of which takes 25 kB of memory until the end.
            recording.set_sinks(rr.FileSink(f"/dev/fd/{sink}", write_footer=False))
        finally:
            os.close(sink)  # Rerun has opened it anew
        self._copying.start()

    def close(self, recording: rr.RecordingStream) -> None:
        """Complete the file, or give up a disk that takes nothing for a minute."""
        leave = threading.Thread(target=recording.disconnect, daemon=True)
        leave.start()
        if not _ended((leave, self._copying), _DISK_PATIENCE_S, lambda: self._written):
            self.error = self.error or TimeoutError("the disk does not answer")
            let_go()
        if self.error is not None:
            what = "was moved or removed, and cannot be written again" if self.went_away else "is truncated"
            why = self.error.strerror or self.error
            _log.warning("%s: %s (%s); the other files do not depend on it", self.path, what, why)
        elif self.went_away:
            _log.warning("%s: was moved or removed during the run; it is written again", self.path)

    def _copy(self) -> None:
        """Copy to the file what Rerun writes."""
        with open(self._source, "rb", buffering=0) as source, self._file as file:
            self._fill(file, source)
            try:
                if self.error is None and not self._in_place(file):
                    self.went_away = True
                    file.seek(0)
                    with self.path.open("xb", buffering=0) as again:
                        self._fill(again, file)
            except OSError as error:
                self.error = error

    def _fill(self, file: FileIO, source: FileIO) -> None:
        """Write to a file all that can be read, until the disk takes no more."""
        while piece := source.read(PIECE_BYTES):
            while piece and self.error is None:
                try:
                    written = file.write(piece)
                except OSError as error:
                    self.error = error
                else:
                    self._written += written
                    piece = piece[written:]

    def _in_place(self, file: FileIO) -> bool:
        """Return whether a file still has its name."""
        try:
            return os.path.samestat(os.stat(self.path), os.fstat(file.fileno()))
        except FileNotFoundError:
            return False


@final
class Shown:
    """What viewers are shown, sent from a thread of its own: Rerun 0.41 waits for a viewer that is 400 MB behind."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._waiting: queue.Queue[Callable[[rr.RecordingStream], object] | None] = queue.Queue(_QUEUED)
        self._behind = False
        self._sending = threading.Thread(target=self._send, daemon=True, name="viewers")
        self._sending.start()

    def put(self, act: Callable[[rr.RecordingStream], object] | None, patience_s: float = 0.0) -> None:
        """Have something done with the stream, None: its end; once the viewers are too far behind, nothing more is."""
        try:
            if not self._behind:
                self._waiting.put(act, timeout=patience_s)
        except queue.Full:
            self._behind = True
            _log.warning("the viewer takes no data any more; the run goes on without it")

    def close(self, end_hung: Callable[[], None]) -> None:
        """Send the rest, and take leave.

        Args:
            end_hung: ends the viewers that are ours, called where they do not take it.
        """
        self.put(None, _PATIENCE_S)
        if self._behind or not _ended((self._sending,), _PATIENCE_S, lambda: 0):
            _log.info("the viewer did not receive all data")
            self._behind = True
            end_hung()
            if not _ended((self._sending,), _STOP_S, lambda: 0):
                let_go()

    def _send(self) -> None:
        while (act := self._waiting.get()) and not self._behind:
            act(self._recording)
        self._recording.disconnect()


def _ended(threads: tuple[threading.Thread, ...], patience_s: float, progress: Callable[[], int]) -> bool:
    """Wait for threads for as long as there is progress, and return whether they have ended."""
    before = -1
    while (now := progress()) != before and any(thread.is_alive() for thread in threads):
        before = now
        for thread in threads:
            thread.join(patience_s)
    return not any(thread.is_alive() for thread in threads)


def let_go() -> None:
    """Let the process end without what Rerun still has: its exit hook would wait for that for ever."""
    if "rerun" in sys.modules:
        import rerun as rr

        rr.unregister_shutdown()
