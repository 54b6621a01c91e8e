"""Oriented points: planes fitted to pixels of a depth image, and voxel grids of point clouds."""

import math

import numpy as np

from modeler.kernels.cache import njit


@njit(cache=True)
def fitted_planes(depth_m, wanted, mask, intrinsics, sigma_m, max_slope):
    """Fit a plane to the depth around each pixel, regularised towards the image plane.

    Neighbours are object pixels in a window of 5×5 that a surface no steeper than `max_slope` can reach. A pixel with
    fewer than three of them adjacent is an outlier and gets no plane.

    Args:
        depth_m: (h, w) z in m, NaN = missing.
        wanted: (n, 2) row and column.
        mask: (h, w) bool, object.
        intrinsics: (4,) fx, fy, cx, cy.
        sigma_m: noise of z.
        max_slope: tangent of the steepest angle between surface and image plane.

    Returns:
        Points (n, 3) and unit normals (n, 3) in camera coordinates; normals are 0 without a plane.
    """
    height, width = depth_m.shape
    points, normals = np.zeros((len(wanted), 3)), np.zeros((len(wanted), 3))
    for q in range(len(wanted)):
        row, column = wanted[q, 0], wanted[q, 1]
        z = depth_m[row, column]
        if not z > 0.0:
            continue
        step_x, step_y = z / intrinsics[0], z / intrinsics[1]
        sxx = sxy = syy = sxz = syz = 0.0
        near = 0
        for r in range(max(0, row - 2), min(height, row + 3)):
            for c in range(max(0, column - 2), min(width, column + 3)):
                if not mask[r, c] or (r == row and c == column):
                    continue
                x, y, dz = (c - column) * step_x, (r - row) * step_y, depth_m[r, c] - z
                if not abs(dz) <= max_slope * math.sqrt(x * x + y * y) + 2.0 * sigma_m:
                    continue
                sxx, sxy, syy, sxz, syz = sxx + x * x, sxy + x * y, syy + y * y, sxz + x * dz, syz + y * dz
                near += abs(r - row) <= 1 and abs(c - column) <= 1
        if near < 3:
            continue
        # Ridge regression: a slope of 1 costs as much as a residual of one sd; planes of few neighbours are frontal.
        ridge = sigma_m * sigma_m + 0.1 * step_x * step_x
        sxx, syy = sxx + ridge, syy + ridge
        determinant = sxx * syy - sxy * sxy
        p, q_ = (syy * sxz - sxy * syz) / determinant, (sxx * syz - sxy * sxz) / determinant
        w, h = (column - intrinsics[2]) / intrinsics[0], (row - intrinsics[3]) / intrinsics[1]
        # With z = z0 + p dx + q dy over the pixel offsets, and x = w z: the tangents give the normal.
        along = 1.0 + p * w + q_ * h
        length = math.sqrt(p * p + q_ * q_ + along * along)
        points[q, 0], points[q, 1], points[q, 2] = w * z, h * z, z
        normals[q, 0], normals[q, 1], normals[q, 2] = p / length, q_ / length, -along / length
    return points, normals


@njit(cache=True)
def voxel_numbers(points, origin, voxel_m, shape):
    """Number the occupied voxels of a box in the order of their first points.

    Args:
        points: (n, 3) in m.
        origin: (3,) lowest corner of the box in m.
        voxel_m: side of a voxel.
        shape: (3,) voxels along each axis.

    Returns:
        (n,) int32 index of each point's voxel, -1 outside the box; and the number of occupied voxels.
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
def voxel_sums(cells, count, weights, values):
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
def neighbour_counts(points, origin, cell_m, shape):
    """Return the number of points, itself included, in the 27 cells around each point (n,).

    Args:
        points: (n, 3) in m.
        origin: (3,) lowest corner of a box that contains them all.
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
