"""What errors of poses and of the focal length do to the surface fused under them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from modeler import se3
from modeler.fusion.fuser import Fuser
from modeler.types import SOME_VIEWS, Array, FocalLength, ObjectModel, Solution, spread

_ROWS: Final = 1 << 13  # vertices at a time, which bounds memory
_UPPER: Final = np.triu_indices(6)


def widened(model: ObjectModel, solution: Solution) -> ObjectModel:
    """Return a model whose vertex uncertainty includes that of poses and focal length (method, eq. 12.9).

    Errors that move the model as a whole are no uncertainty of its surface.

    Args:
        model: fused under the solution's poses.
        solution: with covariances of motions; without these, poses count as exact.
    """
    frames = spread(list(solution.trajectory), SOME_VIEWS)
    if model.vertex_sigmas_m is None or not (solution.focal or solution.knows_motions) or len(frames) == 0:
        return model
    shares = _shares(model, [solution.trajectory[frame] for frame in frames])
    variances_m2 = np.zeros(len(shares))
    if solution.focal is not None:
        variances_m2 += (solution.focal.sigma * _by_focal(model, shares, solution, solution.focal, frames)) ** 2
    if solution.knows_motions and len(frames) > 1:
        variances_m2 += _of_poses(model, shares, solution, frames)
    return replace(model, vertex_sigmas_m=np.sqrt(model.vertex_sigmas_m**2 + variances_m2))


def _shares(model: ObjectModel, poses: Sequence[Array]) -> Array:
    """Return the share (v, f) of each view in each vertex: its cosine, as far as it contributes to the mesh."""
    shares = np.zeros((len(model.vertices_m), len(poses)))
    for k, object_from_camera in enumerate(poses):
        rays = object_from_camera[:3, 3] - model.vertices_m
        cosines = np.sum(model.vertex_normals * rays, axis=1) / np.linalg.norm(rays, axis=1)
        shares[:, k] = np.where(cosines >= Fuser.min_cosine, cosines, 0.0)
    totals = shares.sum(axis=1, keepdims=True)
    return np.divide(shares, totals, out=np.zeros_like(shares), where=totals > 0.0)


def _by_focal(
    model: ObjectModel, shares: Array, solution: Solution, focal: FocalLength, frames: Sequence[int]
) -> Array:
    """Return by how much (v,) in m vertices move along their normals if the logarithm of the focal length is 1 off."""
    moved_m = np.zeros(len(shares))
    for share, frame in zip(shares.T, frames, strict=True):
        object_from_camera, by_focal = solution.trajectory[frame], focal.by_focal.get(frame, np.zeros(6))
        points_m = se3.transform(se3.inverse(object_from_camera), model.vertices_m)
        drawn = (points_m * (-1.0, -1.0, 0.0)) @ object_from_camera[:3, :3].T
        shift = drawn + np.cross(by_focal[:3], model.vertices_m) + by_focal[3:]
        moved_m += share * np.sum(model.vertex_normals * shift, axis=1)
    return moved_m


def _of_poses(model: ObjectModel, shares: Array, solution: Solution, frames: Sequence[int]) -> Array:
    """Return the variance (v,) in m² along the normals by errors of poses relative to the mean of all poses.

    With errors η of poses in the object frame, surface moves by J Σ b η, where b are shares less those of the mean.
    As Σ b = 0, its variance is -Σ b_i b_j J C_ij Jᵀ over pairs, C being the covariance of η_i - η_j.
    """
    first, second = np.triu_indices(len(frames), 1)
    packed = np.empty((21, len(first)))
    for column, (i, j) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        turned = se3.adjoint(solution.trajectory[frames[j]])
        packed[:, column] = (turned @ solution.deforming_covariance(frames[i], frames[j]) @ turned.T)[_UPPER]
    twice = np.where(_UPPER[0] == _UPPER[1], 1.0, 2.0)
    variances_m2 = np.zeros(len(shares))
    for start in range(0, len(shares), _ROWS):
        some = slice(start, start + _ROWS)
        normals, apart = model.vertex_normals[some], shares[some] - 1.0 / len(frames)
        rows = np.concatenate([np.cross(model.vertices_m[some], normals), normals], axis=1)
        squares = (twice * rows[:, _UPPER[0]] * rows[:, _UPPER[1]]) @ packed
        variances_m2[some] = -np.sum(squares * apart[:, first] * apart[:, second], axis=1)
    seen = shares.any(axis=1)
    return np.where(seen, np.maximum(variances_m2, 0.0), 0.0)
