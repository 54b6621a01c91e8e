"""Gauss-Newton steps on matching surface and its colours: normal equations of a pair, and descent."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from modeler.kernels.cache import njit
from modeler.kernels.lie_group import difference, retract
from modeler.kernels.photometric import CELL_SIZE, fetch_colours, linearise_features
from modeler.kernels.point_likelihood import (
    COLUMN,
    FACING,
    PATTERN,
    ROW,
    VECTOR_MATHS,
    ZERO,
    X,
    Y,
    Z,
    buffers,
    project,
    write_transform,
)
from modeler.kernels.point_to_plane import linearise
from modeler.kernels.threads import over_rows

_ROWS = 9  # of a match's equation: six derivatives, residual, weight, and a buffer for products


class Regulariser(NamedTuple):
    """Gaussian prior and damping of a descent (method, eq. 5.2)."""

    mean: npt.NDArray[np.float64]
    """(12,) rows of the prior's mean."""
    precision: npt.NDArray[np.float64]
    """(6, 6) Λ of ξ about the centre."""
    damping: npt.NDArray[np.float64]
    """(6,) diagonal of D."""
    max_step_rad: float
    """Largest rotation of a step."""


_NO_PRIOR = Regulariser(np.eye(4)[:3].ravel(), np.zeros((6, 6)), np.zeros(6), 0.0)


def normal_equations(poses, surfaces, colours, weight, centre, surface_m):
    """Return gradients (m, 2, 6) and matrices (m, 2, 6, 6) of surface and of colours at poses (m, 12), see `equations`.

    Args:
        poses: rows of the 3×4 matrices of target_from_source; or (m, 13), see `write_transform`. Derivatives are then
            those of points as they are, which differ from those under the true focal length by its relative error.
        surfaces: the `Projection` of the source's points in the target, and that of the target's in the source.
        colours: their `Colours`, or `photometric.NO_COLOURS`.
        weight: inverse variance of the difference of features (method, eq. 7.4).
        centre: (3,) point of the source in m.
        surface_m: noise of the surfaces in m beyond that of points and planes.
    """
    _, gradients, matrices = over_rows(_iterate, poses, surfaces, colours, weight, centre, surface_m, _NO_PRIOR, 0)
    return gradients, matrices


def descend(poses, surfaces, colours, weight, centre, surface_m, regulariser, steps):
    """Return poses (m, 12) after damped Gauss-Newton steps with a `Regulariser`; see `normal_equations`."""
    return over_rows(_iterate, poses, surfaces, colours, weight, centre, surface_m, regulariser, steps)[0]


@njit(cache=True, nogil=True, error_model="numpy")
def _iterate(poses, surfaces, colours, weight, centre, surface_m, regulariser, steps):
    """Return poses (m, 12) after some steps, possibly none, and the `equations` last evaluated."""
    moved, gradients, matrices = poses.copy(), np.empty((poses.shape[0], 2, 6)), np.empty((poses.shape[0], 2, 6, 6))
    workspace = new_workspace(surfaces)
    buffer, step, further, rotation = np.empty((6, 6)), np.empty(6), np.empty(12), np.empty((3, 3))
    for i in range(poses.shape[0]):
        for _ in range(max(steps, 1)):
            equations(moved[i], surfaces, colours, weight, centre, surface_m, workspace, gradients[i], matrices[i])
            if steps > 0:
                regularised_step(moved[i], regulariser, centre, gradients[i], matrices[i], buffer, step)
                retract(moved[i], step, centre, rotation, further)
                for k in range(12):
                    moved[i, k] = further[k]
    return moved, gradients, matrices


@njit(cache=True)
def new_workspace(surfaces):
    """Return the buffers of `equations`."""
    count = max(surfaces[0].points.shape[1], surfaces[1].points.shape[1])
    cells, rows = np.empty((CELL_SIZE, count), dtype=np.float32), np.empty((_ROWS, count), dtype=np.float32)
    small = np.empty(12), np.empty(3), np.empty(6), np.empty((6, 6)), np.empty((6, 6)), np.empty(6), np.empty((6, 6))
    return buffers(count), cells, rows, (*small, np.empty(6))


@njit(cache=True, error_model="numpy", inline="always")
def equations(pose, surfaces, colours, weight, centre, surface_m, workspace, gradient, matrix):
    """Write the normal equations of matches, for ξ of a pose about the centre (method, eq. 5.2 and 7.4).

    For small motions ζ = (ω, v) of transformed points about a point c, x → c + exp(ω)(x - c) + v, the gradient is
    -Σ w a r and the matrix Σ w a aᵀ with a = ((x - c) × n, n), n the surface's normal or a feature's gradient. In the
    target, a source point moves by ζ = (R ω, R v) about the transformed centre; in the source, a target point moves by
    -ξ about the centre. One loop over directions and kinds of equations, since compiling is slow.

    Args:
        pose: (12,) rows of target_from_source; or (13,), see `write_transform`.
        surfaces: see `normal_equations`.
        colours: see `normal_equations`.
        weight: see `normal_equations`.
        centre: see `normal_equations`.
        surface_m: see `normal_equations`.
        workspace: of `new_workspace`.
        gradient: (2, 6) out: of surface, and of its colours.
        matrix: (2, 6, 6) out: the same.
    """
    (transformed, pixels, found), colour, rows, small = workspace
    transform, about, part, block, rotated, turned, turned_block, apart = small
    surface_m2 = np.float32(surface_m * surface_m)
    gradient[:] = 0.0
    matrix[:] = 0.0
    for term in range(4):
        direction, kind = term // 2, term % 2
        surface, features = surfaces[direction], colours[direction]
        count = surface.points.shape[1]
        if kind == 0:
            write_transform(pose, direction == 1, transform)
            for k in range(3):
                about[k] = centre[k]
                if direction == 0:
                    about[k] = transform[4 * k + 3]
                    for m in range(3):
                        about[k] += transform[4 * k + m] * centre[m]
            project(transform, surface, transformed, pixels, found)
            linearise(surface.points, transformed, found, about, surface_m2, rows)
            add_pattern_gradient(surface, transformed, about, rows, apart)
        elif features.values.shape[0] == 0:
            continue
        else:
            fetch_colours(count, pixels, features, colour)
            linearise_features(features.values, transformed, colour, about, weight, rows)
        accumulate(rows, count, part, block)
        if kind == 0:
            for k in range(6):
                part[k] += apart[k]
        if direction == 0:
            rotate_to_source(pose, part, block, rotated, turned, turned_block)
        else:
            for k in range(6):
                turned[k] = -part[k]
                for m in range(6):
                    turned_block[k, m] = block[k, m]
        for k in range(6):
            gradient[kind, k] += turned[k]
            for m in range(6):
                matrix[kind, k, m] += turned_block[k, m]


@njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def accumulate(rows, count, gradient, matrix):
    """Write the gradient (6,), -Σ w a r, and the matrix (6, 6), Σ w a aᵀ, of the first equations in `rows` (9, n)."""
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


@njit(cache=True, error_model="numpy")
def add_pattern_gradient(surface, transformed, about, rows, gradient):
    """Add the fixed pattern's part to the gradient (6,) by ζ about a point (3,) (method, eq. 4.9).

    Args:
        surface: the `Projection` of the points.
        transformed: (9, n), see `project`.
        about: the point in m.
        rows: (9, n) of `linearise`; only matches count.
        gradient: out.
    """
    gradient[:] = 0.0
    share, per_square = surface.pattern[0], surface.pattern[1]
    fx, fy, cx, cy = surface.camera[0], surface.camera[1], surface.camera[2], surface.camera[3]
    for j in range(surface.points.shape[1]):
        if transformed[PATTERN, j] <= ZERO or rows[7, j] <= ZERO:
            continue
        x, y, z = transformed[X, j], transformed[Y, j], transformed[Z, j]
        across, down = fx * x / z + cx - surface.points[COLUMN, j], fy * y / z + cy - surface.points[ROW, j]
        correlation = 1.0 - (across * across + down * down) * per_square
        slope = 2.0 * share * transformed[FACING, j] * correlation * per_square / z
        gx, gy = slope * fx * across, slope * fy * down
        gz = -(gx * x + gy * y) / z
        x, y, z = x - about[0], y - about[1], z - about[2]
        gradient[0] += y * gz - z * gy
        gradient[1] += z * gx - x * gz
        gradient[2] += x * gy - y * gx
        gradient[3] += gx
        gradient[4] += gy
        gradient[5] += gz


@njit(cache=True)
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


@njit(cache=True)
def regularised_step(pose, regulariser, centre, gradient, matrix, buffer, step):
    """Write the Gauss-Newton step (6,) of a pose (12,) from its `equations`; `buffer` (6, 6) is overwritten."""
    away = difference(regulariser.mean, pose, centre)
    for k in range(6):
        step[k] = gradient[0, k] + gradient[1, k]
        for m in range(6):
            step[k] -= regulariser.precision[k, m] * away[m]
            buffer[k, m] = matrix[0, k, m] + matrix[1, k, m] + regulariser.precision[k, m]
        buffer[k, k] += regulariser.damping[k]
    solve_positive_definite(buffer, step)
    angle = math.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    if angle > regulariser.max_step_rad:
        for k in range(6):
            step[k] *= regulariser.max_step_rad / angle


@njit(cache=True)
def solve_positive_definite(matrix, vector):
    """Solve a positive definite system (6, 6) in place, by Cholesky factors; overwrites the matrix."""
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
