"""A structured-light depth camera and its errors, effect by effect.

The defaults are those of the first Kinect (Khoshelham & Oude Elberink 2012; Nguyen, Izadi & Lovell 2012): about 1.2 mm
of noise along the ray at 0.8 m, growing with the square of the range.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, gaussian_filter1d, maximum_filter, minimum_filter
from scipy.special import ndtr

from modeler.types import Array, BoolArray


@dataclass(frozen=True)
class LateralJitter:
    """Correlated lateral jitter of the pixels' rays."""

    sigma_px: float = 0.4
    """Standard deviation along rows and columns."""
    correlation_px: float = 1.5
    """Width of the smoothing that neighbours share."""

    def __post_init__(self) -> None:
        _not_negative(sigma_px=self.sigma_px, correlation_px=self.correlation_px)

    def offsets_px(self, shape: tuple[int, int], rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw the lateral offsets of the pixels in px, along columns and rows, each (h, w)."""
        along_w, along_h = (self.sigma_px * gaussian_field(shape, self.correlation_px, rng) for _ in range(2))
        return along_w, along_h


@dataclass(frozen=True)
class DisparityNoise:
    """Noise and quantisation of the disparity."""

    sigma_px: float = 0.07
    """Standard deviation of the disparity of a surface that faces the camera."""
    quantum_px: float = 0.125
    """Step of the disparity; 0 for none."""
    correlation_px: float = 1.0
    """Width of the smoothing that neighbours share; 0 for independent pixels."""
    slope_gain: float = 0.075
    """How fast noise grows on slopes: times 1 + gain·θ²/(π/2 - θ)² at incidence θ."""

    def __post_init__(self) -> None:
        _not_negative(sigma_px=self.sigma_px, quantum_px=self.quantum_px, correlation_px=self.correlation_px)
        _not_negative(slope_gain=self.slope_gain)

    def apply(self, depth_m: Array, incidence_rad: Array, *, focal_baseline: float, rng: np.random.Generator) -> Array:
        """Return noisy depth (h, w); `focal_baseline` is disparity in px times depth in m."""
        slope = np.minimum(incidence_rad, np.radians(85.0))
        gain = 1.0 + self.slope_gain * (slope / (np.pi / 2.0 - slope)) ** 2
        noise_px = self.sigma_px * gain * gaussian_field((depth_m.shape[0], depth_m.shape[1]), self.correlation_px, rng)
        disparity_px = focal_baseline / depth_m + noise_px
        if self.quantum_px > 0.0:
            disparity_px = self.quantum_px * np.rint(disparity_px / self.quantum_px)
        return focal_baseline / np.where(disparity_px > 0.0, disparity_px, np.nan)

    def sigma_m(self, depth_m: float, focal_baseline: float) -> float:
        """Return the standard deviation of depth in m on a surface that faces the camera."""
        return float(depth_m**2 / focal_baseline * np.hypot(self.sigma_px, self.quantum_px / np.sqrt(12.0)))


@dataclass(frozen=True)
class GrazingLoss:
    """Drop-out at grazing incidence, in patches."""

    start_deg: float = 70.0
    """Incidence from which on pixels are lost."""
    end_deg: float = 88.0
    """Incidence at which all are lost."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.start_deg < self.end_deg:
            raise ValueError("start_deg must be at least 0 and less than end_deg")

    def lost(self, incidence_rad: Array, rng: np.random.Generator) -> BoolArray:
        """Draw which pixels (h, w) are lost."""
        share = (np.degrees(incidence_rad) - self.start_deg) / (self.end_deg - self.start_deg)
        return _uniform((share.shape[0], share.shape[1]), 1.0, rng) < share


@dataclass(frozen=True)
class MixedPixels:
    """Mixed pixels: at depth discontinuities a pixel may measure a depth between the two surfaces."""

    probability: float = 0.05
    """Share of border pixels that do."""
    min_jump_m: float = 0.02
    """Least difference of depth that makes a border."""

    def __post_init__(self) -> None:
        _share(probability=self.probability)
        _not_negative(min_jump_m=self.min_jump_m)

    def apply(self, depth_m: Array, rng: np.random.Generator) -> Array:
        """Return depth (h, w) with borders mixed."""
        near = minimum_filter(np.where(np.isnan(depth_m), np.inf, depth_m), size=3)
        far = maximum_filter(np.where(np.isnan(depth_m), -np.inf, depth_m), size=3)
        chosen, blend = rng.random(depth_m.shape) < self.probability, rng.random(depth_m.shape)
        mixed = chosen & np.isfinite(depth_m) & (far - near > self.min_jump_m)
        return np.where(mixed, near + blend * np.where(mixed, far - near, 0.0), depth_m)


@dataclass(frozen=True)
class RandomLoss:
    """Drop-out of small patches anywhere."""

    probability: float = 0.002
    """Share of pixels that are lost."""
    correlation_px: float = 1.0
    """Width of the patches."""

    def __post_init__(self) -> None:
        _share(probability=self.probability)
        _not_negative(correlation_px=self.correlation_px)

    def lost(self, shape: tuple[int, int], rng: np.random.Generator) -> BoolArray:
        """Draw which pixels (h, w) are lost."""
        return _uniform(shape, self.correlation_px, rng) < self.probability


def gaussian_field(shape: tuple[int, int], correlation_px: float, rng: np.random.Generator) -> Array:
    """Draw a Gaussian field (h, w) of mean 0 and variance 1 that is smooth over `correlation_px`."""
    white = rng.normal(size=shape)
    if correlation_px == 0.0:
        return white
    impulse = np.zeros(2 * int(4.0 * correlation_px + 1.0) + 1)
    impulse[len(impulse) // 2] = 1.0
    kernel = gaussian_filter1d(impulse, correlation_px, mode="constant")
    return gaussian_filter(white, correlation_px, mode="wrap") / np.sum(kernel**2)


def _uniform(shape: tuple[int, int], correlation_px: float, rng: np.random.Generator) -> Array:
    """Draw a field (h, w) uniform on 0..1 that is smooth over `correlation_px`."""
    return ndtr(gaussian_field(shape, correlation_px, rng))


def _not_negative(**values: float) -> None:
    for name, value in values.items():
        if value < 0.0:
            raise ValueError(f"{name} must not be negative")


def _share(**values: float) -> None:
    for name, value in values.items():
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"{name} must be from 0 to 1")


@dataclass(frozen=True, eq=False)
class Exposure:
    """Ray hits of one image."""

    depth_m: Array
    """(h, w) distance along the optical axis; NaN where they met nothing."""
    incidence_rad: Array
    """(h, w) angle between the ray and the normal of the hit surface."""
    shadowed: BoolArray
    """(h, w) True where the projector's light does not reach."""


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
    """Whether surface not lit by the projector is lost."""
    jitter: LateralJitter | None = field(default_factory=LateralJitter)
    mixed: MixedPixels | None = field(default_factory=MixedPixels)
    disparity: DisparityNoise | None = field(default_factory=DisparityNoise)
    grazing: GrazingLoss | None = field(default_factory=GrazingLoss)
    loss: RandomLoss | None = field(default_factory=RandomLoss)

    def __post_init__(self) -> None:
        if self.baseline_m == 0.0:
            raise ValueError("baseline_m must not be 0")
        if not 0.0 <= self.min_range_m < self.max_range_m:
            raise ValueError("min_range_m must be at least 0 and less than max_range_m")

    def measure(self, exposure: Exposure, focal_px: float, rng: np.random.Generator) -> npt.NDArray[np.float32]:
        """Draw the measured depth (h, w) in m; NaN = no measurement.

        Every effect has its own random generator, so that leaving one out does not change the others.
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
