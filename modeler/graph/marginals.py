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

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
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
        """All in one go from the root."""
        spreads: dict[int, Array] = {self.root: np.zeros((6, 1))}  # L with LLᵀ the covariance, where still needed
        roots: dict[int, dict[int, Array]] = {}
        for number in range(len(self._cliques) - 1, -1, -1):  # parents before children
            clique = self._cliques[number]
            above = {} if clique.parent is None else roots[clique.parent]
            outer = np.vstack([np.zeros((0, 1)) if not above else np.zeros((0, next(iter(above.values())).shape[1]))]
                              + [above[frame] for frame in clique.outer])  # fmt: skip
            own = solve_triangular(clique.upper, np.eye(len(clique.upper)), check_finite=False)
            spread = np.block([[-own @ (clique.beside @ outer), own], [outer, np.zeros((len(outer), len(own)))]])
            if spread.shape[1] > spread.shape[0]:
                spread = np.asarray(np.linalg.qr(spread.T, mode="r"), dtype=np.float64).T
            blocks = spread.reshape(-1, 6, spread.shape[1])
            roots[number] = dict(zip((*clique.inner, *clique.outer), blocks, strict=True))
            spreads.update({frame: roots[number][frame] for frame in clique.inner if frame in self.trajectory})
        result = {}
        for frame, pose in self.trajectory.items():
            local = se3.adjoint(se3.inverse(pose)) @ spreads[frame]
            result[frame] = local @ local.T + _GAUGE_SIGMA**2 * np.eye(6)
        return result

    @cached_property
    def log_determinant(self) -> float:
        """Log determinant of U, half that of the information of all variables."""
        return float(sum(np.sum(np.log(np.abs(np.diag(clique.upper)))) for clique in self._cliques))

    def _way(self, frames: Sequence[int]) -> list[int]:
        """Return the numbers of the cliques between variables and the last one, children first."""
        numbers: set[int] = set()
        for frame in frames:
            number: int | None = self._homes[frame]
            while number is not None and number not in numbers:
                numbers.add(number)
                number = self._cliques[number].parent
        return sorted(numbers)

    @cached_property
    def _homes(self) -> dict[int, int]:
        return {frame: number for number, clique in enumerate(self._cliques) for frame in clique.inner}

    @cached_property
    def _cliques(self) -> list[_Clique]:
        """The cliques of U, children before parents."""
        if not self.links:
            return []
        factors = gtsam.GaussianFactorGraph()
        for rows in (*self._rows(), *self.others):
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
        last = len(cliques) - 1
        return [
            _Clique(c.inner, c.outer, c.upper, c.beside, None if c.parent is None else last - c.parent)
            for c in reversed(cliques)
        ]

    def _rows(self) -> Iterator[Rows]:
        """Yield the rows of each link, where it stands in the solution."""
        frames = {frame: number for number, frame in enumerate(self.trajectory)}
        poses = np.stack(list(self.trajectory.values()))
        targets, sources = (
            poses[[frames[frame] for frame in ends]]
            for ends in ([link.target for link in self.links], [link.source for link in self.links])
        )
        means = np.stack([link.pose.mean for link in self.links])
        xi = se3.log(se3.inverse(means) @ se3.inverse(targets) @ sources)
        roots = np.stack([link.root_information for link in self.links])
        blocks = roots @ inverse_right_jacobian(xi) @ se3.adjoint(se3.inverse(sources))
        for link, block in zip(self.links, blocks, strict=True):
            yield {link.target: -block, link.source: block}


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
    """Covariances (6, 6) of object_from_camera by frame number, worked out when asked."""

    trajectory: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    marginals: Callable[[], Mapping[int, Array]]
    """Answers for all."""

    def __getitem__(self, frame: int) -> Array:
        """Return the covariance of one pose."""
        return self.marginals()[frame]

    def __iter__(self) -> Iterator[int]:
        """Yield the solved frames."""
        return iter(self.trajectory)

    def __len__(self) -> int:
        """Return the number of solved frames."""
        return len(self.trajectory)
