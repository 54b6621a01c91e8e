"""How far two depth readings of one surface may lie apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
import numpy.typing as npt


@final
@dataclass(frozen=True)
class DepthNoise:
    """Depth noise of a consumer camera: a floor, and a part that grows with the square of the depth.

    The default quadratic part is that of the first Kinect (Khoshelham and Elberink, Sensors 2012, eq. 10).
    """

    floor_m: float = 0.0008
    """Standard deviation at close range in m: quantisation and texture."""
    quadratic_per_m: float = 0.0014
    """Growth of the standard deviation with depth squared in m per m²."""

    def sigma_m(self, depth_m: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the standard deviation of readings at `depth_m`, of the same shape and type."""
        return np.sqrt(self.floor_m**2 + (self.quadratic_per_m * depth_m * depth_m) ** 2)

    def tolerance_m(self, depth_m: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the difference beyond which two readings at `depth_m` are two surfaces: 3 sigma and a floor more."""
        return 3.0 * self.sigma_m(depth_m) + self.floor_m

    def times(self, factor: float) -> DepthNoise:
        """Return the noise of a camera so many times as noisy."""
        return DepthNoise(factor * self.floor_m, factor * self.quadratic_per_m)
