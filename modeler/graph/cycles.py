"""The ways around which loops close, for hypotheses about the modes of the edges on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.graph.factors import Factor, walk
from modeler.types import Array, Edge


@dataclass(frozen=True, eq=False)
class _Piece:
    """A stretch of a loop: a motion with one or several modes, from one end of the stretch to the other."""

    column: int | None
    """Of the hypotheses, which says which mode; None: there is but one."""
    means: Array
    """(m, 4, 4)."""
    covariances: Array
    """(m, 6, 6)."""

    def of(self, hypotheses: npt.NDArray[np.int64]) -> tuple[Array, Array]:
        """Return mean and covariance for each hypothesis (h, edges), or one for all (1, …)."""
        if self.column is None:
            return self.means, self.covariances
        modes = hypotheses[:, self.column]
        return self.means[modes], self.covariances[modes]


@dataclass(frozen=True, eq=False)
class Cycle:
    """The way along the tree from a loop's target to its source, and the loop's own motion."""

    way: tuple[_Piece, ...]
    own: _Piece

    @property
    def columns(self) -> tuple[int, ...]:
        """Of the hypotheses on which it depends."""
        return tuple(piece.column for piece in (*self.way, self.own) if piece.column is not None)

    def gap(self, hypotheses: npt.NDArray[np.int64]) -> tuple[Array, Array]:
        """Return for hypotheses (h, edges) by how much the loop does not close.

        Returns:
            Half the squared Mahalanobis distance (h,), and half the log determinant of its covariance (h,).
        """
        mean, covariance = np.eye(4)[None], np.zeros((1, 6, 6))
        for piece in self.way:
            mean, covariance = _composed((mean, covariance), piece.of(hypotheses))
        own, own_covariance = self.own.of(hypotheses)
        spread = covariance + own_covariance
        xi = se3.log(se3.inverse(own) @ mean)
        error = 0.5 * np.sum(xi * np.linalg.solve(spread, xi[..., None])[..., 0], axis=-1)
        return error, 0.5 * np.linalg.slogdet(spread)[1]


def cycles(
    tree: Sequence[Factor], loops: Sequence[Factor], root: int, settled: Mapping[Edge, Array]
) -> tuple[tuple[Edge, ...], list[Cycle]]:
    """Return the edges on loops whose mode is open, one a column of hypotheses, and the cycles that depend on them.

    Args:
        tree: factors along which the frames hang together.
        loops: the factors beyond those.
        root: a frame of the tree.
        settled: weights of the modes of edges of which the heaviest is to be taken.
    """
    above = {neighbour: (frame, factor) for frame, neighbour, factor in walk(tree, root)}
    depth = {root: 0}
    for neighbour, (frame, _) in above.items():  # outwards
        depth[neighbour] = depth[frame] + 1
    columns: dict[Edge, int] = {}
    found = []
    for loop in loops:
        ahead: list[tuple[Factor, bool]] = []  # each with whether the way goes from its target to its source
        back: list[tuple[Factor, bool]] = []
        target, source = loop.target, loop.source
        while target != source:
            if depth[target] >= depth[source]:
                target, factor = above[target]
                ahead.append((factor, factor.source == target))
            else:
                source, factor = above[source]
                back.append((factor, factor.target == source))
        way = [*ahead, *reversed(back), (loop, True)]
        if any(factor.modes and factor.edge not in settled for factor, _ in way):
            *pieces, own = (_piece(factor, settled, columns, forwards=forwards) for factor, forwards in way)
            found.append(Cycle(_joined(pieces), own))
    return tuple(columns), found


def _piece(factor: Factor, settled: Mapping[Edge, Array], columns: dict[Edge, int], *, forwards: bool) -> _Piece:
    """Return a factor as a stretch of a loop, along it or against it; an open edge is given a column."""
    edge, poses, column = factor.edge, [factor.pose], None
    if factor.modes:
        if edge in settled:
            poses = [factor.modes[int(np.argmax(settled[edge]))].pose]
        else:
            poses, column = [mode.pose for mode in factor.modes], columns.setdefault(edge, len(columns))
    poses = poses if forwards else [pose.inverse() for pose in poses]
    return _Piece(column, np.stack([pose.mean for pose in poses]), np.stack([pose.covariance for pose in poses]))


def _joined(pieces: Sequence[_Piece]) -> tuple[_Piece, ...]:
    """Return the stretches with neighbours of one mode made one."""
    joined: list[_Piece] = []
    for piece in pieces:
        if joined and piece.column is None and joined[-1].column is None:
            last = joined.pop()
            piece = _Piece(None, *_composed((last.means, last.covariances), (piece.means, piece.covariances)))
        joined.append(piece)
    return tuple(joined)


def _composed(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return means (h, 4, 4) and covariances (h, 6, 6) of one motion after another, for independent errors."""
    return first[0] @ second[0], se3.composed_covariance(first[1], *second)
