"""Surface of one view that matches surface measured by the other: residuals, and what they say of the pose."""

import numba
import numpy as np

from modeler.kernels.planes import DISTANCE, KIND, NORMAL_X, NORMAL_Y, NORMAL_Z, SURFACE, VARIANCE
from modeler.kernels.visibility import (
    FACES,
    FACING_X,
    FACING_Y,
    FACING_Z,
    MAX_SIGMAS,
    MIN_AGREEMENT,
    VARIANCE_M2,
    X,
    Y,
    Z,
    carry,
)

# Columns of `matches`: carried position, its own normal, the normal of the surface, distance from it, weight, facing.
POSITION, OWN, OTHER, RESIDUAL, WEIGHT, FACING = slice(0, 3), slice(3, 6), slice(6, 9), 9, 10, 11
# Columns of `normal_equations`: gradient, upper triangle of the matrix.
GRADIENT, MATRIX = slice(0, 6), slice(6, 27)


@numba.njit(cache=True, inline="always")
def match(points, carried, pixels, cells, surface_m2, j):
    """Return the distance in m of a carried point in front of the surface, and its weight in 1/m²: 0 for no match."""
    if pixels[j] < 0 or carried[FACES, j] <= 0.0:
        return 0.0, 0.0
    cell = cells[pixels[j]]
    if cell[KIND] != SURFACE:
        return 0.0, 0.0
    x, y, z = np.float64(cell[NORMAL_X]), np.float64(cell[NORMAL_Y]), np.float64(cell[NORMAL_Z])
    residual = np.float64(cell[DISTANCE]) + x * carried[X, j] + y * carried[Y, j] + z * carried[Z, j]
    variance = points[VARIANCE_M2, j] + np.float64(cell[VARIANCE]) + surface_m2
    agreement = x * carried[FACING_X, j] + y * carried[FACING_Y, j] + z * carried[FACING_Z, j]
    if agreement < MIN_AGREEMENT or residual * residual > MAX_SIGMAS * MAX_SIGMAS * variance:
        return 0.0, 0.0
    return residual, carried[FACES, j] / variance


@numba.njit(cache=True, error_model="numpy")
def matches(pose, points, cells, intrinsics, facing, surface_m):
    """Return what each point finds under one pose.

    Args:
        pose: (12,) rows of the 3×4 matrix that carries the points into the other camera.
        points: (7, n), see `visibility.log_likelihoods`.
        cells: (h · w, 8) of the other view, see `planes`.
        intrinsics: (6,) fx, fy, cx, cy, width and height in px of the other view.
        facing: (2,) cosines at which a point begins to face the camera and fully does.
        surface_m: noise of the surfaces in m beyond that of points and planes.

    Returns:
        (n, 12): position in m, own normal and normal of the surface there, all in the other camera's frame; distance
        in m in front of that surface; weight in 1/m², 0 where nothing matches; how much it faces the camera (0..1).
    """
    carried, pixels = np.empty((7, points.shape[1])), np.empty(points.shape[1], dtype=np.int32)
    carry(pose, points, intrinsics, facing, carried, pixels)
    found = np.zeros((points.shape[1], 12))
    for j in range(points.shape[1]):
        residual, weight = match(points, carried, pixels, cells, surface_m * surface_m, j)
        for k in range(3):
            found[j, k], found[j, 3 + k] = carried[X + k, j], carried[FACING_X + k, j]
        if weight > 0.0:
            for k in range(3):
                found[j, 6 + k] = cells[pixels[j], NORMAL_X + k]
            found[j, RESIDUAL], found[j, WEIGHT], found[j, FACING] = residual, weight, carried[FACES, j]
    return found


@numba.njit(cache=True, parallel=True, error_model="numpy")
def normal_equations(poses, centres, points, cells, intrinsics, facing, surface_m):
    """Return the point-to-plane normal equations of the matching points under each pose.

    For small motions ζ = (ω, v) of the carried points about a centre, x → centre + exp(ω)(x - centre) + v: the
    gradient -Σ w a r and the upper triangle of Σ w a aᵀ, with a = ((x - centre) × n, n) and n the mean of both
    surfaces' normals, so that neither's noise counts whole.

    Args:
        poses: (m, 12) rows of the 3×4 matrices that carry the points into the other camera.
        centres: (m, 3) in m, in the other camera's frame.
        points: (7, n), see `visibility.log_likelihoods`.
        cells: (h · w, 8) of the other view, see `planes`.
        intrinsics: (6,) fx, fy, cx, cy, width and height in px of the other view.
        facing: (2,) cosines at which a point begins to face the camera and fully does.
        surface_m: noise of the surfaces in m beyond that of points and planes.

    Returns:
        (m, 27): gradient (6) and upper triangle (21), row by row.
    """
    result = np.zeros((poses.shape[0], 27))
    for i in numba.prange(poses.shape[0]):
        carried, pixels = np.empty((7, points.shape[1])), np.empty(points.shape[1], dtype=np.int32)
        carry(poses[i], points, intrinsics, facing, carried, pixels)
        a = np.empty(6)
        for j in range(points.shape[1]):
            residual, weight = match(points, carried, pixels, cells, surface_m * surface_m, j)
            if weight <= 0.0:
                continue
            cell = cells[pixels[j]]
            x, y, z = carried[X, j] - centres[i, 0], carried[Y, j] - centres[i, 1], carried[Z, j] - centres[i, 2]
            a[3] = 0.5 * (cell[NORMAL_X] + carried[FACING_X, j])
            a[4] = 0.5 * (cell[NORMAL_Y] + carried[FACING_Y, j])
            a[5] = 0.5 * (cell[NORMAL_Z] + carried[FACING_Z, j])
            a[0], a[1], a[2] = y * a[5] - z * a[4], z * a[3] - x * a[5], x * a[4] - y * a[3]
            k = 6
            for u in range(6):
                result[i, u] -= weight * residual * a[u]
                for v in range(u, 6):
                    result[i, k] += weight * a[u] * a[v]
                    k += 1
    return result
