"""Local registration from the prior's centre: point-to-plane ICP, coloured ICP and generalised ICP."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from modeler import se3
from modeler.baselines.clouds import (
    AbstractCloudRegistrar,
    Cloud,
    Fit,
    Matches,
    cube_edges_m,
    matched,
    nearest,
    plane_residuals,
    residual_variance,
    whitened_jacobian,
)
from modeler.types import Array, RayImage

_STEP = 1e-6  # rad and m: a smaller step ends a level
FINE = (1 / 32, 1 / 64)  # voxels that start from a global registration, in sizes of the object
DAMPING = 1e-9  # relative to the mean curvature; only fixes unobservable directions

Level = Callable[[Cloud, Cloud, Array, float], Fit]
"""Fits downsampled clouds, source and target, from a pose (4, 4), given the voxel edge in m."""


@dataclass(frozen=True)
class AbstractMultiscaleRegistrar(AbstractCloudRegistrar):
    """A method that matches nearest points, from coarse to fine; levels with too few points are skipped."""

    voxels: tuple[float, ...] = (1 / 8, 1 / 16, 1 / 32, 1 / 64)
    """Voxel edge at each level, coarse to fine, as a fraction of the object's size."""
    reach: float = 2.0
    """Largest distance of correspondences, in voxels: at first a quarter of the object's size, as far as a step of 25°
    moves its rim."""
    iterations: int = 60
    """Largest number of steps per level: twice Open3D's default."""

    def by_levels(self, source: Cloud, target: Cloud, target_from_source: Array, level: Level) -> Fit | None:
        """Return the fit of the finest level, each starting from the result of the coarser; None without any level."""
        fit = None
        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return None
        for voxel_m in cube_edges_m(source, target, self.voxels):
            thin = source.thinned(voxel_m), target.thinned(voxel_m)
            if min(len(cloud.points_m) for cloud in thin) >= self.min_points:
                fit = level(*thin, target_from_source if fit is None else fit.target_from_source, voxel_m)
        return fit


@dataclass(frozen=True)
class IcpRegistrar(AbstractMultiscaleRegistrar):
    """Multi-scale point-to-plane ICP (Chen and Medioni 1992).

    As Open3D's, with Tukey weights that vanish at the largest distance of correspondences. Implemented here because
    Open3D sums residuals in the order in which its threads finish, so that results are not reproducible to the bit.
    """

    def fit(self, source: RayImage, target: RayImage, initial: Array, rng: np.random.Generator) -> Fit | None:
        return self.refine(Cloud.of(source), Cloud.of(target), initial)

    def refine(self, source: Cloud, target: Cloud, target_from_source: Array) -> Fit | None:
        """Return the local optimum from a pose (4, 4); None if there are too few points."""
        return self.by_levels(source, target, target_from_source, self._level)

    def _level(self, source: Cloud, target: Cloud, pose: Array, voxel_m: float) -> Fit:
        tree, reach_m = KDTree(target.points_m), self.reach * voxel_m

        def linearised(points_m: Array, pose: Array) -> Linearised:
            matches = matched(points_m, target, tree, pose, reach_m)
            residuals, jacobian = plane_residuals(matches, pose)
            return Linearised(residuals, _tukey(residuals / reach_m), jacobian, matches.fitness)

        return descended(source, pose, self.iterations, linearised)


@dataclass(frozen=True, eq=False)
class Linearised:
    """A least-squares problem, linearised at a pose."""

    residuals: Array
    """(n,)."""
    weights: Array
    """(n,) between 0 and 1."""
    jacobian: Array
    """(n, 6) by the ξ of `pose @ exp(ξ)`."""
    fitness: float
    """Fraction of the source's points that have a correspondence."""


def descended(source: Cloud, pose: Array, iterations: int, linearised: Callable[[Array, Array], Linearised]) -> Fit:
    """Return the result of Gauss-Newton steps.

    Args:
        source: points to transform.
        pose: (4, 4) initial pose.
        iterations: largest number of steps.
        linearised: returns the linearised problem for points (n, 3) of the source at a pose (4, 4).
    """
    # About the centroid, rotation and translation are hardly correlated, and damping favours neither.
    source_from_centred = se3.translation(source.points_m.mean(axis=0))
    points = source.points_m - source_from_centred[:3, 3]
    pose = pose @ source_from_centred
    for _ in range(iterations):
        at = linearised(points, pose)
        hessian = (at.jacobian.T * at.weights) @ at.jacobian
        damping = (DAMPING * np.trace(hessian) + np.finfo(float).tiny) * np.eye(6)
        step = np.linalg.solve(hessian + damping, -at.jacobian.T @ (at.weights * at.residuals))
        pose = pose @ se3.exp(step)
        if np.max(np.abs(step)) < _STEP:
            break
    pose = pose @ se3.inverse(source_from_centred)
    at = linearised(source.points_m, pose)
    return Fit(pose, whitened_jacobian(at.residuals, at.weights, at.jacobian), at.fitness)


def _tukey(ratios: Array) -> Array:
    return np.maximum(1.0 - ratios**2, 0.0) ** 2


@dataclass(frozen=True)
class GicpRegistrar(AbstractMultiscaleRegistrar):
    """GICP of small_gicp (Segal et al. 2009) from coarse to fine, with its Hessian.

    small_gicp's tangent has rotation first and perturbs on the right, as ours does. It runs on one thread, because sums
    over threads are not reproducible.
    """

    def fit(self, source: RayImage, target: RayImage, initial: Array, rng: np.random.Generator) -> Fit | None:
        import small_gicp  # slow to load, and only needed here

        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return None
        # Between centred clouds, the damping of small_gicp's steps favours neither rotation nor translation.
        source_from_centred = se3.translation(source.centroid_m)
        target_from_centred = se3.translation(target.centroid_m)
        pose = se3.inverse(target_from_centred) @ initial @ source_from_centred
        centred = source.points_m - source.centroid_m, target.points_m - target.centroid_m
        jacobian, fitness = None, 0.0
        for voxel_m in cube_edges_m(Cloud.of(source), Cloud.of(target), self.voxels):
            (thin_source, _), (thin_target, tree) = (
                small_gicp.preprocess_points(points, voxel_m, 10) for points in centred
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


@dataclass(frozen=True)
class ColouredIcpRegistrar(AbstractMultiscaleRegistrar):
    """Multi-scale ICP on distances to planes and differences of intensity (Park, Zhou and Koltun 2017).

    As Open3D's coloured ICP, with its weights. Implemented here because Open3D sums residuals in the order in which its
    threads finish, so that results are not reproducible to the bit.
    """

    def fit(self, source: RayImage, target: RayImage, initial: Array, rng: np.random.Generator) -> Fit | None:
        return self.by_levels(Cloud.coloured(source), Cloud.coloured(target), initial, self.level)

    def level(self, source: Cloud, target: Cloud, pose: Array, voxel_m: float) -> Fit:
        """Return the local optimum from a pose (4, 4), for downsampled clouds with intensity."""
        tree, reach_m = KDTree(target.points_m), self.reach * voxel_m
        gradients = intensity_gradients(target, tree, 2.0 * reach_m)
        assert source.intensity is not None
        assert target.intensity is not None
        source_intensity, target_intensity = source.intensity, target.intensity

        def linearised(points_m: Array, pose: Array) -> Linearised:
            near, partner = nearest(points_m, tree, pose, reach_m)
            seen_m, there_m, fitness = points_m[near], target.points_m[partner], float(np.mean(near))
            gaps_m, by_gap = plane_residuals(Matches(seen_m, Cloud(there_m, target.normals[partner]), fitness), pose)
            # Gradients lie in the tangent plane: offsets along the normal do not change the predicted intensity.
            slopes = Matches(seen_m, Cloud(there_m, gradients[partner]), fitness)
            predicted, by_intensity = plane_residuals(slopes, pose)
            differences = source_intensity[near] - target_intensity[partner] - predicted
            shares = np.sqrt([0.968, 1.0 - 0.968])  # of squared distances in m and squared differences of intensity
            residuals = np.concatenate([shares[0] * gaps_m, shares[1] * differences])
            jacobian = np.concatenate([shares[0] * by_gap, -shares[1] * by_intensity])
            return Linearised(residuals, np.ones(len(residuals)), jacobian, fitness)

        return descended(source, pose, self.iterations, linearised)


def intensity_gradients(cloud: Cloud, tree: KDTree, radius_m: float) -> Array:
    """Return the gradients (n, 3) of intensity per m along the surface, by least squares in the tangent planes.

    Each is that of the 30 nearest points at most, itself included, within a radius, and 0 of fewer than four.
    """
    assert cloud.intensity is not None
    distances, indices = tree.query(cloud.points_m, k=30, distance_upper_bound=radius_m)
    known = np.isfinite(distances)
    indices = np.where(known, indices, 0)
    arms = cloud.points_m[indices] - cloud.points_m[:, None]
    arms -= np.sum(arms * cloud.normals[:, None], axis=2, keepdims=True) * cloud.normals[:, None]
    arms *= known[..., None]
    rises = known * (cloud.intensity[indices] - cloud.intensity[:, None])
    spread = np.einsum("nki,nkj->nij", arms, arms)
    mean = np.trace(spread, axis1=1, axis2=2)[:, None, None] + np.finfo(float).tiny
    upright = cloud.normals[:, :, None] * cloud.normals[:, None]
    slopes = np.linalg.solve(
        spread + mean * (upright + DAMPING * np.eye(3)), np.einsum("nki,nk->ni", arms, rises)[..., None]
    )
    return np.where(known.sum(axis=1, keepdims=True) >= 4, slopes[..., 0], 0.0)
