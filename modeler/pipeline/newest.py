"""Frames of a source that is faster than the registration: the newest is tracked, those skipped are filled in later."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TypeVar

from modeler.system.disk_arrays import ViewStore
from modeler.types import Frame

T = TypeVar("T")


@dataclass(eq=False)
class NewestFrames:
    """Reads frames in a thread of its own, yields the newest each time, and keeps the frames skipped (`skipped`).

    A source that is no faster than its consumer is yielded frame by frame. The first frame and the last are never
    skipped. No two frames are farther apart in time than `max_gap_s` because of skipping, so that the motion between
    them stays small: a consumer that is slower still lags behind.
    """

    frames: Iterable[Frame]
    """The source, in order of time but for frames that come late, which are skipped. If it raises, the error follows
    its frames."""
    keep: Callable[[Frame], Frame] = field(default_factory=lambda: ViewStore(memory_bytes=0).keep_frame)
    """Moves the images of a frame that came late out of memory until the end; called by the reading thread."""
    lay_aside: Callable[[Frame], Frame] = field(default_factory=lambda: ViewStore().keep_frame)
    """The same for a frame whose turn has not come: its place on the disk is free again once it was processed."""
    max_gap_s: float = 0.25
    """Longest time between two frames with skipped ones in between: 15° of an object turned at 60° a second."""
    skipped: list[Frame] = field(default_factory=list)
    """The skipped frames so far, in order of time but for those that came late."""

    def __iter__(self) -> Iterator[Frame]:
        """Yield the first frame, and then the newest each time until the source ends.

        Raises:
            Exception: that of the source.
        """
        waiting: deque[Frame] = deque()
        errors: list[BaseException] = []
        state = threading.Condition()
        ended = stopped = False

        def read() -> None:
            nonlocal ended
            newest = -1
            try:
                for frame in self.frames:
                    if stopped:
                        return
                    if frame.index < newest:  # it came late
                        self.skipped.append(self.keep(frame))
                        continue
                    newest, kept = frame.index, self.lay_aside(frame) if waiting else frame
                    with state:
                        waiting.append(kept)
                        state.notify()
            except BaseException as error:  # raised again by the consumer's thread
                errors.append(error)
            finally:
                with state:
                    ended = True
                    state.notify()

        reader = threading.Thread(target=read, name="frames", daemon=True)  # may wait for a camera forever
        reader.start()
        last_s = None
        try:
            while True:
                with state:
                    state.wait_for(lambda: waiting or ended)
                    if not waiting:
                        break
                    frame = waiting.popleft()
                    while waiting and last_s is not None and waiting[0].time_s - last_s <= self.max_gap_s:
                        self.skipped.append(frame)
                        frame = waiting.popleft()
                last_s = frame.time_s
                yield frame
        finally:
            stopped = True
        if errors:
            raise errors[0]


def with_last(items: Iterable[T]) -> Iterator[tuple[T, bool]]:
    """Yield items with whether they are the last, by reading one ahead."""
    remaining = iter(items)
    for item in remaining:
        for following in remaining:
            yield item, False
            item = following
        yield item, True
