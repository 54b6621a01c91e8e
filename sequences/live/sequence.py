"""A camera that is running now."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
import numpy.typing as npt

from modeler.types import Array, Frame, InputError
from sequences.base import AbstractSequence, check_every, span
from sequences.files.images import metres
from sequences.lens import Lens

FIRST = 10
"""So many frames are taken before anything is said of the sequence."""


PATIENCE = 100
"""So often may a camera give the same image."""


class AbstractCamera(ABC):
    """A camera that is running."""

    @property
    @abstractmethod
    def name(self) -> str:
        """What it is called."""

    @property
    @abstractmethod
    def lens(self) -> Lens:
        """The depth camera."""

    @property
    @abstractmethod
    def unit_mm(self) -> float:
        """Millimetres per unit of depth."""

    @abstractmethod
    def take(self) -> tuple[float, npt.NDArray[np.uint16], npt.NDArray[np.uint8] | None]:
        """Return time in s, raw depth (h, w), and colour (h, w, 3) of the depth camera's pixels, of the newest image.

        Raises:
            InputError: where the camera gives none.
        """


@final
@dataclass(frozen=True)
class LiveSequence(AbstractSequence):
    """What a camera sees from now on, an image whenever one is asked for, until it is told to stop."""

    camera: AbstractCamera
    """The running camera."""
    seen: tuple[Frame, ...]
    """What it saw first."""
    every: int = 1
    """Keep the first image and every so many-th after it."""
    kept: slice = field(default_factory=lambda: slice(None, None))
    """Keep these frame numbers."""
    stop: Callable[[], bool] = lambda: False
    """Asked before each image: whether to come to an end."""

    @property
    def name(self) -> str:
        """What the camera is called."""
        return self.camera.name

    @property
    def indices(self) -> tuple[int, ...]:
        """Numbers of the first frames."""
        return tuple(frame.index for frame in self.seen)

    @property
    def live(self) -> bool:
        """True: more frames come."""
        return True

    def recorded(self) -> AbstractSequence:
        """Return the sequence of the first frames alone."""
        return replace(self, stop=lambda: True)

    def frame(self, index: int) -> Frame:
        """Return one of the first frames."""
        for frame in self.seen:
            if frame.index == index:
                return frame
        raise InputError(f"{self.name}: frame {index} is not kept; the first ones are {span(self.indices)}.")

    def __iter__(self) -> Iterator[Frame]:
        """Yield the first frames and then what the camera sees whenever the next is asked for."""
        low, high = self.kept.start or 0, self.kept.stop
        frames = itertools.chain(self.seen, self._coming())
        yield from itertools.islice(frames, low, high, self.every)

    def until(self, stop: Callable[[], bool]) -> LiveSequence:
        """Return the sequence that ends when it is asked to."""
        return replace(self, stop=stop)

    def select(self, every: int = 1, frames: slice | None = None) -> LiveSequence:
        """Return a part of the sequence.

        Raises:
            InputError: where nothing is left.
        """
        check_every(every)
        return replace(self, every=self.every * every, kept=self.kept if frames is None else frames)

    def truth(self) -> dict[int, Array] | None:
        """Return None: a camera does not know."""
        return None

    def sensor(self) -> tuple[float, float] | None:
        """Return None: a camera does not say."""
        return None

    @property
    def motion(self) -> None:
        """None: nothing is known."""
        return None

    @property
    def layout(self) -> str:
        """What the sequence comes from."""
        return "live camera"

    @property
    def depth_unit(self) -> str:
        """What one unit of depth is."""
        return f"{self.camera.unit_mm:g} mm (the camera)"

    def _coming(self) -> Iterator[Frame]:
        last = self.seen[-1]
        while not self.stop():
            last = _next(self.camera, last.index + 1, last.time_s)
            yield last


def begin(camera: AbstractCamera, first: int | None = None) -> LiveSequence:
    """Return what a camera sees from now on."""
    seen: list[Frame] = []
    for number in range(FIRST if first is None else first):
        seen.append(_next(camera, number, seen[-1].time_s if seen else None))
    return LiveSequence(camera, tuple(seen))


def _next(camera: AbstractCamera, number: int, after_s: float | None) -> Frame:
    """Return the first image that is not the one of `after_s` again, as it may come with another colour image."""
    for _ in range(PATIENCE):
        time_s, raw, colour = camera.take()
        if time_s != after_s:
            lens = camera.lens
            depth_m = lens.straight(metres(raw, camera.unit_mm), float("nan"))
            return Frame(number, time_s, depth_m, lens.camera, None, None if colour is None else lens.straight(colour))
    raise InputError(f"{camera.name}: gives the same image again and again; plug it in anew.")
