"""The uncertainty of a run's poses, of its model's size, and of the surface fused under these poses.

`about_mean` is that of a run's solution, and `factor` is `misfit`, on standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from scipy.special import ndtr, ndtri

from modeler import se3
from modeler.fusion import Fuser
from modeler.fusion.depth_views import BATCH
from modeler.significance import OUTSIDE
from modeler.system.disk_arrays import release
from modeler.types import (
    SOME_POINTS,
    SOME_VIEWS,
    Array,
    Check,
    Edge,
    FocalLength,
    ObjectModel,
    RayImage,
    Solution,
    spread,
)
from modeler.verdict.evidence import MAX_VIOLATIONS, WRONG_RAD, graph_check

_NODES: Final = 24  # of quadrature along an axis: shares of 5 % are then accurate to 0.1 %


@dataclass(frozen=True)
class Spread:
    """The frame with the most uncertain pose."""

    frame: int
    """Frame number."""
    check: Check
    """Standard deviation, see `one_axis_sd`. At the limit, a Gaussian is wrong with probability `OUTSIDE`."""
    count: int
    """Number of frames beyond the limit."""
    by_focal_m: float = 0.0
    """Part of a position's standard deviation in m that is due to the focal length."""


def misfit(edges: Sequence[Edge], solution: Solution) -> float:
    """Return the factor by which residuals of edges exceed their standard deviations, at least 1."""
    fit = graph_check(edges, solution)
    return 1.0 if fit is None else float(np.sqrt(max(fit.value, 1.0)))


@dataclass(frozen=True, eq=False)
class AboutMean:
    """Uncertainty of poses from their mean: a motion of all poses together changes nothing of a model."""

    covariances: Mapping[int, Array] = field(default_factory=dict)
    """By frame number (6, 6), in its camera's coordinates, without what is due to the focal length: that is part of the
    model's size (`size_check`) and of `spread_of_positions`."""
    weights: Mapping[int, float] = field(default_factory=dict)
    """Weights in the mean of some frames, spread over the run, that sum to 1: one of unknown pose moves it little."""

    @classmethod
    def of(cls, solution: Solution) -> AboutMean:
        """Return the uncertainty of solved poses; without that of motions between any two, relative to the first."""
        frames = sorted(solution.covariances)
        if not solution.has_relative_covariances or len(frames) < 2:
            return cls({k: _given_focal_length(solution, k, None) for k in frames}, dict.fromkeys(frames[:1], 1.0))
        some = spread(frames, SOME_VIEWS)
        to_object = {frame: se3.adjoint(solution.trajectory[frame]) for frame in frames}
        apart = {
            (frame, other): to_object[frame] @ _given_focal_length(solution, frame, other) @ to_object[frame].T
            for frame in frames
            for other in some
            if other != frame
        }
        rotations = {k: [np.trace(apart[k, other][:3, :3]) for other in some if other != k] for k in some}
        precisions = {frame: 1.0 / max(float(np.median(rotations[frame])), 1e-12) for frame in some}
        weights = {frame: precision / sum(precisions.values()) for frame, precision in precisions.items()}
        # Of errors x with D(k, j) = cov(x_k - x_j): cov(x_k - x̄) = Σ w_j D(k, j) - ½ Σ w_i w_j D(i, j).
        to_mean = {frame: np.zeros((6, 6)) for frame in frames}
        for (frame, other), covariance in apart.items():
            to_mean[frame] += weights[other] * covariance
        among = 0.5 * sum((weight * to_mean[frame] for frame, weight in weights.items()), np.zeros((6, 6)))
        from_object = {frame: se3.adjoint(se3.inverse(solution.trajectory[frame])) for frame in frames}
        return cls({k: from_object[k] @ (to_mean[k] - among) @ from_object[k].T for k in frames}, weights)

    def but_for(self, turns: Array, trajectory: Mapping[int, Array]) -> AboutMean:
        """Return the uncertainty without that of turns under which the surface stays as it is.

        Args:
            turns: (k, 6) ξ of turns by 1 rad about an axis, or about three at right angles, in the object frame.
            trajectory: object_from_camera (4, 4) by frame number.
        """
        covariances = {}
        for frame, covariance in self.covariances.items():
            rest = np.eye(6)
            for here in turns @ se3.adjoint(se3.inverse(trajectory[frame])).T:
                rest -= np.outer(here, np.concatenate([here[:3], np.zeros(3)]))  # ξ less its angle about the axis
            covariances[frame] = rest @ covariance @ rest.T
        return replace(self, covariances=covariances)


def spread_of_rotations(about_mean: AboutMean, factor: float = 1.0) -> Spread | None:
    """Return the largest uncertainty of a pose's rotation, in degrees; None without a pose."""
    sigmas_deg = {
        frame: float(np.degrees(one_axis_sd(factor**2 * covariance[:3, :3], WRONG_RAD)))
        for frame, covariance in about_mean.covariances.items()
    }
    return _widest(sigmas_deg, float(np.degrees(WRONG_RAD)))


def spread_of_positions(
    views: Mapping[int, RayImage],
    solution: Solution,
    about_mean: AboutMean,
    tolerance_m: float,
    factor: float = 1.0,
) -> Spread | None:
    """Return the largest uncertainty of the surface's position in a pose, in m; None without a pose.

    What moves the surface of all views alike is not included, because it does not deform the model: a common shift, and
    the stretch that a wrong focal length causes. Smooth errors of depth are included.

    Args:
        views: by frame number; the position is that of a view's centroid.
        solution: the poses.
        about_mean: of the solution.
        tolerance_m: error of the surface above which a model is wrong.
        factor: on the standard deviations: `misfit`.
    """
    sigmas_m, deformed_m = {}, deformation_by_focal_length(views, solution)
    for frame, covariance in about_mean.covariances.items():
        if frame in views and len(views[frame].points_m):
            of_place = se3.covariance_about(covariance, views[frame].centroid_m)[3:, 3:]
            of_place = of_place - _of_common_shift(solution, frame, about_mean.weights)
            given_m = one_axis_sd(factor**2 * of_place, tolerance_m)
            smooth_m = np.sqrt(solution.variance_factor) * views[frame].multipath_m
            sigmas_m[frame] = float(np.linalg.norm([given_m, deformed_m.get(frame, 0.0), smooth_m]))
    widest = _widest(sigmas_m, tolerance_m)
    return None if widest is None else replace(widest, by_focal_m=deformed_m.get(widest.frame, 0.0))


def _given_focal_length(solution: Solution, frame: int, reference: int | None) -> Array:
    """Return the covariance (6, 6) of a frame's pose without what is due to the focal length.

    Args:
        solution: the poses.
        frame: number of the frame.
        reference: number of the frame without error; None: the first.
    """
    covariance = solution.covariances[frame] if reference is None else solution.relative_covariance(reference, frame)
    focal = solution.focal
    if focal is None or frame not in focal.by_focal:
        return covariance
    apart = focal.by_focal[frame] - (0.0 if reference is None else focal.by_focal.get(reference, 0.0))
    xi = focal.sigma * se3.adjoint(se3.inverse(solution.trajectory[frame])) @ apart  # eq. 10.6
    return covariance - np.outer(xi, xi)


def deformation_by_focal_length(views: Mapping[int, RayImage], solution: Solution) -> dict[int, float]:
    """Return by frame how a focal length wrong by one standard deviation deforms the model, in m (root mean square).

    It stretches every view and moves its pose. What all views have in common, an affine map of the object, changes the
    size of the model and its proportions by as much as the focal length; the rest puts the views' surfaces apart.
    """
    focal = solution.focal
    frames = [frame for frame in views if focal is not None and frame in focal.by_focal and len(views[frame].points_m)]
    if focal is None or not frames:
        return {}
    ends = np.cumsum([len(_some_points_m(views[frame])) for frame in frames])
    design, shift_m = np.ones((ends[-1], 4)), np.zeros((ends[-1], 3))  # of all views: little else of that size
    for frame, here, rows in zip(frames, np.split(design, ends[:-1]), np.split(shift_m, ends[:-1]), strict=True):
        points_m, by_focal = _some_points_m(views[frame]), focal.by_focal[frame]
        place_m = se3.transform(solution.trajectory[frame], points_m)
        here[:, :3] = place_m
        stretch_m = -(points_m * [1.0, 1.0, 0.0]) @ solution.trajectory[frame][:3, :3].T
        rows[:] = focal.sigma * (stretch_m + by_focal[3:] + np.cross(by_focal[:3], place_m))
        release(views[frame].points_m)
    design[:, :3] -= design[:, :3].mean(axis=0)
    shift_m -= design @ np.linalg.lstsq(design, shift_m, rcond=None)[0]
    return {
        frame: float(np.sqrt(np.mean(np.sum(part**2, axis=1))))
        for frame, part in zip(frames, np.split(shift_m, ends[:-1]), strict=True)
    }


def _some_points_m(view: RayImage) -> Array:
    """Return some hundreds of the points of a view."""
    return view.points_m[:: max(len(view.points_m) // SOME_POINTS, 1)]


def _of_common_shift(solution: Solution, frame: int, weights: Mapping[int, float]) -> Array:
    """Return the covariance (3, 3) in m² of a frame's position due to a shift in all views (method, eq. 8.10)."""
    if solution.common_shift_m2 is None:
        return np.zeros((3, 3))
    mean = sum((weight * solution.trajectory[k][:3, :3] for k, weight in weights.items()), np.zeros((3, 3)))
    left = np.eye(3) - solution.trajectory[frame][:3, :3].T @ mean
    return np.asarray(left @ solution.common_shift_m2 @ left.T, dtype=np.float64)


def one_axis_sd(covariance: Array, wrong: float) -> float:
    """Return the standard deviation of an error along one axis that is wrong as often as a vector (3,).

    It is at least that of the least certain axis; other uncertain axes increase it, at most to the root mean square
    length, which counts where nearly every error is wrong.

    Args:
        covariance: (3, 3) of the vector.
        wrong: length above which it is wrong.
    """
    small, middle, large = np.maximum(np.linalg.eigvalsh(covariance), 1e-300)
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    # Given the components along two axes, the third is a Gaussian that has to make up for the rest.
    rest = wrong**2 - small * nodes[:, None] ** 2 - middle * nodes**2
    beyond = 2.0 * ndtr(-np.sqrt(np.maximum(rest, 0.0) / large))
    share = float(weights @ beyond @ weights / weights.sum() ** 2)
    quantile = float(-ndtri(0.5 * share))  # infinite if no error is wrong, 0 if every error is
    equivalent = wrong / quantile if quantile > 0.0 else np.inf
    return float(np.clip(equivalent, np.sqrt(large), np.sqrt(small + middle + large)))


def _widest(sigmas: Mapping[int, float], wrong: float) -> Spread | None:
    """Return the largest standard deviation by frame number; `wrong` is the error above which a pose is wrong."""
    limit = wrong / float(-ndtri(OUTSIDE / 2.0))
    worst = max(sigmas, key=lambda frame: sigmas[frame], default=None)
    if worst is None:
        return None
    return Spread(worst, Check(sigmas[worst], limit), sum(sigma > limit for sigma in sigmas.values()))


def total_depth_scale_sigma(given: float, focal: FocalLength | None) -> float:
    """Return the standard deviation of the depth scale's logarithm.

    Loops cannot separate focal length and relief of the depth, so that the scale of one of them is as uncertain as they
    moved the other.

    Args:
        given: as the camera was given.
        focal: estimated from the loops of the run.
    """
    return given if focal is None else math.hypot(given, 0.5 * focal.log_factor)


def size_check(
    views: Mapping[int, RayImage], trajectory: Mapping[int, Array], scale_sigma: float, tolerance_m: float
) -> Check:
    """Return the uncertainty of the surface in m due to that of the model's scale.

    A model is called wrong if less than 90 % of its surface lies within the tolerance: its reach is the distance from
    its centre within which 90 % of the points lie.

    Args:
        views: by frame number.
        trajectory: object_from_camera (4, 4) by frame number.
        scale_sigma: standard deviation of the scale's logarithm.
        tolerance_m: error of the surface above which a model is wrong.
    """
    surfaces_m = []
    for frame, view in views.items():
        if frame in trajectory:
            surfaces_m.append(se3.transform(trajectory[frame], _some_points_m(view)))
            release(view.points_m)
    surface_m = np.concatenate(surfaces_m) if surfaces_m else np.zeros((1, 3))
    reach_m = np.quantile(np.linalg.norm(surface_m - surface_m.mean(axis=0), axis=1), 1.0 - MAX_VIOLATIONS)
    return Check(scale_sigma * float(reach_m), tolerance_m)


def widened(model: ObjectModel, solution: Solution) -> ObjectModel:
    """Return a model whose vertex uncertainty includes that of poses and focal length (method, eq. 12.9).

    Errors that move the model as a whole are no uncertainty of its surface.

    Args:
        model: fused under the solution's poses.
        solution: with covariances of motions; without these, poses count as exact.
    """
    frames = spread(list(solution.trajectory), SOME_VIEWS)
    if model.vertex_sigmas_m is None or not (solution.focal or solution.has_relative_covariances) or len(frames) == 0:
        return model
    shares = _shares_of_views(model, [solution.trajectory[frame] for frame in frames])
    variances_m2 = np.zeros(len(shares))
    if solution.focal is not None:
        variances_m2 += (solution.focal.sigma * _moved_by_focal(model, shares, solution, solution.focal, frames)) ** 2
    if solution.has_relative_covariances and len(frames) > 1:
        variances_m2 += _of_poses(model, shares, solution, frames)
    return replace(model, vertex_sigmas_m=np.sqrt(model.vertex_sigmas_m**2 + variances_m2))


def _shares_of_views(model: ObjectModel, poses: Sequence[Array]) -> Array:
    """Return the share (v, f) of each view in each vertex: its cosine, as far as it contributes to the mesh."""
    shares = np.zeros((len(model.vertices_m), len(poses)))
    for k, object_from_camera in enumerate(poses):
        rays = object_from_camera[:3, 3] - model.vertices_m
        cosines = np.sum(model.vertex_normals * rays, axis=1) / np.linalg.norm(rays, axis=1)
        shares[:, k] = np.where(cosines >= Fuser.min_cosine, cosines, 0.0)
    totals = shares.sum(axis=1, keepdims=True)
    return np.divide(shares, totals, out=np.zeros_like(shares), where=totals > 0.0)


def _moved_by_focal(
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
    upper, (first, second) = np.triu_indices(6), np.triu_indices(len(frames), 1)
    packed = np.empty((21, len(first)))
    for column, (i, j) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        turned = se3.adjoint(solution.trajectory[frames[j]])
        packed[:, column] = (turned @ solution.deforming_covariance(frames[i], frames[j]) @ turned.T)[upper]
    twice = np.where(upper[0] == upper[1], 1.0, 2.0)
    variances_m2 = np.zeros(len(shares))
    for some in np.array_split(np.arange(len(shares)), max(-(-len(shares) * len(first) // BATCH), 1)):
        normals, apart = model.vertex_normals[some], shares[some] - 1.0 / len(frames)
        rows = np.concatenate([np.cross(model.vertices_m[some], normals), normals], axis=1)
        squares = (twice * rows[:, upper[0]] * rows[:, upper[1]]) @ packed
        variances_m2[some] = -np.sum(squares * apart[:, first] * apart[:, second], axis=1)
    seen = shares.any(axis=1)
    return np.where(seen, np.maximum(variances_m2, 0.0), 0.0)
