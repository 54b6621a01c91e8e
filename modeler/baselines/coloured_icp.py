"""Coloured ICP: point-to-plane ICP that also aligns the surface's intensity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.spatial import KDTree

from modeler.baselines.clouds import Cloud, Fit, Matches, nearest, plane_residuals
from modeler.baselines.icp import DAMPING, AbstractMultiscaleRegistrar, Linearised, by_levels, descended
from modeler.types import Array, RayImage

_MIN_NEIGHBOURS = 4  # points, itself included, that determine the gradient of intensity at a point


@final
@dataclass(frozen=True)
class ColouredIcpRegistrar(AbstractMultiscaleRegistrar):
    """Multi-scale ICP on distances to planes and differences of intensity (Park, Zhou and Koltun 2017).

    As Open3D's coloured ICP, with its weights. Implemented here because Open3D sums residuals in the order in which its
    threads finish, so that results are not reproducible to the bit.
    """

    geometry: float = 0.968
    """Weight (0..1) of squared distances in m; squared differences of intensity have the rest."""
    neighbours: int = 30
    """Largest number of points, itself included, for the gradient of intensity, within twice the reach."""

    def fit(self, source: RayImage, target: RayImage, initial: Array, rng: np.random.Generator) -> Fit | None:
        """Return the local optimum from the initial pose.

        Raises:
            InputError: if a view has no colour.
        """
        clouds = Cloud.coloured(source), Cloud.coloured(target)
        return by_levels(clouds, initial, voxels=self.voxels, min_points=self.min_points, level=self.level)

    def level(self, source: Cloud, target: Cloud, pose: Array, voxel_m: float) -> Fit:
        """Return the local optimum from a pose (4, 4), for downsampled clouds with intensity."""
        tree, reach_m = KDTree(target.points_m), self.reach * voxel_m
        gradients = intensity_gradients(target, tree, 2.0 * reach_m, self.neighbours)
        assert source.intensity is not None
        assert target.intensity is not None
        source_intensity, target_intensity = source.intensity, target.intensity

        def linearised(points_m: Array, pose: Array) -> Linearised:
            near, partner = nearest(points_m, tree, pose, reach_m)
            partners = Cloud(target.points_m[partner], target.normals[partner])
            matches = Matches(points_m[near], partners, float(np.mean(near)))
            gaps_m, by_gap = plane_residuals(matches, pose)
            # Gradients lie in the tangent plane: offsets along the normal do not change the predicted intensity.
            predicted, by_intensity = plane_residuals(
                Matches(matches.points_m, Cloud(partners.points_m, gradients[partner]), matches.fitness), pose
            )
            differences = source_intensity[near] - target_intensity[partner] - predicted
            shares = np.sqrt([self.geometry, 1.0 - self.geometry])
            residuals = np.concatenate([shares[0] * gaps_m, shares[1] * differences])
            jacobian = np.concatenate([shares[0] * by_gap, -shares[1] * by_intensity])
            return Linearised(residuals, np.ones(len(residuals)), jacobian, matches.fitness)

        return descended(source, pose, self.iterations, linearised)


def intensity_gradients(cloud: Cloud, tree: KDTree, radius_m: float, neighbours: int) -> Array:
    """Return the gradients (n, 3) of intensity per m along the surface, by least squares in the tangent planes."""
    assert cloud.intensity is not None
    distances, indices = tree.query(cloud.points_m, k=neighbours, distance_upper_bound=radius_m)
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
    return np.where(known.sum(axis=1, keepdims=True) >= _MIN_NEIGHBOURS, slopes[..., 0], 0.0)
