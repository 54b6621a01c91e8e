"""Sequences of a camera whose noise was measured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

from modeler.types import Frame
from sequences.base import AbstractDerived
from sequences.noise.model import NoiseModel, object_distance_m


@final
@dataclass(frozen=True)
class SensedSequence(AbstractDerived):
    """Another sequence, of a camera with this noise."""

    noise: NoiseModel
    """The camera's noise."""

    def sensor(self) -> tuple[float, float]:
        """Return the noise `(sigma_wh, sigma_r_m)` at the distance of the object in the first frame."""
        return self._at_object

    def select(self, every: int = 1, frames: slice | None = None) -> SensedSequence:
        """Return a part of the sequence."""
        return replace(self, whole=self.whole.select(every, frames))

    def __iter__(self) -> Iterator[Frame]:
        """Read the frames in order."""
        return iter(self.whole)

    @cached_property
    def _at_object(self) -> tuple[float, float]:
        return self.noise.at(object_distance_m(self.whole.frame(self.whole.indices[0])))
