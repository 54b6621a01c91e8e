"""Matches of surface measured by both views, their point-to-plane equations, and patches of the surface."""

import numba
import numpy as np

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


@numba.njit(cache=True, inline="always")
def match_weight(points, transformed, found, residual, surface_m2, j):
    """Return the weight ω in 1/m² of a transformed point at a distance in m from the surface: 0 for no match."""
    variance = points[VARIANCE_M2, j] + found[VARIANCE, j] + surface_m2
    near = residual * residual <= MAX_SIGMAS * MAX_SIGMAS * variance
    agrees = normal_agreement(transformed, found, j) >= MIN_AGREEMENT
    weight = transformed[FACING, j] / variance
    return weight if (found[KIND, j] == _OF_SURFACE) & near & agrees else ZERO


@numba.njit(cache=True, error_model="numpy")
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


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
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


def bisected(points, halvings):
    """Return the patch index (n,) of each point (n, 3), by recursive bisection across the longest side.

    Args:
        points: (n, 3).
        halvings: depth of the recursion; there are 2 to this power patches.
    """
    groups = [np.arange(len(points))]
    for _ in range(halvings):
        halves = []
        for group in groups:
            side = int(np.argmax(np.ptp(points[group], axis=0))) if len(group) else 0
            middle = len(group) // 2
            order = group[np.argpartition(points[group, side], middle)] if len(group) > 1 else group
            halves += [order[:middle], order[middle:]]
        groups = halves
    patches = np.empty(len(points), dtype=np.int64)
    for number, group in enumerate(groups):
        patches[group] = number
    return patches
