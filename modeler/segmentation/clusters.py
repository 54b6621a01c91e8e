"""Pieces of depth images: what hangs together on the image and in space, and which pixels mix two surfaces."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from modeler.types import Array, BoolArray, Float32Array

Labels = npt.NDArray[np.int32]

_JUMP_SHARE = 0.03  # of the depth; neighbours of a thinned image that lie farther apart are on two surfaces
_GRID_CELLS = 80  # most voxels along a side
_GRAZING = np.tan(np.radians(85.0))  # surfaces seen at a flatter angle cannot be told from mixed pixels
_SEEN_SHARE = 0.4  # of a row or column with measurements, for it not to be blind
_BLIND_SHARE = 0.01  # of the measurements in a band that is blind
_RAGGED_SHARE = 0.02  # of the image, by which the edge of a blind band may bend where a lens was straightened
_EVERYWHERE = np.ones((3, 3, 3), dtype=np.bool_)


def pieces(depth_m: Float32Array, within: BoolArray) -> Labels:
    """Label the pieces (h, w) of a region that hang together without a jump; 0 = outside it or before a jump."""
    kept = within.copy()
    limit = np.float32(_JUMP_SHARE) * depth_m
    kept[:-1] &= ~(np.abs(depth_m[1:] - depth_m[:-1]) > limit[1:])
    kept[:, :-1] &= ~(np.abs(depth_m[:, 1:] - depth_m[:, :-1]) > limit[:, 1:])
    return _label(kept)


def voxel_clusters(points: npt.NDArray[np.floating], *, low_m: Array, high_m: Array, gap_m: float) -> Labels:
    """Label points (n, 3) by what hangs together in space.

    Args:
        points: (n, 3), all within the box.
        low_m: (3,) lower corner of the box.
        high_m: (3,) upper corner of the box.
        gap_m: side of a voxel, and about the gap that is bridged; more where the box would have too many voxels.

    Returns:
        (n,) labels from 1.
    """
    side = max(gap_m, float((high_m - low_m).max()) / _GRID_CELLS)
    cell = ((points - low_m.astype(points.dtype)) / points.dtype.type(side)).astype(np.int32)
    filled = np.zeros(tuple(((high_m - low_m) / side).astype(np.int64) + 2), dtype=np.bool_)
    filled[cell[:, 0], cell[:, 1], cell[:, 2]] = True
    return _label(filled, structure=_EVERYWHERE)[cell[:, 0], cell[:, 1], cell[:, 2]]


def mixed_pixels(depth_m: Float32Array, *, tolerance_m: Float32Array, pixel_m: Float32Array) -> BoolArray:
    """Return the pixels (h, w) between two surfaces: nearer than one neighbour and farther than another, by a jump.

    Args:
        depth_m: (h, w), NaN = no measurement.
        tolerance_m: (h, w) what noise explains.
        pixel_m: (h, w) width of a pixel on a surface at that depth.
    """
    missing = ~np.isfinite(depth_m)
    jump = np.maximum(tolerance_m, np.float32(_GRAZING) * pixel_m)
    nearest = ndimage.minimum_filter(np.where(missing, np.float32(np.inf), depth_m), 3)
    farthest = ndimage.maximum_filter(np.where(missing, np.float32(-np.inf), depth_m), 3)
    return (depth_m - nearest > jump) & (farthest - depth_m > jump)


def without_specks(mask: BoolArray, least_share: float) -> BoolArray:
    """Return a mask (h, w) without whiskers one pixel wide and without pieces below a share of its pixels."""
    count = np.pad(mask.astype(np.uint8), 1)
    count = count[:-2] + count[1:-1] + count[2:]
    mask = mask & (count[:, :-2] + count[:, 1:-1] + count[:, 2:] >= 4)
    labels = _label(mask)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return (sizes >= max(1.0, least_share * sizes.sum()))[labels]


def edge_of(seen: BoolArray) -> BoolArray:
    """Return the pixels (h, w) at the edge of what the camera sees, at which things may be cut off.

    That is the edge of the image and of bands that the sensor leaves blind: beyond such a line there is nothing. Where
    a background without measurements begins is another, but what reaches over it is not cut off.
    """
    return _outermost(seen) | _outermost(seen.T).T


def _outermost(seen: BoolArray) -> BoolArray:
    """Return pixels (h, w) of the first and last row, and those, with none beyond, of the first and last well seen."""
    edge = np.zeros_like(seen)
    rows = np.flatnonzero(seen.mean(axis=1) > _SEEN_SHARE)
    if len(rows):
        first, last, ragged = int(rows[0]), int(rows[-1]), round(_RAGGED_SHARE * len(seen))
        beyond = np.pad(seen, ((1, 1), (0, 0)))
        if _blind(seen[: max(first - ragged, 0)]):
            edge[first] = ~beyond[first]
        if _blind(seen[last + 1 + ragged :]):
            edge[last] |= ~beyond[last + 2]
    edge[[0, -1]] = True
    return edge & seen


def _blind(rows: BoolArray) -> bool:
    """Return whether rows (h, w) hold nothing but specks: where a table ends, an object may be seen beyond."""
    return not rows.size or bool(rows.mean() < _BLIND_SHARE)


def _label(mask: BoolArray, structure: BoolArray | None = None) -> Labels:
    """Label the connected pieces of a mask from 1, 0 = outside."""
    labels = np.zeros(mask.shape, dtype=np.int32)
    ndimage.label(mask, structure=structure, output=labels)
    return labels
