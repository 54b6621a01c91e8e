"""From a pose graph to its solution, afresh or from the solution of the graph it grew out of."""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modeler.graph.axis import AxisSolution, CommonAxis
from modeler.graph.closing import closed
from modeler.graph.collapse import collapse_modes
from modeler.graph.factors import Factor, SpanningTree, anchored, chain
from modeler.graph.incremental import Incremental
from modeler.graph.marginals import PoseCovariances, RelativeCovariance
from modeler.graph.modes import decide
from modeler.graph.optimise import agree, joining, values_of
from modeler.graph.pose_graph import PoseGraph
from modeler.graph.shared import SharedCovariance
from modeler.types import Array, Edge, Solution

_ROUNDS = 5  # in which an axis may change which loops agree


@dataclass(frozen=True, eq=False)
class _State:
    """What a solution rests on, by identity of edges and factors: where it stands, it need not be worked out again."""

    root: int | None = None
    factors: Mapping[Edge, Factor] = field(default_factory=dict)
    """Every accepted edge as one Gaussian, before any loop."""
    frames: SpanningTree = field(default_factory=SpanningTree)
    """How these hang together."""
    decided: Mapping[Edge, Factor] = field(default_factory=dict)
    """Edges with several modes on loops, after them."""
    weights: Mapping[Edge, Array] = field(default_factory=dict)
    """What the loops leave to their modes."""
    inlier: tuple[bool, ...] = ()
    """Which loops take part."""
    engine: Incremental | None = None
    """The solution as iSAM2 has it."""


@dataclass(frozen=True, eq=False)
class Smoother:
    """Solves a graph that grows, with as much work as the new edges ask for. A value: `plus` makes a new one.

    A frame that hangs on one edge is placed by it and moves no other. An edge that closes a loop moves those around it,
    see `incremental`. Which loops to leave out, and which modes to choose, is asked again only where the choice no
    longer stands. So each solution is that of the whole graph, within the tolerance of the optimisation, however it
    grew.
    """

    outlier_distance: float = 14.2
    """Mahalanobis distance of a loop edge from the solution beyond which it is an outlier. The default is three times
    the 99.9 % radius of six dimensions: pairwise covariances may be optimistic."""
    shared: float = 0.0
    """Share (0..1) of edges' covariances that is their images' own noise, the same in all edges of an image; see
    `shared_noise`, which tells it."""
    common: float = 0.0
    """Covariance of what all views err by alike, as a share of an edge's; see `SharedCovariance`."""
    axis: CommonAxis | None = None
    """The turntable, where there is one. Each solution is then made afresh; not together with noise that is shared."""
    graph: PoseGraph = field(default_factory=PoseGraph)
    """What is solved."""
    solution: Solution = field(default_factory=Solution)
    """Its solution."""
    state: _State = field(default_factory=_State, repr=False)

    def plus(self, edges: Iterable[Edge]) -> Smoother:
        """Return the smoother with more edges.

        Raises:
            ValueError: where an accepted edge's covariance is not positive definite.
        """
        return self.to(self.graph.plus(edges))

    def to(self, graph: PoseGraph) -> Smoother:
        """Return the smoother of a graph, which costs the less the more of its edges are in this one's.

        Raises:
            ValueError: where an accepted edge's covariance is not positive definite, or with an axis and shared noise.
        """
        if self.axis is not None and (self.shared or self.common):
            raise ValueError("an axis and shared noise were given: the noise of frames is not told apart from slip yet")
        root = graph.root
        if root is None:
            return replace(self, graph=graph, solution=Solution(), state=_State())
        known = self.state.factors
        factors = {edge: known.get(edge) or Factor(edge, collapse_modes(edge.posterior)) for edge in graph.accepted}
        frames, grew = self._frames(list(factors.values()), root)
        tree, loops, closes = frames.tree, frames.loops, not grew or len(frames.loops) > len(self.state.frames.loops)
        odometry = chain(tree, root, self.solution.odometry if grew else {})
        weights, decided = self.state.weights, self.state.decided
        if closes:
            weights, decided = self._decided(tree, loops, root, grew=grew)
        taken, closing = (
            [decided.get(factor.edge, factor) for factor in some] if decided else some for some in (tree, loops)
        )
        jumped = _jumped(decided, self.state)
        start = chain(taken, root, {} if jumped else anchored(self.solution.trajectory, root))
        threshold, inlier, engine = 0.5 * self.outlier_distance**2, self.state.inlier, self.state.engine
        trajectory: Mapping[int, Array] = start if grew or loops else chain(taken, root, {})
        if closes:  # otherwise the new frames hang on one edge each
            before = ((), None) if jumped or not grew else (inlier, engine)
            trajectory, inlier, engine = closed(taken, closing, start, root=root, threshold=threshold, before=before)
        state = _State(root, factors, frames, decided, weights, inlier, engine)
        if grew and decided and inlier.count(False) > self.state.inlier.count(False):
            # Modes that were settled may have been so by a lie: all are put in question.
            again = replace(self, state=_State()).to(graph)
            if len(again.solution.outliers) <= inlier.count(False):
                return again
        solution = self._solution(state, (taken, closing), trajectory, grew=grew and graph is not self.graph)
        return replace(self, graph=graph, solution=replace(solution, odometry=odometry), state=state)

    def _solution(
        self,
        state: _State,
        factors: tuple[Sequence[Factor], Sequence[Factor]],
        trajectory: Mapping[int, Array],
        *,
        grew: bool,
    ) -> Solution:
        """Return the solution but for its odometry.

        Args:
            state: what it rests on.
            factors: tree and loops, of several modes as loops have decided.
            trajectory: object_from_camera (4, 4) by frame number, as all but an axis has it.
            grew: whether the graph grew from that of the solution before.
        """
        root, (taken, closing), inlier = state.root or 0, factors, state.inlier
        turned: AxisSolution | None = None
        if self.axis is not None:
            inlier, turned = self._turned(self.axis, taken, closing, trajectory, state)
        trajectory = trajectory if turned is None else turned.poses
        taking_part = [*taken, *joining(closing, inlier)]
        relative_covariance = self._covariance(taking_part, trajectory, turned, root=root, grew=grew)
        several = [factor for factor in (*taken, *closing) if factor.modes]
        return Solution(
            trajectory=trajectory,
            covariances=PoseCovariances(
                trajectory, functools.partial(relative_covariance, root), relative_covariance.marginals
            ),
            outliers=tuple(loop.edge for loop, good in zip(closing, inlier, strict=True) if not good),
            relative_covariance=relative_covariance,
            edge_poses={(factor.source, factor.target): factor.pose for factor in several},
            mode_weights={(factor.source, factor.target): _weights(factor, state.weights) for factor in several},
            camera_from_axis=None if turned is None else turned.camera_from_axis,
        )

    def _frames(self, factors: list[Factor], root: int) -> tuple[SpanningTree, bool]:
        """Return how factors hang together, and whether those before hung together so and have but grown."""
        before = self.state.frames
        count = len(before.factors)
        if root == self.state.root and len(factors) >= count and all(map(operator.is_, factors, before.factors)):
            grown = before.plus(factors[count:])
            if grown is not None:
                return grown, True
        return SpanningTree.of(factors, root), False

    def _covariance(
        self,
        factors: Sequence[Factor],
        trajectory: Mapping[int, Array],
        turned: AxisSolution | None,
        *,
        root: int,
        grew: bool,
    ) -> RelativeCovariance | SharedCovariance:
        """Return the covariances of a solution, where the graph grew from those before as far as these stayed."""
        before = self.solution.relative_covariance
        if isinstance(before, SharedCovariance):
            before = before.independent
        if turned is None and isinstance(before, RelativeCovariance) and grew:
            found = before.to(trajectory, factors)
        else:
            found = RelativeCovariance(trajectory, root, factors, () if turned is None else turned.rows)
        if not (factors and (self.shared or self.common)):
            return found
        return SharedCovariance(found, factors, self.shared, self.common)

    def _turned(
        self,
        axis: CommonAxis,
        tree: Sequence[Factor],
        loops: Sequence[Factor],
        trajectory: Mapping[int, Array],
        state: _State,
    ) -> tuple[tuple[bool, ...], AxisSolution | None]:
        """Return which loops take part where steps share an axis, and the solution then; None: they do not."""
        inlier, turned = state.inlier, None
        for _ in range(_ROUNDS):
            found = axis.solved([*tree, *joining(loops, inlier)], trajectory, state.root or 0)
            if found is None:
                return state.inlier, None
            agreeing, turned = agree(loops, values_of(found.poses), 0.5 * self.outlier_distance**2), found
            if agreeing == inlier:
                break
            inlier = agreeing
        return inlier, turned

    def _decided(
        self, tree: Sequence[Factor], loops: Sequence[Factor], root: int, *, grew: bool
    ) -> tuple[dict[Edge, Array], dict[Edge, Factor]]:
        """Return what the loops leave to the modes of edges with several, and those edges as one Gaussian each."""
        threshold, before = 0.5 * self.outlier_distance**2, self.state.weights if grew else {}
        weights = decide(tree, loops, root=root, threshold=threshold, before=before)
        decided = {
            edge: self.state.decided[edge]
            if edge in before and np.array_equal(before[edge], left)
            else Factor(edge, collapse_modes(edge.posterior, left))
            for edge, left in weights.items()
        }
        return weights, decided


def _weights(factor: Factor, decided: Mapping[Edge, Array]) -> Array:
    """Return the weights of a factor's modes: as loops have decided, or else the posterior's own."""
    return decided.get(factor.edge, np.array([mode.weight for mode in factor.modes]))


def _jumped(decided: Mapping[Edge, Factor], state: _State) -> bool:
    """Return whether another mode was chosen than the one that the poses so far rest on."""
    before = ((factor, state.decided.get(edge) or state.factors.get(edge)) for edge, factor in decided.items())
    return any(old is not None and not np.array_equal(factor.pose.mean, old.pose.mean) for factor, old in before)
