"""Walks along ridges of the posterior: out along the least determined direction, and down only across it."""

import math
from typing import NamedTuple

import numba
import numpy as np

from modeler.kernels.lie_group import turn
from modeler.kernels.matching import equations, regularised_step, workspace
from modeler.kernels.projection import Projection, buffers
from modeler.kernels.visibility import LikelihoodParameters, compare


class RidgeLikelihood(NamedTuple):
    """What a walker looks at, and when it turns back."""

    forward: Projection
    """The source's points in the target, and"""
    backward: Projection
    """the target's in the source: those used for descent."""
    scoring_forward: Projection
    """More of the source's points in the target, and"""
    scoring_backward: Projection
    """of the target's in the source: those that tell how good a place is."""
    forward_parameters: LikelihoodParameters
    """The likelihood of either direction, and"""
    backward_parameters: LikelihoodParameters
    """of the other."""
    per_point: float
    """Nats that a nat of the likelihood's is worth."""
    no_overlap: float
    """What it costs that no surface matches (nats)."""
    per_explained: float
    """By how many e-folds an explained point lowers that."""
    floor: float
    """A place worse than this is the end (nats)."""


@numba.njit(cache=True)
def height(pose, ground, room):
    """Return how good a pose (12,) is (nats): the tempered likelihood; room as for `visibility.compare`."""
    projections, parameters = (
        (ground.scoring_forward, ground.scoring_backward),
        (ground.forward_parameters, ground.backward_parameters),
    )
    plain, explained = compare(pose, projections[0], projections[1], parameters[0], parameters[1], room)
    return ground.per_point * plain - ground.no_overlap * math.exp(-ground.per_explained * explained)


@numba.njit(cache=True, error_model="numpy")
def walk(poses, spreads, axes, stride, ground, centre, surface_m, regulariser, max_ridge_steps):
    """Walk from each pose along its axis until it is no longer good, with two Gauss-Newton steps across after each.

    Args:
        poses: (k, 12) where tracing starts.
        spreads: (k, 6, 6) lower triangular roots of the covariances of ξ about the centre.
        axes: (k, 6) unit vectors in units of those spreads.
        stride: length of a stride in such units.
        ground: see `RidgeLikelihood`.
        centre: (3,) point of the source in m.
        surface_m: noise of the surfaces in m beyond that of points and planes.
        regulariser: see `Regulariser`.
        max_ridge_steps: a walker takes at most so many.

    Returns:
        (k, max_ridge_steps, 12) the places visited, and how many (k,) of them are good.
    """
    visited, counts = np.empty((len(poses), max_ridge_steps, 12)), np.zeros(len(poses), dtype=np.int64)
    room, gradient, matrix = workspace(ground.forward, ground.backward), np.empty(6), np.empty((6, 6))
    looked = buffers(ground.scoring_forward), buffers(ground.scoring_backward), np.empty(12)
    step, z, rotation = np.empty(6), np.empty(6), np.empty((3, 3))
    pose, moved = np.empty(12), np.empty(12)
    for i in range(len(poses)):
        pose[:] = poses[i]
        for number in range(max_ridge_steps):
            for k in range(6):
                z[k] = stride * axes[i, k]
            spread_out(spreads[i], z, step)
            turn(pose, step, centre, rotation, moved)
            pose[:] = moved
            for _ in range(2):
                equations(pose, ground.forward, ground.backward, centre, surface_m, room, gradient, matrix)
                regularised_step(pose, regulariser, centre, gradient, matrix, step)
                along = 0.0
                for k in range(6):  # in units of the spread
                    z[k] = step[k]
                    for m in range(k):
                        z[k] -= spreads[i, k, m] * z[m]
                    z[k] /= spreads[i, k, k]
                    along += axes[i, k] * z[k]
                for k in range(6):
                    z[k] -= along * axes[i, k]
                spread_out(spreads[i], z, step)
                turn(pose, step, centre, rotation, moved)
                pose[:] = moved
            if not height(pose, ground, looked) > ground.floor:
                break
            visited[i, number] = pose
            counts[i] = number + 1
    return visited, counts


@numba.njit(cache=True)
def spread_out(root, z, xi):
    """Write ξ (6,), a lower triangular root (6, 6) times z (6,)."""
    for k in range(6):
        xi[k] = 0.0
        for m in range(k + 1):
            xi[k] += root[k, m] * z[m]
