"""Gauss-Newton steps on matching surface and its colours: normal equations of a pair, and descent."""

import math
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from modeler.kernels.lie_group import difference, retract
from modeler.kernels.photometric import add_colour_equations, new_colour_workspace
from modeler.kernels.point_to_plane import equations, new_workspace


class Regulariser(NamedTuple):
    """Gaussian prior and damping of a descent (method.md, eq. 10)."""

    mean: npt.NDArray[np.float64]
    """(12,) rows of the prior's mean."""
    precision: npt.NDArray[np.float64]
    """(6, 6) Λ of ξ about the centre."""
    damping: npt.NDArray[np.float64]
    """(6,) diagonal of D."""
    max_step_rad: float
    """Largest rotation of a step."""


@numba.njit(cache=True, parallel=True, error_model="numpy")
def normal_equations(poses, forward, backward, colours, colours_back, weight, centre, surface_m):
    """Return gradients (m, 6) and matrices (m, 6, 6) of poses (m, 12), see `point_to_plane.equations`.

    Args:
        poses: rows of the 3×4 matrices of target_from_source.
        forward: the `Projection` of the source's points in the target, and
        backward: of the target's in the source.
        colours: the `ColourProjection` of the source's points in the target, without points where there is none, and
        colours_back: of the target's in the source.
        weight: inverse variance of the difference of features (method.md, eq. 20).
        centre: (3,) point of the source in m.
        surface_m: noise of the surfaces in m beyond that of points and planes.
    """
    group = 16  # poses per workspace
    gradients, matrices = np.empty((poses.shape[0], 6)), np.empty((poses.shape[0], 6, 6))
    for number in numba.prange((poses.shape[0] + group - 1) // group):
        workspace, colour_workspace = new_workspace(forward, backward), new_colour_workspace(colours, colours_back)
        for i in range(number * group, min((number + 1) * group, poses.shape[0])):
            equations(poses[i], forward, backward, centre, surface_m, workspace, gradients[i], matrices[i])
            add_colour_equations(
                poses[i],
                colours,
                colours_back,
                weight,
                centre,
                surface_m,
                colour_workspace,
                gradients[i],
                matrices[i],
            )
    return gradients, matrices


@numba.njit(cache=True, parallel=True, error_model="numpy")
def descend(poses, forward, backward, colours, colours_back, weight, centre, surface_m, regulariser, steps):
    """Return poses (m, 12) after damped Gauss-Newton steps with a `Regulariser`; see `normal_equations`."""
    group = 4
    moved = poses.copy()
    for number in numba.prange((poses.shape[0] + group - 1) // group):
        workspace, colour_workspace = new_workspace(forward, backward), new_colour_workspace(colours, colours_back)
        gradient, matrix = np.empty(6), np.empty((6, 6))
        step, further, rotation = np.empty(6), np.empty(12), np.empty((3, 3))
        for i in range(number * group, min((number + 1) * group, poses.shape[0])):
            for _ in range(steps):
                equations(moved[i], forward, backward, centre, surface_m, workspace, gradient, matrix)
                add_colour_equations(
                    moved[i], colours, colours_back, weight, centre, surface_m, colour_workspace, gradient, matrix
                )
                regularised_step(moved[i], regulariser, centre, gradient, matrix, step)
                retract(moved[i], step, centre, rotation, further)
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
    solve_positive_definite(matrix, step)
    angle = math.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    if angle > regulariser.max_step_rad:
        for k in range(6):
            step[k] *= regulariser.max_step_rad / angle


@numba.njit(cache=True)
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
