"""A folder that another program is still writing frames into."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from modeler.sequences.base import FIRST, AbstractDerived, AbstractLive, AbstractSequence
from modeler.sequences.intrinsics import Overrides
from modeler.sequences.opening import open_sequence
from modeler.sequences.survey import survey
from modeler.types import Frame, InputError, checked

_log = logging.getLogger(__name__)

END = "done"  # a file of this name in the folder marks the end of the sequence
POLL_S = 0.05  # polling interval of the folder
REST = 3.0
"""So many times as long as looking took is rested at least: of 10,000 frames it takes 0.1 s."""


@dataclass(frozen=True)
class WatchLimits:
    """Time limits of watching a folder."""

    idle_s: float = 10.0
    """When nothing has come for so long, the sequence is over."""
    settle_s: float = 0.5
    """The newest frame is taken once the folder has not changed for so long: its colour and mask may come late."""
    first: int = FIRST
    """Number of frames to wait for before the sequence is described."""


@dataclass(frozen=True)
class WatchedSequence(AbstractLive, AbstractDerived):
    """The frames in a folder, and those that will come, each once it is complete.

    `indices`, `name` and the rest keep their values from when the sequence was opened.
    """

    path: Path
    """The folder, in any layout of pictures."""
    overrides: Overrides = field(default_factory=Overrides)
    """Values that take precedence over the files."""
    patience: WatchLimits = field(default_factory=WatchLimits)

    @property
    def indices(self) -> tuple[int, ...]:
        wanted = [index for index in self.whole.indices if self._wants(index)]
        return tuple(wanted[:: self.every])

    def recorded(self) -> AbstractSequence:
        return self.whole

    def __iter__(self) -> Iterator[Frame]:
        """Yield each frame when it is complete, until none has come for a while."""
        wanted = -1
        for frame in arriving(self.path, self.overrides, self.patience, self.stop):
            if self.kept.stop is not None and frame.index >= self.kept.stop:
                return
            if not self._wants(frame.index):
                continue
            wanted += 1
            if wanted % self.every == 0:
                yield frame

    @property
    def layout(self) -> str:
        return f"{self.whole.layout}, being written"

    def _wants(self, index: int) -> bool:
        low, high = self.kept.start, self.kept.stop
        return (low is None or index >= low) and (high is None or index < high)


def arriving(path: Path, overrides: Overrides, patience: WatchLimits, stop: Callable[[], bool]) -> Iterator[Frame]:
    """Yield frames, each once it is complete, until none has come for a while.

    They ascend, but for a frame that comes, or can be read, only after later ones. What can never be read is reported
    to the log and left out, if there are other frames.
    """
    taken: set[int] = set()
    failing: dict[int, _Failing] = {}
    coming: list[int] = []  # those in the folder that are not taken
    known, fault = False, ""  # whether `coming` is as the folder is now, and why it cannot be opened
    came_s = changed_s = time.monotonic()
    before = 0
    while not stop():
        now, ended = time.monotonic(), (path / END).exists()  # what came before it, the look finds
        if (state := _state(path)) != before:
            before, changed_s, known = state, now, False
        idle = now - max(came_s, changed_s) >= patience.idle_s
        settled = ended or now - changed_s >= patience.settle_s
        opened = None
        if not known or any(
            ended or idle or index not in failing or now >= failing[index].again_s
            for index in (coming if settled else coming[:-1])
        ):
            try:
                opened, fault, known = open_sequence(path, overrides), "", True
                coming = [index for index in opened.indices if index not in taken]
            except InputError as error:  # half-written, perhaps
                fault, known, coming = str(error), False, []
        rest_s = max(POLL_S, REST * (time.monotonic() - now))
        for index in () if opened is None else coming if settled else coming[:-1]:
            assert opened is not None
            failed = failing.get(index, _Failing(now, now))
            frame = None
            if ended or idle or now >= failed.again_s:
                try:
                    frame = opened.frame(index)
                except InputError as error:
                    failing[index] = _Failing(failed.since_s, 2.0 * now - failed.since_s, str(error))
            if frame is None and not ended and now - failed.since_s < patience.settle_s:
                break  # it may be being written
            if frame is None:
                continue
            failing.pop(index, None)
            yield frame
            taken.add(index)
            came_s = time.monotonic()  # which the taker may have spent long with
            if stop():
                return
        coming = [index for index in coming if index not in taken]
        if ended or (idle and time.monotonic() - max(came_s, changed_s) >= patience.idle_s):
            for words in [fault] if fault else [failing[index].words for index in coming if index in failing]:
                if not taken:
                    raise InputError(words)
                _log.warning("%s: continuing with the frames so far", words.rstrip("."))
            return
        opened = None  # it has some names for each frame
        time.sleep(rest_s)


@checked
def watch(path: str | Path, overrides: Overrides | None = None, patience: WatchLimits | None = None) -> WatchedSequence:
    """Wait for the first frames in a folder, which need not be there yet, and return the sequence that they begin.

    Raises:
        InputError: if no readable frame comes in time.
    """
    path, overrides, patience = Path(path), overrides or Overrides(), patience or WatchLimits()
    first: list[int] = []
    for frame in arriving(path, overrides, patience, lambda: len(first) == patience.first):
        first.append(frame.index)
    if not first:
        raise InputError(f"{path}: no frame has come in {patience.idle_s:g} s; start the program that writes them.")
    seen = open_sequence(path, overrides).select(frames=slice(None, max(first) + 1))
    survey(seen, truth=False)
    return WatchedSequence(seen, path, overrides, patience)


class _Failing(NamedTuple):
    """A frame that cannot be read."""

    since_s: float
    """Of when."""
    again_s: float
    """When it is tried again: a damaged one costs less the longer it is."""
    words: str = ""
    """Why; not the error itself, which holds the images that were read before it."""


def _state(folder: str | Path, *, deep: bool = True) -> int:
    """Return a number that is another once a file in a folder, or in a folder in it, is made, changes or goes."""
    state = 0
    with suppress(OSError), os.scandir(folder) as entries:  # it may go away meanwhile
        for entry in entries:
            with suppress(OSError):  # so may a file, or it is a link to nothing
                status = entry.stat()
                state += hash((entry.path, status.st_mtime_ns, status.st_size))
                state += _state(entry.path, deep=False) if deep and entry.is_dir() else 0
    return state
