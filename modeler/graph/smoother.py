"""From a pose graph to its solution, afresh or from the solution of the graph it grew out of."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modeler.graph.links import Link, anchored, chain, split
from modeler.graph.marginals import PoseCovariances, RelativeCovariance
from modeler.graph.modes import belief, decide
from modeler.graph.optimise import optimise
from modeler.graph.pose_graph import PoseGraph
from modeler.types import Array, Edge, Solution


@dataclass(frozen=True, eq=False)
class _State:
    """What a solution rests on, by identity of edges and links: where it stands, it need not be worked out again."""

    root: int | None = None
    links: Mapping[Edge, Link] = field(default_factory=dict)
    """Every accepted edge as one Gaussian, before any loop."""
    tree: tuple[Link, ...] = ()
    loops: tuple[Link, ...] = ()
    decided: Mapping[Edge, Link] = field(default_factory=dict)
    """Edges with several modes on loops, after them."""
    weights: Mapping[Edge, Array] = field(default_factory=dict)
    """What the loops leave to their modes."""
    inlier: tuple[bool, ...] = ()
    """Which loops take part."""


@dataclass(frozen=True, eq=False)
class Smoother:
    """Solves a graph that grows, with as much work as the new edges ask for. A value: `plus` makes a new one.

    A frame that hangs on one edge is placed by it and moves no other. An edge that closes a loop moves all: the poses
    so far are where the optimisation starts, and one or two iterations end it. Which loops to leave out, and which
    modes to choose, is asked again only where the choice no longer stands. So each solution is that of the whole graph,
    within the tolerance of the optimisation, however it grew.
    """

    outlier_distance: float = 14.2
    """Mahalanobis distance of a loop edge from the solution beyond which it is an outlier. The default is three times
    the 99.9 % radius of six dimensions: pairwise covariances may be optimistic."""
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
            ValueError: where an accepted edge's covariance is not positive definite.
        """
        root = graph.root
        if root is None:
            return replace(self, graph=graph, solution=Solution(), state=_State())
        known = self.state.links
        links = {edge: known.get(edge) or Link(edge, belief(edge.posterior)) for edge in graph.accepted}
        tree, loops = split(links.values(), root)
        grew = root == self.state.root and _begins(tree, self.state.tree) and _begins(loops, self.state.loops)
        odometry = chain(tree, root, self.solution.odometry if grew else {})
        weights, decided = self.state.weights, self.state.decided
        if not grew or len(loops) > len(self.state.loops):
            weights, decided = self._decided(tree, loops, root, grew=grew)
        taken, closing = ([decided.get(link.edge, link) for link in some] for some in (tree, loops))
        start = chain(taken, root, {} if _jumped(decided, self.state) else anchored(self.solution.trajectory, root))
        inlier: tuple[bool, ...] = ()
        trajectory: Mapping[int, Array] = start if grew or loops else chain(taken, root, {})
        if grew and len(loops) == len(self.state.loops):  # the new frames hang on one edge each
            inlier = self.state.inlier
        elif loops:
            threshold = 0.5 * self.outlier_distance**2
            stood = self.state.inlier if grew else ()
            optimum = optimise(taken, closing, start, root=root, threshold=threshold, inlier=stood)
            inlier = optimum.inlier
            # Without a loop dead reckoning meets every edge exactly.
            trajectory = optimum.poses if any(inlier) else chain(taken, root, {})
        chosen = [loop for loop, good in zip(closing, inlier, strict=True) if good]
        relative_covariance = RelativeCovariance(trajectory, root, (*taken, *chosen))
        several = [link for link in (*taken, *closing) if len(link.edge.posterior.modes) > 1]
        own = {link.edge: [mode.weight for mode in link.edge.posterior.modes] for link in several}
        solution = Solution(
            trajectory=trajectory,
            covariances=PoseCovariances(relative_covariance),
            odometry=odometry,
            outliers=tuple(loop.edge for loop, good in zip(closing, inlier, strict=True) if not good),
            relative_covariance=relative_covariance,
            edge_poses={(link.source, link.target): link.pose for link in several},
            mode_weights={(e.source, e.target): weights.get(e, np.array(prior)) for e, prior in own.items()},
        )
        state = _State(root, links, tuple(tree), tuple(loops), decided, weights, inlier)
        return replace(self, graph=graph, solution=solution, state=state)

    def _decided(
        self, tree: list[Link], loops: list[Link], root: int, *, grew: bool
    ) -> tuple[dict[Edge, Array], dict[Edge, Link]]:
        """Return what the loops leave to the modes of edges with several, and those edges as one Gaussian each."""
        threshold, before = 0.5 * self.outlier_distance**2, self.state.weights if grew else {}
        weights = decide(tree, loops, root=root, threshold=threshold, before=before)
        decided = {
            edge: self.state.decided[edge]
            if edge in before and np.array_equal(before[edge], left)
            else Link(edge, belief(edge.posterior, left))
            for edge, left in weights.items()
        }
        return weights, decided


def _begins(links: Sequence[Link], beginning: Sequence[Link]) -> bool:
    return len(links) >= len(beginning) and all(map(operator.is_, links, beginning))


def _jumped(decided: Mapping[Edge, Link], state: _State) -> bool:
    """Return whether another mode was chosen than the one that the poses so far rest on."""
    before = ((link, state.decided.get(edge) or state.links.get(edge)) for edge, link in decided.items())
    return any(old is not None and not np.array_equal(link.pose.mean, old.pose.mean) for link, old in before)


def solve(graph: PoseGraph, guess: Mapping[int, Array], *, outlier_distance: float = 14.2) -> Solution:
    """Optimise the poses of all frames that accepted edges connect with the first.

    Edges that reach a frame nothing else has reached, odometry before closures, cannot be contradicted and are trusted.
    The others close loops; those that the rest contradicts are left out, see `optimise`. Of an edge whose posterior has
    several modes the loops choose one, see `modes`. A graph that grows is solved faster by `Smoother`.

    Args:
        graph: the edges.
        guess: object_from_camera (4, 4) by frame number, to start from; frames without one start on the chain.
        outlier_distance: see `Smoother`.

    Raises:
        ValueError: where an accepted edge's covariance is not positive definite.
    """
    return Smoother(outlier_distance, solution=Solution(guess)).to(graph).solution
