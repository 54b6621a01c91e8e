"""A folder that another program is still writing frames into."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import final

from modeler.sequences.base import FIRST, AbstractDerived, AbstractSequence, check_every
from modeler.sequences.intrinsics import Overrides
from modeler.sequences.opening import open_sequence
from modeler.sequences.survey import survey
from modeler.types import Frame, InputError

_log = logging.getLogger(__name__)

END = "done"
"""A file of this name in the folder marks the end of the sequence."""
POLL_S = 0.05
"""Polling interval of the folder."""
REST = 3.0
"""So many times as long as looking took is rested at least: of 4000 frames it takes 40 ms."""


@final
@dataclass(frozen=True)
class WatchLimits:
    """Time limits of watching a folder."""

    idle_s: float = 10.0
    """When nothing has come for so long, the sequence is over."""
    settle_s: float = 0.5
    """The newest frame is taken once the folder has not changed for so long: its colour and mask may come late."""
    first: int = FIRST
    """Number of frames to wait for before the sequence is described."""


@final
@dataclass(frozen=True)
class WatchedSequence(AbstractDerived):
    """The frames in a folder, and those that will come, each once it is complete.

    `indices`, `name` and the rest keep their values from when the sequence was opened.
    """

    path: Path
    """The folder, in any layout of pictures."""
    overrides: Overrides = field(default_factory=Overrides)
    """Values that take precedence over the files."""
    patience: WatchLimits = field(default_factory=WatchLimits)
    """How long to wait."""
    every: int = 1
    """Stride over the frames."""
    kept: slice = field(default_factory=lambda: slice(None, None))
    """Keep these frame numbers."""
    stop: Callable[[], bool] = lambda: False
    """Polled while waiting; true ends the sequence."""

    @property
    def indices(self) -> tuple[int, ...]:
        """Numbers of the frames that have arrived."""
        wanted = [index for index in self.whole.indices if self._wants(index)]
        return tuple(wanted[:: self.every])

    @property
    def live(self) -> bool:
        """True: more frames come."""
        return True

    def recorded(self) -> AbstractSequence:
        """Return the frames that existed when it was opened."""
        return self.whole

    def __iter__(self) -> Iterator[Frame]:
        """Yield each frame when it is complete, until none has come for a while.

        Raises:
            InputError: if the data at the end cannot be read.
        """
        wanted = -1
        for frame in arriving(self.path, self.overrides, self.patience, self.stop):
            if self.kept.stop is not None and frame.index >= self.kept.stop:
                return
            if not self._wants(frame.index):
                continue
            wanted += 1
            if wanted % self.every == 0:
                yield frame

    def until(self, stop: Callable[[], bool]) -> WatchedSequence:
        """Return the sequence that ends when it is asked to."""
        return replace(self, stop=stop)

    def select(self, every: int = 1, frames: slice | None = None) -> WatchedSequence:
        """Return a part of the sequence, of present and future frames.

        Raises:
            InputError: if `every` keeps nothing.
        """
        check_every(every)
        return replace(self, every=self.every * every, kept=self.kept if frames is None else frames)

    @property
    def layout(self) -> str:
        """What the sequence is stored as."""
        return f"{self.whole.layout}, being written"

    def _wants(self, index: int) -> bool:
        low, high = self.kept.start, self.kept.stop
        return (low is None or index >= low) and (high is None or index < high)


def arriving(path: Path, overrides: Overrides, patience: WatchLimits, stop: Callable[[], bool]) -> Iterator[Frame]:
    """Yield frames, each once it is complete, until none has come for a while.

    They ascend, but for a frame that comes, or can be read, only after later ones. What can never be read is reported
    to the log and left out, if there are other frames.

    Raises:
        InputError: if nothing can be read.
    """
    taken: set[int] = set()
    failing: dict[int, float] = {}  # since when a frame cannot be read
    faults: dict[int | None, InputError] = {}
    opened: AbstractSequence | None = None  # as the folder is now
    state: object = None
    came_s = changed_s = time.monotonic()
    while not stop():
        now, before, state = time.monotonic(), state, _state(path)
        rest_s = max(POLL_S, REST * (time.monotonic() - now))
        changed_s = changed_s if state == before else now
        faults = {}
        if state != before or opened is None:
            try:
                opened = open_sequence(path, overrides)
            except InputError as error:  # half-written, perhaps
                faults[None], opened = error, None
        ended = (path / END).exists()
        settled = ended or now - changed_s >= patience.settle_s
        coming = [] if opened is None else [(index, opened) for index in opened.indices if index not in taken]
        for index, sequence in coming if settled else coming[:-1]:
            try:
                frame = sequence.frame(index)
            except InputError as error:
                faults[index] = error
                if not ended and now - failing.setdefault(index, now) < patience.settle_s:
                    break  # it may be being written
                continue
            yield frame
            taken.add(index)
            came_s = time.monotonic()  # which the taker may have spent long with
            if stop():
                return
        if time.monotonic() - max(came_s, changed_s) >= patience.idle_s or (ended and settled):
            for fault in faults.values():
                if not taken:
                    raise fault
                _log.warning("%s: continuing with the frames so far", str(fault).rstrip("."))
            return
        time.sleep(rest_s)


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


def _state(path: Path) -> object:
    """Return what changes when a file in a folder or in one of its folders is made, grows or goes."""
    found: list[tuple[str, int, int]] = []
    waiting = [(str(path), 1)]
    while waiting:
        folder, deeper = waiting.pop()
        with suppress(OSError):  # it went away between two looks
            for entry in os.scandir(folder):
                with suppress(OSError):  # this alone did, or it is a link to nothing
                    status = entry.stat()
                    found.append((entry.path, status.st_mtime_ns, status.st_size))
                    if deeper and entry.is_dir():
                        waiting.append((entry.path, deeper - 1))
    return sorted(found)
