"""Ctrl-C as a request to come to an end."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterable, Iterator
from types import FrameType, TracebackType
from typing import TypeVar

from modeler.cli.saying import say

T = TypeVar("T")

TERMINATED = 128 + signal.SIGTERM
"""Exit status after SIGTERM, as shells have it."""


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Let a request to terminate end the program as an error would, so that it puts in order what it leaves."""
    before = signal.signal(signal.SIGTERM, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(TERMINATED)


class Interrupt:
    """While it is entered, the first Ctrl-C ends the iteration `until`, the second the program."""

    def __init__(self) -> None:
        self.ended_early = False
        """Whether there were more items."""
        self._asked = False
        self._before = signal.getsignal(signal.SIGINT)

    def __enter__(self) -> Interrupt:
        """Listen to Ctrl-C."""
        self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Hand Ctrl-C back."""
        signal.signal(signal.SIGINT, self._before)

    @property
    def asked(self) -> bool:
        """Whether Ctrl-C was pressed."""
        return self._asked

    def until(self, items: Iterable[T]) -> Iterator[T]:
        """Yield items until Ctrl-C."""
        for item in items:
            if self._asked:
                self.ended_early = True
                return
            yield item

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        say("finishing with the frames so far; Ctrl-C again stops at once")
