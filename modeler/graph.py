"""The pose graph: accepted edges in, optimised poses and their uncertainty out. The only module that imports GTSAM.

Variables are object_from_camera(k). An edge is `BetweenFactorPose3(target, source, target_from_source)`, whose noise
GTSAM expresses as `target_from_source @ exp(ξ)`, rotation first: the package's own convention, see `se3`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from modeler import se3
from modeler.marginals import PoseCovariances, network, walk
from modeler.types import Array, Edge, Solution

_GAUGE_SIGMA = 1e-6  # rad and m: far below any registration, so that it pins a pose without being seen


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Every edge judged so far. A value: adding edges makes a new graph."""

    edges: tuple[Edge, ...] = ()
    """In the order in which they were judged."""
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
        """Number of the frame that holds the gauge; None in an empty graph."""
        if self.first is not None:
            return self.first
        return next((edge.target for edge in self.accepted), None)


def solve(graph: PoseGraph, guess: Mapping[int, Array], *, outlier_distance: float = 14.2) -> Solution:
    """Optimise the poses of all frames that accepted edges connect with the first.

    Edges that reach a frame nothing else has reached, odometry before closures, cannot be contradicted and are trusted.
    The others close loops; they pass graduated non-convexity with a truncated least-squares loss (Yang et al.,
    Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020), which drops those that the rest contradicts.

    Args:
        graph: the edges.
        guess: object_from_camera (4, 4) by frame number, to start from; frames without one start on the chain.
        outlier_distance: Mahalanobis distance of a loop edge from the solution beyond which it is an outlier. The
            default is three times the 99.9 % radius of six dimensions: pairwise covariances may be optimistic.

    Raises:
        ValueError: where an accepted edge's covariance is not positive definite.
    """
    root = graph.root
    if root is None:
        return Solution()
    tree, loops = _split(graph.accepted, root)
    odometry = _chain(tree, root, {})
    start = _values(_chain(tree, root, _anchored(guess, root)))
    closures, outliers, trajectory = loops, [], odometry  # without loops dead reckoning meets every edge exactly
    if loops:
        values, inlier = _optimise(tree, loops, root, start, threshold=0.5 * outlier_distance**2)
        closures = [edge for edge, good in zip(loops, inlier, strict=True) if good]
        outliers = [edge for edge, good in zip(loops, inlier, strict=True) if not good]
        if closures:  # the gauge stands in the graph as a tight prior, in the result as what it means
            trajectory = {frame: values.atPose3(frame).matrix() for frame in odometry} | {root: np.eye(4)}
    relative_covariance = network(trajectory, root, tree, closures)
    covariances = PoseCovariances(root, relative_covariance)
    return Solution(trajectory, covariances, odometry, tuple(outliers), relative_covariance)


def _split(edges: Iterable[Edge], root: int) -> tuple[list[Edge], list[Edge]]:
    """Return the edges that first connect each frame with the root, odometry preferred, and the rest that close loops.

    Edges that do not hang together with the root are in neither.
    """
    tree: list[Edge] = []
    loops: list[Edge] = []
    group: dict[int, set[int]] = {}
    for edge in sorted(edges, key=lambda edge: edge.kind != "odometry"):  # stable: by arrival within a kind
        target, source = (group.setdefault(frame, {frame}) for frame in (edge.target, edge.source))
        if source is target:
            loops.append(edge)
            continue
        tree.append(edge)
        target |= source
        group.update(dict.fromkeys(source, target))
    reached = group.get(root, {root})
    return [edge for edge in tree if edge.target in reached], [edge for edge in loops if edge.target in reached]


def _chain(tree: Sequence[Edge], root: int, guess: Mapping[int, Array]) -> dict[int, Array]:
    """Return object_from_camera by frame, outwards from the root: the guess, or else dead reckoning."""
    poses = {root: np.eye(4)}
    for frame, neighbour, edge in walk(tree, root):
        target_from_source = edge.posterior.pose.mean
        frame_from_neighbour = target_from_source if edge.target == frame else se3.inverse(target_from_source)
        poses[neighbour] = guess.get(neighbour, poses[frame] @ frame_from_neighbour)
    return poses


def _anchored(guess: Mapping[int, Array], root: int) -> dict[int, Array]:
    """Return the guess with the root's pose at the identity; without the root it says nothing."""
    if root not in guess:
        return {}
    root_from_guess = se3.inverse(guess[root])
    return {frame: root_from_guess @ pose for frame, pose in guess.items()}


def _values(poses: Mapping[int, Array]) -> gtsam.Values:
    values = gtsam.Values()
    for frame, object_from_camera in poses.items():
        values.insert(frame, gtsam.Pose3(object_from_camera))
    return values


def _factors(edges: Iterable[Edge], root: int) -> gtsam.NonlinearFactorGraph:
    """Return the edges as factors, after a prior that pins the root's pose at the identity."""
    factors = gtsam.NonlinearFactorGraph()
    factors.add(gtsam.PriorFactorPose3(root, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, _GAUGE_SIGMA)))
    for edge in edges:
        target_from_source = gtsam.Pose3(edge.posterior.pose.mean)
        # smart=False: GTSAM's tests for simpler models have thresholds that near-singular information falls through.
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(_root_information(edge), False)
        factors.add(gtsam.BetweenFactorPose3(edge.target, edge.source, target_from_source, noise))
    return factors


def _root_information(edge: Edge) -> Array:
    """Return R (6, 6), upper triangular, with RᵀR = Σ⁻¹: from Σ = UUᵀ with U upper triangular, R = U⁻¹."""
    covariance = edge.posterior.pose.covariance
    try:
        upper = np.linalg.cholesky(covariance[::-1, ::-1])[::-1, ::-1]
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"the covariance of edge {edge.source} -> {edge.target} is not positive definite: leave it out"
        ) from error
    return np.asarray(np.triu(np.linalg.inv(upper)), dtype=np.float64)


def _parameters() -> gtsam.LevenbergMarquardtParams:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")  # Cholesky gives up where one direction is 4096 times vaguer
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    return parameters


def _optimise(
    tree: Sequence[Edge], loops: Sequence[Edge], root: int, start: gtsam.Values, *, threshold: float
) -> tuple[gtsam.Values, list[bool]]:
    """Return the optimum and which loop edges take part in it: those whose error stays below the threshold."""
    factors = _factors([*tree, *loops], root)
    trusted = 1 + len(tree)  # the gauge and the tree
    values = gtsam.LevenbergMarquardtOptimizer(factors, start, _parameters()).optimize()
    if all(factors.at(number).error(values) <= threshold for number in range(trusted, factors.size())):
        return values, [True] * len(loops)
    parameters = gtsam.GncLMParams(_parameters())
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(list(range(trusted)))
    annealing = gtsam.GncLMOptimizer(factors, start, parameters)
    annealing.setInlierCostThresholds(threshold)
    values = annealing.optimize()
    inlier = [weight > 0.5 for weight in annealing.getWeights()[trusted:]]
    remaining = [edge for edge, good in zip(loops, inlier, strict=True) if good]
    factors = _factors([*tree, *remaining], root)  # at full weight, where annealing ended between
    return gtsam.LevenbergMarquardtOptimizer(factors, values, _parameters()).optimize(), inlier
