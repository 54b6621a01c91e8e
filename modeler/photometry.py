"""Colour as registration compares it: what is painted on the surface, band by band, without what the lights do.

Lights stay with the camera while the object turns: shading moves over the surface, and exposure and white balance
drift. Both multiply, and shading is smooth, so that the logarithm of a colour, less its mean over a wider
neighbourhood, shows the print and little else (method.md, eq. 17).
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
from scipy import ndimage

from modeler.types import Frame, RayImage

FINEST_PX = 0.6
"""Standard deviation of the finest band's Gaussian in px: below it, pixels and noise rule."""
BANDS = 6
"""Number of bands, each twice as wide as the one before."""

VALUE, BY_COLUMN, BY_ROW = 0, 1, 2
"""Of a band at a surface point: the feature, and its derivatives by column and row in 1/px."""

_BLACK = 4.0  # added to 8-bit values: below it noise and rounding would rule their logarithm
_REACH = 3.0  # of a Gaussian, in standard deviations
_KNOWN: WeakKeyDictionary[RayImage, np.ndarray] = WeakKeyDictionary()  # features of views made so far


def view_features(view: RayImage) -> np.ndarray:
    """Return the features of a view's surface points, see `features`; made once, as a view is part of several pairs."""
    if view not in _KNOWN:
        _KNOWN[view] = features(view.frame, view.pixels)
    return _KNOWN[view]


def features(frame: Frame, pixels: np.ndarray) -> np.ndarray:
    """Return the features of surface points in bands of increasing width (method.md, eq. 17).

    Args:
        frame: with its colour.
        pixels: (n, 2) row and column of each surface point.

    Returns:
        (BANDS, 3, n) float32: `VALUE`, `BY_COLUMN` and `BY_ROW`.
    """
    found = np.zeros((BANDS, 3, len(pixels)), dtype=np.float32)
    if frame.colour is None or not len(pixels):
        return found
    low, high = pixels.min(axis=0), pixels.max(axis=0) + 1
    places = pixels - low
    logs = np.log(frame.colour[low[0] : high[0], low[1] : high[1]].astype(np.float32) + np.float32(_BLACK)).mean(axis=2)
    share = np.zeros(logs.shape, dtype=np.float32)
    share[tuple(places.T)] = 1.0
    image = (logs - logs[tuple(places.T)].mean()) * share
    scale = 1
    for band in range(BANDS):
        if band > 1:  # from an image of half the size of the one before
            image, share, scale = _halved(image), _halved(share), 2 * scale
        width_px = FINEST_PX * 2**band / scale
        cell = places // scale
        away = (places + 0.5) / scale - (cell + 0.5)
        layer = np.where(share > 0.0, _mean(image, share, width_px) - _mean(image, share, 2.0 * width_px), 0.0)
        by_row, by_column = (_slope(layer, share > 0.0, axis)[tuple(cell.T)] for axis in (0, 1))
        found[band, VALUE] = layer[tuple(cell.T)] + by_row * away[:, 0] + by_column * away[:, 1]
        found[band, BY_COLUMN], found[band, BY_ROW] = by_column / scale, by_row / scale
    return found


def _halved(image: np.ndarray) -> np.ndarray:
    """Return the means of blocks of 2 × 2 px of an image (h, w)."""
    padded = np.pad(image, [(0, side % 2) for side in image.shape])
    return np.asarray(padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2).mean(axis=(1, 3)))


def _mean(image: np.ndarray, share: np.ndarray, width_px: float) -> np.ndarray:
    """Return Gaussian means of an image (h, w), which is weighted by the share of each pixel that is surface."""
    weighted, weight = (
        ndimage.gaussian_filter(part, width_px, mode="constant", truncate=_REACH) for part in (image, share)
    )
    return np.asarray(weighted / np.maximum(weight, np.float32(1e-3)))


def _slope(image: np.ndarray, inside: np.ndarray, axis: int) -> np.ndarray:
    """Return central differences of an image (h, w) per px; 0 where a neighbour is outside."""
    slope = np.zeros_like(image)
    middle, after, before = (
        tuple(part if k == axis else slice(None) for k in (0, 1))
        for part in (slice(1, -1), slice(2, None), slice(0, -2))
    )
    slope[middle] = 0.5 * (image[after] - image[before]) * inside[after] * inside[before]
    return slope
