"""The interface of sequences, and selections of their frames."""

from __future__ import annotations

import itertools
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self

from modeler.types import Array, Frame, InputError, SensorNoise

FIRST: Final = 3  # frames of a live source to wait for before the scene is learned from them


class AbstractSequence(ABC):
    """Frames of one rigid object in order of time; it can be iterated over repeatedly.

    Frame numbers ascend, but need be neither dense nor start at 0. Frames are read when asked for.
    """

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the sequence."""

    @property
    @abstractmethod
    def indices(self) -> tuple[int, ...]:
        """Frame numbers, ascending."""

    @abstractmethod
    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`; InputError if there is no such frame or it cannot be read."""

    def truth(self) -> dict[int, Array] | None:
        """Return the true camera_from_model (4, 4), in m, by frame number; None if it is not known.

        Frames whose truth is not known are left out.

        Raises:
            InputError: if the ground truth cannot be read.
        """
        return None

    def sensor(self) -> SensorNoise | None:
        """Return the noise of its camera; None if unknown."""
        return None

    @property
    def motion(self) -> Mapping[str, Any] | None:
        """Known motion, `{"kind": "turntable", "step_deg": 25, …}`; None if nothing is known."""
        return None

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Input files and folders, which are never written to; none for sequences in memory."""
        return ()

    @property
    def robot_path(self) -> Path | None:
        """Trajectory of the robot hand that holds the object; None if there is none."""
        return None

    @property
    def model_path(self) -> Path | None:
        """The true surface as a mesh in m, in the model frame of `truth()`; None if it is not known."""
        return None

    @property
    def layout(self) -> str:
        """Storage format, for people."""
        return "frames in memory"

    @property
    def depth_unit(self) -> str:
        """Unit of the stored depth and its source, for people."""
        return "m"

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions and omissions of the reader, a sentence each."""
        return ()

    @property
    def live(self) -> bool:
        """Whether more frames arrive than `indices` lists; iterating waits for them."""
        return False

    def recorded(self) -> AbstractSequence:
        """Return the frames that have already arrived, as a sequence that ends."""
        return self

    def until(self, stop: Callable[[], bool]) -> AbstractSequence:
        """Return the sequence, which, if live, ends as soon as `stop()` is true."""
        return self

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(index) for index in self.indices)

    def select(self, every: int = 1, frames: slice | None = None) -> AbstractSequence:
        """Return a part of the sequence.

        Args:
            every: stride over the frames.
            frames: keep frame numbers from `start` up to but not including `stop`.

        Raises:
            InputError: if nothing is left.
        """
        check_every(every)
        start, stop = (None, None) if frames is None else (frames.start, frames.stop)
        kept = tuple(i for i in self.indices if (start is None or i >= start) and (stop is None or i < stop))[::every]
        if not kept:
            wanted = f"{'' if start is None else start}:{'' if stop is None else stop}"
            raise InputError(
                f"`frames` {wanted} leaves nothing of sequence {self.name!r}; its frames are {span(self.indices)}."
            )
        return self if kept == self.indices else SelectedSequence(self, kept)


@dataclass(frozen=True)
class AbstractDerived(AbstractSequence):
    """A view of another sequence; subclasses override the differences."""

    whole: AbstractSequence
    """The underlying sequence."""

    @property
    def name(self) -> str:
        return self.whole.name

    @property
    def indices(self) -> tuple[int, ...]:
        return self.whole.indices

    def frame(self, index: int) -> Frame:
        return self.whole.frame(index)

    def truth(self) -> dict[int, Array] | None:
        return self.whole.truth()

    def sensor(self) -> SensorNoise | None:
        return self.whole.sensor()

    @property
    def motion(self) -> Mapping[str, Any] | None:
        return self.whole.motion

    @property
    def inputs(self) -> tuple[Path, ...]:
        return self.whole.inputs

    @property
    def robot_path(self) -> Path | None:
        return self.whole.robot_path

    @property
    def model_path(self) -> Path | None:
        return self.whole.model_path

    @property
    def layout(self) -> str:
        return self.whole.layout

    @property
    def depth_unit(self) -> str:
        return self.whole.depth_unit

    @property
    def notes(self) -> tuple[str, ...]:
        return self.whole.notes

    @property
    def live(self) -> bool:
        return self.whole.live

    def recorded(self) -> AbstractSequence:
        return replace(self, whole=self.whole.recorded())

    def until(self, stop: Callable[[], bool]) -> AbstractSequence:
        return replace(self, whole=self.whole.until(stop))


@dataclass(frozen=True)
class AbstractLive(AbstractSequence):
    """A sequence to which frames are still added."""

    every: int = field(default=1, kw_only=True)
    """Stride over the frames."""
    kept: slice = field(default_factory=lambda: slice(None, None), kw_only=True)
    """Keep these frame numbers."""
    stop: Callable[[], bool] = field(default=lambda: False, kw_only=True)
    """Polled while waiting; true ends the sequence."""

    @property
    def live(self) -> bool:
        return True

    def until(self, stop: Callable[[], bool]) -> Self:
        return replace(self, stop=stop)

    def select(self, every: int = 1, frames: slice | None = None) -> Self:
        """Return a part of the sequence, of present and future frames.

        Raises:
            InputError: if `every` keeps nothing.
        """
        check_every(every)
        return replace(self, every=self.every * every, kept=self.kept if frames is None else frames)


@dataclass(frozen=True)
class SelectedSequence(AbstractDerived):
    """Some frames of another sequence."""

    kept: tuple[int, ...]
    """Numbers of the frames to keep, ascending."""

    @property
    def indices(self) -> tuple[int, ...]:
        return self.kept

    def frame(self, index: int) -> Frame:
        if index not in self.kept:
            raise InputError(
                f"frame {index} is not among the selected frames ({span(self.kept)}); ask for one of those."
            )
        return self.whole.frame(index)

    def truth(self) -> dict[int, Array] | None:
        truth = self.whole.truth()
        return None if truth is None else {index: truth[index] for index in self.kept if index in truth} or None


@dataclass(frozen=True, eq=False)
class GivenSequence(AbstractSequence):
    """Frames that a program gives: those that it has given, and, from a live source, those to come."""

    given: tuple[Frame, ...]
    """In order of time."""
    coming: Iterator[Frame] | None = None
    """Yields the rest, once; None: there is none."""

    @classmethod
    def of(cls, frames: Iterable[Frame], *, live: bool) -> GivenSequence:
        """Return the sequence of an iterable.

        Args:
            frames: in order of time.
            live: take only the first frames, from which the scene is learned, and each other one when it is asked for.

        Raises:
            InputError: if there is none, one is no frame, or their numbers do not ascend.
        """
        coming = _checked(frames)
        given = tuple(itertools.islice(coming, FIRST if live else None))
        if not given:
            raise InputError("there is no frame; give at least one")
        return cls(given, coming if live else None)

    @property
    def name(self) -> str:
        return "frames"

    @property
    def indices(self) -> tuple[int, ...]:
        return tuple(frame.index for frame in self.given)

    @property
    def live(self) -> bool:
        return self.coming is not None

    def frame(self, index: int) -> Frame:
        for frame in self.given:
            if frame.index == index:
                return frame
        raise InputError(f"frame {index} is not kept; there are {span(self.indices)}.")

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames that were given and then, once, those to come."""
        return itertools.chain(self.given, self.coming or ())


def _checked(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield frames of ascending numbers."""
    last = None
    for frame in frames:
        if not isinstance(frame, Frame):
            kind = type(frame).__name__
            raise InputError(f"the sequence yields a {kind} where a frame is wanted; make it with modeler.Frame.of")
        if last is not None and frame.index <= last:
            raise InputError(f"frame {frame.index} comes after frame {last}; number frames in order of time")
        last = frame.index
        yield frame


@dataclass(frozen=True)
class KeptSequence(AbstractDerived):
    """Another sequence, of which frames stay in memory once they were read: to decode them takes milliseconds each.

    The first do, until they fill `memory_bytes`; the rest are read whenever they are asked for.
    """

    memory_bytes: int = 64 * 2**20
    """Of frames that stay: those that a run keeps in memory as well, so that it takes little more."""
    kept: dict[int, Frame] = field(default_factory=dict, init=False, repr=False, compare=False)
    """By frame number."""

    def frame(self, index: int) -> Frame:
        found = self.kept.get(index)
        if found is None:
            found = self.whole.frame(index)
            if sum(map(_size_bytes, self.kept.values())) + _size_bytes(found) <= self.memory_bytes:
                self.kept[index] = found
        return found

    def until(self, stop: Callable[[], bool]) -> AbstractSequence:
        """Return itself, with the frames that stay in memory: it is never live."""
        return self


def _size_bytes(frame: Frame) -> int:
    """Return the memory that a frame's images take."""
    images = (frame.depth_m, frame.mask, frame.colour, frame.occluder)
    return sum(image.nbytes for image in images if image is not None)


def check_every(every: int) -> None:
    """Check a stride."""
    if every < 1:
        raise InputError(f"`every` {every} keeps no frame; give a whole number of at least 1.")


def frame_range(text: str) -> slice:
    """Read a range of frame numbers `A:B`, half-open; either end may be left out.

    Raises:
        InputError: if the text is no such range.
    """
    match = re.fullmatch(r"([0-9]{0,18}):([0-9]{0,18})", text.strip())
    if match is None:
        raise InputError(f"`frames` {text[:99]!r} is not a range of frame numbers; write A:B, for instance 0:14.")
    start, stop = (int(end) if end else None for end in match.groups())
    return slice(start, stop)


def span(indices: tuple[int, ...]) -> str:
    """Return a range of frame numbers as text."""
    count = f"{len(indices)} frame" + ("" if len(indices) == 1 else "s")
    return f"{indices[0]} to {indices[-1]}, {count}" if indices else "none"
