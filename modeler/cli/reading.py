"""A bar for work that goes through the frames of a sequence, wherever that happens."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, final

from modeler.cli.console import bar
from modeler.cli.saying import say
from modeler.types import Frame, InputError
from sequences import AbstractSequence
from sequences.base import AbstractDerived


@final
@dataclass(frozen=True)
class ToldSequence(AbstractDerived):
    """Another sequence that tells of every frame it is asked for."""

    told: Callable[[], None]
    """Called after each frame."""

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`."""
        frame = self.whole.frame(index)
        self.told()
        return frame


class Watched(Protocol):
    """From a sequence to the same sequence, watched."""

    def __call__(self, sequence: AbstractSequence, what: str = "", /) -> AbstractSequence:
        """Add a bar for a sequence, with what is done with its frames in a word."""
        ...


def while_it_lasts(camera: AbstractSequence) -> Iterator[Frame]:
    """Yield the frames of a camera; one that fails ends them with a line on stderr, for they cannot be had again."""
    try:
        yield from camera
    except InputError as error:
        say(f"{str(error).rstrip('.')}: going on with the frames so far")


@contextmanager
def reading() -> Iterator[Watched]:
    """Show a bar on stderr for each sequence handed in, as its frames are taken; nothing where that is no terminal.

    A sequence that is still being written is left alone.
    """
    with bar() as progress:

        def watched(sequence: AbstractSequence, what: str = "", /) -> AbstractSequence:
            if sequence.live:
                return sequence
            task = progress.add_task(what, total=len(sequence))
            return ToldSequence(sequence, lambda: progress.advance(task))

        yield watched
