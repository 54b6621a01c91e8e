"""Global registration by FPFH features and RANSAC, and the same refined by ICP."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from modeler import se3
from modeler.features import fpfh, kabsch, mutual_matches
from modeler.registration.baselines.clouds import (
    AbstractCloudRegistrar,
    Cloud,
    Fit,
    cube_edges_m,
    matched,
    plane_residuals,
    whitened_jacobian,
)
from modeler.registration.baselines.icp import IcpRegistrar
from modeler.types import Array, RayImage

_DRAW = 3  # correspondences that fix a motion
_BATCH = 2_000  # draws between two looks at the stopping rule


@final
@dataclass(frozen=True)
class FpfhRegistrar(AbstractCloudRegistrar):
    """Match points by Fast Point Feature Histograms (Rusu et al. 2009) and take the motion most matches agree with.

    Open3D computes the features. The RANSAC follows its tutorial step for step (mutual matches, edge lengths,
    distances, share of the cloud that finds a partner, confidence) but draws from `rng`: Open3D's own shares one
    generator among threads, so that its seed does not fix the result (its issue 7475). The prior is not used, except
    for its spread where nothing is seen.
    """

    voxel: float = 1 / 40
    """Edge of the thinning cubes, as a share of the object's size."""
    feature_radius: float = 5.0
    """Radius of a feature's neighbourhood, in cubes."""
    reach: float = 1.5
    """Largest distance of partners, in cubes."""
    edge_ratio: float = 0.9
    """Smallest ratio of corresponding edges of a drawn triangle."""
    draws: int = 100_000
    """Largest number of triangles drawn."""
    confidence: float = 0.999
    """Draws end once a better motion would have turned up with this probability."""
    scored_points: int = 400
    """Points of the source, drawn at random, by which motions are compared."""

    def fit(self, source: RayImage, target: RayImage, begin: Array, rng: np.random.Generator) -> Fit | None:
        """Return the motion that most feature matches agree with."""
        return self.search(Cloud.of(source), Cloud.of(target), begin, rng)

    def search(self, source: Cloud, target: Cloud, otherwise: Array, rng: np.random.Generator) -> Fit | None:
        """Return the motion that most feature matches agree with; None where too few points are left to match.

        Args:
            source: points to carry.
            target: points to lay them on.
            otherwise: (4, 4) motion to return, as a poor fit, where no three matches agree.
            rng: source of the draws.
        """
        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return None
        (voxel_m,) = cube_edges_m(source, target, (self.voxel,))
        source, target = source.thinned(voxel_m), target.thinned(voxel_m)
        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return None
        radius_m, reach_m = self.feature_radius * voxel_m, self.reach * voxel_m
        first, second = (fpfh(cloud.points_m, cloud.normals, radius_m) for cloud in (source, target))
        pairs = mutual_matches(first, second)
        tree = KDTree(target.points_m)
        scored = source.points_m[rng.permutation(len(source.points_m))[: self.scored_points]]
        pose = self._ransac(
            source.points_m[pairs[:, 0]], target.points_m[pairs[:, 1]], _Score(scored, tree, reach_m), rng
        )
        if pose is None:
            return Fit(otherwise, np.zeros((0, 6)), 0.0)
        matches = matched(source.points_m, target, tree, pose, reach_m)
        residuals, jacobian = plane_residuals(matches, pose)
        return Fit(pose, whitened_jacobian(residuals, np.ones(len(residuals)), jacobian), matches.fitness)

    def _ransac(self, source_m: Array, target_m: Array, score: _Score, rng: np.random.Generator) -> Array | None:
        best, best_score, drawn, needed = None, -np.inf, 0, np.inf
        while drawn < min(needed, self.draws):
            triples = rng.integers(len(source_m), size=(min(_BATCH, self.draws - drawn), _DRAW))
            drawn += len(triples)
            triples = triples[self._similar(source_m[triples], target_m[triples])]
            poses = kabsch(source_m[triples], target_m[triples])
            gaps_m = np.linalg.norm(_carried(poses, source_m[triples]) - target_m[triples], axis=2)
            poses = poses[np.all(gaps_m < score.reach_m, axis=1)]
            scores = score(poses)
            if np.max(scores, initial=-np.inf) > best_score:
                best, best_score = poses[np.argmax(scores)], np.max(scores)
                agree = np.linalg.norm(se3.transform(best, source_m) - target_m, axis=1) < score.reach_m
                needed = _draws_needed(float(np.mean(agree)), self.confidence)
        return best

    def _similar(self, source_m: Array, target_m: Array) -> npt.NDArray[np.bool_]:
        """Return which triangles (n, 3, 3) have nearly equal edges and no point twice."""
        source_edges, target_edges = (np.linalg.norm(t - np.roll(t, 1, axis=1), axis=2) for t in (source_m, target_m))
        shorter, longer = np.minimum(source_edges, target_edges), np.maximum(source_edges, target_edges)
        return np.all((shorter > self.edge_ratio * longer) & (shorter > 0.0), axis=1)


@dataclass(frozen=True, eq=False)
class _Score:
    """How well motions lay a sample of the source on the target: the share within reach, less its mean square gap."""

    source_m: Array
    target: KDTree
    reach_m: float

    def __call__(self, poses: Array) -> Array:
        """Return the scores (n,) of motions (n, 4, 4)."""
        gaps, _ = self.target.query(_carried(poses, self.source_m), distance_upper_bound=self.reach_m)
        return np.mean(1.0 - np.minimum(gaps / self.reach_m, 1.0) ** 2, axis=1)


def _carried(poses: Array, points_m: Array) -> Array:
    """Carry points (n, k, 3) or (k, 3) by motions (n, 4, 4)."""
    return points_m @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]


def _draws_needed(agreement: float, confidence: float) -> float:
    """Return how many draws find, with that confidence, one whose matches all agree."""
    chance = agreement**_DRAW
    return 0.0 if chance >= 1.0 else float(np.log1p(-confidence) / np.log1p(-chance)) if chance > 0.0 else np.inf


@final
@dataclass(frozen=True)
class FpfhIcpRegistrar(AbstractCloudRegistrar):
    """Take the motion that most FPFH matches agree with, and start point-to-plane ICP there."""

    fpfh: FpfhRegistrar = field(default_factory=FpfhRegistrar)
    """The global search."""
    icp: IcpRegistrar = field(default_factory=lambda: IcpRegistrar(voxels=(1 / 32, 1 / 64)))
    """The refinement, with no coarse levels, whose basins are wide enough to leave a good start."""

    def fit(self, source: RayImage, target: RayImage, begin: Array, rng: np.random.Generator) -> Fit | None:
        """Return the local optimum nearest to the feature matches' motion."""
        clouds = Cloud.of(source), Cloud.of(target)
        coarse = self.fpfh.search(*clouds, begin, rng)
        return None if coarse is None else self.icp.refine(*clouds, coarse.target_from_source)
