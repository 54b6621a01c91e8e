"""A structured-light depth camera: what it makes of the true depth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
import numpy.typing as npt

from modeler.types import Array, BoolArray
from sequences.rendering.depth_noise import DisparityNoise, GrazingLoss, LateralJitter, MixedPixels, RandomLoss


@final
@dataclass(frozen=True, eq=False)
class Exposure:
    """What the rays of one image met."""

    depth_m: Array
    """(h, w) distance along the optical axis; NaN where they met nothing."""
    incidence_rad: Array
    """(h, w) angle between the ray and the normal of what it met."""
    shadowed: BoolArray
    """(h, w) True where the projector's light does not reach."""


@final
@dataclass(frozen=True)
class DepthSensor:
    """A camera and a projector side by side. An effect that is null is left out."""

    baseline_m: float = 0.075
    """Distance of the projector from the camera along x, in m; positive to the right."""
    min_range_m: float = 0.4
    """Nearer surfaces are not measured."""
    max_range_m: float = 3.5
    """Farther surfaces are not measured."""
    shadow: bool = True
    """Whether what the projector does not light is lost."""
    jitter: LateralJitter | None = field(default_factory=LateralJitter)
    """Pixels look a little aside."""
    mixed: MixedPixels | None = field(default_factory=MixedPixels)
    """Borders mix."""
    disparity: DisparityNoise | None = field(default_factory=DisparityNoise)
    """Noise and steps of disparity."""
    grazing: GrazingLoss | None = field(default_factory=GrazingLoss)
    """Loss of grazing surfaces."""
    loss: RandomLoss | None = field(default_factory=RandomLoss)
    """Loss anywhere."""

    def __post_init__(self) -> None:
        """Check the sizes."""
        if self.baseline_m == 0.0:
            raise ValueError("baseline_m must not be 0")
        if not 0.0 <= self.min_range_m < self.max_range_m:
            raise ValueError("min_range_m must be at least 0 and less than max_range_m")

    def measure(self, exposure: Exposure, focal_px: float, rng: np.random.Generator) -> npt.NDArray[np.float32]:
        """Draw the measured depth (h, w) in m; NaN = no measurement.

        Every effect draws from a generator of its own, so that leaving one out does not change the others.
        """
        mixed_rng, disparity_rng, grazing_rng, loss_rng = rng.spawn(4)
        depth_m, incidence_rad = exposure.depth_m, exposure.incidence_rad
        shape = (depth_m.shape[0], depth_m.shape[1])
        lost = np.isnan(depth_m)
        if self.shadow:
            lost = lost | exposure.shadowed
        if self.mixed is not None:
            depth_m = self.mixed.apply(depth_m, mixed_rng)
        if self.disparity is not None:
            focal_baseline = focal_px * abs(self.baseline_m)
            depth_m = self.disparity.apply(depth_m, incidence_rad, focal_baseline=focal_baseline, rng=disparity_rng)
        if self.grazing is not None:
            lost = lost | self.grazing.lost(incidence_rad, grazing_rng)
        if self.loss is not None:
            lost = lost | self.loss.lost(shape, loss_rng)
        kept = ~lost & (depth_m >= self.min_range_m) & (depth_m <= self.max_range_m)
        return np.where(kept, depth_m, np.nan).astype(np.float32)

    def sigmas(self, depth_m: float, focal_px: float, depth_unit_m: float) -> tuple[float, float]:
        """Return `(sigma_wh, sigma_r_m)` at a depth; a pixel's own width and the file's unit count as noise too."""
        jitter_px = 0.0 if self.jitter is None else self.jitter.sigma_px
        noise_m = 0.0 if self.disparity is None else self.disparity.sigma_m(depth_m, focal_px * abs(self.baseline_m))
        rounding = 1.0 / np.sqrt(12.0)
        return float(np.hypot(jitter_px, rounding) / focal_px), float(np.hypot(noise_m, depth_unit_m * rounding))


EXACT = DepthSensor(1.0, 0.0, 1e6, False, jitter=None, mixed=None, disparity=None, grazing=None, loss=None)
"""A camera without any of the effects."""
