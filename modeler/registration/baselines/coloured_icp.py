"""Coloured ICP: point-to-plane ICP that matches the surface's intensity as well."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.spatial import KDTree

from modeler.registration.baselines.clouds import Cloud, Fit, Matches, nearest, plane_residuals
from modeler.registration.baselines.icp import AbstractMultiscaleRegistrar, Linearised, by_levels, descended
from modeler.types import Array, RayImage

_FLAT = 1e-9  # share of the mean spread; only holds gradients still along which there are no neighbours
_FEWEST = 4  # points, itself included, that show how intensity changes around a point


@final
@dataclass(frozen=True)
class ColouredIcpRegistrar(AbstractMultiscaleRegistrar):
    """Match nearest points and fit planes and intensity together, level by level (Park, Zhou and Koltun 2017).

    As Open3D's coloured ICP, with its weights. The arithmetic is our own, since Open3D adds up its residuals in
    whatever order its threads finish, so that no two runs need agree to the last bit.
    """

    geometry: float = 0.968
    """Weight of squared distances in m against those of intensity, which have the rest."""
    neighbours: int = 30
    """Most points from which the gradient of intensity is taken, itself included, within twice the reach."""

    def fit(self, source: RayImage, target: RayImage, begin: Array, rng: np.random.Generator) -> Fit | None:
        """Return the local optimum nearest to the start.

        Raises:
            InputError: where a view has no colour.
        """
        clouds = Cloud.coloured(source), Cloud.coloured(target)
        return by_levels(clouds, begin, voxels=self.voxels, min_points=self.min_points, level=self.level)

    def level(self, source: Cloud, target: Cloud, pose: Array, voxel_m: float) -> Fit:
        """Return the local optimum nearest to a pose (4, 4), for clouds with intensity thinned to cubes."""
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
            # Gradients lie in the tangent plane: what is off the plane does not change the intensity foreseen there.
            foreseen, by_intensity = plane_residuals(
                Matches(matches.points_m, Cloud(partners.points_m, gradients[partner]), matches.fitness), pose
            )
            differences = source_intensity[near] - target_intensity[partner] - foreseen
            shares = np.sqrt([self.geometry, 1.0 - self.geometry])
            residuals = np.concatenate([shares[0] * gaps_m, shares[1] * differences])
            jacobian = np.concatenate([shares[0] * by_gap, -shares[1] * by_intensity])
            return Linearised(residuals, np.ones(len(residuals)), jacobian, matches.fitness)

        return descended(source, pose, self.iterations, linearised)


def intensity_gradients(cloud: Cloud, tree: KDTree, radius_m: float, neighbours: int) -> Array:
    """Return how intensity changes (n, 3) per m along the surface at each point: least squares in the tangent plane.

    Args:
        cloud: points with intensity.
        tree: holds the points.
        radius_m: how far neighbours may be.
        neighbours: how many are taken at most, the point itself included.
    """
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
        spread + mean * (upright + _FLAT * np.eye(3)), np.einsum("nki,nk->ni", arms, rises)[..., None]
    )
    return np.where(known.sum(axis=1, keepdims=True) >= _FEWEST, slopes[..., 0], 0.0)
