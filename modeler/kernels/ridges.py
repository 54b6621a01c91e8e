"""Walks along ridges of the posterior: out along the least determined direction, and down only across it."""

import math
from typing import NamedTuple

import numba
import numpy as np

from modeler.kernels.matching import equations, held_step, workroom
from modeler.kernels.moves import turn
from modeler.kernels.sight import Sight, buffers
from modeler.kernels.visibility import Model, compare


class Ground(NamedTuple):
    """What a walker looks at, and when it turns back."""

    forward: Sight
    """The source's points in the target, and"""
    backward: Sight
    """the target's in the source: those that lead downhill."""
    judging_forward: Sight
    """More of the source's points in the target, and"""
    judging_backward: Sight
    """of the target's in the source: those that tell how good a place is."""
    forward_model: Model
    """The likelihood of either direction, and"""
    backward_model: Model
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
    sights, models = (ground.judging_forward, ground.judging_backward), (ground.forward_model, ground.backward_model)
    plain, explained = compare(pose, sights[0], sights[1], models[0], models[1], room)
    return ground.per_point * plain - ground.no_overlap * math.exp(-ground.per_explained * explained)


@numba.njit(cache=True, error_model="numpy")
def walk(poses, spreads, axes, stride, ground, centre, surface_m, pull, max_strides):
    """Walk from each pose along its axis until it is no longer good, with two Gauss-Newton steps across after each.

    Args:
        poses: (k, 12) where walkers start.
        spreads: (k, 6, 6) lower triangular roots of the covariances of ξ about the centre.
        axes: (k, 6) unit vectors in units of those spreads.
        stride: length of a stride in such units.
        ground: see `Ground`.
        centre: (3,) point of the source in m.
        surface_m: noise of the surfaces in m beyond that of points and planes.
        pull: see `Pull`.
        max_strides: a walker takes at most so many.

    Returns:
        (k, max_strides, 12) the places visited, and how many (k,) of them are good.
    """
    visited, counts = np.empty((len(poses), max_strides, 12)), np.zeros(len(poses), dtype=np.int64)
    room, gradient, matrix = workroom(ground.forward, ground.backward), np.empty(6), np.empty((6, 6))
    looked = buffers(ground.judging_forward), buffers(ground.judging_backward), np.empty(12)
    step, z, rotation = np.empty(6), np.empty(6), np.empty((3, 3))
    pose, moved = np.empty(12), np.empty(12)
    for i in range(len(poses)):
        pose[:] = poses[i]
        for number in range(max_strides):
            for k in range(6):
                z[k] = stride * axes[i, k]
            spread_out(spreads[i], z, step)
            turn(pose, step, centre, rotation, moved)
            pose[:] = moved
            for _ in range(2):
                equations(pose, ground.forward, ground.backward, centre, surface_m, room, gradient, matrix)
                held_step(pose, pull, centre, gradient, matrix, step)
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
