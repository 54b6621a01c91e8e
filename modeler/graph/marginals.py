"""Uncertainty of solved frames and of the motion between any two of them, from square roots of information.

Errors are written in object coordinates, δ_k with true object_from_camera(k) = exp(δ_k) object_from_camera(k), so that
a link says R J Ad(source_from_object) (δ_source − δ_target) ~ N(0, I), with RᵀR the inverse of its covariance and J the
derivative of its error's logarithm, the identity but for what is left of that error; the root has none. Householder QR
of all rows, clique by clique along a sparse ordering, leaves U with UᵀU the information of all poses (Kaess and
Dellaert, Covariance recovery from a square root information matrix, RAS 2009). Neither information nor covariance is
ever formed, subtracted or inverted as a whole, so that a direction nobody observed, metres wide beside micrometres, is
as welcome as any other. First order in the errors.
"""

from __future__ import annotations

from collections.abc import Callable, ItemsView, Iterator, Mapping, Sequence, ValuesView
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from modeler import se3
from modeler.graph.links import Link, inverse_right_jacobian
from modeler.types import Array

_GAUGE_SIGMA = 1e-9  # rad and m: a pose relative to itself, as a covariance that is still positive definite
Rows = Mapping[int, Array]  # by variable, blocks (m, 6) of whitened rows in object coordinates


@dataclass(frozen=True, eq=False)
class _Clique:
    """Some variables given some others: upper (6 f, 6 f) of the former, beside (6 f, 6 p) of the latter."""

    inner: tuple[int, ...]
    outer: tuple[int, ...]
    upper: Array
    beside: Array
    parent: int | None
    """Number of the clique that holds all of `outer`."""


@dataclass(frozen=True, eq=False)
class _Leaf:
    """A frame that hangs on another by one link alone, which tells nothing of the others. Known by identity."""

    rows: Rows
    """Of the link, where it stands in the solution."""
    frame: int
    other: int

    @cached_property
    def clique(self) -> _Clique:
        """The frame given the other one, without its place among the cliques; the other may be the root."""
        turned, upper = np.linalg.qr(self.rows[self.frame])
        return _Clique((self.frame,), (self.other,), upper, turned.T @ self.rows[self.other], None)


@dataclass(frozen=True, eq=False)
class RelativeCovariance:
    """Covariances of target_from_source between solved frames. All work is done when asked."""

    trajectory: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    root: int
    """The frame without error."""
    links: Sequence[Link]
    """All that take part."""
    others: Sequence[Rows] = ()
    """What else is known, as rows of errors in object coordinates; more variables than frames may take part."""
    before: RelativeCovariance | None = None
    """That of fewer frames, all worked out; the others are leaves."""
    leaves: tuple[_Leaf, ...] = ()
    """Frames beyond those before, each of which hangs on one that comes before it."""

    def plus(self, trajectory: Mapping[int, Array], links: Sequence[Link]) -> RelativeCovariance | None:
        """Return it with more frames; None where they do not hang on one link each, one after the other.

        Args:
            trajectory: as before, and object_from_camera (4, 4) of the new frames.
            links: those by which they hang, in order.
        """
        leaves, known = list(self.leaves), set(self.trajectory)
        for link, rows in zip(links, _rows(links, trajectory), strict=True):
            if (link.source in known) == (link.target in known):
                return None
            frame, other = (link.target, link.source) if link.source in known else (link.source, link.target)
            known.add(frame)
            leaves.append(_Leaf(rows, frame, other))
        before, links = self.before or self, (*self.links, *links)
        return RelativeCovariance(trajectory, self.root, links, self.others, before, tuple(leaves))

    def __call__(self, target: int, source: int) -> Array:
        """Return the covariance (6, 6) of ξ in `target_from_source @ exp(ξ)`.

        Raises:
            KeyError: where a frame was not solved.
        """
        source_from_object = se3.adjoint(se3.inverse(self.trajectory[source]))
        right: dict[int, Array] = {}  # columns still to be solved for, by variable
        for frame, sign in ((source, 1.0), (target, -1.0)):
            if frame != self.root:
                right[frame] = right.get(frame, np.zeros((6, 6))) + sign * source_from_object.T
        if target not in self.trajectory:
            raise KeyError(target)
        covariance = _GAUGE_SIGMA**2 * np.eye(6)
        for number in self._way(tuple(right)):
            clique = self._cliques[number]
            inner = np.vstack([right.pop(frame, np.zeros((6, 6))) for frame in clique.inner])
            solved = solve_triangular(clique.upper, inner, trans=1, check_finite=False)
            covariance = covariance + solved.T @ solved
            passed = clique.beside.T @ solved
            for place, frame in enumerate(clique.outer):
                right[frame] = right.get(frame, np.zeros((6, 6))) - passed[6 * place : 6 * place + 6]
        return 0.5 * (covariance + covariance.T)

    def marginals(self) -> Mapping[int, Array]:
        """Return covariances (6, 6) of ξ in `object_from_camera @ exp(ξ)` by frame number."""
        return self._marginals

    @cached_property
    def _marginals(self) -> dict[int, Array]:
        poses = np.stack(list(self.trajectory.values()))
        local = se3.adjoint(se3.inverse(poses)) @ np.stack([self._spreads[frame] for frame in self.trajectory])
        covariances = local @ np.swapaxes(local, 1, 2) + _GAUGE_SIGMA**2 * np.eye(6)
        return dict(zip(self.trajectory, covariances, strict=True))

    @cached_property
    def _spreads(self) -> dict[int, Array]:
        """L (6, 6) with LLᵀ the covariance of each pose in object coordinates: all in one go from the root."""
        if self.before is not None:
            found, known = dict(self.before._spreads), self.before._leaf_spreads
            for leaf in self.leaves:
                if leaf not in known:
                    known[leaf] = _lower(_spread(leaf.clique, found[leaf.other])[:6])
                found[leaf.frame] = known[leaf]
            return found
        found = {self.root: np.zeros((6, 6))}
        spreads: list[dict[int, Array]] = []  # of all variables of a clique
        for clique in self._cliques:  # parents before children
            above = {} if clique.parent is None else spreads[clique.parent]
            outer = np.vstack([above[frame] for frame in clique.outer]) if above else np.zeros((0, 0))
            spread = _lower(_spread(clique, outer))
            blocks = spread.reshape(-1, 6, spread.shape[1])
            spreads.append(dict(zip((*clique.inner, *clique.outer), blocks, strict=True)))
            found |= {frame: _lower(spreads[-1][frame]) for frame in clique.inner if frame in self.trajectory}
        return found

    @cached_property
    def _leaf_spreads(self) -> dict[_Leaf, Array]:
        """Those of leaves that hang here, as they are asked for."""
        return {}

    @cached_property
    def log_determinant(self) -> float:
        """Log determinant of U, half that of the information of all variables."""
        return float(sum(np.sum(np.log(np.abs(np.diag(clique.upper)))) for clique in self._cliques))

    def _way(self, frames: Sequence[int]) -> list[int]:
        """Return the numbers of the cliques between variables and the roots, children first."""
        numbers: set[int] = set()
        for frame in frames:
            number: int | None = self._homes[frame]
            while number is not None and number not in numbers:
                numbers.add(number)
                number = self._cliques[number].parent
        return sorted(numbers, reverse=True)

    @cached_property
    def _homes(self) -> dict[int, int]:
        if self.before is None:
            return {frame: number for number, clique in enumerate(self._cliques) for frame in clique.inner}
        first = len(self.before._cliques)
        return self.before._homes | {leaf.frame: first + number for number, leaf in enumerate(self.leaves)}

    @cached_property
    def _cliques(self) -> list[_Clique]:
        """The cliques of U, parents before children."""
        if self.before is not None:
            return self.before._cliques + [self._hung(leaf) for leaf in self.leaves]
        if not self.links:
            return []
        factors = gtsam.GaussianFactorGraph()
        for rows in (*_rows(self.links, self.trajectory), *self.others):
            factors.add(gaussian_factor({key: block for key, block in rows.items() if key != self.root}))
        tree = factors.eliminateMultifrontal(gtsam.Ordering.OrderingType.COLAMD, gtsam.EliminateQR)
        cliques: list[_Clique] = []
        waiting = [(clique, None) for clique in tree.roots()]
        for clique, parent in waiting:
            conditional = clique.conditional()
            upper, beside = np.array(conditional.R()), np.array(conditional.S())  # views of what the tree owns
            keys, size = tuple(conditional.keys()), len(upper) // 6
            waiting += [(clique[number], len(cliques)) for number in range(clique.nrChildren())]
            cliques.append(_Clique(keys[:size], keys[size:], upper, beside, parent))
        return cliques

    def _hung(self, leaf: _Leaf) -> _Clique:
        """Return the clique of a leaf in its place."""
        if leaf.other == self.root:
            return replace(leaf.clique, outer=(), beside=np.zeros((6, 0)))
        return replace(leaf.clique, parent=self._homes[leaf.other])


def _rows(links: Sequence[Link], trajectory: Mapping[int, Array]) -> Iterator[Rows]:
    """Yield the rows of each link, where it stands in a solution."""
    if not links:
        return
    targets = np.stack([trajectory[link.target] for link in links])
    sources = np.stack([trajectory[link.source] for link in links])
    means = np.stack([link.pose.mean for link in links])
    xi = se3.log(se3.inverse(means) @ se3.inverse(targets) @ sources)
    roots = np.stack([link.root_information for link in links])
    blocks = roots @ inverse_right_jacobian(xi) @ se3.adjoint(se3.inverse(sources))
    for link, block in zip(links, blocks, strict=True):
        yield {link.target: -block, link.source: block}


def _spread(clique: _Clique, outer: Array) -> Array:
    """Return L with LLᵀ the covariance of a clique's variables, from that of its outer ones."""
    own = solve_triangular(clique.upper, np.eye(len(clique.upper)), check_finite=False)
    size, (more, columns) = len(own), outer.shape
    spread = np.zeros((size + more, columns + size))
    spread[:size, :columns] = -own @ (clique.beside @ outer)
    spread[:size, columns:] = own
    spread[size:, :columns] = outer
    return spread


def _lower(spread: Array) -> Array:
    """Return L with as many columns as rows at most and the same LLᵀ."""
    if spread.shape[1] <= spread.shape[0]:
        return spread
    return np.asarray(np.linalg.qr(spread.T, mode="r"), dtype=np.float64).T


def gaussian_factor(rows: Rows, right: Array | None = None) -> gtsam.JacobianFactor:
    """Return rows of one to three variables, and their right sides (m,) or zero, as GTSAM takes them."""
    (key, block), *more = rows.items()
    right, unit = np.zeros(len(block)) if right is None else right, gtsam.noiseModel.Unit.Create(len(block))
    if not more:
        return gtsam.JacobianFactor(key, block, right, unit)
    if len(more) == 1:
        return gtsam.JacobianFactor(key, block, *more[0], right, unit)
    return gtsam.JacobianFactor(key, block, *more[0], *more[1], right, unit)


@dataclass(frozen=True, eq=False)
class PoseCovariances(Mapping[int, Array]):
    """Covariances (6, 6) of object_from_camera by frame number, worked out when asked.

    The first one that is asked for is worked out alone; whoever asks for a second one is taken to want them all.
    """

    trajectory: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    alone: Callable[[int], Array]
    """Answers for one."""
    marginals: Callable[[], Mapping[int, Array]]
    """Answers for all."""

    def __getitem__(self, frame: int) -> Array:
        """Return the covariance of one pose."""
        if frame not in self.trajectory:
            raise KeyError(frame)
        if not self._first:
            self._first[frame] = self.alone(frame)
        return self._first[frame] if frame in self._first else self.marginals()[frame]

    def __contains__(self, frame: object) -> bool:
        """Return whether a frame was solved."""
        return frame in self.trajectory

    def __iter__(self) -> Iterator[int]:
        """Yield the solved frames."""
        return iter(self.trajectory)

    def __len__(self) -> int:
        """Return the number of solved frames."""
        return len(self.trajectory)

    def items(self) -> ItemsView[int, Array]:
        """Return all, the same numbers whatever was asked before."""
        return self.marginals().items()

    def values(self) -> ValuesView[Array]:
        """Return all, the same numbers whatever was asked before."""
        return self.marginals().values()

    @cached_property
    def _first(self) -> dict[int, Array]:
        return {}
