"""Selection among the modes of multimodal edges by loops and the other edges.

A hypothesis selects one mode of every such edge on a loop. Hypotheses are first scored loop by loop, along the tree,
thousands at once; the best few are then optimised and compared by Laplace's approximation of the evidence (method,
eq. 8.3). Weights of modes are sums over all near the best: if a shape looks the same from behind, thousands are equal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.graph.covariance import RelativeCovariance
from modeler.graph.optimise import MAX_ROUNDS, optimise, selected
from modeler.graph.pose_graph import Factor, chain, walk
from modeler.significance import SELDOM
from modeler.types import Array, Edge

_BEAM = 4096  # hypotheses kept while loops are added one by one: all of twelve edges with two modes
_MAX_EXTRA_OUTLIERS = 1.5
"""Outlier loops more than the best hypothesis before one is dropped: one loop may be wrong. Halved or doubled, the
dragon's poses are the same."""


@dataclass(frozen=True, eq=False)
class _Segment:
    """A part of a cycle: a motion with one or several modes."""

    column: int | None
    """Column of the hypotheses that selects the mode; None if there is only one."""
    means: Array
    """(m, 4, 4)."""
    covariances: Array
    """(m, 6, 6)."""

    def of(self, hypotheses: npt.NDArray[np.int64]) -> tuple[Array, Array]:
        """Return means and covariances for hypotheses (h, edges), or one for all (1, …)."""
        if self.column is None:
            return self.means, self.covariances
        modes = hypotheses[:, self.column]
        return self.means[modes], self.covariances[modes]


@dataclass(frozen=True, eq=False)
class Cycle:
    """The path along the tree from a loop's target to its source, and the loop's own motion."""

    path: tuple[_Segment, ...]
    own: _Segment

    @property
    def columns(self) -> tuple[int, ...]:
        """Columns of the hypotheses on which it depends."""
        return tuple(segment.column for segment in (*self.path, self.own) if segment.column is not None)

    def residual(self, hypotheses: npt.NDArray[np.int64]) -> tuple[Array, Array]:
        """Return the closure error under hypotheses (h, edges).

        Returns:
            Half its squared Mahalanobis distance (h,), and half the log determinant of its covariance (h,).
        """
        mean, covariance = np.eye(4)[None], np.zeros((1, 6, 6))
        for segment in self.path:
            mean, covariance = _composed((mean, covariance), segment.of(hypotheses))
        own, own_covariance = self.own.of(hypotheses)
        spread = covariance + own_covariance
        xi = se3.log(se3.inverse(own) @ mean)
        error = 0.5 * np.sum(xi * np.linalg.solve(spread, xi[..., None])[..., 0], axis=-1)
        return error, 0.5 * np.linalg.slogdet(spread)[1]


def cycles(
    tree: Sequence[Factor], loops: Sequence[Factor], root: int, settled: Mapping[Edge, Array]
) -> tuple[tuple[Edge, ...], list[Cycle]]:
    """Return the edges on loops whose mode is undecided, one per column of hypotheses, and the cycles through them.

    Args:
        tree: factors that connect the frames.
        loops: the factors beyond those.
        root: a frame of the tree.
        settled: weights of modes by edge; the heaviest is used.
    """
    above = {neighbour: (frame, factor) for frame, neighbour, factor in walk(tree, root)}
    depth = {root: 0}
    for neighbour, (frame, _) in above.items():  # outwards
        depth[neighbour] = depth[frame] + 1
    columns: dict[Edge, int] = {}
    found = []
    for loop in loops:
        ahead: list[tuple[Factor, bool]] = []  # each with whether the path goes from its target to its source
        back: list[tuple[Factor, bool]] = []
        target, source = loop.target, loop.source
        while target != source:
            if depth[target] >= depth[source]:
                target, factor = above[target]
                ahead.append((factor, factor.source == target))
            else:
                source, factor = above[source]
                back.append((factor, factor.target == source))
        path = [*ahead, *reversed(back), (loop, True)]
        if any(factor.modes and factor.edge not in settled for factor, _ in path):
            *segments, own = (_segment(factor, settled, columns, forwards=forwards) for factor, forwards in path)
            found.append(Cycle(_merged(segments), own))
    return tuple(columns), found


def _segment(factor: Factor, settled: Mapping[Edge, Array], columns: dict[Edge, int], *, forwards: bool) -> _Segment:
    """Return a factor as part of a cycle, along it or against it; an undecided edge is given a column."""
    edge, poses, column = factor.edge, [factor.pose], None
    if factor.modes:
        if edge in settled:
            poses = [factor.modes[int(np.argmax(settled[edge]))].pose]
        else:
            poses, column = [mode.pose for mode in factor.modes], columns.setdefault(edge, len(columns))
    poses = poses if forwards else [pose.inverse() for pose in poses]
    return _Segment(column, np.stack([pose.mean for pose in poses]), np.stack([pose.covariance for pose in poses]))


def _merged(segments: Sequence[_Segment]) -> tuple[_Segment, ...]:
    """Return the segments, consecutive ones of one mode composed."""
    merged: list[_Segment] = []
    for segment in segments:
        if merged and segment.column is None and merged[-1].column is None:
            last = merged.pop()
            segment = _Segment(None, *_composed((last.means, last.covariances), (segment.means, segment.covariances)))
        merged.append(segment)
    return tuple(merged)


def _composed(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return means (h, 4, 4) and covariances (h, 6, 6) of one motion after another, for independent errors."""
    return first[0] @ second[0], se3.composed_covariance(first[1], *second)


def select_modes(
    tree: Sequence[Factor],
    loops: Sequence[Factor],
    *,
    root: int,
    threshold: float,
    before: Mapping[Edge, Array] | None = None,
) -> dict[Edge, Array]:
    """Return the weights (m,) of the modes of each multimodal edge on a loop, given the loops.

    Args:
        tree: factors that connect the frames.
        loops: the factors beyond those.
        root: a frame of the tree.
        threshold: half the squared Mahalanobis distance from which a loop is an outlier.
        before: weights given fewer loops; modes decided there are kept.
    """
    settled = {edge: weights for edge, weights in (before or {}).items() if 1.0 - weights.max() <= SELDOM}
    if not any(factor.modes and factor.edge not in settled for factor in (*tree, *loops)):
        return settled
    search = _Search.of(tree, loops, root, settled, threshold)
    best = search.best() if search.edges else None
    decided = dict(settled)
    if best is not None:
        hypotheses, scores = best
        if len(hypotheses) > 1:
            chosen = (dict(zip(search.edges, row, strict=True)) for row in hypotheses[:MAX_ROUNDS])
            evidence = np.array([search.evidence(tree, loops, root, modes, settled) for modes in chosen])
            # Scores along the tree differ from the evidence by nearly the same amount for all of the best.
            scores = np.concatenate([evidence, scores[len(evidence) :] + np.mean(evidence - scores[: len(evidence)])])
        shares = np.exp(scores - scores.max())
        shares = shares / shares.sum()
        for column, edge in enumerate(search.edges):
            modes = np.arange(len(edge.posterior.modes))
            weights = (hypotheses[:, column, None] == modes).T @ shares
            top = weights == weights.max()
            decided[edge] = top.astype(np.float64) if 1.0 - weights.max() <= SELDOM else weights
    return decided


@dataclass(frozen=True, eq=False)
class _Search:
    """Beam search over hypotheses, scored loop by loop."""

    edges: tuple[Edge, ...]
    """Edges whose mode is undecided, by column."""
    cycles: tuple[Cycle, ...]
    """Cycles that depend on them, those with the fewest undecided edges first."""
    threshold: float
    """Half the squared Mahalanobis distance from which a loop is an outlier."""

    @classmethod
    def of(
        cls, tree: Sequence[Factor], loops: Sequence[Factor], root: int, settled: Mapping[Edge, Array], threshold: float
    ) -> _Search:
        """Return the search for the modes of all undecided edges on loops."""
        edges, found = cycles(tree, loops, root, settled)
        return cls(edges, tuple(sorted(found, key=lambda cycle: len(cycle.columns))), threshold)

    def best(self) -> tuple[npt.NDArray[np.int64], Array]:
        """Return hypotheses (h, edges), best first, and their scores (h,)."""
        hypotheses, scores = np.full((1, len(self.edges)), -1), np.zeros(1)
        for cycle in self.cycles:
            for column in cycle.columns:
                if hypotheses[0, column] < 0:
                    hypotheses, scores = self._expanded(hypotheses, scores, column)
            scores = scores + self._loop_score(cycle, hypotheses)
            alive = scores >= scores.max() - _MAX_EXTRA_OUTLIERS * self.threshold
            hypotheses, scores = hypotheses[alive], scores[alive]
        hypotheses = _near_best(hypotheses, scores)[0]
        while True:  # recovers hypotheses that the beam dropped
            around = np.unique(np.concatenate([hypotheses, self._neighbours(hypotheses[0])]), axis=0)
            found, scores = _near_best(around, self._score(around))
            if np.array_equal(found[0], hypotheses[0]):
                return found, scores
            hypotheses = found

    def evidence(
        self,
        tree: Sequence[Factor],
        loops: Sequence[Factor],
        root: int,
        hypothesis: Mapping[Edge, np.int64],
        settled: Mapping[Edge, Array],
    ) -> float:
        """Return the Laplace approximation of a hypothesis' log evidence (eq. 8.3), up to a common constant."""
        of = {edge: int(mode) for edge, mode in hypothesis.items()}
        of |= {edge: int(np.argmax(weights)) for edge, weights in settled.items()}
        tree, loops = ([_chosen(factor, of) for factor in some] for some in (tree, loops))
        optimum = optimise(tree, loops, chain(tree, root, {}), root=root, threshold=self.threshold)
        chosen = selected(loops, optimum.inlier)
        evidence = -optimum.error - RelativeCovariance.of(optimum.poses, root, (*tree, *chosen)).log_determinant
        for edge, mode in hypothesis.items():
            chosen_mode = edge.posterior.modes[int(mode)]
            evidence += np.log(chosen_mode.weight) - 0.5 * np.linalg.slogdet(chosen_mode.pose.covariance)[1]
        return float(evidence)

    def _weights(self, column: int) -> Array:
        return np.log([max(mode.weight, 1e-300) for mode in self.edges[column].posterior.modes])

    def _expanded(
        self, hypotheses: npt.NDArray[np.int64], scores: Array, column: int
    ) -> tuple[npt.NDArray[np.int64], Array]:
        """Return the best hypotheses after adding each mode of one more edge."""
        weights = self._weights(column)
        expanded = np.repeat(hypotheses, len(weights), axis=0)
        expanded[:, column] = np.tile(np.arange(len(weights)), len(hypotheses))
        scores = np.repeat(scores, len(weights)) + np.tile(weights, len(hypotheses))
        order = np.argsort(-scores, kind="stable")[:_BEAM]
        return expanded[order], scores[order]

    def _neighbours(self, hypothesis: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the hypotheses that differ from one (edges,) in one edge."""
        changes = [
            (column, mode) for column, edge in enumerate(self.edges) for mode in range(len(edge.posterior.modes))
        ]
        neighbours = np.tile(hypothesis, (len(changes), 1))
        for row, (column, mode) in zip(neighbours, changes, strict=True):
            row[column] = mode
        return neighbours

    def _score(self, hypotheses: npt.NDArray[np.int64]) -> Array:
        """Return the scores (h,) of whole hypotheses (h, edges)."""
        scores = np.zeros(len(hypotheses))
        for column in range(len(self.edges)):
            scores = scores + self._weights(column)[hypotheses[:, column]]
        return scores + np.sum([self._loop_score(cycle, hypotheses) for cycle in self.cycles], axis=0)

    def _loop_score(self, cycle: Cycle, hypotheses: npt.NDArray[np.int64]) -> Array:
        """Return the truncated log density (h,) of a loop's residual."""
        error, log_volume = cycle.residual(hypotheses)
        return -np.minimum(error, self.threshold) - log_volume


def _chosen(factor: Factor, modes: Mapping[Edge, int]) -> Factor:
    """Return a factor with the mode that a hypothesis selects."""
    return Factor(factor.edge, factor.edge.posterior.modes[modes[factor.edge]].pose) if factor.edge in modes else factor


def _near_best(hypotheses: npt.NDArray[np.int64], scores: Array) -> tuple[npt.NDArray[np.int64], Array]:
    """Return the hypotheses (h, edges) with scores (h,) near the best, best first."""
    order = np.argsort(-scores, kind="stable")[:_BEAM]
    return hypotheses[order], scores[order]
