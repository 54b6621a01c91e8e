"""Sequences as commands read them: with a progress bar, from a camera, or while they are still being written."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from modeler.cli.console import bar, say
from modeler.cli.options import FrameOptions, InputOptions, WatchOptions
from modeler.sequences import (
    AbstractSequence,
    KeptSequence,
    Survey,
    WatchLimits,
    frame_range,
    open_sequence,
    survey,
    watch,
)
from modeler.sequences.base import AbstractDerived
from modeler.types import Frame, InputError


@dataclass(frozen=True)
class ObservedSequence(AbstractDerived):
    """Another sequence, with a callback after each frame that is read."""

    on_read: Callable[[], None]
    """Called after each frame."""

    def frame(self, index: int) -> Frame:
        frame = self.whole.frame(index)
        self.on_read()
        return frame


def while_it_lasts(camera: AbstractSequence) -> Iterator[Frame]:
    """Yield the frames of a camera; a failure ends them with a line on stderr, as they cannot be read again."""
    try:
        yield from camera
    except InputError as error:
        say(f"{str(error).rstrip('.')}: continuing with the frames so far")


@contextmanager
def reading() -> Iterator[Callable[..., AbstractSequence]]:
    """Yield what gives a sequence a progress bar on stderr as its frames are read; hidden if that is no terminal.

    It takes the sequence, and what is done with its frames in words. One that is still being written is unchanged.
    """
    with bar() as progress:

        def watched(sequence: AbstractSequence, what: str = "") -> AbstractSequence:
            if sequence.live:
                return sequence
            task = progress.add_task(what, total=len(sequence))
            return ObservedSequence(sequence, lambda: progress.advance(task))

        yield watched


def opened(path: Path, given: InputOptions, watching: WatchOptions) -> AbstractSequence:
    """Return a sequence, its first frames kept in memory; one that another program is writing, once it has begun."""
    if not watching.watch:
        whole = open_sequence(path, given.overrides())
        return whole if whole.live else KeptSequence(whole)
    if not 0.0 < watching.idle_s < math.inf:
        raise InputError(f"--idle-s {watching.idle_s:g} is out of range; give a positive number of seconds")
    say(f"waiting for frames in {path}")
    return watch(path, given.overrides(), WatchLimits(watching.idle_s))


def selected(
    whole: AbstractSequence, selection: FrameOptions, given: InputOptions
) -> tuple[AbstractSequence, Survey | None]:
    """Return the selected frames, and what is found in them if they are not live: doubts are said, errors refused."""
    frames = whole.select(every=selection.every, frames=frame_range(selection.frames))
    if frames.live:
        return frames, None
    found = survey(frames, truth=False)
    found.check(frames.name, despite_doubts=given.despite_doubts)
    for doubt in found.doubts:
        say(doubt)
    return frames, found
