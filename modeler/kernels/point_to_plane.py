"""Point-to-plane equations of surface that both views measured, and patches of the surface."""

import numba
import numpy as np

from modeler.kernels.planes import KIND, NORMAL_X, NORMAL_Y, NORMAL_Z, SURFACE, VARIANCE
from modeler.kernels.point_likelihood import (
    FACING,
    HALF,
    MAX_SIGMAS,
    MIN_AGREEMENT,
    POINT_NORMAL_X,
    POINT_NORMAL_Y,
    POINT_NORMAL_Z,
    VARIANCE_M2,
    VECTOR_MATHS,
    ZERO,
    X,
    Y,
    Z,
    buffers,
    invert,
    normal_agreement,
    plane_distance,
    project,
)

# Columns of `matches`: transformed position, own normal, the surface's normal, distance from it, weight, f.
POSITION, OWN, OTHER, RESIDUAL, WEIGHT, FACING_WEIGHT = slice(0, 3), slice(3, 6), slice(6, 9), 9, 10, 11

_OF_SURFACE = np.float32(SURFACE)
EQUATION_ROWS = 9  # of one direction's equations: six derivatives, residual, weight, and a buffer for products


@numba.njit(cache=True, inline="always")
def match_weight(points, transformed, found, residual, surface_m2, j):
    """Return the weight ω in 1/m² of a transformed point at a distance in m from the surface: 0 for no match."""
    variance = points[VARIANCE_M2, j] + found[VARIANCE, j] + surface_m2
    near = residual * residual <= MAX_SIGMAS * MAX_SIGMAS * variance
    alike = normal_agreement(transformed, found, j) >= MIN_AGREEMENT
    weight = transformed[FACING, j] / variance
    return weight if (found[KIND, j] == _OF_SURFACE) & near & alike else ZERO


@numba.njit(cache=True, error_model="numpy")
def matches(pose, projection, surface_m):
    """Return the match of each point under one pose.

    Args:
        pose: (12,) rows of the 3×4 matrix that takes the points into the other camera.
        projection: the `Projection` of the points.
        surface_m: noise of the surfaces in m beyond that of points and planes.

    Returns:
        (n, 12): position in m, own normal and normal of the surface there, all in the other camera's frame; distance
        in m in front of that surface; weight in 1/m², 0 where nothing matches; f (0..1).
    """
    transformed, pixels, cells = buffers(projection)
    project(pose, projection, transformed, pixels, cells)
    found = np.zeros((pixels.shape[0], 12))
    for j in range(pixels.shape[0]):
        residual = plane_distance(transformed, cells, j)
        weight = match_weight(projection.points, transformed, cells, residual, np.float32(surface_m * surface_m), j)
        for k in range(3):
            found[j, k], found[j, 3 + k] = transformed[X + k, j], transformed[POINT_NORMAL_X + k, j]
        if weight > ZERO:
            for k in range(3):
                found[j, 6 + k] = cells[NORMAL_X + k, j]
            found[j, RESIDUAL], found[j, WEIGHT], found[j, FACING_WEIGHT] = residual, weight, transformed[FACING, j]
    return found


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def linearise(points, transformed, found, centre, surface_m2, rows):
    """Write the equations of matches into `rows` (9, n): derivatives by ζ, residual and weight; see `equations`."""
    cx, cy, cz = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2])
    for j in range(points.shape[1]):
        residual = plane_distance(transformed, found, j)
        rows[6, j] = residual
        rows[7, j] = match_weight(points, transformed, found, residual, surface_m2, j)
    for j in range(points.shape[1]):  # a separate loop: compilers prove that no more rows than these do not alias
        x, y, z = transformed[X, j] - cx, transformed[Y, j] - cy, transformed[Z, j] - cz
        # The mean of both surfaces' normals, so that neither's noise counts in full.
        normal_x = HALF * (found[NORMAL_X, j] + transformed[POINT_NORMAL_X, j])
        normal_y = HALF * (found[NORMAL_Y, j] + transformed[POINT_NORMAL_Y, j])
        normal_z = HALF * (found[NORMAL_Z, j] + transformed[POINT_NORMAL_Z, j])
        rows[0, j] = y * normal_z - z * normal_y
        rows[1, j] = z * normal_x - x * normal_z
        rows[2, j] = x * normal_y - y * normal_x
        rows[3, j], rows[4, j], rows[5, j] = normal_x, normal_y, normal_z


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def accumulate(rows, count, gradient, matrix):
    """Write the gradient (6,), -Σ w a r, and the matrix (6, 6), Σ w a aᵀ, of the first equations in `rows` (8, n)."""
    for u in range(6):
        total = ZERO
        for j in range(count):
            rows[8, j] = rows[u, j] * rows[7, j]
            total += rows[8, j] * rows[6, j]
        gradient[u] = -np.float64(total)
        for v in range(u, 6):
            total = ZERO
            for j in range(count):
                total += rows[8, j] * rows[v, j]
            matrix[u, v] = matrix[v, u] = np.float64(total)


@numba.njit(cache=True)
def new_workspace(forward, backward):
    """Return the buffers of `equations`."""
    most = max(forward.points.shape[1], backward.points.shape[1])
    rows = np.empty((EQUATION_ROWS, most), dtype=np.float32)
    small = np.empty(12), np.empty(3), np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    return buffers(forward), buffers(backward), rows, small


@numba.njit(cache=True)
def rotate_to_source(pose, part, block, rotated, gradient, matrix):
    """Write Rᵀ g and Rᵀ M R, by halves and blocks of three, of a gradient (6,) and a symmetric matrix (6, 6)."""
    for half in range(0, 6, 3):
        for k in range(3):
            a, b, c = pose[k], pose[4 + k], pose[8 + k]
            gradient[half + k] = a * part[half] + b * part[half + 1] + c * part[half + 2]
            for m in range(6):
                rotated[half + k, m] = a * block[half, m] + b * block[half + 1, m] + c * block[half + 2, m]
    for half in range(0, 6, 3):
        for k in range(3):
            a, b, c = pose[k], pose[4 + k], pose[8 + k]
            for m in range(6):
                matrix[m, half + k] = a * rotated[m, half] + b * rotated[m, half + 1] + c * rotated[m, half + 2]


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def equations(pose, forward, backward, centre, surface_m, workspace, gradient, matrix):
    """Write the point-to-plane normal equations of matches, for ξ of a pose about the centre (method.md, eq. 10).

    For small motions ζ = (ω, v) of transformed points about a point c, x → c + exp(ω)(x - c) + v, the gradient is
    -Σ w a r and the matrix Σ w a aᵀ with a = ((x - c) × n, n). In the target, a source point moves by ζ = (R ω, R v)
    about the transformed centre; in the source, a target point moves by -ξ about the centre.

    Args:
        pose: (12,) rows of target_from_source.
        forward: the `Projection` of the source's points in the target, and
        backward: of the target's in the source.
        centre: (3,) point of the source in m.
        surface_m: noise of the surfaces in m beyond that of points and planes.
        workspace: of `new_workspace`.
        gradient: (6,) out.
        matrix: (6, 6) out.
    """
    there, back, rows, (inverse, transformed_centre, part, block, rotated) = workspace
    surface_m2 = np.float32(surface_m * surface_m)
    for k in range(3):
        transformed_centre[k] = pose[4 * k + 3]
        for m in range(3):
            transformed_centre[k] += pose[4 * k + m] * centre[m]
    project(pose, forward, there[0], there[1], there[2])
    linearise(forward.points, there[0], there[2], transformed_centre, surface_m2, rows)
    accumulate(rows, forward.points.shape[1], part, block)
    rotate_to_source(pose, part, block, rotated, gradient, matrix)
    invert(pose, inverse)
    project(inverse, backward, back[0], back[1], back[2])
    linearise(backward.points, back[0], back[2], centre, surface_m2, rows)
    accumulate(rows, backward.points.shape[1], part, block)
    for k in range(6):
        gradient[k] -= part[k]
        for m in range(6):
            matrix[k, m] += block[k, m]


@numba.njit(cache=True)
def bisected(points, halvings):
    """Return the patch number (n,) of each point (n, 3): recursive bisection, each across its longest side.

    Args:
        points: (n, 3).
        halvings: depth of the recursion; there are 2 to this power patches.
    """
    order, starts = np.arange(len(points)), np.array([0, len(points)])
    for _ in range(halvings):
        cut = np.empty(2 * len(starts) - 1, dtype=np.int64)
        for number in range(len(starts) - 1):
            group = order[starts[number] : starts[number + 1]]
            best, side = -1.0, 0
            for k in range(3):
                extent = 0.0
                if len(group):
                    extent = np.max(points[group, k]) - np.min(points[group, k])
                if extent > best:
                    best, side = extent, k
            group[:] = group[np.argsort(points[group, side], kind="mergesort")]
            cut[2 * number], cut[2 * number + 1] = starts[number], starts[number] + len(group) // 2
        cut[-1] = len(points)
        starts = cut
    patches = np.empty(len(points), dtype=np.int64)
    for number in range(len(starts) - 1):
        patches[order[starts[number] : starts[number + 1]]] = number
    return patches
