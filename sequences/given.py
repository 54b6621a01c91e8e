"""What a person says of an input that does not say it itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modeler.types import InputError

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy in px."""


@dataclass(frozen=True)
class Given:
    """Facts that take precedence over what the reader would find or assume."""

    intrinsics: Intrinsics | None = None
    """fx, fy, cx, cy of the depth camera in px."""
    depth_scale_mm: float | None = None
    """Millimetres per unit of stored depth."""
    depth_topic: str | None = None
    """Topic of the depth images in a ROS bag."""
    colour_topic: str | None = None
    """Topic of the colour images in a ROS bag."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InputError: where they cannot be.
        """
        if self.intrinsics is not None and not sane(self.intrinsics):
            shown = " ".join(f"{value:g}" for value in self.intrinsics)
            raise InputError(
                f"--intrinsics {shown} are those of no camera; give FX FY CX CY in px, FX and FY at least 1."
            )
        if self.depth_scale_mm is not None and not 1e-6 <= self.depth_scale_mm <= 1e3:
            raise InputError(
                f"--depth-scale-mm {self.depth_scale_mm:g} is out of range; give the millimetres in one unit of depth."
            )


def sane(intrinsics: Intrinsics) -> bool:
    """Return whether numbers can be the intrinsics of a camera."""
    fx, fy, cx, cy = intrinsics
    finite = all(math.isfinite(value) for value in intrinsics)
    return finite and min(fx, fy) >= 1.0 and max(fx, fy, abs(cx), abs(cy)) <= 1e6
