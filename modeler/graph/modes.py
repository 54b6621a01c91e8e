"""Edges whose posterior has several modes: which of them the loops and the other edges single out.

A hypothesis names one mode for every edge with several that lies on a loop. Its evidence is the product of the weights
of its modes and of how well each loop then closes. Loops are first taken one by one, along the tree, for thousands of
hypotheses at once; the few that are left are solved whole, and their evidence is Laplace's: with e the error at the
optimum, Σ_m the covariances of the modes and UᵀU the information of all poses,

    log evidence = Σ log(w_m |Σ_m|^-1/2) − e − log |U|.

Without a loop that is Σ log w_m: what one edge says of itself. (Olson and Agarwal, Inference on networks of mixtures
for robust robot mapping, IJRR 2013, choose by w_m |Σ_m|^-1/2 exp(−e) alone, which favours narrow modes.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modeler.graph.cycles import Cycle, cycles
from modeler.graph.factors import Factor, chain
from modeler.graph.marginals import RelativeCovariance
from modeler.graph.optimise import joining, optimise
from modeler.types import Array, Edge

_BEAM = 4096  # hypotheses kept while loops are taken one by one: all of twelve edges with two modes
_SOLVED = 8  # hypotheses solved whole
_MARGIN = 15.0  # nats below the best at which a hypothesis is no longer worth solving
_DECIDED = 0.9999  # weight from which a mode is taken for the only one
_REFUTED = 1.5  # false loops more than the best hypothesis has, and one is dropped: two, for one may lie
_PAIRS = 16  # edges up to which the modes of two of them are changed at once


def decide(
    tree: Sequence[Factor],
    loops: Sequence[Factor],
    *,
    root: int,
    threshold: float,
    before: Mapping[Edge, Array] | None = None,
) -> dict[Edge, Array]:
    """Return the weights (m,) that the loops leave to the modes of each edge with several that lies on a loop.

    Args:
        tree: factors along which the frames hang together.
        loops: the factors beyond those.
        root: a frame of the tree.
        threshold: half the squared Mahalanobis distance at which a loop is taken to be false.
        before: weights that fewer loops left; modes settled there are not put in question.
    """
    settled = {edge: weights for edge, weights in (before or {}).items() if weights.max() >= _DECIDED}
    if not any(factor.modes and factor.edge not in settled for factor in (*tree, *loops)):
        return settled
    search = _Search.of(tree, loops, root, settled, threshold)
    best = search.best() if search.edges else None
    decided = dict(settled)
    if best is not None:
        hypotheses, scores = best
        near = scores >= scores[0] - _MARGIN
        hypotheses, scores = hypotheses[near][:_SOLVED], scores[near][:_SOLVED]
        if len(hypotheses) > 1:
            chosen = (dict(zip(search.edges, row, strict=True)) for row in hypotheses)
            scores = np.array([search.evidence(tree, loops, root, modes, settled) for modes in chosen])
        shares = np.exp(scores - scores.max())
        shares = shares / shares.sum()
        for column, edge in enumerate(search.edges):
            modes = np.arange(len(edge.posterior.modes))
            weights = (hypotheses[:, column, None] == modes).T @ shares
            top = weights == weights.max()
            decided[edge] = top.astype(np.float64) if weights.max() >= _DECIDED else weights
    return decided


@dataclass(frozen=True, eq=False)
class _Search:
    """Hypotheses against loops taken one by one."""

    edges: tuple[Edge, ...]
    """Whose mode is open, by column."""
    cycles: tuple[Cycle, ...]
    """That depend on them, those with the fewest open edges first."""
    threshold: float
    """Half the squared Mahalanobis distance at which a loop is taken to be false."""

    @classmethod
    def of(
        cls, tree: Sequence[Factor], loops: Sequence[Factor], root: int, settled: Mapping[Edge, Array], threshold: float
    ) -> _Search:
        """Return the search for the modes of all edges on loops that are not settled."""
        edges, found = cycles(tree, loops, root, settled)
        return cls(edges, tuple(sorted(found, key=lambda cycle: len(cycle.columns))), threshold)

    def best(self) -> tuple[npt.NDArray[np.int64], Array]:
        """Return hypotheses (h, edges), best first, and their scores (h,)."""
        hypotheses, scores = np.full((1, len(self.edges)), -1), np.zeros(1)
        for cycle in self.cycles:
            for column in cycle.columns:
                if hypotheses[0, column] < 0:
                    hypotheses, scores = self._grown(hypotheses, scores, column)
            scores = scores + self._closes(cycle, hypotheses)
            alive = scores >= scores.max() - _REFUTED * self.threshold
            hypotheses, scores = hypotheses[alive], scores[alive]
        hypotheses = hypotheses[np.argsort(-scores, kind="stable")[:_SOLVED]]
        while True:  # what the beam has dropped may be a change or two away
            around = np.unique(np.concatenate([hypotheses, self._neighbours(hypotheses[0])]), axis=0)
            scores = self._score(around)
            order = np.argsort(-scores, kind="stable")[: 2 * _SOLVED]
            if np.array_equal(around[order[0]], hypotheses[0]):
                return around[order], scores[order]
            hypotheses = around[order]

    def evidence(
        self,
        tree: Sequence[Factor],
        loops: Sequence[Factor],
        root: int,
        hypothesis: Mapping[Edge, np.int64],
        settled: Mapping[Edge, Array],
    ) -> float:
        """Return Laplace's log evidence of a hypothesis, but for what all hypotheses share."""
        of = {edge: int(mode) for edge, mode in hypothesis.items()}
        of |= {edge: int(np.argmax(weights)) for edge, weights in settled.items()}
        tree, loops = ([_chosen(factor, of) for factor in some] for some in (tree, loops))
        optimum = optimise(tree, loops, chain(tree, root, {}), root=root, threshold=self.threshold)
        chosen = joining(loops, optimum.inlier)
        evidence = -optimum.error - RelativeCovariance(optimum.poses, root, (*tree, *chosen)).log_determinant
        for edge, mode in hypothesis.items():
            chosen_mode = edge.posterior.modes[int(mode)]
            evidence += np.log(chosen_mode.weight) - 0.5 * np.linalg.slogdet(chosen_mode.pose.covariance)[1]
        return float(evidence)

    def _weights(self, column: int) -> Array:
        return np.log([max(mode.weight, 1e-300) for mode in self.edges[column].posterior.modes])

    def _grown(
        self, hypotheses: npt.NDArray[np.int64], scores: Array, column: int
    ) -> tuple[npt.NDArray[np.int64], Array]:
        """Return the hypotheses with every mode of one more edge, the best of them."""
        weights = self._weights(column)
        grown = np.repeat(hypotheses, len(weights), axis=0)
        grown[:, column] = np.tile(np.arange(len(weights)), len(hypotheses))
        scores = np.repeat(scores, len(weights)) + np.tile(weights, len(hypotheses))
        order = np.argsort(-scores, kind="stable")[:_BEAM]
        return grown[order], scores[order]

    def _neighbours(self, hypothesis: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the hypotheses that differ from one (edges,) in one edge, or in two where those are few."""
        single = [(column, mode) for column, edge in enumerate(self.edges) for mode in range(len(edge.posterior.modes))]
        changes = [(change,) for change in single]
        if len(self.edges) <= _PAIRS:
            changes += [(one, other) for one in single for other in single if one[0] < other[0]]
        neighbours = np.tile(hypothesis, (len(changes), 1))
        for row, change in zip(neighbours, changes, strict=True):
            for column, mode in change:
                row[column] = mode
        return neighbours

    def _score(self, hypotheses: npt.NDArray[np.int64]) -> Array:
        """Return the scores (h,) of whole hypotheses (h, edges)."""
        scores = np.zeros(len(hypotheses))
        for column in range(len(self.edges)):
            scores = scores + self._weights(column)[hypotheses[:, column]]
        return scores + np.sum([self._closes(cycle, hypotheses) for cycle in self.cycles], axis=0)

    def _closes(self, cycle: Cycle, hypotheses: npt.NDArray[np.int64]) -> Array:
        """Return how well a loop closes (h,), as a log density that is cut off where it is false."""
        error, log_volume = cycle.gap(hypotheses)
        return -np.minimum(error, self.threshold) - log_volume


def _chosen(factor: Factor, modes: Mapping[Edge, int]) -> Factor:
    """Return a factor with the mode that is named for it."""
    return Factor(factor.edge, factor.edge.posterior.modes[modes[factor.edge]].pose) if factor.edge in modes else factor
