"""Colours of the static background, which reveal false object depth next to the object.

Stereo cameras widen outlines, and with hole filling they close the gaps between limbs. For a static camera, other
frames show the colour behind such a pixel. If the pixel has that colour, and the object rarely does, it is background,
whatever its depth. Colours are compared by their chromaticity, as shadows and exposure change their intensity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from modeler.kernels import planes
from modeler.segmentation.depth_images import without_specks
from modeler.significance import QUORUM
from modeler.types import Array, BoolArray, Float32Array, Frame
from modeler.views.range_noise import WIDENED_PX

_LEAST_SIGMA = 3.0  # of 255 levels: noise of a colour camera indoors
_DARKEST, _BRIGHTEST = 0.7, 1.1  # of the background, by shadows of the object and by exposure
_BINS = 64  # of red and of green chromaticity: a bin is three levels of a grey pixel wide
_TINT = 2.0  # bins: change of chromaticity by light from different sides, 6 levels of grey; twice as much: another one
_PRIOR_ODDS = 0.02  # of background at a pixel that has the object's depth: 6 % of `figure`, under 2 % of six captures
_LEAST_SHARE = 0.3  # of the object's pixels, with another colour behind them: else its frequency is unknown


@dataclass(frozen=True, eq=False)
class BackgroundColour:
    """Background colours of a fixed camera, and the frequency of each colour on the object."""

    window: tuple[slice, slice]
    """Rows and columns of the images that contain the object in some frame; (h, w) below is its size."""
    mean: Float32Array
    """(h, w, 3) RGB."""
    sigma: Float32Array
    """(h, w) standard deviation of each channel, in levels."""
    known: BoolArray
    """(h, w) where the background is seen in enough frames."""
    object_density: Array
    """(b, b) probability density of the object's colours by bin of red and green chromaticity; inf: not known."""

    @classmethod
    def learned(cls, frames: Sequence[Frame], masks: Sequence[BoolArray]) -> BackgroundColour | None:
        """Learn the background outside the object; None without colour, or with too few frames.

        Args:
            frames: of one camera, of one size.
            masks: of the object by depth, one a frame, none of them empty.
        """
        seen = [(frame.colour, mask) for frame, mask in zip(frames, masks, strict=True) if frame.colour is not None]
        if len(seen) < QUORUM:
            return None
        size = 2 * WIDENED_PX + 1
        top, bottom, left, right = planes.bounds(np.any([mask for _, mask in seen], axis=0))
        window = slice(top, bottom), slice(left, right)
        colours = np.stack([colour[window] for colour, _ in seen])
        away = np.stack([_dilated(mask, size)[window] for _, mask in seen]) == 0
        known = np.count_nonzero(away, axis=0) >= QUORUM
        mean, sigma = np.zeros((*known.shape, 3), dtype=np.float32), np.zeros(known.shape, dtype=np.float32)
        shown = np.where(away[:, known, None], colours[:, known], np.float32(np.nan))
        mean[known] = _median(shown)
        sigma[known] = 1.4826 * _median(np.abs(shown - mean[known])).max(axis=-1, initial=0.0)
        deep = (np.stack([1 - _dilated(~mask, size)[window] for _, mask in seen]) == 1) & known
        behind = np.broadcast_to(mean, colours.shape)[deep]
        sigma = np.maximum(sigma, np.float32(_LEAST_SIGMA))
        return cls(window, mean, sigma, known, _object_density(colours[deep], behind))

    def shown(self, colour: npt.NDArray[np.uint8], mask: BoolArray) -> BoolArray:
        """Return the pixels of a mask (h, w) that show the background rather than the object (method, eq. 2.2).

        Args:
            colour: (h, w, 3) RGB.
            mask: (h, w) of the object by depth.
        """
        where = mask[self.window] & self.known
        near = colour[self.window].astype(np.float32)
        smooth = np.stack([ndimage.uniform_filter(near[..., k], 3)[where] for k in range(3)], axis=1)
        intensity, behind = smooth.sum(axis=1) + 1.0, self.mean[where].sum(axis=1) + 1.0
        sigma = self.sigma[where] / np.minimum(intensity, behind)
        off = np.linalg.norm(_chromaticity(smooth) - _chromaticity(self.mean[where]), axis=1)
        background = np.exp(-0.5 * (off / sigma) ** 2) / (2.0 * np.pi * sigma**2)
        shade = intensity / behind
        of_object = self.object_density[tuple(_bins(smooth))]
        found, inner = np.zeros(mask.shape, dtype=np.bool_), np.zeros(where.shape, dtype=np.bool_)
        inner[where] = (shade > _DARKEST) & (shade < _BRIGHTEST) & (_PRIOR_ODDS * background > of_object)
        found[self.window] = without_specks(inner, 0.0)
        return found


def without_background(mask: BoolArray, frame: Frame, background: BackgroundColour | None) -> BoolArray:
    """Return a mask (h, w) by depth without the pixels that show the background."""
    if background is None or frame.colour is None:
        return mask
    shown = background.shown(frame.colour, mask)
    return without_specks(mask & ~shown) if shown.any() else mask


def _object_density(colours: npt.NDArray[np.uint8], behind: Float32Array) -> Array:
    """Return the density (b, b) of an object's colours, each from the pixels with a different background colour.

    Args:
        colours: (n, 3) RGB of pixels that are the object's, or between its limbs.
        behind: (n, 3) RGB of the background there.
    """
    other = 2.0 * _TINT
    apart = np.linalg.norm(_chromaticity(colours) - _chromaticity(behind), axis=1) > other / _BINS
    of_colour, of_background = np.zeros((_BINS, _BINS)), np.zeros((_BINS, _BINS))
    np.add.at(of_colour, tuple(_bins(colours[apart])), 1.0)
    np.add.at(of_background, tuple(_bins(behind)), 1.0)
    x, y = np.mgrid[-other : other + 1, -other : other + 1]
    alike = ndimage.convolve(of_background, (np.hypot(x, y) <= other).astype(float), mode="constant")
    chances = len(colours) - alike
    of_colour = ndimage.gaussian_filter(of_colour, _TINT, mode="constant") + 1.0 / _BINS  # of a colour not seen yet
    known = chances > _LEAST_SHARE * len(colours)
    return np.divide(_BINS**2 * of_colour, chances, out=np.full_like(chances, np.inf), where=known)


def _median(values: Float32Array) -> Float32Array:
    """Return the lower median (…) of values (n, …) along the first axis without NaN: faster than `np.nanmedian`."""
    middle = (np.count_nonzero(~np.isnan(values), axis=0) - 1) // 2
    found = np.take_along_axis(np.sort(values, axis=0), middle[None], axis=0)[0]  # NaN comes last
    return np.asarray(found, dtype=np.float32)


def _dilated(mask: BoolArray, size: int) -> npt.NDArray[np.uint8]:
    """Return a mask (h, w) dilated by a square, as numbers."""
    return np.asarray(ndimage.maximum_filter(mask.view(np.uint8), size=size), dtype=np.uint8)


def _chromaticity(colours: npt.NDArray[np.generic]) -> Array:
    """Return red and green (n, 2) of RGB (n, 3) as shares of the intensity."""
    rgb = colours.astype(np.float64)
    return rgb[:, :2] / (rgb.sum(axis=1, keepdims=True) + 1.0)


def _bins(colours: npt.NDArray[np.generic]) -> npt.NDArray[np.int64]:
    """Return the bins (2, n) of the chromaticities of RGB (n, 3)."""
    return (_chromaticity(colours) * _BINS).astype(np.int64).T
