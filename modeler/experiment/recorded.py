"""What an experiment needs of a sequence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from modeler.types import Array, Frame


class Recorded(Protocol):
    """Frames, and what is known of them; the readers of sequences have it."""

    @property
    def name(self) -> str:
        """What the sequence is called."""
        ...

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers, ascending."""
        ...

    def frame(self, index: int) -> Frame:
        """Return a frame by its number."""
        ...

    def truth(self) -> Mapping[int, Array] | None:
        """Return the true camera_from_model (4, 4) by frame number, where it is known."""
        ...

    def sensor(self) -> tuple[float, float] | None:
        """Return the sensor's noise `(sigma_wh, sigma_r_m)`, where it is known."""
        ...
