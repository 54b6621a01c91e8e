"""Three matches of FPFH features at a time: guesses at the motion of objects with shape to recognise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modeler.features import fpfh, kabsch, mutual_matches
from modeler.priors.bumps import KernelMixture
from modeler.priors.proposal import AbstractProposal, defensive_mixture
from modeler.types import AbstractPoseDensity, Array, RayImage

_DRAWS = 20_000  # triples looked at
_JUDGED = 1000  # at most so many of their motions are put to the vote


@dataclass(frozen=True)
class FeaturesPrior(AbstractProposal):
    """Triples of matching points lay the surfaces on each other; a bump about each good one proposes, no evidence.

    Fast Point Feature Histograms (Rusu, Blodow and Beetz 2009) of thinned surfaces are matched; of many triples of
    matches whose distances agree, those motions are kept with which most other matches agree.
    """

    features_sigma_deg: float = 4.0
    """Standard deviation of the bump about each motion, about each axis."""
    features_sigma_m: float = 0.006
    """Standard deviation of the bump about each motion, in where the centroid goes, along each axis."""
    bumps: int = 24
    """Most motions that are kept."""
    voxel: float = 1 / 25
    """Edge of the thinning cubes, as a share of the object's size."""
    feature_radius: float = 5.0
    """Radius of a feature's neighbourhood, in cubes."""
    agreement: float = 2.0
    """Largest distance of matching points, in cubes."""
    min_points: int = 30
    """Fewest points a side after thinning; with fewer, features say nothing."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source: that of what is known, where no three matches agree.

        Raises:
            InputError: where the views lack what `known` needs.
        """
        known = self.known.between(source, target)
        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return known
        sizes_m = [2.0 * float(np.sqrt(np.sum(np.var(view.points_m, axis=0)))) for view in (source, target)]
        voxel_m = self.voxel * max(sizes_m)
        (first_m, first), (second_m, second) = (self._features(view, voxel_m) for view in (source, target))
        if min(len(first_m), len(second_m)) < self.min_points:
            return known
        pairs = mutual_matches(first, second)
        motions, votes = self._motions(first_m[pairs[:, 0]], second_m[pairs[:, 1]], known, self.agreement * voxel_m)
        if not len(motions):
            return known
        guess = KernelMixture(
            motions,
            votes**2 / np.sum(votes**2),
            centre_m=source.centroid_m,
            sigma_rad=float(np.radians(self.features_sigma_deg)),
            sigma_m=self.features_sigma_m,
            evidence=False,
        )
        return defensive_mixture(known, [guess])

    def _features(self, view: RayImage, voxel_m: float) -> tuple[Array, Array]:
        """Return the points (n, 3) of a thinned surface and their features (n, 33)."""
        import open3d as o3d  # slow to load, and only needed here

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(view.points_m))
        cloud.normals = o3d.utility.Vector3dVector(view.normals)
        cloud = cloud.voxel_down_sample(voxel_m)
        cloud.normalize_normals()
        points_m, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
        order = np.lexsort(points_m.T)  # Open3D's order is that of a hash table
        points_m, normals = points_m[order], normals[order]
        return points_m, fpfh(points_m, normals, self.feature_radius * voxel_m)

    def _motions(
        self, source_m: Array, target_m: Array, known: AbstractPoseDensity, reach_m: float
    ) -> tuple[Array, Array]:
        """Return motions (k, 4, 4) that matches (m, 3) agree with three at a time, and with how many each agrees (k,).

        Args:
            source_m: (m, 3) points of the source.
            target_m: (m, 3) their partners.
            known: whose support holds the motions.
            reach_m: largest distance of partners that agree.
        """
        if len(source_m) < 3:
            return np.zeros((0, 4, 4)), np.zeros(0)
        rng = np.random.default_rng(0)  # the same views have the same density, whoever asks
        triples = rng.integers(len(source_m), size=(_DRAWS, 3))
        sides, others = (
            np.linalg.norm(points[triples] - points[np.roll(triples, 1, axis=1)], axis=2)
            for points in (source_m, target_m)
        )
        triples = triples[
            ((np.abs(sides - others) < reach_m) & (np.minimum(sides, others) > 3.0 * reach_m)).all(axis=1)
        ]
        if not len(triples):
            return np.zeros((0, 4, 4)), np.zeros(0)
        motions = kabsch(source_m[triples], target_m[triples])
        motions = motions[np.isfinite(known.log_density(motions))][:_JUDGED]
        carried = source_m @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
        votes = np.sum(np.sum((carried - target_m) ** 2, axis=2) < reach_m**2, axis=1).astype(np.float64)
        best = np.argsort(-votes, kind="stable")[: self.bumps]
        best = best[votes[best] >= 3.0]  # its own three at least
        return motions[best], votes[best]
