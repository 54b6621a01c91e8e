"""Local registration from the prior's centre: point-to-plane ICP and generalised ICP."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.spatial import KDTree

from modeler import se3
from modeler.registration.baselines.clouds import (
    AbstractCloudRegistrar,
    Cloud,
    Fit,
    cube_edges_m,
    matched,
    plane_residuals,
    residual_variance,
    whitened_jacobian,
)
from modeler.types import Array, RayImage

_STEP = 1e-6  # rad and m: a smaller step ends a level
_DAMPING = 1e-9  # share of the mean curvature; only holds directions still that no plane sees


@dataclass(frozen=True)
class AbstractMultiscaleRegistrar(AbstractCloudRegistrar):
    """A method that matches nearest points, from coarse to fine; levels left with too few points are passed over."""

    voxels: tuple[float, ...] = (1 / 8, 1 / 16, 1 / 32, 1 / 64)
    """Edge of the thinning cubes at each level, coarse to fine, as a share of the object's size."""
    reach: float = 2.0
    """Largest distance of partners, in cubes."""
    iterations: int = 60
    """Largest number of steps per level."""


@final
@dataclass(frozen=True)
class IcpRegistrar(AbstractMultiscaleRegistrar):
    """Match nearest points within reach and move onto their planes, level by level (Chen and Medioni 1992).

    As Open3D's multi-scale point-to-plane ICP with Tukey's weights: a pair whose point is as far from the plane as the
    reach has no weight left. The arithmetic is our own, since Open3D adds up its residuals in whatever order its
    threads finish, so that no two runs need agree to the last bit.
    """

    def fit(self, source: RayImage, target: RayImage, begin: Array, rng: np.random.Generator) -> Fit | None:
        """Return the local optimum nearest to the start."""
        return self.refine(Cloud.of(source), Cloud.of(target), begin)

    def refine(self, source: Cloud, target: Cloud, target_from_source: Array) -> Fit | None:
        """Return the local optimum nearest to a pose (4, 4); None where too few points are left to match."""
        return by_levels(
            (source, target), target_from_source, voxels=self.voxels, min_points=self.min_points, level=self._level
        )

    def _level(self, source: Cloud, target: Cloud, pose: Array, voxel_m: float) -> Fit:
        tree, reach_m = KDTree(target.points_m), self.reach * voxel_m

        def linearised(points_m: Array, pose: Array) -> Linearised:
            matches = matched(points_m, target, tree, pose, reach_m)
            residuals, jacobian = plane_residuals(matches, pose)
            return Linearised(residuals, _tukey(residuals / reach_m), jacobian, matches.fitness)

        return descended(source, pose, self.iterations, linearised)


@final
@dataclass(frozen=True, eq=False)
class Linearised:
    """A sum of squares at a pose."""

    residuals: Array
    """(n,)."""
    weights: Array
    """(n,) between 0 and 1."""
    jacobian: Array
    """(n, 6) by the ξ of `pose @ exp(ξ)`."""
    fitness: float
    """Share of the source's points that have a partner."""


def by_levels(
    clouds: tuple[Cloud, Cloud],
    target_from_source: Array,
    *,
    voxels: Sequence[float],
    min_points: int,
    level: Callable[[Cloud, Cloud, Array, float], Fit],
) -> Fit | None:
    """Return the fit of the finest level, each begun where the coarser one ended.

    Levels that thinning leaves with too few points are passed over.

    Args:
        clouds: of source and target.
        target_from_source: (4, 4) where to begin.
        voxels: edge of the thinning cubes at each level, coarse to fine, as a share of the object's size.
        min_points: fewest points a side; None is returned where there are fewer.
        level: fits thinned clouds from a pose (4, 4), given the edge of the cubes in m.
    """
    fit = None
    if min(len(cloud.points_m) for cloud in clouds) < min_points:
        return None
    for voxel_m in cube_edges_m(*clouds, voxels):
        thin = clouds[0].thinned(voxel_m), clouds[1].thinned(voxel_m)
        if min(len(cloud.points_m) for cloud in thin) >= min_points:
            fit = level(*thin, target_from_source if fit is None else fit.target_from_source, voxel_m)
    return fit


def descended(source: Cloud, pose: Array, iterations: int, linearised: Callable[[Array, Array], Linearised]) -> Fit:
    """Return where steps of Gauss and Newton end.

    Args:
        source: points to carry.
        pose: (4, 4) where to begin.
        iterations: largest number of steps.
        linearised: the sum of squares for points (n, 3) of the source at a pose (4, 4).
    """
    # About the centroid, rotation and translation hardly mix, and damping favours neither.
    source_from_centred = se3.translation(source.points_m.mean(axis=0))
    points = source.points_m - source_from_centred[:3, 3]
    pose = pose @ source_from_centred
    for _ in range(iterations):
        at = linearised(points, pose)
        hessian = (at.jacobian.T * at.weights) @ at.jacobian
        damping = (_DAMPING * np.trace(hessian) + np.finfo(float).tiny) * np.eye(6)
        step = np.linalg.solve(hessian + damping, -at.jacobian.T @ (at.weights * at.residuals))
        pose = pose @ se3.exp(step)
        if np.max(np.abs(step)) < _STEP:
            break
    pose = pose @ se3.inverse(source_from_centred)
    at = linearised(source.points_m, pose)
    return Fit(pose, whitened_jacobian(at.residuals, at.weights, at.jacobian), at.fitness)


def _tukey(ratios: Array) -> Array:
    return np.maximum(1.0 - ratios**2, 0.0) ** 2


@final
@dataclass(frozen=True)
class GicpRegistrar(AbstractMultiscaleRegistrar):
    """Align by small_gicp's GICP (Segal et al. 2009) from coarse to fine, and report its Hessian.

    small_gicp's tangent has rotation first and perturbs from the right, as ours does. It runs on one thread, since
    sums over threads are not the same from run to run.
    """

    neighbours: int = 10
    """Points from which the shape of a neighbourhood is taken."""

    def fit(self, source: RayImage, target: RayImage, begin: Array, rng: np.random.Generator) -> Fit | None:
        """Return the local optimum nearest to the start."""
        import small_gicp  # slow to load, and only needed here

        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return None
        # Between centred clouds, the damping of small_gicp's steps favours neither rotation nor translation.
        source_from_centred = se3.translation(source.centroid_m)
        target_from_centred = se3.translation(target.centroid_m)
        pose = se3.inverse(target_from_centred) @ begin @ source_from_centred
        centred = source.points_m - source.centroid_m, target.points_m - target.centroid_m
        jacobian, fitness = None, 0.0
        for voxel_m in cube_edges_m(Cloud.of(source), Cloud.of(target), self.voxels):
            (thin_source, _), (thin_target, tree) = (
                small_gicp.preprocess_points(points, voxel_m, self.neighbours) for points in centred
            )
            if min(thin_source.size(), thin_target.size()) < self.min_points:
                continue
            result = small_gicp.align(
                thin_target,
                thin_source,
                tree,
                pose,
                "GICP",
                max_correspondence_distance=self.reach * voxel_m,
                num_threads=1,
                max_iterations=self.iterations,
                rotation_epsilon=_STEP,
                translation_epsilon=_STEP,
            )
            pose, fitness = result.T_target_source, result.num_inliers / thin_source.size()
            curvatures, axes = np.linalg.eigh(result.H / residual_variance(2.0 * result.error, result.num_inliers))
            jacobian = np.sqrt(np.maximum(curvatures, 0.0))[:, None] * axes.T
        if jacobian is None:
            return None
        centred_from_source = se3.inverse(source_from_centred)
        jacobian = jacobian @ se3.adjoint(centred_from_source)
        return Fit(target_from_centred @ pose @ centred_from_source, jacobian, fitness)
