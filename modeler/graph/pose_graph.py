"""The pose graph: edges, their factors in GTSAM, the spanning tree and the loops beyond it, dead reckoning.

Variables are object_from_camera(k). A factor is `BetweenFactorPose3(target, source, target_from_source)`, whose noise
GTSAM expresses as `target_from_source @ exp(ξ)`, rotation first: the convention of `se3`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.graph import lazy_gtsam as gtsam
from modeler.types import Array, Edge, EdgeKind, Mode, PoseGaussian, Posterior, are_separate, pooled

ROOT_SIGMA = 1e-9  # standard deviation of the root's pose in rad and m: practically zero, but positive definite
_KINDS: tuple[EdgeKind, ...] = ("odometry", "span", "closure", "join")  # in order of preference for the tree


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """All edges so far, accepted or rejected. Immutable: adding edges returns a new graph."""

    edges: tuple[Edge, ...] = ()
    """In order of arrival."""
    first: int | None = None
    """Number of the first accepted frame, whose camera frame is the object frame; None: the first edge's target."""

    def plus(self, edges: Iterable[Edge]) -> PoseGraph:
        """Return the graph with more edges."""
        return PoseGraph((*self.edges, *edges), self.first)

    @property
    def accepted(self) -> tuple[Edge, ...]:
        """The edges that take part."""
        return tuple(edge for edge in self.edges if edge.accepted)

    @property
    def root(self) -> int | None:
        """Number of the frame that fixes the gauge; None in an empty graph."""
        if self.first is not None:
            return self.first
        return next((edge.target for edge in self.edges if edge.accepted), None)


@dataclass(frozen=True, eq=False)
class Factor:
    """An edge as a single Gaussian."""

    edge: Edge
    """The accepted edge."""
    pose: PoseGaussian
    """target_from_source in the optimisation; that of a multimodal edge depends on the modes that loops select."""

    @cached_property
    def target(self) -> int:
        """Frame number of the target view."""
        return self.edge.target

    @cached_property
    def source(self) -> int:
        """Frame number of the source view."""
        return self.edge.source

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """Modes among which loops may select; none if they are not separate."""
        return self.edge.posterior.modes if are_separate(self.edge.posterior.modes) else ()

    def under(self, log_factor: float) -> Factor:
        """Return the factor under a longer focal length (method, eq. 10.3).

        Args:
            log_factor: logarithm of the focal length over that of the views.
        """
        return self if log_factor == 0.0 else Factor(self.edge, self.pose.under(log_factor))

    @cached_property
    def between(self) -> gtsam.BetweenFactorPose3:
        """The factor in GTSAM; ValueError if the covariance is not positive definite."""
        # smart=False: GTSAM may otherwise mistake near-singular information for that of a simpler model.
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(self.root_information, False)
        return gtsam.BetweenFactorPose3(self.target, self.source, gtsam.Pose3(self.pose.mean), noise)

    @cached_property
    def root_information(self) -> Array:
        """R (6, 6), upper triangular, with RᵀR = Σ⁻¹: from Σ = UUᵀ with U upper triangular, R = U⁻¹.

        Raises:
            ValueError: if the covariance is not positive definite.
        """
        try:
            upper = np.linalg.cholesky(self.pose.covariance[::-1, ::-1])[::-1, ::-1]
        except np.linalg.LinAlgError as error:
            raise ValueError(
                f"the covariance of edge {self.source} -> {self.target} is not positive definite: leave it out"
            ) from error
        return np.asarray(np.triu(np.linalg.inv(upper)), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class SpanningTree:
    """The factors that first connect each frame with the root, odometry preferred, and those that close loops."""

    factors: Sequence[Factor] = ()
    """All of them, in order of arrival."""
    tree: Sequence[Factor] = ()
    """Factors of the tree."""
    loops: Sequence[Factor] = ()
    """The other factors; those not connected with the root are in neither."""
    reached: frozenset[int] = frozenset()
    """The frames of the tree, and the root."""
    last: int = 0
    """Index of the least preferred kind in the tree."""

    @classmethod
    def of(cls, factors: Sequence[Factor], root: int) -> SpanningTree:
        """Return the tree from the root."""
        tree: list[Factor] = []
        loops: list[Factor] = []
        group: dict[int, set[int]] = {}
        for factor in sorted(factors, key=_preference):  # stable: by arrival within a kind
            target, source = (group.setdefault(frame, {frame}) for frame in (factor.target, factor.source))
            if source is target:
                loops.append(factor)
                continue
            tree.append(factor)
            larger, smaller = (target, source) if len(target) >= len(source) else (source, target)
            larger |= smaller
            group.update(dict.fromkeys(smaller, larger))
        reached = frozenset(group.get(root, {root}))
        tree, loops = ([factor for factor in some if factor.target in reached] for some in (tree, loops))
        return cls(factors, tree, loops, reached, max(map(_preference, tree), default=0))

    def plus(self, factors: Sequence[Factor]) -> SpanningTree | None:
        """Return the tree with more factors; None if a new tree is needed."""
        if len(self.tree) + len(self.loops) < len(self.factors):
            return None
        tree, loops, reached, last = list(self.tree), list(self.loops), set(self.reached), self.last
        for factor in sorted(factors, key=_preference):
            known = (factor.target in reached) + (factor.source in reached)
            if known == 0 or (known == 2 and _preference(factor) < last):
                return None
            if known == 2:
                loops.append(factor)
                continue
            tree.append(factor)
            reached |= {factor.target, factor.source}
            last = max(last, _preference(factor))
        return SpanningTree([*self.factors, *factors], tree, loops, frozenset(reached), last)


def _preference(factor: Factor) -> int:
    return _KINDS.index(factor.edge.kind)


def walk(tree: Sequence[Factor], *starts: int) -> Iterator[tuple[int, int, Factor]]:
    """Yield (frame, neighbour, factor) of a forest, breadth-first from some frames."""
    factors: dict[int, list[Factor]] = {}
    for factor in tree:
        factors.setdefault(factor.target, []).append(factor)
        factors.setdefault(factor.source, []).append(factor)
    queue, reached = list(starts), set(starts)
    for frame in queue:
        for factor in factors.get(frame, []):
            neighbour = factor.source if factor.target == frame else factor.target
            if neighbour not in reached:
                reached.add(neighbour)
                queue.append(neighbour)
                yield frame, neighbour, factor


def chain(tree: Sequence[Factor], root: int, guess: Mapping[int, Array]) -> dict[int, Array]:
    """Return object_from_camera by frame: the guess, for other frames dead reckoning."""
    poses = {root: np.eye(4)}
    poses |= {frame: guess[frame] for factor in tree for frame in (factor.target, factor.source) if frame in guess}
    poses[root] = np.eye(4)
    return extended(poses, tree)


def extended(poses: Mapping[int, Array], tree: Sequence[Factor]) -> dict[int, Array]:
    """Return object_from_camera by frame: the given poses, and dead reckoning from them along a tree."""
    poses = dict(poses)
    left = [factor for factor in tree if factor.target not in poses or factor.source not in poses]
    known = [frame for factor in left for frame in (factor.target, factor.source) if frame in poses]
    for frame, neighbour, factor in walk(left, *known):
        target_from_source = factor.pose.mean
        frame_from_neighbour = target_from_source if factor.target == frame else se3.inverse(target_from_source)
        poses[neighbour] = poses[frame] @ frame_from_neighbour
    return poses


def anchored(guess: Mapping[int, Array], root: int) -> Mapping[int, Array]:
    """Return a guess transformed so that the root's pose is the identity; empty without the root."""
    if root not in guess:
        return {}
    if np.array_equal(guess[root], np.eye(4)):
        return guess
    root_from_guess = se3.inverse(guess[root])
    return {frame: root_from_guess @ pose for frame, pose in guess.items()}


def inverse_right_jacobian(xi: Array) -> Array:
    """Return J (n, 6, 6) with log(exp(ξ) exp(η)) = ξ + J η to first order in η, to third order in small ξ (n, 6)."""
    adjoint = np.zeros((len(xi), 6, 6))
    adjoint[:, :3, :3] = adjoint[:, 3:, 3:] = se3.hat(xi[:, :3])
    adjoint[:, 3:, :3] = se3.hat(xi[:, 3:])
    return np.eye(6) + 0.5 * adjoint + adjoint @ adjoint / 12.0


def collapse_modes(posterior: Posterior, weights: Array | None = None) -> PoseGaussian:
    """Return a posterior as one Gaussian; separate modes are pooled at the heaviest (eq. 8.4).

    Args:
        posterior: with its modes.
        weights: (m,) of the modes, given loops; None: the posterior's own.
    """
    return pooled(posterior.modes, weights) if are_separate(posterior.modes) else posterior.pose


def dead_reckoning(graph: PoseGraph) -> dict[int, PoseGaussian]:
    """Return object_from_camera by frame number along the edges that first connect each frame with the root.

    The means are `Solution.odometry`. Covariances are of first order.
    """
    root = graph.root
    if root is None:
        return {}
    tree = SpanningTree.of([Factor(edge, collapse_modes(edge.posterior)) for edge in graph.accepted], root).tree
    poses = {root: PoseGaussian(np.eye(4), ROOT_SIGMA**2 * np.eye(6))}
    for frame, neighbour, factor in walk(tree, root):
        before = poses[frame]
        motion = factor.pose if factor.target == frame else factor.pose.inverse()
        covariance = se3.composed_covariance(before.covariance, motion.mean, motion.covariance)
        poses[neighbour] = PoseGaussian(before.mean @ motion.mean, covariance)
    return poses
