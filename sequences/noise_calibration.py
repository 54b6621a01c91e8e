"""The noise of a depth camera from a few frames of a static scene (the L of the paper)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, correlate
from scipy.optimize import nnls
from scipy.signal import savgol_coeffs

from modeler.sequences.base import AbstractSequence
from modeler.sequences.calibrated import NoiseModel, slope_terms
from modeler.types import Array, BoolArray, Camera, InputError

REACH = 4  # pixels on either side of a border that must belong to the near and to the far thing
MIN_JUMP = 0.03  # least step of depth at a border, as a share of the depth
STEEPEST = 1.5
"""Columns a row; steeper borders are measured along the other axis alone, those about the diagonal along both."""
WINDOW = 9  # rows over which a border is compared with a smooth curve


@dataclass(frozen=True)
class DepthEdge:
    """A depth discontinuity across a number of rows (or columns)."""

    variance_px2: float
    """Variance of its position at right angles to itself: over time, and about a smooth curve."""
    depth_m: float
    """Depth of the near thing."""
    length: int
    """Number of rows."""


def borders(depth_m: Array, middle_m: Array) -> list[DepthEdge]:
    """Find the borders in frames of a still scene and measure how unsteady they are.

    In each row the position of a border is the number of pixels around it that belong to the near thing: pixel by pixel
    a frame either sees the near thing or does not. Its variance over time measures the temporal noise,
    its distance from a curve through its neighbours the fixed-pattern noise.

    Args:
        depth_m: (n, h, w), NaN where nothing was measured.
        middle_m: (h, w), their median.
    """
    found = []
    for swap in (False, True):
        frames, middle = (np.swapaxes(depth_m, 1, 2), middle_m.T) if swap else (depth_m, middle_m)
        for flip in (False, True):
            ordered = (frames[:, :, ::-1], middle[:, ::-1]) if flip else (frames, middle)
            for chain in _chains(_positions(*ordered), middle.shape[0]):
                found += _measured(chain, frames.shape[0])
    return found


def pooled_px(found: list[DepthEdge]) -> float | None:
    """Return the standard deviation in px that half of the borders, by length, do not exceed; None without any."""
    if not found:
        return None
    order = sorted(found, key=lambda border: border.variance_px2)
    lengths = np.cumsum([border.length for border in order])
    return float(np.sqrt(order[int(np.searchsorted(lengths, 0.5 * lengths[-1]))].variance_px2))


def _positions(depth_m: Array, middle_m: Array) -> Array:
    """Return rows, mean positions, variances over time in px² and depths (k, 4) where near ends, left to right."""
    near = middle_m[:, REACH - 1 : -REACH]
    jump = MIN_JUMP * near
    width = near.shape[1]
    good = np.isfinite(near)
    with np.errstate(invalid="ignore"):
        for step in range(1, REACH):
            good &= np.abs(middle_m[:, REACH - 1 - step :][:, :width] - near) < 0.5 * jump
        for step in range(1, REACH + 1):
            beyond = middle_m[:, REACH - 1 + step :][:, :width]
            good &= np.isnan(beyond) | (beyond > near + jump)
        # a camera with a projector has no depth in the shadow of the near object; the next measurement must be farther.
        good &= _following(middle_m)[:, REACH:][:, :width] > near + jump
    rows, starts = np.nonzero(good)
    columns = starts + REACH - 1
    window = columns[:, None] + np.arange(1 - REACH, REACH + 1)
    with np.errstate(invalid="ignore"):
        limit = (near[rows, starts] + 0.5 * jump[rows, starts])[:, None]
        counts = (depth_m[:, rows[:, None], window] < limit).sum(axis=2)
    where = columns + 1.0 + counts.mean(axis=0) - REACH
    return np.stack([rows.astype(np.float64), where, counts.var(axis=0, ddof=1), near[rows, starts]], axis=1)


def _following(middle_m: Array) -> Array:
    """Return at each pixel (h, w) the next measurement to the right, itself included; NaN where none follows soon."""
    places = np.where(np.isfinite(middle_m), np.arange(middle_m.shape[1]), middle_m.shape[1] - 1)
    following = np.minimum.accumulate(places[:, ::-1], axis=1)[:, ::-1]
    found = np.take_along_axis(middle_m, following, axis=1)
    return np.where(following - np.arange(middle_m.shape[1]) <= 60, found, np.nan)  # px: no shadow is wider


def _chains(positions: Array, rows: int) -> list[Array]:
    """Return positions (m, 4) that continue each other from row to row."""
    by_row = [positions[positions[:, 0] == row] for row in range(rows)]
    open_chains: list[list[Array]] = []
    closed: list[list[Array]] = []
    for row in by_row:
        free, going = list(row), []
        for chain in open_chains:
            last = chain[-1]
            near = [i for i, one in enumerate(free) if abs(one[1] - last[1]) <= 1.5]  # px
            near = [i for i in near if abs(free[i][3] - last[3]) <= MIN_JUMP * last[3]]
            if near:
                chain.append(free.pop(min(near, key=lambda i: abs(free[i][1] - last[1]))))
                going.append(chain)
            else:
                closed.append(chain)
        open_chains = going + [[one] for one in free]
    return [np.stack(chain) for chain in closed + open_chains if len(chain) >= WINDOW + 3]


def _measured(chain: Array, frames: int) -> list[DepthEdge]:
    """Return the measurement of a chain, unless it is nearly parallel to the rows."""
    smooth, slope = savgol_coeffs(WINDOW, 2), savgol_coeffs(WINDOW, 2, deriv=1)
    where = chain[:, 1]
    half = WINDOW // 2
    residual = where[half:-half] - np.convolve(where, smooth, mode="valid")
    gradient = np.convolve(where, slope, mode="valid")
    straight = np.abs(gradient) <= STEEPEST
    if np.count_nonzero(straight) < 3:
        return []
    squeeze = 1.0 / (1.0 + gradient[straight] ** 2)
    over_time = chain[half:-half, 2][straight]
    about_curve = residual[straight] ** 2 / (1.0 - smooth[half]) - over_time / frames
    variance = float(np.mean(squeeze * over_time) + max(np.mean(squeeze * about_curve), 0.0))
    return [DepthEdge(variance, float(np.median(chain[:, 3])), int(np.count_nonzero(straight)))]


HALF = 3  # half width of the window of the quadric fit in px
MAX_BEND = 0.05  # where neighbours differ by more than this share of the depth, there is no surface
STEEPEST_RAD = np.radians(80.0)  # steeper surfaces are not measured: the quadric spans too much of them


@dataclass(frozen=True)
class NoiseBin:
    """Pixels of about one distance and angle."""

    distance_m: float
    """Mean distance."""
    angle_rad: float
    """Mean angle between ray and normal."""
    variance_m2: float
    """Variance along the ray."""
    pixels: int


def noise_bins(depth_m: Array, middle_m: Array, camera: Camera, lateral_px: float) -> list[NoiseBin]:
    """Measure noise along the ray by distance and angle.

    Over time, and about a quadric through the neighbours of the mean image in inverse depth, in which planes are
    linear. The effect of lateral noise on slopes is subtracted: it is counted there.

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


def fit_growth(found: list[NoiseBin]) -> tuple[float, tuple[float, float, float]]:
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
    """Return weights (7, 7) for value and slopes of a quadric fit, and the rest of a pixel's own variance."""
    y, x = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].astype(np.float64)
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    solver = np.linalg.pinv(design).reshape(6, *x.shape)
    return solver[0], solver[1], solver[2], float(1.0 - solver[0][HALF, HALF])


def _pooled(distance_m: Array, angle_rad: Array, varies: Array, stays: Array) -> list[NoiseBin]:
    """Return the mean variance of each class; the wildest pixels of a class, which are no noise, are left out."""
    near = np.floor(np.log(distance_m) / np.log(1.15)).astype(np.int64)
    tilt = np.floor(angle_rad / np.radians(10.0)).astype(np.int64)
    found = []
    for key in np.unique(np.stack([near, tilt], axis=1), axis=0):
        inside = (near == key[0]) & (tilt == key[1]) & (angle_rad < STEEPEST_RAD)
        if np.count_nonzero(inside) < 200:  # too few to say anything
            continue
        variance = _calm_mean(varies[inside]) + max(_calm_mean(stays[inside]), 0.0)
        if variance > 0.0:
            middle = float(distance_m[inside].mean()), float(angle_rad[inside].mean())
            found.append(NoiseBin(*middle, variance, int(np.count_nonzero(inside))))
    return found


def _calm_mean(values: Array) -> float:
    limit = 16.0 * max(float(np.mean(np.sort(values)[: int(0.9 * values.size)])), 1e-12)
    return float(values[values < limit].mean())


@dataclass(frozen=True)
class Calibration:
    """Noise of a camera measured in a static scene."""

    model: NoiseModel
    bins: tuple[NoiseBin, ...]
    """Variance along the ray by distance and angle."""
    borders: tuple[DepthEdge, ...]
    """Variance across the ray at depth discontinuities."""
    frames: int


def calibrate(sequence: AbstractSequence) -> Calibration:
    """Measure the noise of the camera that took a sequence."""
    indices = sequence.indices[:40]  # more frames of a still scene add little
    if len(indices) < 3:
        raise InputError(f"{sequence.name}: has {len(indices)} frames; record at least 3, better 10, of a still scene.")
    frames = [sequence.frame(index) for index in indices]
    for frame in frames:
        if frame.camera != frames[0].camera:
            raise InputError(
                f"{sequence.name}: frame {frame.index} has other intrinsics; a still scene needs one camera."
            )
    depth_m = np.stack([frame.depth_m.astype(np.float64) for frame in frames])
    seen = np.isfinite(depth_m).mean(axis=0) > 0.5
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels without any measurement
        middle_m = np.where(seen, np.nanmedian(depth_m, axis=0), np.nan)
    moving = moving_share(depth_m, middle_m)
    if moving > 0.02:
        raise InputError(
            f"{sequence.name}: {moving:.0%} of the image moves; record a scene in which camera and things stand still."
        )
    found = borders(depth_m, middle_m)
    lateral_px = pooled_px(found)
    if lateral_px is None:
        raise InputError(
            f"{sequence.name}: shows no border of a near thing before a far one; put a box in front of the background."
        )
    camera = frames[0].camera
    bins = noise_bins(depth_m, middle_m, camera, lateral_px)
    if not bins:
        raise InputError(f"{sequence.name}: shows no smooth surface; put flat things at several distances and angles.")
    floor_m, growth = fit_growth(bins)
    # a constant border is still uncertain within its pixel.
    lateral_px = max(lateral_px, float(np.sqrt(1.0 / 12.0)))
    model = NoiseModel(lateral_px, 0.5 * (camera.fx + camera.fy), floor_m, growth)
    return Calibration(model, tuple(bins), tuple(found), len(frames))
