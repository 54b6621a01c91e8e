"""Global registration by features: FPFH with RANSAC, and KISS-Matcher, each refined by ICP."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from modeler import se3
from modeler.baselines.clouds import (
    AbstractCloudRegistrar,
    Cloud,
    Fit,
    cube_edges_m,
    matched,
    plane_residuals,
    whitened_jacobian,
)
from modeler.baselines.icp import FINE, IcpRegistrar
from modeler.registration.features import FeatureMatcher, fpfh, kabsch, mutual_matches
from modeler.system.processes import check_installed
from modeler.types import Array, RayImage

_VOXEL = 1 / 40  # edge, as a fraction of the object's size
_BATCH = 2_000  # draws between evaluations of the stopping rule: 50 at most


@dataclass(frozen=True)
class FpfhRegistrar(AbstractCloudRegistrar):
    """RANSAC on matches of Fast Point Feature Histograms (Rusu et al. 2009).

    Open3D computes the features. The RANSAC follows its tutorial (mutual matches, edge lengths, distances, fraction of
    the cloud with a correspondence, confidence) but draws from `rng`: threads of Open3D's share one generator, so that
    its seed does not determine the result (its issue 7475). The prior is used only for its spread in directions that
    the surfaces leave open.
    """

    reach: float = 1.5
    """Largest distance of correspondences, in voxels, as in Open3D's tutorial."""
    draws: int = 100_000
    """Largest number of triangles drawn: Open3D's default."""

    def fit(self, source: RayImage, target: RayImage, initial: Array, rng: np.random.Generator) -> Fit | None:
        """Return the motion with most inliers among the feature matches."""
        return self.search(Cloud.of(source), Cloud.of(target), initial, rng)

    def search(self, source: Cloud, target: Cloud, fallback: Array, rng: np.random.Generator) -> Fit | None:
        """Return the motion with most inliers among the feature matches; None if there are too few points.

        Args:
            source: points to transform.
            target: points to align them with.
            fallback: (4, 4) motion to return, as a poor fit, if no three matches agree.
            rng: source of all randomness.
        """
        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return None
        (voxel_m,) = cube_edges_m(source, target, (_VOXEL,))
        source, target = source.thinned(voxel_m), target.thinned(voxel_m)
        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return None
        radius_m, reach_m = FeatureMatcher.feature_radius * voxel_m, self.reach * voxel_m
        first, second = (fpfh(cloud.points_m, cloud.normals, radius_m) for cloud in (source, target))
        pairs = mutual_matches(first, second)
        tree = KDTree(target.points_m)
        scored = source.points_m[rng.permutation(len(source.points_m))[:400]]  # by which motions are compared
        pose = self._ransac(
            source.points_m[pairs[:, 0]], target.points_m[pairs[:, 1]], _Score(scored, tree, reach_m), rng
        )
        if pose is None:
            return Fit(fallback, np.zeros((0, 6)), 0.0)
        matches = matched(source.points_m, target, tree, pose, reach_m)
        residuals, jacobian = plane_residuals(matches, pose)
        return Fit(pose, whitened_jacobian(residuals, np.ones(len(residuals)), jacobian), matches.fitness)

    def _ransac(self, source_m: Array, target_m: Array, score: _Score, rng: np.random.Generator) -> Array | None:
        best, best_score, drawn, needed = None, -np.inf, 0, np.inf
        while drawn < min(needed, self.draws):
            triples = rng.integers(len(source_m), size=(min(_BATCH, self.draws - drawn), 3))
            drawn += len(triples)
            triples = triples[_similar(source_m[triples], target_m[triples])]
            poses = kabsch(source_m[triples], target_m[triples])
            gaps_m = np.linalg.norm(_transformed(poses, source_m[triples]) - target_m[triples], axis=2)
            poses = poses[np.all(gaps_m < score.reach_m, axis=1)]
            scores = score(poses)
            if np.max(scores, initial=-np.inf) > best_score:
                best, best_score = poses[np.argmax(scores)], np.max(scores)
                agree = np.linalg.norm(se3.transform(best, source_m) - target_m, axis=1) < score.reach_m
                needed = _draws_needed(float(np.mean(agree)))
        return best


def _similar(source_m: Array, target_m: Array) -> npt.NDArray[np.bool_]:
    """Return whether triangles (n, 3, 3) have nearly equal edges and no point twice, (n,)."""
    source_edges, target_edges = (np.linalg.norm(t - np.roll(t, 1, axis=1), axis=2) for t in (source_m, target_m))
    shorter, longer = np.minimum(source_edges, target_edges), np.maximum(source_edges, target_edges)
    return np.all((shorter > 0.9 * longer) & (shorter > 0.0), axis=1)


@dataclass(frozen=True, eq=False)
class _Score:
    """The score of motions: the fraction of a sample of the source within reach, minus its mean squared distance."""

    source_m: Array
    target: KDTree
    reach_m: float

    def __call__(self, poses: Array) -> Array:
        """Return the scores (n,) of motions (n, 4, 4)."""
        gaps, _ = self.target.query(_transformed(poses, self.source_m), distance_upper_bound=self.reach_m)
        return np.mean(1.0 - np.minimum(gaps / self.reach_m, 1.0) ** 2, axis=1)


def _transformed(poses: Array, points_m: Array) -> Array:
    """Transform points (n, k, 3) or (k, 3) by motions (n, 4, 4)."""
    return points_m @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]


def _draws_needed(agreement: float) -> float:
    """Return the number of triangles drawn of which, with a probability of 99.9 %, one is of inliers only."""
    chance = agreement**3
    return 0.0 if chance >= 1.0 else float(np.log(0.001) / np.log1p(-chance)) if chance > 0.0 else np.inf


REFINEMENT = IcpRegistrar(voxels=FINE)
"""Without coarse levels, which could leave the basin of a good initial pose."""


@dataclass(frozen=True)
class FpfhIcpRegistrar(AbstractCloudRegistrar):
    """FPFH with RANSAC, refined by point-to-plane ICP."""

    def fit(self, source: RayImage, target: RayImage, initial: Array, rng: np.random.Generator) -> Fit | None:
        """Return the local optimum from the motion of the feature matches."""
        clouds = Cloud.of(source), Cloud.of(target)
        coarse = FpfhRegistrar().search(*clouds, initial, rng)
        return None if coarse is None else REFINEMENT.refine(*clouds, coarse.target_from_source)


def check_kiss() -> None:
    """Reject the use of KISS-Matcher where it is not installed."""
    check_installed("kiss_matcher", "KISS-Matcher", "peers")


@dataclass(frozen=True)
class KissIcpRegistrar(AbstractCloudRegistrar):
    """KISS-Matcher (Lim et al., ICRA 2025), refined by point-to-plane ICP.

    Faster-PFH features, matches pruned by the largest k-core of their compatibility graph (ROBIN), and a robust solver,
    with its default parameters for voxels of one unit. The prior is used only for its spread in directions that the
    surfaces leave open.
    """

    def fit(self, source: RayImage, target: RayImage, initial: Array, rng: np.random.Generator) -> Fit | None:
        """Return the local optimum from KISS-Matcher's motion.

        Raises:
            InputError: if KISS-Matcher is not installed.
        """
        check_kiss()
        clouds = Cloud.of(source), Cloud.of(target)
        if min(len(cloud.points_m) for cloud in clouds) < self.min_points:
            return None
        return REFINEMENT.refine(*clouds, self.search(*clouds, initial))

    def search(self, source: Cloud, target: Cloud, fallback: Array) -> Array:
        """Return the motion (4, 4) that KISS-Matcher finds; `fallback` (4, 4) if it finds none."""
        matcher: Any = importlib.import_module("kiss_matcher")  # its types are known only if it is installed
        (unit_m,) = cube_edges_m(source, target, (_VOXEL,))  # it rejects voxels below 5 mm
        centres_m = source.points_m.mean(axis=0), target.points_m.mean(axis=0)
        centred = [
            list(((cloud.points_m - centre_m) / unit_m).astype(np.float32))
            for cloud, centre_m in zip((source, target), centres_m, strict=True)
        ]
        with _one_processor():
            found = matcher.KISSMatcher(matcher.KISSMatcherConfig(1.0)).estimate(*centred)
        if not found.valid:
            return fallback
        pose = np.eye(4)
        pose[:3, :3] = found.rotation
        pose[:3, 3] = centres_m[1] + unit_m * np.asarray(found.translation).ravel() - pose[:3, :3] @ centres_m[0]
        return pose


@contextmanager
def _one_processor() -> Iterator[None]:
    """Restrict this thread, and those that a library starts for it, to one processor, if the system can.

    KISS-Matcher sums in the order in which its threads finish, so that 5 of 27 pairs registered three times differ.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)
