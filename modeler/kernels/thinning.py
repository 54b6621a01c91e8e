"""Kernels on clouds in a box of cells: thinning, averaging, and counting neighbours."""

import math

import numpy as np
from numba import njit


@njit(cache=True)
def thin(points, origin, voxel_m, shape):
    """Number the occupied voxels of a box in the order in which the points meet them.

    Args:
        points: (n, 3) in m.
        origin: (3,) lowest corner of the box in m.
        voxel_m: side of a voxel.
        shape: (3,) voxels along each axis.

    Returns:
        (n,) int32 number of each point's voxel, -1 outside the box; and how many voxels are occupied.
    """
    lookup = np.zeros(shape[0] * shape[1] * shape[2], dtype=np.int32)
    cells = np.empty(len(points), dtype=np.int32)
    count = 0
    for i in range(len(points)):
        x = math.floor((points[i, 0] - origin[0]) / voxel_m)
        y = math.floor((points[i, 1] - origin[1]) / voxel_m)
        z = math.floor((points[i, 2] - origin[2]) / voxel_m)
        if not (0 <= x < shape[0] and 0 <= y < shape[1] and 0 <= z < shape[2]):
            cells[i] = -1
            continue
        key = (int(x) * shape[1] + int(y)) * shape[2] + int(z)
        if lookup[key] == 0:
            count += 1
            lookup[key] = count
        cells[i] = lookup[key] - 1
    return cells, count


@njit(cache=True)
def average(cells, count, weights, values):
    """Return the weighted sums (count, c) of values (n, c) in each cell, and the sums (count,) of the weights."""
    sums = np.zeros((count, values.shape[1]))
    totals = np.zeros(count)
    for i in range(len(cells)):
        if cells[i] >= 0:
            totals[cells[i]] += weights[i]
            for k in range(values.shape[1]):
                sums[cells[i], k] += weights[i] * values[i, k]
    return sums, totals


@njit(cache=True)
def crowd(points, origin, cell_m, shape):
    """Return for each point (n,) how many points, itself included, lie in the 27 cells around it.

    Args:
        points: (n, 3) in m.
        origin: (3,) lowest corner of a box that holds them all.
        cell_m: side of a cell.
        shape: (3,) cells along each axis.
    """
    counts = np.zeros((shape[0] + 2, shape[1] + 2, shape[2] + 2), dtype=np.int32)
    places = np.empty((len(points), 3), dtype=np.int64)
    for i in range(len(points)):
        for k in range(3):
            places[i, k] = min(max(math.floor((points[i, k] - origin[k]) / cell_m), 0), shape[k] - 1)
        counts[places[i, 0] + 1, places[i, 1] + 1, places[i, 2] + 1] += 1
    result = np.zeros(len(points), dtype=np.int64)
    for i in range(len(points)):
        for x in range(places[i, 0], places[i, 0] + 3):
            for y in range(places[i, 1], places[i, 1] + 3):
                for z in range(places[i, 2], places[i, 2] + 3):
                    result[i] += counts[x, y, z]
    return result
