"""Noise statistics of a depth camera from planes around the object: tables, floors, walls.

A plane is linear in inverse depth, so the residual of a plane fitted to a tile of the image is noise. Its
autocorrelation gives the area over which errors are correlated (method, eq. 1.4), and the same tile in two frames the
fixed-pattern share, such as that of a projected pattern or the lens (eq. 4.9).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from modeler.types import Array, BoolArray, Float32Array, Frame, spread

_TILES_PX: Final = (48, 24)  # the first size with enough tiles: 24 px hold half of the area on captures, 96 px bends
_MIN_TILES: Final = 10  # of a size; 5 or 20 give the same on captures
WIDENED_PX: Final = 8  # by which depth cameras widen an outline at most: a D415 with hole filling by up to 8 px of 640
_FRAMES: Final = 4  # more are redundant
_NOT_PLANE: Final = 4.0
"""Times the median of the tiles' variances, which noise of some twenty independent pixels does not reach."""
_BALL_PX: Final = 6  # side of the squares over which errors are averaged, as by the smoothing of surface


class RangeNoise(NamedTuple):
    """Noise statistics of a depth camera."""

    area_px: float
    """Integral of the autocorrelation of smooth errors of inverse depth over the image: 1 px² for independent pixels.

    Errors that averaging removes, such as the steps of a disparity, do not count beside smooth ones.
    """
    sigma_inverse_per_m: float
    """Standard deviation of inverse depth in 1/m of errors averaged as smoothing does."""
    pixel_sigma_inverse_per_m: float
    """The same of single pixels."""
    pattern_share: float | None = None
    """Share of the variance of errors, averaged as smoothing does, that repeats from frame to frame; None if no two
    frames show the same plane."""


def range_noise(looks: Sequence[tuple[Frame, BoolArray]]) -> RangeNoise | None:
    """Return the noise statistics of a camera around an object; None without enough planar surface.

    Args:
        looks: frames with masks (h, w) of the object, of which a few are looked at. Pixels without depth are 0 or NaN.
    """
    images = [_inverse(frame.depth_m, mask) for frame, mask in spread(looks, _FRAMES)]
    for tile_px in _TILES_PX:
        residuals = [_left_of_planes(image, tile_px) for image in images]
        limit = _NOT_PLANE * _median_variance(residuals)
        calm = [np.mean(left**2, axis=1) <= limit for left in residuals]  # False where NaN
        if sum(np.count_nonzero(kept) for kept in calm) < _MIN_TILES or limit == 0.0:
            continue
        noise = np.concatenate([left[kept] for left, kept in zip(residuals, calm, strict=True)])
        smoothed = [_averaged(left, tile_px) for left in residuals]
        averages = np.concatenate([left[kept] for left, kept in zip(smoothed, calm, strict=True)])
        sigma = float(np.sqrt(np.mean(averages**2)))
        if sigma == 0.0:
            continue
        # Averaging changes the variance, but not the integral of the autocovariance.
        variance = float(np.mean(noise**2))
        integral_px = variance * _correlated_area(noise.reshape(-1, tile_px, tile_px))
        area_px = _area_before_averaging(integral_px / sigma**2)
        return RangeNoise(area_px, sigma, variance**0.5, _pattern_share(smoothed, calm))
    return None


def _inverse(depth_m: Float32Array, mask: BoolArray) -> Array:
    """Return inverse depth (h, w) in 1/m; NaN where nothing was measured and near a mask."""
    measured = (depth_m > 0.0) & np.isfinite(depth_m) & (maximum_filter(mask, 2 * WIDENED_PX + 1) == 0)
    return np.divide(1.0, depth_m, out=np.full(depth_m.shape, np.nan), where=measured)


def _left_of_planes(inverse: Array, tile_px: int) -> Array:
    """Return the residuals (n, tile²) of planes fitted to the tiles of an image (h, w); NaN for tiles with holes."""
    rows, columns = (size // tile_px for size in inverse.shape)
    whole = inverse[: rows * tile_px, : columns * tile_px].reshape(rows, tile_px, columns, tile_px)
    return _without_plane(whole.swapaxes(1, 2).reshape(-1, tile_px**2), tile_px)


def _without_plane(tiles: Array, tile_px: int) -> Array:
    """Return tiles (n, tile²) without the plane that fits each best."""
    down, across = np.divmod(np.arange(tile_px**2), tile_px)
    plane, _ = np.linalg.qr(np.stack([np.ones(tile_px**2), down, across], axis=1))
    return np.asarray(tiles - (tiles @ plane) @ plane.T)


def _median_variance(residuals: Sequence[Array]) -> float:
    """Return the median variance of whole tiles (n, tile²) of several images; 0 where there are none."""
    variances = np.concatenate([np.mean(left**2, axis=1) for left in residuals]) if residuals else np.zeros(0)
    whole = variances[np.isfinite(variances)]
    return float(np.median(whole)) if len(whole) else 0.0


def _averaged(residuals: Array, tile_px: int) -> Array:
    """Return residuals (n, tile²) averaged over squares, without the plane that is left in these."""
    squares = tile_px // _BALL_PX
    means = residuals.reshape(-1, squares, _BALL_PX, squares, _BALL_PX).mean(axis=(2, 4))
    return _without_plane(means.reshape(len(residuals), -1), squares)


def _pattern_share(means: Sequence[Array], calm: Sequence[BoolArray]) -> float | None:
    """Return the share of the variance of averaged errors that repeats from frame to frame."""
    common, whole, count = 0.0, 0.0, 0
    for one, other in combinations(range(len(means)), 2):
        if len(means[one]) != len(means[other]):
            continue
        both = calm[one] & calm[other]
        a, b = means[one][both], means[other][both]
        common += float(np.sum(a * b))
        whole += 0.5 * float(np.sum(a**2) + np.sum(b**2))
        count += int(np.count_nonzero(both))
    return float(np.clip(common / whole, 0.0, 1.0)) if count >= _MIN_TILES and whole > 0.0 else None


def _area_before_averaging(averaged_px: float) -> float:
    """Return the correlated area in px of errors whose averages over squares have the given one.

    The errors are taken for smooth: their autocorrelation is a Gaussian of some width. What averaging removes, such as
    the steps of a disparity, does not count.
    """
    low, high = 0.1, float(_TILES_PX[0])
    for _ in range(30):  # bisection
        width = 0.5 * (low + high)
        low, high = (width, high) if _gaussian_areas(width)[1] < averaged_px else (low, width)
    return _gaussian_areas(low)[0]


def _gaussian_areas(width_px: float) -> tuple[float, float]:
    """Return the correlated areas in px of errors of Gaussian autocorrelation, and of their averages over squares."""
    lags = np.arange(-6 * _TILES_PX[0], 6 * _TILES_PX[0] + 1)
    correlation = np.exp(-0.5 * (lags / width_px) ** 2)
    pairs = np.maximum(_BALL_PX - np.abs(lags), 0)
    return float(np.sum(correlation)) ** 2, float(np.sum(correlation) / np.sum(pairs * correlation) * _BALL_PX**2) ** 2


def _correlated_area(noise: Array) -> float:
    """Return the integral in px of the autocorrelation of noise (n, t, t), up to its first zero."""
    size = noise.shape[1]
    padded = 2 * size, 2 * size
    power = np.mean(np.abs(np.fft.rfft2(noise, padded)) ** 2, axis=0)
    pairs = np.fft.irfft2(np.abs(np.fft.rfft2(np.ones((size, size)), padded)) ** 2, padded)
    correlation = np.fft.irfft2(power, padded) / np.maximum(pairs, 1.0)
    correlation /= correlation[0, 0]
    lag = np.fft.fftfreq(2 * size, 1.0 / (2 * size))
    distance = np.rint(np.hypot(lag[:, None], lag)).astype(np.int64)
    reach = size // 2
    profile = np.bincount(distance.ravel(), correlation.ravel()) / np.bincount(distance.ravel())
    gone = np.flatnonzero(profile[:reach] <= 0.0)
    end = int(gone[0]) if len(gone) else reach
    return max(float(correlation[distance < end].sum()), 1.0)
