"""The merged cloud: points of all views in the object frame, one a voxel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from modeler.kernels import thinning
from modeler.types import Array, BoolArray


def thinned(points_m: Array, normals: Array, weights: Array, *, voxel_m: float, max_voxels: int) -> tuple[Array, Array]:
    """Average oriented points (n, 3) over voxels.

    Returns:
        Points (m, 3) and unit normals (m, 3), in the order in which the points meet the voxels.
    """
    points_m, normals, _ = _thinned(
        points_m, normals, weights, np.zeros((len(points_m), 0)), voxel_m=voxel_m, max_voxels=max_voxels
    )
    return points_m, normals


def painted(
    points_m: Array,
    normals: Array,
    colours: npt.NDArray[np.uint8],
    coloured: BoolArray,
    *,
    voxel_m: float,
    max_voxels: int,
    unknown: int,
) -> tuple[Array, Array, npt.NDArray[np.uint8]]:
    """Average oriented points (n, 3) over voxels, and the colours (n, 3) of those that have one (n,).

    Returns:
        Points (m, 3), unit normals (m, 3) and RGB (m, 3), `unknown` where no point has a colour.
    """
    paint = np.concatenate([colours * coloured[:, None], coloured[:, None]], axis=1).astype(np.float64)
    points_m, normals, means = _thinned(
        points_m, normals, np.ones(len(points_m)), paint, voxel_m=voxel_m, max_voxels=max_voxels
    )
    share = means[:, 3:]
    return (
        points_m,
        normals,
        np.rint(np.where(share > 0.0, means[:, :3] / np.maximum(share, 1e-9), unknown)).astype(np.uint8),
    )


def _thinned(
    points_m: Array, normals: Array, weights: Array, others: Array, *, voxel_m: float, max_voxels: int
) -> tuple[Array, Array, Array]:
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    while np.prod(np.ceil((high - low) / voxel_m) + 1.0) > max_voxels:
        voxel_m *= 1.25
    shape = (np.ceil((high - low) / voxel_m) + 1.0).astype(np.int64)
    cells, count = thinning.thin(points_m, low, voxel_m, shape)
    sums, totals = thinning.average(cells, count, weights, np.concatenate([points_m, normals, others], axis=1))
    means = sums / totals[:, None]
    lengths = np.linalg.norm(means[:, 3:6], axis=1)
    # Opposite sides of a sheet thinner than a voxel cancel: such a point has no normal and is left out.
    kept = lengths > 0.1
    means, lengths = means[kept], lengths[kept]
    return means[:, :3], means[:, 3:6] / lengths[:, None], means[:, 6:]


def crowded(points_m: Array, cell_m: float, least: int) -> BoolArray:
    """Return which points (n,) have at least `least` points, themselves included, in the 27 cells around them."""
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    shape = (np.ceil((high - low) / cell_m) + 1.0).astype(np.int64)
    return thinning.crowd(points_m, low, cell_m, shape) >= least
