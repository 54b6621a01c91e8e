"""Matches of surface measured by both views, their point-to-plane equations, and patches of the surface."""

import numpy as np

from modeler.kernels.cache import njit
from modeler.kernels.planes import KIND, NORMAL_X, NORMAL_Y, NORMAL_Z, RIM, SURFACE, VARIANCE
from modeler.kernels.point_likelihood import (
    COLUMN,
    FACING,
    HALF,
    MAX_SIGMAS,
    MIN_AGREEMENT,
    POINT_NORMAL_X,
    POINT_NORMAL_Y,
    POINT_NORMAL_Z,
    ROW,
    VARIANCE_M2,
    VECTOR_MATHS,
    ZERO,
    X,
    Y,
    Z,
    buffers,
    normal_agreement,
    plane_distance,
    project,
)

# Columns of `matches`: transformed position, own normal, the surface's normal, distance from it, weight, f, shift, and
# the weight of errors near the silhouette there.
POSITION, OWN, OTHER, SHIFT = slice(0, 3), slice(3, 6), slice(6, 9), slice(12, 14)
RESIDUAL, WEIGHT, FACING_WEIGHT, OTHER_RIM, COLUMNS = 9, 10, 11, 14, 15

_OF_SURFACE = np.float32(SURFACE)


@njit(cache=True, inline="always")
def match_weight(points, transformed, found, residual, surface_m2, j):
    """Return the weight ω in 1/m² of a transformed point at a distance in m from the surface: 0 for no match."""
    variance = points[VARIANCE_M2, j] + found[VARIANCE, j] + surface_m2
    near = residual * residual <= MAX_SIGMAS * MAX_SIGMAS * variance
    agrees = normal_agreement(transformed, found, j) >= MIN_AGREEMENT
    weight = transformed[FACING, j] / variance
    return weight if (found[KIND, j] == _OF_SURFACE) & near & agrees else ZERO


@njit(cache=True, error_model="numpy")
def matches(pose, projection, surface_m):
    """Return the match of each point under one pose.

    Args:
        pose: (12,) rows of the 3×4 transform of the points into the other camera.
        projection: the `Projection` of the points.
        surface_m: noise of the surfaces in m beyond that of points and planes.

    Returns:
        (n, 15): position in m, own normal and normal of the surface there, all in the other camera's frame; distance
        in m in front of that surface; weight in 1/m², 0 without a match; f (0..1); shift in px, columns and rows, from
        the point's pixel in its own view; weight of errors near the other silhouette.
    """
    transformed, pixels, cells = buffers(projection.points.shape[1])
    project(pose, projection, transformed, pixels, cells)
    found, (fx, fy, cx, cy, _, _) = np.zeros((pixels.shape[0], COLUMNS)), projection.camera
    for j in range(pixels.shape[0]):
        residual = plane_distance(transformed, cells, j)
        weight = match_weight(projection.points, transformed, cells, residual, np.float32(surface_m * surface_m), j)
        for k in range(3):
            found[j, k], found[j, 3 + k] = transformed[X + k, j], transformed[POINT_NORMAL_X + k, j]
        if weight > ZERO:
            for k in range(3):
                found[j, 6 + k] = cells[NORMAL_X + k, j]
            found[j, RESIDUAL], found[j, WEIGHT], found[j, FACING_WEIGHT] = residual, weight, transformed[FACING, j]
            found[j, OTHER_RIM] = cells[RIM, j]
            x, y, z = transformed[X, j], transformed[Y, j], transformed[Z, j]
            found[j, SHIFT.start] = fx * x / z + cx - projection.points[COLUMN, j]
            found[j, SHIFT.start + 1] = fy * y / z + cy - projection.points[ROW, j]
    return found


@njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def linearise(points, transformed, found, centre, surface_m2, rows):
    """Write the equations of matches into `rows` (9, n): derivatives by ζ, residual and weight, see `gauss_newton`."""
    cx, cy, cz = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2])
    for j in range(points.shape[1]):
        residual = plane_distance(transformed, found, j)
        rows[6, j] = residual
        rows[7, j] = match_weight(points, transformed, found, residual, surface_m2, j)
    for j in range(points.shape[1]):  # a second loop: compilers can rule out aliasing of only so many rows
        x, y, z = transformed[X, j] - cx, transformed[Y, j] - cy, transformed[Z, j] - cz
        # The mean of both surfaces' normals, so that neither's noise counts in full.
        normal_x = HALF * (found[NORMAL_X, j] + transformed[POINT_NORMAL_X, j])
        normal_y = HALF * (found[NORMAL_Y, j] + transformed[POINT_NORMAL_Y, j])
        normal_z = HALF * (found[NORMAL_Z, j] + transformed[POINT_NORMAL_Z, j])
        rows[0, j] = y * normal_z - z * normal_y
        rows[1, j] = z * normal_x - x * normal_z
        rows[2, j] = x * normal_y - y * normal_x
        rows[3, j], rows[4, j], rows[5, j] = normal_x, normal_y, normal_z


@njit(cache=True)
def bisected(points, halvings):
    """Return the patch index (n,) of each point (n, 3), by recursive bisection across the longest side.

    Args:
        points: (n, 3).
        halvings: depth of the recursion; there are 2 to this power patches.
    """
    count = len(points)
    order, ends, patches = np.arange(count), np.array([0, count]), np.empty(count, dtype=np.int64)
    for _ in range(halvings):
        halves = np.empty(2 * len(ends) - 1, dtype=np.int64)
        halves[::2] = ends
        for k in range(len(ends) - 1):
            first, last = ends[k], ends[k + 1]
            halves[2 * k + 1] = first + (last - first) // 2
            if last - first > 1:
                _separate(order, points[:, _longest_side(points, order[first:last])], first, halves[2 * k + 1], last)
        ends = halves
    for k in range(len(ends) - 1):
        patches[order[ends[k] : ends[k + 1]]] = k
    return patches


@njit(cache=True)
def _longest_side(points, chosen):
    """Return the axis along which the points with these indices extend most."""
    longest, side = -1.0, 0
    for axis in range(3):
        low = high = points[chosen[0], axis]
        for k in chosen:
            low, high = min(low, points[k, axis]), max(high, points[k, axis])
        if high - low > longest:
            longest, side = high - low, axis
    return side


@njit(cache=True)
def _separate(order, values, first, middle, last):
    """Sort order[first:last] so far that no value before the middle is above one from there on (Hoare 1961, FIND)."""
    left, right = first, last - 1
    while left < right:
        pivot, i, j = values[order[middle]], left, right
        while i <= j:
            while values[order[i]] < pivot:
                i += 1
            while values[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i, j = i + 1, j - 1
        if j < middle:
            left = i
        if i > middle:
            right = j
