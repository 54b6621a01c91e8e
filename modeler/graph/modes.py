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

from modeler import se3
from modeler.graph.links import Link, chain, walk
from modeler.graph.marginals import RelativeCovariance
from modeler.graph.optimise import optimise
from modeler.types import Array, Edge

_BEAM = 4096  # hypotheses kept while loops are taken one by one: all of twelve edges with two modes
_SOLVED = 8  # hypotheses solved whole
_MARGIN = 15.0  # nats below the best at which a hypothesis is no longer worth solving
_DECIDED = 0.9999  # weight from which a mode is taken for the only one, unless a loop then contradicts it
_REFUTED = 1.5  # false loops more than the best hypothesis has, and one is dropped: two, for one may lie
_PAIRS = 16  # edges up to which the modes of two of them are changed at once


@dataclass(frozen=True, eq=False)
class _Piece:
    """A stretch of a loop: a motion with one or several modes, from one end of the stretch to the other."""

    edge: int | None
    """Column of the hypotheses that says which mode; None: there is but one."""
    means: Array
    """(m, 4, 4)."""
    covariances: Array
    """(m, 6, 6)."""

    def of(self, hypotheses: npt.NDArray[np.int64]) -> tuple[Array, Array]:
        """Return mean and covariance for each hypothesis (h, edges), or one for all (1, …)."""
        if self.edge is None:
            return self.means, self.covariances
        modes = hypotheses[:, self.edge]
        return self.means[modes], self.covariances[modes]


@dataclass(frozen=True, eq=False)
class _Loop:
    """The way along the tree from a loop's target to its source, and the loop's own motion."""

    way: tuple[_Piece, ...]
    own: _Piece

    @property
    def edges(self) -> tuple[int, ...]:
        """Columns on which the loop depends."""
        return tuple(piece.edge for piece in (*self.way, self.own) if piece.edge is not None)


def decide(
    tree: Sequence[Link],
    loops: Sequence[Link],
    *,
    root: int,
    threshold: float,
    before: Mapping[Edge, Array] | None = None,
) -> dict[Edge, Array]:
    """Return the weights (m,) that the loops leave to the modes of each edge with several that lies on a loop.

    Args:
        tree: links along which the frames hang together.
        loops: the links beyond those.
        root: a frame of the tree.
        threshold: half the squared Mahalanobis distance at which a loop is taken to be false.
        before: weights that fewer loops left; modes settled there are not put in question unless a loop contradicts
            them on whose way there are others that are not.
    """
    settled = {edge: weights for edge, weights in (before or {}).items() if weights.max() >= _DECIDED}
    if not any(link.modes and link.edge not in settled for link in (*tree, *loops)):
        return settled
    search = _Search.of(tree, loops, root, settled, threshold)
    best = search.best() if search.edges else None
    if settled and best is not None and search.contradicted(best[0][:1]):
        return decide(tree, loops, root=root, threshold=threshold)
    decided = dict(settled)
    if best is not None:
        hypotheses, scores = best
        near = scores >= scores[0] - _MARGIN
        hypotheses, scores = hypotheses[near][:_SOLVED], scores[near][:_SOLVED]
        if len(hypotheses) > 1:
            solved = [search.evidence(tree, loops, root, dict(zip(search.edges, row, strict=True)), settled)
                      for row in hypotheses]  # fmt: skip
            scores = np.array(solved)
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
    loops: tuple[_Loop, ...]
    """That depend on them, those with the fewest open edges first."""
    threshold: float
    """Half the squared Mahalanobis distance at which a loop is taken to be false."""

    @classmethod
    def of(
        cls, tree: Sequence[Link], loops: Sequence[Link], root: int, settled: Mapping[Edge, Array], threshold: float
    ) -> _Search:
        """Return the search for the modes of all edges on loops that are not settled."""
        above = {neighbour: (frame, link) for frame, neighbour, link in walk(tree, root)}
        depth = {root: 0}
        for neighbour, (frame, _) in above.items():  # outwards
            depth[neighbour] = depth[frame] + 1
        columns: dict[Edge, int] = {}
        found = []
        for loop in loops:
            ahead: list[tuple[Link, bool]] = []  # each with whether the way goes from its target to its source
            back: list[tuple[Link, bool]] = []
            target, source = loop.target, loop.source
            while target != source:
                if depth[target] >= depth[source]:
                    target, link = above[target]
                    ahead.append((link, link.source == target))
                else:
                    source, link = above[source]
                    back.append((link, link.target == source))
            way = [*ahead, *reversed(back), (loop, True)]
            if any(link.modes and link.edge not in settled for link, _ in way):
                *pieces, own = (_piece(link, settled, columns, forwards=forwards) for link, forwards in way)
                found.append(_Loop(_joined(pieces), own))
        open_loops = sorted(found, key=lambda loop: len(loop.edges))
        return cls(tuple(columns), tuple(open_loops), threshold)

    def best(self) -> tuple[npt.NDArray[np.int64], Array]:
        """Return hypotheses (h, edges), best first, and their scores (h,)."""
        hypotheses, scores = np.full((1, len(self.edges)), -1), np.zeros(1)
        for loop in self.loops:
            for column in loop.edges:
                if hypotheses[0, column] < 0:
                    hypotheses, scores = self._grown(hypotheses, scores, column)
            scores = scores + self._closes(loop, hypotheses)[0]
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

    def contradicted(self, hypothesis: npt.NDArray[np.int64]) -> bool:
        """Return whether a loop is false under a hypothesis (1, edges)."""
        return any(bool(self._closes(loop, hypothesis)[1][0]) for loop in self.loops)

    def evidence(
        self,
        tree: Sequence[Link],
        loops: Sequence[Link],
        root: int,
        hypothesis: Mapping[Edge, np.int64],
        settled: Mapping[Edge, Array],
    ) -> float:
        """Return Laplace's log evidence of a hypothesis, but for what all hypotheses share."""
        of = {edge: int(mode) for edge, mode in hypothesis.items()}
        of |= {edge: int(np.argmax(weights)) for edge, weights in settled.items()}
        tree, loops = ([_chosen(link, of) for link in some] for some in (tree, loops))
        optimum = optimise(tree, loops, chain(tree, root, {}), root=root, threshold=self.threshold)
        chosen = [loop for loop, good in zip(loops, optimum.inlier, strict=True) if good]
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
        return scores + np.sum([self._closes(loop, hypotheses)[0] for loop in self.loops], axis=0)

    def _closes(self, loop: _Loop, hypotheses: npt.NDArray[np.int64]) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return how well a loop closes (h,), as a log density that is cut off where it is false, and where it is."""
        mean, covariance = np.eye(4)[None], np.zeros((1, 6, 6))
        for piece in loop.way:
            mean, covariance = _composed((mean, covariance), piece.of(hypotheses))
        own, own_covariance = loop.own.of(hypotheses)
        spread = covariance + own_covariance
        xi = se3.log(se3.inverse(own) @ mean)
        error = 0.5 * np.sum(xi * np.linalg.solve(spread, xi[..., None])[..., 0], axis=-1)
        return -np.minimum(error, self.threshold) - 0.5 * np.linalg.slogdet(spread)[1], error > self.threshold


def _chosen(link: Link, modes: Mapping[Edge, int]) -> Link:
    """Return a link with the mode that is named for it."""
    return Link(link.edge, link.edge.posterior.modes[modes[link.edge]].pose) if link.edge in modes else link


def _piece(link: Link, settled: Mapping[Edge, Array], columns: dict[Edge, int], *, forwards: bool) -> _Piece:
    """Return a link as a stretch of a loop, along it or against it; an open edge is given a column."""
    edge, poses, column = link.edge, [link.pose], None
    if link.modes:
        if edge in settled:
            poses = [link.modes[int(np.argmax(settled[edge]))].pose]
        else:
            poses, column = [mode.pose for mode in link.modes], columns.setdefault(edge, len(columns))
    poses = poses if forwards else [pose.inverse() for pose in poses]
    return _Piece(column, np.stack([pose.mean for pose in poses]), np.stack([pose.covariance for pose in poses]))


def _joined(pieces: Sequence[_Piece]) -> tuple[_Piece, ...]:
    """Return the stretches with neighbours of one mode made one."""
    joined: list[_Piece] = []
    for piece in pieces:
        if joined and piece.edge is None and joined[-1].edge is None:
            last = joined.pop()
            piece = _Piece(None, *_composed((last.means, last.covariances), (piece.means, piece.covariances)))
        joined.append(piece)
    return tuple(joined)


def _composed(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return means (h, 4, 4) and covariances (h, 6, 6) of one motion after another, for independent errors."""
    return first[0] @ second[0], se3.composed_covariance(first[1], *second)
