"""Depth cameras: what each kind makes of true depth. They share nothing with the renderer of `modeler render`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from scipy import ndimage

from modeler.types import Array, BoolArray

Rng = np.random.Generator


@final
@dataclass(frozen=True, eq=False)
class Seen:
    """What is before the camera, without errors."""

    depth_m: Array
    """(h, w) along the optical axis; NaN where there is nothing."""
    within_m: Array
    """(h, w, 4) at four places within each pixel."""
    facing: Array
    """(h, w) cosine of the incidence; 0 where there is nothing."""
    shadowed: Callable[[float], BoolArray]
    """Returns (h, w) what cannot be seen from a place beside the camera, its distance to the right given in m."""


@final
@dataclass(frozen=True)
class Lens:
    """What a camera's errors are made of."""

    focal_px: float
    """True focal length."""
    distance_m: float
    """At which the noise is stated."""
    noise_m: float
    """Standard deviation of depth there, on a surface that faces the camera."""
    bias: float
    """Standard deviation of the smooth error, in standard deviations of the noise."""


def structured_light(seen: Seen, lens: Lens, fixed: Rng, rng: Rng) -> Array:
    """Return depth (h, w) by disparities, quantised, with shadows of the projector and torn outlines."""
    sigma_px = 0.07 * seen.depth_m.shape[1] / 640.0
    focal_baseline = lens.distance_m**2 * sigma_px / lens.noise_m
    disparity_px = focal_baseline / _torn(seen.depth_m, rng)
    noise_px = sigma_px * (_slope(seen, 0.3) * _smooth(rng, seen, 0.7) + lens.bias * _smooth(fixed, seen, 25.0))
    quantum_px = 0.125 * seen.depth_m.shape[1] / 640.0
    depth_m = focal_baseline / (quantum_px * np.rint((disparity_px + noise_px) / quantum_px))
    lost = seen.shadowed(focal_baseline / lens.focal_px) | _grazing(seen, 72.0, rng) | _holes(seen, 0.003, rng)
    return np.where(lost, np.nan, depth_m)


def stereo(seen: Seen, lens: Lens, fixed: Rng, rng: Rng) -> Array:
    """Return depth (h, w) by matched blocks: smooth noise, outlines a pixel too wide, holes beside them."""
    sigma_px = 0.08 * seen.depth_m.shape[1] / 640.0
    focal_baseline = lens.distance_m**2 * sigma_px / lens.noise_m
    disparity_px = focal_baseline / seen.depth_m
    wide_px = ndimage.maximum_filter(np.nan_to_num(disparity_px), 3)
    jump = wide_px - np.nan_to_num(disparity_px) > 0.04 * wide_px
    disparity_px = np.where(jump & (_smooth(rng, seen, 1.5) > -0.5), wide_px, disparity_px)
    noise_px = sigma_px * (_slope(seen, 0.5) * _smooth(rng, seen, 1.5) + lens.bias * _smooth(fixed, seen, 25.0))
    disparity_px = np.rint(32.0 * (disparity_px + noise_px)) / 32.0
    lost = seen.shadowed(focal_baseline / lens.focal_px) | _grazing(seen, 75.0, rng) | _holes(seen, 0.01, rng)
    return focal_baseline / np.where(lost | (disparity_px <= 0.0), np.nan, disparity_px)


def time_of_flight(seen: Seen, lens: Lens, fixed: Rng, rng: Rng) -> Array:
    """Return depth (h, w) by phases: pixels on outlines mix what they see, noise grows where little light returns."""
    returned = np.nan_to_num(1.0 / seen.within_m**2)
    total = returned.sum(axis=2)
    mixed_m = (returned * np.nan_to_num(seen.within_m)).sum(axis=2) / np.where(total > 0.0, total, np.nan)
    amplitude = np.maximum(seen.facing, 0.15) * (lens.distance_m / mixed_m) ** 2
    # Wiggling: harmonics of the modulation that the phase is not corrected for (Foix et al. 2011).
    wiggle = np.sin(2.0 * np.pi * mixed_m / (0.35 * lens.distance_m) + fixed.uniform(0.0, 2.0 * np.pi))
    smooth = 0.7 * lens.bias * (_smooth(fixed, seen, 25.0) + wiggle)
    depth_m = mixed_m + lens.noise_m * (rng.normal(size=mixed_m.shape) / amplitude + smooth)
    return np.where(_holes(seen, 0.002, rng) | (amplitude < 0.04), np.nan, depth_m)


def laser(seen: Seen, lens: Lens, fixed: Rng, rng: Rng) -> Array:
    """Return depth (h, w) of a scanner: little noise, nothing at grazing incidence or in the shadow of its line."""
    noise_m = lens.noise_m * (seen.depth_m / lens.distance_m) ** 2
    depth_m = seen.depth_m + noise_m * (rng.normal(size=noise_m.shape) + lens.bias * _smooth(fixed, seen, 25.0))
    lost = seen.shadowed(0.2 * lens.distance_m) | _grazing(seen, 75.0, rng)
    return np.where(lost, np.nan, depth_m)


KINDS: Final = {
    "structured light": structured_light,
    "stereo": stereo,
    "time of flight": time_of_flight,
    "laser": laser,
}
"""By name. The first generator draws what stays from frame to frame."""


def _smooth(rng: Rng, seen: Seen, sigma_px: float) -> Array:
    """Draw a field (h, w) of standard deviation 1."""
    field = ndimage.gaussian_filter(rng.normal(size=seen.depth_m.shape), sigma_px, mode="wrap")
    return field / field.std()


def _slope(seen: Seen, gain: float) -> Array:
    """Return by how much noise grows with incidence (h, w)."""
    return 1.0 + gain * np.minimum(1.0 / np.maximum(seen.facing, 0.1) ** 2 - 1.0, 20.0)


def _grazing(seen: Seen, from_deg: float, rng: Rng) -> BoolArray:
    """Draw what is lost (h, w): from an angle of incidence on, patch by patch."""
    incidence_deg = np.degrees(np.arccos(np.clip(seen.facing, 0.0, 1.0)))
    return incidence_deg + 3.0 * _smooth(rng, seen, 1.0) > from_deg


def _holes(seen: Seen, share: float, rng: Rng) -> BoolArray:
    """Draw holes (h, w) of a few pixels each."""
    field = _smooth(rng, seen, 1.2)
    return field > np.quantile(field, 1.0 - share)


def _torn(depth_m: Array, rng: Rng) -> Array:
    """Return depth (h, w) taken from up to a pixel or two beside, as matched patterns do along outlines."""
    rows, columns = np.indices(depth_m.shape)
    beside = [
        np.clip(place + np.rint(rng.normal(0.0, 0.45, depth_m.shape)).astype(int), 0, size - 1)
        for place, size in zip((rows, columns), depth_m.shape, strict=True)
    ]
    there = depth_m[beside[0], beside[1]]
    edge = ~(np.abs(there - depth_m) < 0.02 * depth_m)  # elsewhere neighbours are the same surface: no noise of slopes
    return np.where(edge, there, depth_m)
