"""The edges of a graph, their connectivity and chains, and the optimised poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.types.base import Array
from modeler.types.posteriors import PoseGaussian, Posterior
from modeler.types.reasons import Reason

_Numbers = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Chains:
    """A forest of frames, and the motions between any two, at a cost that hardly grows with their distance.

    Each frame keeps the motion over 2^k edges towards its root (Bender and Farach-Colton, The level ancestor problem
    simplified, 2004), so that a chain of n edges is composed of log n motions, and many chains at once.
    """

    index: Mapping[int, int]
    """Of each frame in the arrays."""
    root: _Numbers
    """(n,) index of the root of its tree."""
    depth: _Numbers
    """(n,) number of edges to the root."""
    above: _Numbers
    """(levels, n) index of the frame 2^k edges nearer to the root; the root where there are fewer."""
    means: Array
    """(levels, n, 4, 4) motion from each frame to that one."""
    covariances: Array
    """(levels, n, 6, 6) of these."""

    @classmethod
    def of(cls, motions: Sequence[tuple[int, int, PoseGaussian]]) -> Chains:
        """Return the forest of (target, source, target_from_source); of edges that make a cycle some are left out."""
        neighbours: dict[int, list[tuple[int, PoseGaussian]]] = {}
        for target, source, pose in motions:
            neighbours.setdefault(target, []).append((source, pose))
            neighbours.setdefault(source, []).append((target, pose.inverse()))
        index: dict[int, int] = {}
        roots, depths, parents, poses = [], [], [], []
        for first in neighbours:
            waiting = [(first, len(index), PoseGaussian(np.eye(4), np.zeros((6, 6))))]
            for frame, parent, pose in waiting:
                if frame in index:
                    continue
                number = index[frame] = len(index)
                roots.append(number if parent == number else roots[parent])
                depths.append(0 if parent == number else depths[parent] + 1)
                parents.append(parent)
                poses.append(pose)
                waiting += [(other, number, motion) for other, motion in neighbours[frame] if other not in index]
        above = [np.array(parents, dtype=np.int64)]
        means = [np.array([pose.mean for pose in poses]).reshape(-1, 4, 4)]
        covariances = [np.array([pose.covariance for pose in poses]).reshape(-1, 6, 6)]
        for _ in range(max(depths, default=0).bit_length()):
            up, mean, covariance = above[-1], means[-1], covariances[-1]
            above.append(up[up])
            means.append(mean[up] @ mean)
            covariances.append(se3.composed_covariance(covariance[up], mean, covariance))
        return cls(index, np.array(roots), np.array(depths), np.array(above), np.array(means), np.array(covariances))

    def joined(self, target: int, source: int) -> bool:
        """Return whether a chain connects two frames."""
        both = self.index.get(target), self.index.get(source)
        return None not in both and self.root[both[0]] == self.root[both[1]]

    def motions(self, pairs: Sequence[tuple[int, int]]) -> tuple[list[PoseGaussian], _Numbers]:
        """Return target_from_source along the chain of each pair (target, source) that is joined, and their lengths."""
        ends = np.array([[self.index[frame] for frame in pair] for pair in pairs], dtype=np.int64).reshape(-1, 2).T
        heights = self.depth[ends] - self._common_depth(*ends)
        (target, target_covariance), (source, source_covariance) = map(self._lifted, ends, heights)
        means = se3.inverse(target) @ source
        covariances = se3.composed_covariance(
            se3.inverse_covariance(target, target_covariance), source, source_covariance
        )
        return [PoseGaussian(*motion) for motion in zip(means, covariances, strict=True)], heights.sum(axis=0)

    def _common_depth(self, one: _Numbers, other: _Numbers) -> _Numbers:
        """Return the depth (m,) of the deepest frame above or at both of two (m,)."""
        level = np.minimum(self.depth[one], self.depth[other])
        one, other = (self._ancestors(some, self.depth[some] - level) for some in (one, other))
        depth = np.where(one == other, level, 0)
        for up in self.above[::-1]:
            apart = up[one] != up[other]
            one, other = np.where(apart, up[one], one), np.where(apart, up[other], other)
        return np.where(one == other, depth, self.depth[one] - 1)

    def _ancestors(self, frames: _Numbers, heights: _Numbers) -> _Numbers:
        """Return the indices (m,) of the frames that lie the given number of edges (m,) above others (m,)."""
        for level, up in enumerate(self.above):
            frames = np.where(heights >> level & 1, up[frames], frames)
        return frames

    def _lifted(self, frames: _Numbers, heights: _Numbers) -> tuple[Array, Array]:
        """Return mean (m, 4, 4) and covariance (m, 6, 6) of the motion to the frame a number of edges (m,) above."""
        mean, covariance = np.tile(np.eye(4), (len(frames), 1, 1)), np.zeros((len(frames), 6, 6))
        for level, up in enumerate(self.above):
            some = np.flatnonzero(heights >> level & 1)
            at = frames[some]
            covariance[some] = se3.composed_covariance(self.covariances[level, at], mean[some], covariance[some])
            mean[some] = self.means[level, at] @ mean[some]
            frames = np.where(heights >> level & 1, up[frames], frames)
        return mean, covariance


EdgeKind = Literal["odometry", "closure", "span", "join"]
"""Purpose of an edge: to place a frame, to close a loop with a view that the object had turned away from, to span
several steps between frames that others placed, or to join two segments, between which there is no motion
prior: the object was laid down differently, or regrasped."""


@dataclass(frozen=True, eq=False)
class Edge:
    """A posterior as an edge of the graph, accepted or rejected."""

    posterior: Posterior
    """The registration behind the edge."""
    kind: EdgeKind
    accepted: bool
    """Whether the edge takes part in the optimisation."""
    reason: Reason
    """Why; `explain` words it."""

    @property
    def source(self) -> int:
        """Frame number of the source view."""
        return self.posterior.source

    @property
    def target(self) -> int:
        """Frame number of the target view."""
        return self.posterior.target


AWAY_DEG: Final = 90.0
"""Rotation beyond which the object has turned away from a view: half of the visible part of a sphere remains."""
NEAR_DEG: Final = 45.0
"""Rotation up to which two views share surface for any shape: 85 % of the visible part of a sphere."""


@dataclass(frozen=True, eq=False)
class FocalLength:
    """Estimate of the logarithm of the true focal length over that of the views, from the edges of a graph."""

    log_factor: float
    """Its mean."""
    sigma: float
    """Its standard deviation."""
    prior_sigma: float
    """Its prior standard deviation."""
    loops: int
    """Number of loops used."""
    sigmas_before: float
    """Root mean square of the loops' normalised residuals with the one given: 1 if calibrated; 0 without a loop."""
    sigmas_after: float
    """The same at the mean."""
    by_focal: Mapping[int, Array] = field(repr=False)
    """By frame number (6,) derivative of a pose: it moves to exp(by_focal · log_factor) object_from_camera."""
    noise_sigma: float = 0.0
    """The part of its standard deviation that is due to the noise of edges."""

    @property
    def factor(self) -> float:
        """The true focal length over that of the views."""
        return float(np.exp(self.log_factor))

    @property
    def determined_by(self) -> Literal["loop", "prior"]:
        """Source of most of the information: loops or the prior."""
        return "loop" if self.sigma < 0.5 * self.prior_sigma else "prior"


def _unsolved(target: int, source: int) -> Array:
    """Raise: nothing was solved."""
    raise KeyError(f"no motion from frame {source} to frame {target} was solved")


@dataclass(frozen=True, eq=False)
class Solution:
    """The optimised poses."""

    trajectory: Mapping[int, Array] = field(default_factory=dict)
    """object_from_camera (4, 4) by frame number."""
    covariances: Mapping[int, Array] = field(default_factory=dict)
    """Marginal covariance (6, 6) by frame number; the first frame's is the gauge's."""
    odometry: Mapping[int, Array] = field(default_factory=dict)
    """object_from_camera (4, 4) of the pairwise chain alone, before closure."""
    outliers: tuple[Edge, ...] = ()
    """Accepted edges that the optimisation left out as outliers, as the others contradict them."""
    relative_covariance: Callable[[int, int], Array] = _unsolved
    """Covariance (6, 6) of `relative(target, source)`, computed when called."""
    deforming_covariance: Callable[[int, int], Array] = _unsolved
    """The same without errors of the focal length, and without those that move surface and poses of all views alike."""
    edge_poses: Mapping[tuple[int, int], PoseGaussian] = field(default_factory=dict)
    """target_from_source by (source, target) of edges that entered with a pose other than their posterior's."""
    mode_weights: Mapping[tuple[int, int], Array] = field(default_factory=dict)
    """Weights (m,) of the modes of a multimodal edge, given all edges together, by (source, target)."""
    focal: FocalLength | None = None
    """Estimate of the focal length, whose uncertainty is part of the covariances; None: exact."""
    common_shift_m2: Array | None = None
    """(3, 3) covariance in m² of a shift of the surface in all views, part of the covariances; None: 0. It moves poses
    relative to the camera, but does not deform the model."""
    variance_factor: float = 1.0
    """On the covariances of edges, for smooth errors of depth that are smaller than stated, as loops show."""
    camera_from_axis: Array | None = None
    """(4, 4), whose third direction is the axis of all steps; None if none was estimated, or it does not fit."""

    def takes_part(self, edge: Edge) -> bool:
        """Return whether an edge was accepted and the optimisation did not leave it out since."""
        return edge.accepted and edge not in self._left_out

    @cached_property
    def _left_out(self) -> frozenset[Edge]:
        return frozenset(self.outliers)

    @property
    def has_relative_covariances(self) -> bool:
        """Whether covariances of motions between any two frames can be computed."""
        return self.relative_covariance is not _unsolved

    def pose_of(self, edge: Edge) -> PoseGaussian:
        """Return target_from_source of an edge as it entered the graph; several modes are weighted by all edges."""
        posterior = edge.posterior
        if not self.edge_poses:
            return posterior.pose
        return self.edge_poses.get((posterior.source, posterior.target), posterior.pose)

    def relative_gaussian(self, target: int, source: int) -> PoseGaussian:
        """Return target_from_source between two different solved frames, with its uncertainty."""
        return PoseGaussian(self.relative(target, source), self.relative_covariance(target, source))

    def relative(self, target: int, source: int) -> Array:
        """Return target_from_source (4, 4) between two solved frames."""
        return se3.inverse(self.trajectory[target]) @ self.trajectory[source]


def loops_closed(edges: Sequence[Edge]) -> int:
    """Return how many closures close a loop: those without which the graph remains connected.

    A closure that is a bridge of the graph is unconfirmed: if two consecutive views share little surface and an early
    view places the next frame, the graph is a tree and has no loop.
    """
    closures = np.array([edge.kind == "closure" for edge in edges], dtype=bool)
    if not closures.any():
        return 0
    ends = _ends(edges)
    return int(closures.sum()) - (_parts(ends[~closures], ends) - _parts(ends, ends))


def segments(edges: Sequence[Edge]) -> dict[int, int]:
    """Return the number of its segment for each frame of edges that take part: frames connected without joins."""
    ends = _ends(edges)
    frames, indices = np.unique(ends, return_inverse=True)
    indices = indices.reshape(-1, 2)[np.array([edge.kind != "join" for edge in edges], dtype=bool)]
    return dict(zip(frames.tolist(), components(indices, len(frames)).tolist(), strict=True))


def joined_without(edge: Edge, edges: Sequence[Edge]) -> bool:
    """Return whether the ends of an edge are connected without it."""
    ends, others = _ends(edges), np.array([other is not edge for other in edges], dtype=bool)
    return _parts(ends[others], ends) == _parts(ends, ends)


def _ends(edges: Sequence[Edge]) -> npt.NDArray[np.int64]:
    """Return the two frames (n, 2) of edges."""
    return np.array([(edge.posterior.source, edge.posterior.target) for edge in edges], dtype=np.int64).reshape(-1, 2)


def _parts(ends: npt.NDArray[np.int64], everything: npt.NDArray[np.int64]) -> int:
    """Return the number of connected components of the frames of `everything` (n, 2) under edges (m, 2)."""
    frames = np.unique(everything)
    return len(set(components(np.searchsorted(frames, ends), len(frames)).tolist()))


def components(ends: npt.NDArray[np.int64], count: int) -> npt.NDArray[np.int32]:
    """Return the number (count,) of the connected component of each of `count` nodes under edges (m, 2)."""
    from scipy.sparse import coo_array  # with which nouns alone take twice as long to import
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    return connected_components(graph, directed=False)[1]


@dataclass(frozen=True)
class LoopClosureError:
    """The error of a chain of odometry edges against the closure that joins its ends, before the optimisation."""

    source: int
    """Frame number of the closure's source."""
    target: int
    """Frame number of the closure's target."""
    edges: int
    """Number of edges of the chain."""
    rotation_rad: float
    """Rotation between the closure and the chain."""
    translation_m: float
    """Distance between the object's positions under the two."""
    sigmas: float
    """Root of NEES/6 under the covariances of chain and closure: about 1 if these are calibrated."""

    @property
    def words(self) -> str:
        """The closure error in words."""
        return (
            f"the loop from frame {self.target} to {self.source} has a closure error of "
            f"{np.degrees(self.rotation_rad):.1f}° and "
            f"{1000.0 * self.translation_m:.1f} mm, {self.sigmas:.1f} times its standard deviation"
        )


def loop_closure_errors(
    edges: Sequence[Edge], solution: Solution, centroids_m: Mapping[int, Array]
) -> list[LoopClosureError]:
    """Compare each accepted closure whose ends a chain of odometry edges joins with that chain.

    Needs no ground truth: a closure error of many standard deviations shows errors that are not part of the
    covariances, such as those of intrinsics, or a wrong edge. Noise common to consecutive edges is not modelled.

    Args:
        edges: of the graph.
        solution: determines which of them take part, and with which pose.
        centroids_m: (3,) of the object in camera coordinates by frame number, for the translation; 0 where unknown.
    """
    used = [edge for edge in edges if solution.takes_part(edge)]
    chains = Chains.of([(e.target, e.source, solution.pose_of(e)) for e in used if e.kind == "odometry"])
    loops = [edge for edge in used if edge.kind == "closure" and chains.joined(edge.target, edge.source)]
    if not loops:
        return []
    motions, counts = chains.motions([(edge.target, edge.source) for edge in loops])
    return [
        _closure_error(edge, solution.pose_of(edge), motion, int(count), centroids_m.get(edge.source, np.zeros(3)))
        for edge, motion, count in zip(loops, motions, counts, strict=True)
    ]


def loop_closure_error(
    edges: Sequence[Edge], solution: Solution, centroids_m: Mapping[int, Array]
) -> LoopClosureError | None:
    """Return the closure error of the loop with most edges, the largest of several; None without a loop."""
    errors = loop_closure_errors(edges, solution, centroids_m)
    return max(errors, key=lambda error: (error.edges, error.sigmas), default=None)


def _closure_error(
    edge: Edge, closure: PoseGaussian, chain: PoseGaussian, count: int, centroid_m: Array
) -> LoopClosureError:
    """Return the error between a closure and the chain of its frames."""
    xi = se3.log(se3.inverse(closure.mean) @ chain.mean)
    squared = xi @ np.linalg.solve(closure.covariance + chain.covariance, xi)
    moved_m = se3.transform(chain.mean, centroid_m[None]) - se3.transform(closure.mean, centroid_m[None])
    return LoopClosureError(
        source=edge.source,
        target=edge.target,
        edges=count,
        rotation_rad=float(np.linalg.norm(xi[:3])),
        translation_m=float(np.linalg.norm(moved_m)),
        sigmas=float(np.sqrt(squared / 6.0)),
    )
