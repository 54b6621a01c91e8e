"""Surface of one view that matches surface measured by the other: residuals, and what they say of the pose."""

import math
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from modeler.kernels.lie_group import difference, turn
from modeler.kernels.planes import KIND, NORMAL_X, NORMAL_Y, NORMAL_Z, SURFACE, VARIANCE
from modeler.kernels.projection import (
    FACES,
    FACING_X,
    FACING_Y,
    FACING_Z,
    HALF,
    VARIANCE_M2,
    VECTOR_MATHS,
    ZERO,
    X,
    Y,
    Z,
    buffers,
    invert,
    look,
)
from modeler.kernels.visibility import MAX_SIGMAS, MIN_AGREEMENT, agreement_of, height_over

# Columns of `matches`: carried position, its own normal, the normal of the surface, distance from it, weight, facing.
POSITION, OWN, OTHER, RESIDUAL, WEIGHT, FACING = slice(0, 3), slice(3, 6), slice(6, 9), 9, 10, 11

_OF_SURFACE = np.float32(SURFACE)
_ROWS = 9  # of one direction's equations: six derivatives, residual, weight, and room for products


class Regulariser(NamedTuple):
    """What holds descending poses."""

    mean: npt.NDArray[np.float64]
    """(12,) rows of the pose at which nothing pulls."""
    precision: npt.NDArray[np.float64]
    """(6, 6) of ξ about the centre, away from it."""
    damping: npt.NDArray[np.float64]
    """(6,) added to the diagonal."""
    max_step_rad: float
    """A step turns the object no further."""


@numba.njit(cache=True, inline="always")
def weight_of(points, carried, found, residual, surface_m2, j):
    """Return the weight in 1/m² of a carried point at some distance in m from the surface: 0 for no match."""
    variance = points[VARIANCE_M2, j] + found[VARIANCE, j] + surface_m2
    near = residual * residual <= MAX_SIGMAS * MAX_SIGMAS * variance
    alike = agreement_of(carried, found, j) >= MIN_AGREEMENT
    weight = carried[FACES, j] / variance
    return weight if (found[KIND, j] == _OF_SURFACE) & near & alike else ZERO


@numba.njit(cache=True, error_model="numpy")
def matches(pose, projection, surface_m):
    """Return what each point finds under one pose.

    Args:
        pose: (12,) rows of the 3×4 matrix that carries the points into the other camera.
        projection: the `Projection` of the points.
        surface_m: noise of the surfaces in m beyond that of points and planes.

    Returns:
        (n, 12): position in m, own normal and normal of the surface there, all in the other camera's frame; distance
        in m in front of that surface; weight in 1/m², 0 where nothing matches; how much it faces the camera (0..1).
    """
    carried, pixels, cells = buffers(projection)
    look(pose, projection, carried, pixels, cells)
    found = np.zeros((pixels.shape[0], 12))
    for j in range(pixels.shape[0]):
        residual = height_over(carried, cells, j)
        weight = weight_of(projection.points, carried, cells, residual, np.float32(surface_m * surface_m), j)
        for k in range(3):
            found[j, k], found[j, 3 + k] = carried[X + k, j], carried[FACING_X + k, j]
        if weight > ZERO:
            for k in range(3):
                found[j, 6 + k] = cells[NORMAL_X + k, j]
            found[j, RESIDUAL], found[j, WEIGHT], found[j, FACING] = residual, weight, carried[FACES, j]
    return found


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def derive(points, carried, found, centre, surface_m2, rows):
    """Write the equations of matches into `rows` (9, n): derivatives by ζ, residual and weight; see `equations`."""
    cx, cy, cz = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2])
    for j in range(points.shape[1]):
        residual = height_over(carried, found, j)
        rows[6, j] = residual
        rows[7, j] = weight_of(points, carried, found, residual, surface_m2, j)
    for j in range(points.shape[1]):  # in a loop of its own: compilers prove no more rows apart than these
        x, y, z = carried[X, j] - cx, carried[Y, j] - cy, carried[Z, j] - cz
        # The mean of both surfaces' normals, so that neither's noise counts whole.
        normal_x = HALF * (found[NORMAL_X, j] + carried[FACING_X, j])
        normal_y = HALF * (found[NORMAL_Y, j] + carried[FACING_Y, j])
        normal_z = HALF * (found[NORMAL_Z, j] + carried[FACING_Z, j])
        rows[0, j] = y * normal_z - z * normal_y
        rows[1, j] = z * normal_x - x * normal_z
        rows[2, j] = x * normal_y - y * normal_x
        rows[3, j], rows[4, j], rows[5, j] = normal_x, normal_y, normal_z


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def gather(rows, count, gradient, matrix):
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
def workspace(forward, backward):
    """Return all the room that `equations` needs."""
    most = max(forward.points.shape[1], backward.points.shape[1])
    rows = np.empty((_ROWS, most), dtype=np.float32)
    small = np.empty(12), np.empty(3), np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    return buffers(forward), buffers(backward), rows, small


@numba.njit(cache=True)
def into_source(pose, part, block, turned, gradient, matrix):
    """Write Rᵀ g and Rᵀ M R, by halves and blocks of three, of a gradient (6,) and a symmetric matrix (6, 6)."""
    for half in range(0, 6, 3):
        for k in range(3):
            a, b, c = pose[k], pose[4 + k], pose[8 + k]
            gradient[half + k] = a * part[half] + b * part[half + 1] + c * part[half + 2]
            for m in range(6):
                turned[half + k, m] = a * block[half, m] + b * block[half + 1, m] + c * block[half + 2, m]
    for half in range(0, 6, 3):
        for k in range(3):
            a, b, c = pose[k], pose[4 + k], pose[8 + k]
            for m in range(6):
                matrix[m, half + k] = a * turned[m, half] + b * turned[m, half + 1] + c * turned[m, half + 2]


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def equations(pose, forward, backward, centre, surface_m, room, gradient, matrix):
    """Write the point-to-plane normal equations of matching points for ξ of a pose about the source's centre.

    For small motions ζ = (ω, v) of carried points about a point c, x → c + exp(ω)(x - c) + v, the gradient is -Σ w a r
    and the matrix Σ w a aᵀ with a = ((x - c) × n, n). Carried forward, a point moves by ζ = (R ω, R v) of ξ about the
    carried centre; carried back, by -ξ about the centre.

    Args:
        pose: (12,) rows of target_from_source.
        forward: the `Projection` of the source's points in the target, and
        backward: of the target's in the source.
        centre: (3,) point of the source in m.
        surface_m: noise of the surfaces in m beyond that of points and planes.
        room: of `workspace`.
        gradient: (6,) out.
        matrix: (6, 6) out.
    """
    there, back, rows, (inverse, carried_centre, part, block, turned) = room
    surface_m2 = np.float32(surface_m * surface_m)
    for k in range(3):
        carried_centre[k] = pose[4 * k + 3]
        for m in range(3):
            carried_centre[k] += pose[4 * k + m] * centre[m]
    look(pose, forward, there[0], there[1], there[2])
    derive(forward.points, there[0], there[2], carried_centre, surface_m2, rows)
    gather(rows, forward.points.shape[1], part, block)
    into_source(pose, part, block, turned, gradient, matrix)
    invert(pose, inverse)
    look(inverse, backward, back[0], back[1], back[2])
    derive(backward.points, back[0], back[2], centre, surface_m2, rows)
    gather(rows, backward.points.shape[1], part, block)
    for k in range(6):
        gradient[k] -= part[k]
        for m in range(6):
            matrix[k, m] += block[k, m]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def normal_equations(poses, forward, backward, centre, surface_m):
    """Return gradients (m, 6) and matrices (m, 6, 6) of poses (m, 12), see `equations`."""
    group = 16  # poses that share one room
    gradients, matrices = np.empty((poses.shape[0], 6)), np.empty((poses.shape[0], 6, 6))
    for number in numba.prange((poses.shape[0] + group - 1) // group):
        room = workspace(forward, backward)
        for i in range(number * group, min((number + 1) * group, poses.shape[0])):
            equations(poses[i], forward, backward, centre, surface_m, room, gradients[i], matrices[i])
    return gradients, matrices


@numba.njit(cache=True)
def normal_equation(pose, forward, backward, centre, surface_m):
    """Return the gradient (6,) and the matrix (6, 6) of one pose (12,): to wake other threads would take longer."""
    gradient, matrix = np.empty(6), np.empty((6, 6))
    equations(pose, forward, backward, centre, surface_m, workspace(forward, backward), gradient, matrix)
    return gradient, matrix


@numba.njit(cache=True, parallel=True, error_model="numpy")
def descend(poses, forward, backward, centre, surface_m, regulariser, steps):
    """Return poses (m, 12) after so many damped Gauss-Newton steps, each held by a `Regulariser`; see `equations`."""
    group = 4
    moved = poses.copy()
    for number in numba.prange((poses.shape[0] + group - 1) // group):
        room, gradient, matrix = workspace(forward, backward), np.empty(6), np.empty((6, 6))
        step, further, rotation = np.empty(6), np.empty(12), np.empty((3, 3))
        for i in range(number * group, min((number + 1) * group, poses.shape[0])):
            for _ in range(steps):
                equations(moved[i], forward, backward, centre, surface_m, room, gradient, matrix)
                regularised_step(moved[i], regulariser, centre, gradient, matrix, step)
                turn(moved[i], step, centre, rotation, further)
                moved[i] = further
    return moved


@numba.njit(cache=True)
def regularised_step(pose, regulariser, centre, gradient, matrix, step):
    """Write the Gauss-Newton step (6,) of a pose (12,) from its normal equations; overwrites the matrix."""
    away = difference(regulariser.mean, pose, centre)
    for k in range(6):
        step[k] = gradient[k]
        for m in range(6):
            step[k] -= regulariser.precision[k, m] * away[m]
            matrix[k, m] += regulariser.precision[k, m]
        matrix[k, k] += regulariser.damping[k]
    solve_positive(matrix, step)
    angle = math.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    if angle > regulariser.max_step_rad:
        for k in range(6):
            step[k] *= regulariser.max_step_rad / angle


@numba.njit(cache=True)
def solve_positive(matrix, vector):
    """Solve a positive definite system (6, 6) in place, by Cholesky's factors; the matrix is spoilt."""
    for k in range(6):
        for m in range(k + 1):
            total = matrix[k, m]
            for u in range(m):
                total -= matrix[k, u] * matrix[m, u]
            matrix[k, m] = math.sqrt(max(total, 1e-300)) if k == m else total / matrix[m, m]
        for u in range(k):
            vector[k] -= matrix[k, u] * vector[u]
        vector[k] /= matrix[k, k]
    for k in range(5, -1, -1):
        for u in range(k + 1, 6):
            vector[k] -= matrix[u, k] * vector[u]
        vector[k] /= matrix[k, k]
