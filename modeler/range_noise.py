"""Over how many pixels a depth camera errs alike, from what surrounds the object: tables, floors, walls.

A plane is linear in inverse depth, so what is left of a plane fitted to a tile of the image is noise, and its
autocorrelation tells over how many pixels errors are alike. One frame is enough, and noise that does not change from
frame to frame, as that of a projected pattern, is seen like any other (method.md, eq. 23).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.ndimage import maximum_filter

from modeler.types import Array, BoolArray, Float32Array, Frame

_TILES_PX: Final = (48, 24)  # the first of which there are enough: small tiles take wide errors for the plane's
_MIN_TILES: Final = 10  # of a size
_MARGIN_PX: Final = 8  # from the object and its mixed pixels
_FRAMES: Final = 4  # more show the same surface again
_NOT_PLANE: Final = 4.0  # times the median of the tiles' variances


def noise_area(looks: Sequence[tuple[Frame, BoolArray]]) -> float | None:
    """Return the correlated area of the noise around an object in px; None where too little of that is plane.

    It is the integral of the autocorrelation of inverse depth over the image: 1 where pixels err independently.

    Args:
        looks: frames with masks (h, w) of the object, of which a few are looked at. Pixels without depth are 0 or NaN.
    """
    few = [looks[k] for k in np.linspace(0, len(looks) - 1, min(_FRAMES, len(looks))).astype(np.int64).tolist()]
    images = [_inverse(frame.depth_m, mask) for frame, mask in few]
    for tile_px in _TILES_PX:
        tiles = [_tiles(image, tile_px) for image in images]
        found = _measured(np.concatenate(tiles), tile_px) if tiles else None
        if found is not None:
            return found
    return None


def _inverse(depth_m: Float32Array, mask: BoolArray) -> Array:
    """Return inverse depth (h, w) in 1/m; NaN where nothing was measured and near a mask."""
    measured = (depth_m > 0.0) & np.isfinite(depth_m) & (maximum_filter(mask, 2 * _MARGIN_PX + 1) == 0)
    return np.divide(1.0, depth_m, out=np.full(depth_m.shape, np.nan), where=measured)


def _tiles(inverse: Array, tile_px: int) -> Array:
    """Return those tiles (n, tile²) of an image (h, w) that have no NaN."""
    rows, columns = (size // tile_px for size in inverse.shape)
    whole = inverse[: rows * tile_px, : columns * tile_px].reshape(rows, tile_px, columns, tile_px)
    tiles = whole.swapaxes(1, 2).reshape(-1, tile_px**2)
    return np.asarray(tiles[np.isfinite(tiles).all(axis=1)])


def _measured(tiles: Array, tile_px: int) -> float | None:
    """Return the correlated area in px of the noise of tiles (n, tile²); None where few are plane."""
    if len(tiles) < _MIN_TILES:
        return None
    rows, columns = np.divmod(np.arange(tile_px**2), tile_px)
    plane, _ = np.linalg.qr(np.stack([np.ones(tile_px**2), rows, columns], axis=1))
    left = tiles - (tiles @ plane) @ plane.T
    variance = np.sum(left**2, axis=1) / (tile_px**2 - 3)
    calm = variance <= _NOT_PLANE * np.median(variance)
    if np.count_nonzero(calm) < _MIN_TILES or not variance[calm].any():
        return None
    return _correlated_area(left[calm].reshape(-1, tile_px, tile_px))


def _correlated_area(noise: Array) -> float:
    """Return the integral in px of the autocorrelation of noise (n, t, t), out to the distance where it is first 0."""
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
