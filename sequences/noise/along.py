"""Noise along the ray, from smooth surfaces in a scene that stands still."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.ndimage import binary_dilation, correlate
from scipy.optimize import nnls

from modeler.types import Array, BoolArray, Camera
from sequences.noise.model import slope_terms

HALF = 3
"""Surfaces are compared with a quadric over so many pixels to either side."""
MAX_BEND = 0.05
"""Where neighbours differ by more than this share of the depth, there is no surface."""
DISTANCE_STEP = 1.15
"""Ratio of the ends of a class of distances."""
ANGLE_STEP_RAD = np.radians(10.0)
"""Width of a class of angles."""
MIN_PIXELS = 200
"""Classes with fewer pixels say nothing."""
STEEPEST_RAD = np.radians(80.0)
"""Steeper surfaces are not measured: the quadric spans too much of them."""


@final
@dataclass(frozen=True)
class Class:
    """Pixels of about one distance and angle."""

    distance_m: float
    """Mean distance."""
    angle_rad: float
    """Mean angle between ray and normal."""
    variance_m2: float
    """Variance along the ray."""
    pixels: int
    """How many."""


def classes(depth_m: Array, middle_m: Array, camera: Camera, lateral_px: float) -> list[Class]:
    """Measure noise along the ray by distance and angle.

    Over time, and about a quadric through the neighbours of the mean image in inverse depth, in which planes are
    linear. What slopes make of noise across the ray is taken off: it is counted there.

    Args:
        depth_m: (n, h, w), NaN where nothing was measured.
        middle_m: (h, w), their median.
        camera: the camera.
        lateral_px: noise across the ray.
    """
    count = depth_m.shape[0]
    whole = np.isfinite(depth_m).all(axis=0) & ~_rough(middle_m)
    filled = np.where(whole, depth_m, 1.0)
    inverse, variance = (1.0 / filled).mean(axis=0), filled.var(axis=0, ddof=1)
    smooth, slope_x, slope_y, residual_gain = _quadric()
    fits = correlate(whole.astype(np.float64), np.ones_like(smooth), mode="constant") > smooth.size - 0.5
    value = correlate(inverse, smooth, mode="nearest")
    across, down = correlate(inverse, slope_x, mode="nearest"), correlate(inverse, slope_y, mode="nearest")
    rays = camera.rays()
    length = np.sqrt(rays[0] ** 2 + rays[1] ** 2 + 1.0)
    normal_z = value - across * rays[0] * camera.fx - down * rays[1] * camera.fy
    norm = np.sqrt((across * camera.fx) ** 2 + (down * camera.fy) ** 2 + normal_z**2)
    cosine = np.clip(value / (norm * length), 0.0, 1.0)
    z4 = middle_m**4
    stays = z4 * (inverse - value) ** 2 / residual_gain - variance / count
    moved_px2 = max(lateral_px**2 - 1.0 / 12.0, 0.0)  # rounding to pixels does not change from frame to frame
    sideways = moved_px2 * z4 * (across**2 + down**2)
    total = (variance - sideways) * length**2, stays * length**2
    return _pooled(middle_m[fits], np.arccos(cosine[fits]), total[0][fits], total[1][fits])


def fitted(found: list[Class]) -> tuple[float, tuple[float, float, float]]:
    """Return floor_m and growth of the model nearest to the classes, relative errors counted."""
    distance, angle = np.array([one.distance_m for one in found]), np.array([one.angle_rad for one in found])
    variance = np.array([one.variance_m2 for one in found])
    weight = np.sqrt([float(one.pixels) for one in found]) / variance
    terms = slope_terms(distance, angle)
    scale = np.abs(terms * weight[:, None]).max(axis=0)
    solved, _ = nnls(terms * weight[:, None] / scale, variance * weight)
    floor, c0, c1, c2 = (float(value) for value in solved / scale)
    return float(np.sqrt(floor)), (c0, c1, c2)


def moving_share(depth_m: Array, middle_m: Array) -> float:
    """Return the share (0..1) of the pixels away from borders whose depth changes by more than noise does."""
    calm = np.isfinite(depth_m).all(axis=0) & ~_rough(middle_m)
    spread = np.ptp(depth_m[:, calm], axis=0) / middle_m[calm] ** 2 if calm.any() else np.zeros(0)
    if not spread.size:
        return 1.0
    return float(np.mean(spread > 10.0 * np.median(spread) + 0.01))


def _rough(middle_m: Array) -> BoolArray:
    """Return which pixels (h, w) are near a border."""
    with np.errstate(invalid="ignore"):
        down = np.abs(np.diff(middle_m, axis=0, append=middle_m[-1:])) > MAX_BEND * middle_m
        across = np.abs(np.diff(middle_m, axis=1, append=middle_m[:, -1:])) > MAX_BEND * middle_m
    return np.asarray(binary_dilation(down | across | ~np.isfinite(middle_m), iterations=2), dtype=np.bool_)


def _quadric() -> tuple[Array, Array, Array, float]:
    """Return weights (7, 7) for value and slopes of a quadric fit, and what it leaves of a pixel's own variance."""
    y, x = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].astype(np.float64)
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    solver = np.linalg.pinv(design).reshape(6, *x.shape)
    return solver[0], solver[1], solver[2], float(1.0 - solver[0][HALF, HALF])


def _pooled(distance_m: Array, angle_rad: Array, varies: Array, stays: Array) -> list[Class]:
    """Return the mean variance of each class; the wildest pixels of a class, which are no noise, are left out."""
    near = np.floor(np.log(distance_m) / np.log(DISTANCE_STEP)).astype(np.int64)
    tilt = np.floor(angle_rad / ANGLE_STEP_RAD).astype(np.int64)
    found = []
    for key in np.unique(np.stack([near, tilt], axis=1), axis=0):
        inside = (near == key[0]) & (tilt == key[1]) & (angle_rad < STEEPEST_RAD)
        if np.count_nonzero(inside) < MIN_PIXELS:
            continue
        variance = _calm_mean(varies[inside]) + max(_calm_mean(stays[inside]), 0.0)
        if variance > 0.0:
            middle = float(distance_m[inside].mean()), float(angle_rad[inside].mean())
            found.append(Class(*middle, variance, int(np.count_nonzero(inside))))
    return found


def _calm_mean(values: Array) -> float:
    limit = 16.0 * max(float(np.mean(np.sort(values)[: int(0.9 * values.size)])), 1e-12)
    return float(values[values < limit].mean())
