"""The truncated signed distance function (TSDF) on a voxel grid around the object."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from modeler.fusion.depth_views import ViewBlocks
from modeler.kernels import marching_cubes, tsdf
from modeler.types import Array, BoolArray

LEAST_NEIGHBOURS = 15  # of the 26 around a voxel that fill it: more than half, so that open borders do not grow
FAINT = 1e-3  # weight of a voxel that is filled: known, but next to nothing against an observation


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Cubic voxels over a box of the object frame, whole blocks along each axis."""

    origin_m: Array
    """(3,) lowest corner."""
    voxel_m: float
    """Side of a voxel."""
    blocks: npt.NDArray[np.int64]
    """(3,) blocks of `tsdf.SIDE` voxels along each axis."""

    @property
    def shape(self) -> npt.NDArray[np.int64]:
        """(3,) voxels along each axis."""
        return self.blocks * tsdf.SIDE

    @property
    def corners_m(self) -> Array:
        """(8, 3) corners of the box."""
        size_m = self.shape * self.voxel_m
        return self.origin_m + size_m * np.array([[c >> 2 & 1, c >> 1 & 1, c & 1] for c in range(8)])


def grid_around(points_m: Array, *, voxel_m: float, border_m: float, max_voxels: int) -> VoxelGrid:
    """Return the grid around points (n, 3) and a border; its voxels are enlarged until it holds at most `max_voxels`.

    Outliers do not enlarge the box: it ends half its size beyond the central 98 % of the points.
    """
    low, high = np.quantile(points_m, [0.01, 0.99], axis=0)
    slack = 0.5 * (high - low) + border_m
    low = np.maximum(low - slack, points_m.min(axis=0)) - border_m
    high = np.minimum(high + slack, points_m.max(axis=0)) + border_m
    voxel_m = max(voxel_m, float(np.prod(high - low) / max_voxels) ** (1.0 / 3.0))
    # One unknown voxel on each side, so that kernels may look at neighbours without bounds checks.
    blocks = np.ceil((high - low) / voxel_m + 2.0).astype(np.int64) // tsdf.SIDE + 1
    origin = 0.5 * (low + high) - 0.5 * blocks * tsdf.SIDE * voxel_m
    return VoxelGrid(origin, voxel_m, blocks)


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Signed distance on the voxels of a grid near the surface."""

    grid: VoxelGrid
    """The voxels."""
    values_m: npt.NDArray[np.float32]
    """(x, y, z) distance at voxel centres, positive outside."""
    weights: npt.NDArray[np.float32]
    """(x, y, z) weight; 0 = unknown."""

    @cached_property
    def cells(self) -> npt.NDArray[np.int64]:
        """(n, 3) cells that the surface may cross, see `crossed`."""
        return crossed(self.values_m)


def measured(grid: VoxelGrid, views: ViewBlocks, *, tau_m: float, empty_weight: float) -> DistanceField:
    """Return the signed distance measured by the views, within ±`tau_m` of the surface (method, eq. 12.5).

    The distances that several blocks of views measure are averaged by their weights.
    """
    block_m = tsdf.SIDE * grid.voxel_m
    near = np.zeros(grid.blocks, dtype=bool)
    for some in views:
        near[tuple(tsdf.blocks_near(some.points_m, grid.origin_m, block_m, tau_m, grid.blocks).T)] = True
    voxels = voxels_where(near)
    distance, weight = (np.zeros((len(voxels), *(tsdf.SIDE,) * 3), dtype=np.float32) for _ in range(2))
    for some in views:
        value, share = tsdf.integrate(
            voxels, grid.origin_m, grid.voxel_m, tau_m, empty_weight, some.views, *some.lookup
        )
        weight += share
        distance += np.divide(share, weight, out=np.ones_like(share), where=weight > 0.0) * (value - distance)
    x, y, z = (int(n) for n in grid.blocks)
    values, weights = (np.zeros((x, y, z, tsdf.SIDE, tsdf.SIDE, tsdf.SIDE), dtype=np.float32) for _ in range(2))
    values[near], weights[near] = distance, weight
    values = values.transpose(0, 3, 1, 4, 2, 5).reshape(grid.shape)
    weights = weights.transpose(0, 3, 1, 4, 2, 5).reshape(grid.shape)
    for axis in range(3):
        np.moveaxis(weights, axis, 0)[[0, -1]] = 0.0
    return DistanceField(grid, values, weights)


def voxels_where(mask: BoolArray) -> npt.NDArray[np.int64]:
    """Return the voxels (n, 3) where a mask (x, y, z) is true, in ascending order: faster than `np.argwhere`."""
    return np.stack(np.unravel_index(np.flatnonzero(mask), mask.shape), axis=1)


def filled(field: DistanceField) -> DistanceField:
    """Return the field with unknown voxels filled whose neighbours are mostly known: the mean of these."""
    cells, means = marching_cubes.fill(field.values_m, field.weights, LEAST_NEIGHBOURS)
    if not len(cells):
        return field
    values, weights = field.values_m.copy(), field.weights.copy()
    values[tuple(cells.T)] = means
    weights[tuple(cells.T)] = FAINT
    return DistanceField(field.grid, values, weights)


def crossed(values_m: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """Return the cells (n, 3), by their lowest voxel, in ascending order, whose eight voxels differ in sign."""
    inside = values_m < 0.0
    some, every = inside, inside
    for axis in range(3):
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        some = some[tuple(low)] | some[tuple(high)]
        every = every[tuple(low)] & every[tuple(high)]
    return voxels_where(some & ~every)
