"""Uncertainty of solved frames and of the motion between any two of them, from square roots of information.

Errors are written in object coordinates, δ_k with true object_from_camera(k) = exp(δ_k) object_from_camera(k), so that
a factor says R J Ad(source_from_object) (δ_source − δ_target) ~ N(0, I), with RᵀR the inverse of its covariance and J
the derivative of its error's logarithm, the identity but for what is left of that error; the root has none. The square
root U of the information of all poses is all that is ever worked out (Kaess and Dellaert, Covariance recovery from a
square root information matrix, RAS 2009). Neither information nor covariance is ever formed, subtracted or inverted as
a whole, so that a direction nobody observed, metres wide beside micrometres, is as welcome as any other. First order in
the errors; factors are taken where the frames were some steps ago as long as that is near enough.
"""

from __future__ import annotations

from collections.abc import Callable, ItemsView, Iterator, Mapping, Sequence, ValuesView
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import get_blas_funcs

from modeler import se3
from modeler.graph.factors import ROOT_SIGMA, Factor, inverse_right_jacobian
from modeler.graph.square_root import Clique, Rows, SquareRoot
from modeler.types import Array

_NEAR = 4e-3  # rad and m by which a pose may be off the place where its factors were taken: a hundredth of a covariance
(_solved,) = get_blas_funcs(("trsm",))  # LAPACK's trtrs, and all that rests on it, wakes threads for the least system


@dataclass(frozen=True, eq=False)
class _Taken:
    """Factors as rows, and what all of them say."""

    poses: Mapping[int, Array] = field(default_factory=dict)
    """object_from_camera (4, 4) of each frame, where they were taken."""
    rows: Mapping[Factor, Rows] = field(default_factory=dict)
    root: SquareRoot = field(default_factory=SquareRoot)
    """Of the information of all poses."""

    def to(self, factors: Sequence[Factor], trajectory: Mapping[int, Array], root: int) -> _Taken:
        """Return those of a solution, which costs the less the more of it stayed."""
        both = [frame for frame in trajectory if frame in self.poses]
        before, after = ([poses[frame] for frame in both] for poses in (self.poses, trajectory))
        far = np.abs(np.reshape(before, (-1, 16)) - np.reshape(after, (-1, 16))).max(axis=1, initial=0.0) > _NEAR
        moved = {both[place] for place in np.flatnonzero(far)}
        poses = {frame: pose if frame in moved else self.poses.get(frame, pose) for frame, pose in trajectory.items()}
        present = frozenset(factors)
        kept = {
            factor: rows
            for factor, rows in self.rows.items()
            if factor in present and not (moved and (factor.target in moved or factor.source in moved))
        }
        new = [factor for factor in factors if factor not in kept]
        rows = dict(zip(new, _rows(new, poses, root), strict=True))
        gone = [rows for factor, rows in self.rows.items() if factor not in kept]
        return _Taken(poses, kept | rows, self.root.plus(list(rows.values()), gone))


@dataclass(frozen=True, eq=False)
class RelativeCovariance:
    """Covariances of target_from_source between solved frames. All work is done when asked."""

    trajectory: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    root: int
    """The frame without error."""
    factors: Sequence[Factor]
    """All that take part."""
    others: Sequence[Rows] = ()
    """What else is known, as rows of errors in object coordinates; more variables than frames may take part."""
    before: _Taken = field(default_factory=_Taken)
    """The factors of an earlier solution with the same root, as far as these were asked for."""

    def to(self, trajectory: Mapping[int, Array], factors: Sequence[Factor]) -> RelativeCovariance:
        """Return that of a solution with the same root, which costs the less the more of it stayed."""
        before = self._taken if "_taken" in vars(self) and not self.others else self.before
        return RelativeCovariance(trajectory, self.root, factors, before=before)

    def __call__(self, target: int, source: int) -> Array:
        """Return the covariance (6, 6) of ξ in `target_from_source @ exp(ξ)`.

        Raises:
            KeyError: where a frame was not solved.
        """
        taken = self._taken
        source_from_object = se3.adjoint(se3.inverse(taken.poses[source]))
        right: dict[int, Array] = {}  # columns still to be solved for, by variable
        for frame, sign in ((source, 1.0), (target, -1.0)):
            if frame != self.root:
                right[frame] = right.get(frame, np.zeros((6, 6))) + sign * source_from_object.T
        if target not in self.trajectory:
            raise KeyError(target)
        covariance = ROOT_SIGMA**2 * np.eye(6)
        for clique in taken.root.way(right):
            inner = np.zeros((len(clique.upper), 6))
            for place, frame in enumerate(clique.inner):
                if frame in right:
                    inner[6 * place : 6 * place + 6] = right.pop(frame)
            solved = _solved(1.0, clique.upper, inner, trans_a=1)
            covariance = covariance + solved.T @ solved
            passed = clique.beside.T @ solved
            for place, frame in enumerate(clique.outer):
                here = passed[6 * place : 6 * place + 6]
                right[frame] = right[frame] - here if frame in right else -here
        return 0.5 * (covariance + covariance.T)

    def marginals(self) -> Mapping[int, Array]:
        """Return covariances (6, 6) of ξ in `object_from_camera @ exp(ξ)` by frame number."""
        return self._marginals

    @cached_property
    def _marginals(self) -> dict[int, Array]:
        poses = np.stack([self._taken.poses[frame] for frame in self.trajectory])
        local = se3.adjoint(se3.inverse(poses)) @ np.stack([self._spreads[frame] for frame in self.trajectory])
        covariances = local @ np.swapaxes(local, 1, 2) + ROOT_SIGMA**2 * np.eye(6)
        return dict(zip(self.trajectory, covariances, strict=True))

    @cached_property
    def _spreads(self) -> dict[int, Array]:
        """L (6, 6) with LLᵀ the covariance of each pose in object coordinates: all in one go from the root."""
        found, square_root = {self.root: np.zeros((6, 6))}, self._taken.root
        spreads: dict[Clique, dict[int, Array]] = {}  # of all variables of a clique
        for clique in square_root.all():
            parent = square_root.parent(clique)
            above = {} if parent is None else spreads[parent]
            outer = np.vstack([above[frame] for frame in clique.outer]) if above else np.zeros((0, 0))
            spread = _lower(_spread(clique, outer))
            blocks = spread.reshape(-1, 6, spread.shape[1])
            spreads[clique] = dict(zip((*clique.inner, *clique.outer), blocks, strict=True))
            found |= {frame: _lower(spreads[clique][frame]) for frame in clique.inner if frame in self.trajectory}
        return found

    @cached_property
    def log_determinant(self) -> float:
        """Log determinant of U, half that of the information of all variables."""
        return float(sum(np.sum(np.log(np.abs(np.diag(clique.upper)))) for clique in self._taken.root.all()))

    @cached_property
    def _taken(self) -> _Taken:
        taken = self.before.to(self.factors, self.trajectory, self.root)
        if not self.others:
            return taken
        others = [{frame: block for frame, block in rows.items() if frame != self.root} for rows in self.others]
        return _Taken(taken.poses, taken.rows, SquareRoot().plus([*taken.rows.values(), *others]))


def _rows(factors: Sequence[Factor], trajectory: Mapping[int, Array], root: int) -> Iterator[Rows]:
    """Yield the rows of each factor, where it stands in a solution."""
    if not factors:
        return
    targets = np.stack([trajectory[factor.target] for factor in factors])
    sources = np.stack([trajectory[factor.source] for factor in factors])
    means = np.stack([factor.pose.mean for factor in factors])
    xi = se3.log(se3.inverse(means) @ se3.inverse(targets) @ sources)
    roots = np.stack([factor.root_information for factor in factors])
    blocks = roots @ inverse_right_jacobian(xi) @ se3.adjoint(se3.inverse(sources))
    for factor, block in zip(factors, blocks, strict=True):
        yield {frame: rows for frame, rows in ((factor.target, -block), (factor.source, block)) if frame != root}


def _spread(clique: Clique, outer: Array) -> Array:
    """Return L with LLᵀ the covariance of a clique's variables, from that of its outer ones."""
    own = _solved(1.0, clique.upper, np.eye(len(clique.upper)))
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
