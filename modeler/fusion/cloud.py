"""The merged cloud: points of all views in the object frame, one a voxel."""

from __future__ import annotations

import numpy as np

from modeler.kernels import thinning
from modeler.types import Array, BoolArray


def thinned(points_m: Array, normals: Array, weights: Array, *, voxel_m: float, max_voxels: int) -> tuple[Array, Array]:
    """Average oriented points (n, 3) over voxels.

    Returns:
        Points (m, 3) and unit normals (m, 3), in the order in which the points meet the voxels.
    """
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    while np.prod(np.ceil((high - low) / voxel_m) + 1.0) > max_voxels:
        voxel_m *= 1.25
    shape = (np.ceil((high - low) / voxel_m) + 1.0).astype(np.int64)
    cells, count = thinning.thin(points_m, low, voxel_m, shape)
    sums, totals = thinning.average(cells, count, weights, np.concatenate([points_m, normals], axis=1))
    means = sums / totals[:, None]
    lengths = np.linalg.norm(means[:, 3:], axis=1)
    # Opposite sides of a sheet thinner than a voxel cancel: such a point has no normal and is left out.
    kept = lengths > 0.1
    return means[kept, :3], means[kept, 3:] / lengths[kept, None]


def crowded(points_m: Array, cell_m: float, least: int) -> BoolArray:
    """Return which points (n,) have at least `least` points, themselves included, in the 27 cells around them."""
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    shape = (np.ceil((high - low) / cell_m) + 1.0).astype(np.int64)
    return thinning.crowd(points_m, low, cell_m, shape) >= least
