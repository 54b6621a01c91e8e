"""Generalised ICP by small_gicp: nearest points matched with the shape of their neighbourhoods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from modeler import se3
from modeler.registration.clouds import Cloud, Fit, cube_edges_m, registered, residual_variance
from modeler.types import AbstractPoseDensity, AbstractRegistrar, Array, Posterior, RayImage

_STEP = 1e-6  # rad and m: a smaller step ends a level


@final
@dataclass(frozen=True)
class GicpRegistrar(AbstractRegistrar):
    """Align by small_gicp's GICP (Segal et al. 2009) from coarse to fine, and report its Hessian.

    small_gicp's tangent has rotation first and perturbs from the right, as ours does. It runs on one thread, since
    sums over threads are not the same from run to run.
    """

    voxels: tuple[float, ...] = (1 / 8, 1 / 16, 1 / 32, 1 / 64)
    """Edge of the thinning cubes at each level, coarse to fine, as a share of the object's size."""
    reach: float = 2.0
    """Largest distance of partners, in cubes."""
    neighbours: int = 10
    """Points from which the shape of a neighbourhood is taken."""
    iterations: int = 60
    """At most so many steps a level."""
    min_points: int = 12
    """Fewest points a side; levels that thinning leaves with fewer are passed over."""
    min_fitness: float = 0.1
    """Smallest share of matched points that counts as overlap."""

    def register(
        self, source: RayImage, target: RayImage, density: AbstractPoseDensity, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the local optimum nearest to the prior's centre, with its residual-scaled inverse Hessian."""
        return registered(
            (source, target),
            density,
            rng,
            min_fitness=self.min_fitness,
            fit=lambda begin: self._fit(source, target, begin),
        )

    def _fit(self, source: RayImage, target: RayImage, target_from_source: Array) -> Fit | None:
        import small_gicp  # slow to load, and only needed here

        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return None
        # Between centred clouds, the damping of small_gicp's steps favours neither rotation nor translation.
        source_from_centred = se3.translation(source.centroid_m)
        target_from_centred = se3.translation(target.centroid_m)
        pose = se3.inverse(target_from_centred) @ target_from_source @ source_from_centred
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
