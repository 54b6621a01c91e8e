"""The solution of a pose graph, in one batch or incrementally."""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modeler.graph.axis import AxisSolution, CommonAxis
from modeler.graph.condensed import Condensed
from modeler.graph.covariance import PoseCovariances, RelativeCovariance, SharedCovariance
from modeler.graph.modes import select_modes
from modeler.graph.optimise import MAX_ROUNDS, IncrementalSolver, inliers, selected, solve_loops, values_of
from modeler.graph.pose_graph import Factor, PoseGraph, SpanningTree, anchored, chain, collapse_modes, extended
from modeler.significance import SELDOM, SIGMAS, radius
from modeler.types import Array, Edge, FocalLength, Solution

OUTLIER_DISTANCE = SIGMAS * radius(SELDOM)
"""Mahalanobis distance of a loop edge from the solution beyond which it is an outlier: pairwise covariances may be
optimistic."""


@dataclass(frozen=True, eq=False)
class _State:
    """Intermediate results of a solution; edges and factors are compared by identity to find what changed."""

    root: int | None = None
    factors: Mapping[Edge, Factor] = field(default_factory=dict)
    """Every accepted edge as one Gaussian, before any loop."""
    spanning: SpanningTree = field(default_factory=SpanningTree)
    """Their tree and loops."""
    decided: Mapping[Edge, Factor] = field(default_factory=dict)
    """Multimodal edges on loops, with the modes that the loops select."""
    weights: Mapping[Edge, Array] = field(default_factory=dict)
    """Weights of their modes, given the loops."""
    inlier: tuple[bool, ...] = ()
    """Whether each loop takes part."""
    solver: IncrementalSolver | None = None
    covariance: RelativeCovariance | None = None
    """Covariances for independent edges; None with an axis."""


@dataclass(frozen=True, eq=False)
class Smoother:
    """Incremental solver of a growing graph. Immutable: `plus` returns a new one.

    A frame with one edge is placed by it and moves no other; edges that close loops are passed to iSAM2. Outlier loops
    and modes are selected again only if the earlier selection is no longer consistent. Each solution is that of the
    whole graph, within the tolerance of the optimisation, however it grew; in a graph of a thousand frames, poses of
    earlier frames follow those of the newest and of the targets of loops only now and then, or if it is solved again
    without new edges.
    """

    shared: float = 0.0
    """Fraction (0..1) of edges' covariances that is noise of their images, the same in all edges of an image, as
    `shared_noise` estimates it."""
    common: float = 0.0
    """Covariance of the error common to all views, as a fraction of an edge's; see `SharedCovariance`."""
    axis: CommonAxis | None = None
    """The turntable, if any; not together with shared noise. Each solution is then a batch solution."""
    focal: FocalLength | None = None
    """Estimate of the focal length, whose uncertainty is added to the covariances; None: exact."""
    common_shift_m2: Array | None = None
    """(3, 3) covariance in m² of a shift of the surface common to all views; see `SharedCovariance`. None: 0."""
    variance_factor: float = Solution.variance_factor
    """On the covariances of edges; see `SharedCovariance`."""
    graph: PoseGraph = field(default_factory=PoseGraph)
    """The graph."""
    solution: Solution = field(default_factory=Solution)
    """Its solution."""
    state: _State = field(default_factory=_State, repr=False)

    def plus(self, edges: Iterable[Edge]) -> Smoother:
        """Return the smoother with more edges; ValueError if an accepted edge's covariance is not positive definite."""
        return self.to(self.graph.plus(edges))

    def to(self, graph: PoseGraph) -> Smoother:
        """Return the smoother of a graph; only what its new edges change is computed, without new ones all poses.

        Raises:
            ValueError: if an accepted edge's covariance is not positive definite, or both axis and shared noise are
                given.
        """
        if self.axis is not None and (self.shared or self.common):
            raise ValueError("an axis and shared noise cannot be separated; give one of them")
        root = graph.root
        if root is None:
            return replace(self, graph=graph, solution=Solution(), state=_State())
        factors = self._factors(graph)
        spanning, grew = self._spanning(list(factors.values()), root)
        tree, loops = spanning.tree, spanning.loops
        growing = len(graph.edges) > len(self.graph.edges)
        settles = not growing and self._condensed is not None
        closes = not grew or settles or len(loops) > len(self.state.spanning.loops)
        known = len(self.state.spanning.tree)
        odometry = extended(self.solution.odometry, tree[known:]) if grew else chain(tree, root, {})
        weights, decided = self.state.weights, self.state.decided
        if closes:
            weights, decided = self._decided(tree, loops, root, grew=grew)
        if decided:
            tree, loops = ([decided.get(factor.edge, factor) for factor in some] for some in (tree, loops))
        mode_changed = _mode_changed(decided, self.state)
        guess = {} if mode_changed else anchored(self.solution.trajectory, root)
        start = extended(guess, tree[known:]) if grew and not mode_changed else chain(tree, root, guess)
        inlier, solver = self.state.inlier, self.state.solver
        trajectory: Mapping[int, Array] = start if grew or loops else chain(tree, root, {})
        if closes:  # otherwise each new frame has one edge
            before = ((), None) if mode_changed or not grew else (inlier, solver)
            trajectory, inlier, solver = solve_loops(
                tree, loops, start, root=root, threshold=self._threshold, before=before, growing=growing
            )
        before = None if closes or mode_changed else self.state.covariance
        covariance = None if before is None else before.plus(trajectory, tree[known:])
        state = _State(root, factors, spanning, decided, weights, inlier, solver, covariance)
        if grew and decided and inlier.count(False) > self.state.inlier.count(False):
            # A false loop may have decided modes: all are selected anew.
            again = replace(self, state=_State()).to(graph)
            if len(again.solution.outliers) <= inlier.count(False):
                return again
        state, solution = self._solution(state, (tree, loops), trajectory)
        return replace(self, graph=graph, solution=replace(solution, odometry=odometry), state=state)

    @property
    def _condensed(self) -> Condensed | None:
        """What the solver holds of earlier factors as a Gaussian, if it does."""
        return None if self.state.solver is None else self.state.solver.condensed

    @property
    def _threshold(self) -> float:
        """Half the squared outlier distance."""
        return 0.5 * OUTLIER_DISTANCE**2

    def _solution(
        self,
        state: _State,
        factors: tuple[Sequence[Factor], Sequence[Factor]],
        trajectory: Mapping[int, Array],
    ) -> tuple[_State, Solution]:
        """Return the intermediate results with covariances, and the solution without its odometry.

        Args:
            state: intermediate results; with covariances where these are known already.
            factors: tree and loops, with the modes that the loops select.
            trajectory: object_from_camera (4, 4) by frame number, without an axis.
        """
        root, (tree, loops), inlier = state.root or 0, factors, state.inlier
        with_axis: AxisSolution | None = None
        if self.axis is not None:
            inlier, with_axis = self._with_axis(self.axis, tree, loops, trajectory, state)
        trajectory = trajectory if with_axis is None else with_axis.poses
        independent = state.covariance
        if independent is None or self.axis is not None:
            taking_part = [*tree, *selected(loops, inlier)]
            if with_axis is not None:
                independent = RelativeCovariance.of(trajectory, root, taking_part, with_axis.factors)
            else:
                condensed = None if state.solver is None else state.solver.condensed
                independent = RelativeCovariance.of(trajectory, root, taking_part, condensed=condensed)
        relative_covariance = self._covariance(independent)
        several = [factor for factor in (*tree, *loops) if factor.modes]
        state = replace(state, covariance=None if self.axis is not None else independent)
        return state, Solution(
            trajectory=trajectory,
            covariances=PoseCovariances(
                trajectory, functools.partial(relative_covariance, root), self._known(relative_covariance)
            ),
            outliers=tuple(loop.edge for loop, good in zip(loops, inlier, strict=True) if not good),
            relative_covariance=relative_covariance,
            deforming_covariance=relative_covariance.deforming,
            edge_poses={(factor.source, factor.target): factor.pose for factor in several},
            mode_weights={(factor.source, factor.target): _weights(factor, state.weights) for factor in several},
            focal=self.focal,
            common_shift_m2=self.common_shift_m2,
            variance_factor=self.variance_factor,
            camera_from_axis=None if with_axis is None else with_axis.camera_from_axis,
        )

    def _known(self, relative: RelativeCovariance | SharedCovariance) -> dict[int, Array]:
        """Return covariances of poses which frames that have been added, each by one factor, leave as they are."""
        before, poses = self.solution.relative_covariance, self.solution.covariances
        if not (isinstance(before, RelativeCovariance) and isinstance(relative, RelativeCovariance)):
            return {}
        if not (isinstance(poses, PoseCovariances) and before.eliminated is relative.eliminated):
            return {}
        return dict(poses.known)

    def _factors(self, graph: PoseGraph) -> dict[Edge, Factor]:
        """Return every accepted edge of a graph as one Gaussian, reusing factors of the solved graph."""
        known, count = self.state.factors, len(self.graph.edges)
        if known and graph.edges[:count] == self.graph.edges:
            new = [edge for edge in graph.edges[count:] if edge.accepted]
            return {**known, **{edge: Factor(edge, collapse_modes(edge.posterior)) for edge in new}}
        return {edge: known.get(edge) or Factor(edge, collapse_modes(edge.posterior)) for edge in graph.accepted}

    def _spanning(self, factors: list[Factor], root: int) -> tuple[SpanningTree, bool]:
        """Return tree and loops, and whether they have only grown."""
        before = self.state.spanning
        count = len(before.factors)
        if root == self.state.root and len(factors) >= count and all(map(operator.is_, factors, before.factors)):
            grown = before.plus(factors[count:])
            if grown is not None:
                return grown, True
        return SpanningTree.of(factors, root), False

    def _covariance(self, independent: RelativeCovariance) -> RelativeCovariance | SharedCovariance:
        """Return covariances with the errors that edges share."""
        factors = independent.factors
        stated = self.shared or self.common or self.focal or self.variance_factor != 1.0
        if not (factors and (stated or self.common_shift_m2 is not None)):
            return independent
        parts = self.shared, self.common, self.focal, self.common_shift_m2, self.variance_factor
        return SharedCovariance(independent, factors, *parts)

    def _with_axis(
        self,
        axis: CommonAxis,
        tree: Sequence[Factor],
        loops: Sequence[Factor],
        trajectory: Mapping[int, Array],
        state: _State,
    ) -> tuple[tuple[bool, ...], AxisSolution | None]:
        """Return which loops are inliers, and the solution with a common axis; None if there is none."""
        agreeing, inlier, found = state.inlier, state.inlier, None
        for _ in range(MAX_ROUNDS):
            inlier = agreeing
            found = axis.solve([*tree, *selected(loops, inlier)], trajectory, state.root or 0)
            if found is None:
                return state.inlier, None
            agreeing = inliers(loops, values_of(found.poses), self._threshold)
            if agreeing == inlier:
                break
        return inlier, found

    def _decided(
        self, tree: Sequence[Factor], loops: Sequence[Factor], root: int, *, grew: bool
    ) -> tuple[dict[Edge, Array], dict[Edge, Factor]]:
        """Return the weights of the modes of edges given the loops, and these edges as one Gaussian each."""
        before = self.state.weights if grew else {}
        weights = select_modes(tree, loops, root=root, threshold=self._threshold, before=before)
        decided = {
            edge: self.state.decided[edge]
            if edge in before and np.array_equal(before[edge], left)
            else Factor(edge, collapse_modes(edge.posterior, left))
            for edge, left in weights.items()
        }
        return weights, decided


def _weights(factor: Factor, decided: Mapping[Edge, Array]) -> Array:
    """Return the weights of a factor's modes: those given the loops, or else the posterior's own."""
    return decided.get(factor.edge, np.array([mode.weight for mode in factor.modes]))


def _mode_changed(decided: Mapping[Edge, Factor], state: _State) -> bool:
    """Return whether the selected mode of some edge has changed."""
    before = ((factor, state.decided.get(edge) or state.factors.get(edge)) for edge, factor in decided.items())
    return any(old is not None and not np.array_equal(factor.pose.mean, old.pose.mean) for factor, old in before)


def solve(
    graph: PoseGraph,
    guess: Mapping[int, Array],
    *,
    shared: float = 0.0,
    common: float = 0.0,
    axis: CommonAxis | None = None,
    focal: FocalLength | None = None,
    common_shift_m2: Array | None = None,
) -> Solution:
    """Optimise the poses of all frames that accepted edges connect with the first.

    Edges that first connect a frame, odometry before closures, form a tree and are trusted. The others close loops;
    outliers are left out, see `optimise`. Loops select among the modes of multimodal edges, see `modes`. A growing
    graph is solved faster by `Smoother`.

    Args:
        graph: the edges.
        guess: initial object_from_camera (4, 4) by frame number; for other frames, dead reckoning.
        shared: see `Smoother`.
        common: see `Smoother`.
        axis: the turntable, if any.
        focal: see `Smoother`; of a solution of the same graph.
        common_shift_m2: see `Smoother`.

    Raises:
        ValueError: if an accepted edge's covariance is not positive definite.
    """
    parts = shared, common, axis, focal, common_shift_m2
    return Smoother(*parts, solution=Solution(guess)).to(graph).solution
