"""Covariances of solved frames and of the motion between any two, from the square root of their information.

Errors are written in object coordinates, δ_k with true object_from_camera(k) = exp(δ_k) object_from_camera(k), so that
a factor with RᵀR the inverse of its covariance implies

    R J Ad(source_from_object) (δ_source − δ_target) ~ N(0, I)                               (method.md, eq. G5)

with J the inverse right Jacobian of its residual; the root has no error. Householder QR of all rows along a sparse
ordering gives U with UᵀU their information, as a Bayes tree: cliques of variables, each conditional on a separator of
variables in the cliques above. Adding or removing rows affects only the cliques on the paths from their variables to
the roots (Kaess et al., iSAM2: Incremental smoothing and mapping using the Bayes tree, IJRR 2012); covariances are
recovered by back substitution (Kaess and Dellaert, Covariance recovery from a square root information matrix, RAS
2009). Information and covariance are never formed, subtracted or inverted as a whole, so that an unobserved direction
with a standard deviation of metres does not degrade others of micrometres. First order in the errors; factors are
relinearised if poses have moved.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, ItemsView, Iterable, Iterator, Mapping, Sequence, ValuesView
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from scipy.linalg import get_blas_funcs, get_lapack_funcs
from scipy.special import gammaincinv

from modeler import se3
from modeler.graph.pose_graph import ROOT_SIGMA, Factor, inverse_right_jacobian
from modeler.types import Array

Rows = Mapping[int, Array]
"""By variable, blocks (m, 6) of whitened rows."""
_MIN_DISSECTED = 8  # variables from which on nested dissection orders them, which keeps paths to the roots short
_MAX_DEPTH = 40  # cliques on a path to a root, beyond which it is eliminated again to shorten it
_PANEL = 32  # block size of LAPACK's QR
_MAX_MOVED = 4e-3  # rad and m of a pose from its linearisation point: 1 % of a covariance
(_qr,) = get_lapack_funcs(("geqrf",))
(_trsm,) = get_blas_funcs(("trsm",))  # LAPACK's trtrs starts threads even for the smallest system


@dataclass(frozen=True, eq=False)
class Clique:
    """The conditional of some variables given a separator: R (6 f, 6 f), upper triangular, and S (6 f, 6 p)."""

    frontals: tuple[int, ...]
    separator: tuple[int, ...]
    r: Array
    s: Array
    marginal: tuple[Array, ...]
    """By variable of the separator, blocks of m rows: the factor on it that this clique and all below leave. Upper
    triangular: block k has only its first 6 k + 6 rows. Empty if they leave none."""
    rows: tuple[Rows, ...]
    """Rows with a frontal variable and none of a clique below."""

    @property
    def separator_rows(self) -> Rows:
        """`marginal` by variable, with all rows."""
        height = max(map(len, self.marginal), default=0)
        return {
            frame: np.vstack([block, np.zeros((height - len(block), 6))])
            for frame, block in zip(self.separator, self.marginal, strict=True)
        }


@dataclass(frozen=True, eq=False)
class SquareRoot:
    """A Bayes tree of whitened rows. Immutable: `plus` returns a new one, which shares the unchanged cliques."""

    clique_of: Mapping[int, Clique] = field(default_factory=dict)
    """By variable, the clique in which it is frontal."""
    rank: Mapping[int, int] = field(default_factory=dict)
    """By variable, its position in the elimination order."""
    children: Mapping[Clique, tuple[Clique, ...]] = field(default_factory=dict)
    """Children of each clique that has any."""

    def parent(self, clique: Clique) -> Clique | None:
        """Return the parent of a clique, which contains all variables of its separator."""
        return self.clique_of[min(clique.separator, key=self.rank.__getitem__)] if clique.separator else None

    def path_to_roots(self, variables: Iterable[int]) -> list[Clique]:
        """Return the cliques between variables and the roots, children first."""
        found: dict[Clique, int] = {}
        for variable in variables:
            clique: Clique | None = self.clique_of[variable]
            while clique is not None and clique not in found:
                found[clique] = self.rank[clique.frontals[-1]]
                clique = self.parent(clique)
        return sorted(found, key=found.__getitem__)

    def cliques(self) -> list[Clique]:
        """Return all cliques, parents before children."""
        return sorted(set(self.clique_of.values()), key=lambda clique: -self.rank[clique.frontals[-1]])

    def plus(self, added: Sequence[Rows], removed: Sequence[Rows] = ()) -> SquareRoot:
        """Return the square root after adding and removing rows.

        Args:
            added: rows that connect their variables with the others.
            removed: rows to remove, compared by identity.
        """
        count: dict[int, int] = {}
        for variable in itertools.chain.from_iterable(added):
            count[variable] = count.get(variable, 0) + (variable not in self.clique_of)
        leaves = [rows for rows in added if _is_leaf(rows, count) and not self._is_deep(rows)]
        others = [rows for rows in added if not any(rows is leaf for leaf in leaves)]
        grown = self._eliminated(others, removed) if others or removed else self
        while leaves:
            ready = [rows for rows in leaves if sum(variable in grown.clique_of for variable in rows) == len(rows) - 1]
            if not ready:
                return grown._eliminated(leaves, ())
            grown = grown._with_leaves(ready)
            leaves = [rows for rows in leaves if not any(rows is done for done in ready)]
        return grown

    def _is_deep(self, rows: Rows) -> bool:
        """Return whether the paths from the existing variables of rows to the roots are long."""
        return len(self.path_to_roots(variable for variable in rows if variable in self.clique_of)) >= _MAX_DEPTH

    def _with_leaves(self, leaves: Sequence[Rows]) -> SquareRoot:
        """Return the square root with new variables, each connected by its rows to one existing variable."""
        clique_of, rank, children = dict(self.clique_of), dict(self.rank), dict(self.children)
        lowest = min(rank.values(), default=0)
        for number, rows in enumerate(leaves):
            (leaf,) = (variable for variable in rows if variable not in self.clique_of)
            (clique,) = _cliques([rows], [leaf])
            clique_of[leaf], rank[leaf] = clique, lowest - 1 - number
            for other in clique.separator:
                children[clique_of[other]] = (*children.get(clique_of[other], ()), clique)
        return SquareRoot(clique_of, rank, children)

    def _eliminated(self, added: Sequence[Rows], removed: Sequence[Rows]) -> SquareRoot:
        """Return the square root after eliminating again all cliques that rows affect."""
        left_out = {id(rows) for rows in removed}
        concerned = dict.fromkeys(itertools.chain.from_iterable((*added, *removed)))
        top = self.path_to_roots(variable for variable in concerned if variable in self.clique_of)
        in_top = set(top)
        orphans = [clique for parent in top for clique in self.children.get(parent, ()) if clique not in in_top]
        rows = [row for clique in top for row in clique.rows if id(row) not in left_out]
        rows += added
        from_below = [clique.separator_rows for clique in orphans if len(clique.marginal)]
        order = _ordering([*rows, *from_below])
        clique_of, rank, children = dict(self.clique_of), dict(self.rank), dict(self.children)
        for clique in top:
            children.pop(clique, None)
        highest = max(rank.values(), default=0)
        rank.update((variable, highest + 1 + number) for number, variable in enumerate(order))
        cliques = _cliques(rows, order, from_below)
        clique_of.update((variable, clique) for clique in cliques for variable in clique.frontals)
        for clique in (*orphans, *cliques):
            if clique.separator:
                parent = clique_of[min(clique.separator, key=rank.__getitem__)]
                children[parent] = (*children.get(parent, ()), clique)
        return SquareRoot(clique_of, rank, children)


def _is_leaf(rows: Rows, count: Mapping[int, int]) -> bool:
    """Return whether rows connect one new variable, which no other rows contain, to at most one other."""
    height = len(next(iter(rows.values())))
    return height == 6 and len(rows) <= 2 and sorted(count[variable] for variable in rows) in ([1], [0, 1])


def _ordering(rows: Sequence[Rows]) -> list[int]:
    """Return the variables in an elimination order of little fill-in."""
    variables = list(dict.fromkeys(itertools.chain.from_iterable(rows)))
    graph = gtsam.SymbolicFactorGraph()
    for one in variables:
        graph.push_factor(one)
    for one, other in dict.fromkeys(pair for some in rows for pair in itertools.combinations(sorted(some), 2)):
        graph.push_factor(one, other)
    dissected = len(variables) >= _MIN_DISSECTED
    order = gtsam.Ordering.MetisSymbolicFactorGraph if dissected else gtsam.Ordering.ColamdSymbolicFactorGraph
    found = order(graph)
    return [found.at(number) for number in range(found.size())]


def _cliques(rows: Sequence[Rows], order: Sequence[int], from_below: Sequence[Rows] = ()) -> list[Clique]:
    """Return the cliques that eliminating variables in an order gives, children before parents.

    Args:
        rows: factors.
        order: the variables to eliminate; rows may contain others, on which the cliques are conditional.
        from_below: `separator_rows` of cliques below.
    """
    place = {variable: number for number, variable in enumerate(order)}
    own_rows: list[list[Rows]] = [[] for _ in order]  # by the variable that is eliminated first
    child_rows: list[list[Rows]] = [[] for _ in order]  # those from below, likewise
    named: list[set[int]] = [set() for _ in order]  # the variables of the factor that its elimination leaves
    for lists, more in ((own_rows, rows), (child_rows, from_below)):
        for some in more:
            number = min(place.get(variable, len(order)) for variable in some)
            lists[number].append(some)
            named[number].update(some)
    parent: list[int | None] = []
    for number, variable in enumerate(order):
        named[number].discard(variable)
        above = min((place[other] for other in named[number] if other in place), default=None)
        parent.append(above)
        if above is not None:
            named[above] |= named[number]
    last_of = list(range(len(order)))  # of each variable, the last of its clique
    merged: set[int] = set()
    for number in reversed(range(len(order))):
        above = parent[number]
        if above is not None and above not in merged and len(named[number]) == len(named[above]) + 1:
            merged.add(above)
            last_of[number] = last_of[above]
    members: dict[int, list[int]] = {}
    for number, last in enumerate(last_of):
        members.setdefault(last, []).append(number)
    cliques: list[Clique] = []
    for last, numbers in sorted(members.items()):
        frontals = tuple(order[number] for number in numbers)
        separator = tuple(sorted(named[last], key=lambda other: place.get(other, len(order))))
        own, below = ([some for number in numbers for some in lists[number]] for lists in (own_rows, child_rows))
        clique = _clique(frontals, separator, own, below)
        cliques.append(clique)
        above = parent[last]
        if above is not None and len(clique.marginal):
            child_rows[above].append(clique.separator_rows)
    return cliques


def _clique(
    frontals: tuple[int, ...], separator: tuple[int, ...], own: Sequence[Rows], below: Sequence[Rows]
) -> Clique:
    """Return the clique of some rows, by QR."""
    column = {variable: 6 * number for number, variable in enumerate((*frontals, *separator))}
    stacked = [*own, *below]
    heights = [len(next(iter(some.values()))) for some in stacked]
    matrix = np.zeros((sum(heights), 6 * len(column)), order="F")
    row = 0
    for some, height in zip(stacked, heights, strict=True):
        for variable, block in some.items():
            matrix[row : row + height, column[variable] : column[variable] + 6] = block
        row += height
    reflected, *_ = _qr(matrix, lwork=_PANEL * matrix.shape[1], overwrite_a=1)
    upper = np.triu(reflected[: min(matrix.shape)])
    size = 6 * len(frontals)
    # Copies: a view would keep the whole matrix in memory.
    r = upper[:size, :size].copy(order="F")  # for BLAS
    height, ends = len(upper) - size, range(6, 6 * len(separator) + 1, 6)
    marginal = tuple(upper[size : size + end, size + end - 6 : size + end].copy() for end in ends if height > 0)
    return Clique(frontals, separator, r, upper[:size, size:].copy(order="K"), marginal, tuple(own))


@dataclass(frozen=True, eq=False)
class _Linearised:
    """Factors as rows, and the square root of their information."""

    poses: Mapping[int, Array] = field(default_factory=dict)
    """Linearisation point object_from_camera (4, 4) by frame number."""
    rows: Mapping[Factor, Rows] = field(default_factory=dict)
    square_root: SquareRoot = field(default_factory=SquareRoot)

    def at(self, factors: Sequence[Factor], trajectory: Mapping[int, Array], root: int) -> _Linearised:
        """Return the linearisation of another solution; only what has changed is computed."""
        both = [frame for frame in trajectory if frame in self.poses]
        before, after = ([poses[frame] for frame in both] for poses in (self.poses, trajectory))
        apart = np.abs(np.reshape(before, (-1, 16)) - np.reshape(after, (-1, 16))).max(axis=1, initial=0.0)
        moved = {both[k] for k in np.flatnonzero(apart > _MAX_MOVED)}
        poses = {frame: pose if frame in moved else self.poses.get(frame, pose) for frame, pose in trajectory.items()}
        present = frozenset(factors)
        kept = {
            factor: rows
            for factor, rows in self.rows.items()
            if factor in present and not (moved and (factor.target in moved or factor.source in moved))
        }
        new = [factor for factor in factors if factor not in kept]
        rows = dict(zip(new, _linearise(new, poses, root), strict=True))
        removed = [rows for factor, rows in self.rows.items() if factor not in kept]
        return _Linearised(poses, kept | rows, self.square_root.plus(list(rows.values()), removed))


@dataclass(frozen=True, eq=False)
class RelativeCovariance:
    """Covariances of target_from_source between solved frames, computed when called."""

    trajectory: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    root: int
    """The frame without error."""
    factors: Sequence[Factor]
    """All that take part."""
    extra_rows: Sequence[Rows] = ()
    """Further factors, as rows of errors in object coordinates, possibly with variables other than frames."""
    before: _Linearised = field(default_factory=_Linearised)
    """Linearised factors of an earlier solution with the same root."""

    def at(self, trajectory: Mapping[int, Array], factors: Sequence[Factor]) -> RelativeCovariance:
        """Return the covariances of another solution with the same root; only what has changed is computed."""
        before = self._linearised if "_linearised" in vars(self) and not self.extra_rows else self.before
        return RelativeCovariance(trajectory, self.root, factors, before=before)

    def __call__(self, target: int, source: int) -> Array:
        """Return the covariance (6, 6) of ξ in `target_from_source @ exp(ξ)`.

        Raises:
            KeyError: if a frame was not solved.
        """
        linearised = self._linearised
        source_from_object = se3.adjoint(se3.inverse(linearised.poses[source]))
        right: dict[int, Array] = {}  # columns still to be solved for, by variable
        for frame, sign in ((source, 1.0), (target, -1.0)):
            if frame != self.root:
                right[frame] = right.get(frame, np.zeros((6, 6))) + sign * source_from_object.T
        if target not in self.trajectory:
            raise KeyError(target)
        covariance = ROOT_SIGMA**2 * np.eye(6)
        for clique in linearised.square_root.path_to_roots(right):  # method.md, eq. G6
            frontal = np.zeros((len(clique.r), 6))
            for k, frame in enumerate(clique.frontals):
                if frame in right:
                    frontal[6 * k : 6 * k + 6] = right.pop(frame)
            solved = _trsm(1.0, clique.r, frontal, trans_a=1)
            covariance = covariance + solved.T @ solved
            update = clique.s.T @ solved
            for k, frame in enumerate(clique.separator):
                here = update[6 * k : 6 * k + 6]
                right[frame] = right[frame] - here if frame in right else -here
        return 0.5 * (covariance + covariance.T)

    def marginals(self) -> Mapping[int, Array]:
        """Return covariances (6, 6) of ξ in `object_from_camera @ exp(ξ)` by frame number."""
        return self._marginals

    @cached_property
    def _marginals(self) -> dict[int, Array]:
        poses = np.stack([self._linearised.poses[frame] for frame in self.trajectory])
        local = se3.adjoint(se3.inverse(poses)) @ np.stack([self._root_covariances[f] for f in self.trajectory])
        covariances = local @ np.swapaxes(local, 1, 2) + ROOT_SIGMA**2 * np.eye(6)
        return dict(zip(self.trajectory, covariances, strict=True))

    @cached_property
    def _root_covariances(self) -> dict[int, Array]:
        """L (6, 6) with LLᵀ the covariance of each pose in object coordinates, in one pass from the roots down."""
        found, square_root = {self.root: np.zeros((6, 6))}, self._linearised.square_root
        of_clique: dict[Clique, dict[int, Array]] = {}  # of all variables of a clique
        for clique in square_root.cliques():
            parent = square_root.parent(clique)
            above = {} if parent is None else of_clique[parent]
            separator = np.vstack([above[frame] for frame in clique.separator]) if above else np.zeros((0, 0))
            root = _square(_root_covariance(clique, separator))
            blocks = root.reshape(-1, 6, root.shape[1])
            of_clique[clique] = dict(zip((*clique.frontals, *clique.separator), blocks, strict=True))
            found |= {frame: _square(of_clique[clique][frame]) for frame in clique.frontals if frame in self.trajectory}
        return found

    @cached_property
    def log_determinant(self) -> float:
        """Log determinant of U, half that of the information of all variables."""
        cliques = self._linearised.square_root.cliques()
        return float(sum(np.sum(np.log(np.abs(np.diag(clique.r)))) for clique in cliques))

    @cached_property
    def _linearised(self) -> _Linearised:
        found = self.before.at(self.factors, self.trajectory, self.root)
        if not self.extra_rows:
            return found
        extra = [{frame: block for frame, block in rows.items() if frame != self.root} for rows in self.extra_rows]
        return _Linearised(found.poses, found.rows, SquareRoot().plus([*found.rows.values(), *extra]))


def _linearise(factors: Sequence[Factor], trajectory: Mapping[int, Array], root: int) -> Iterator[Rows]:
    """Yield the rows of each factor at a solution (method.md, eq. G5)."""
    if not factors:
        return
    targets = np.stack([trajectory[factor.target] for factor in factors])
    sources = np.stack([trajectory[factor.source] for factor in factors])
    means = np.stack([factor.pose.mean for factor in factors])
    xi = se3.log(se3.inverse(means) @ se3.inverse(targets) @ sources)
    whiten = np.stack([factor.root_information for factor in factors])
    blocks = whiten @ inverse_right_jacobian(xi) @ se3.adjoint(se3.inverse(sources))
    for factor, block in zip(factors, blocks, strict=True):
        yield {frame: rows for frame, rows in ((factor.target, -block), (factor.source, block)) if frame != root}


def _root_covariance(clique: Clique, separator: Array) -> Array:
    """Return L with LLᵀ the covariance of a clique's variables, from that of its separator."""
    own = _trsm(1.0, clique.r, np.eye(len(clique.r)))
    size, (more, columns) = len(own), separator.shape
    root = np.zeros((size + more, columns + size))
    root[:size, :columns] = -own @ (clique.s @ separator)
    root[:size, columns:] = own
    root[size:, :columns] = separator
    return root


def _square(root: Array) -> Array:
    """Return L with at most as many columns as rows and the same LLᵀ."""
    if root.shape[1] <= root.shape[0]:
        return root
    return np.asarray(np.linalg.qr(root.T, mode="r"), dtype=np.float64).T


@dataclass(frozen=True, eq=False)
class PoseCovariances(Mapping[int, Array]):
    """Covariances (6, 6) of object_from_camera by frame number, computed on access.

    The first access computes one covariance; the next one computes all.
    """

    trajectory: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    one: Callable[[int], Array]
    """Computes the covariance of one frame."""
    marginals: Callable[[], Mapping[int, Array]]
    """Computes the covariances of all frames."""

    def __getitem__(self, frame: int) -> Array:
        """Return the covariance of one pose."""
        if frame not in self.trajectory:
            raise KeyError(frame)
        if not self._first:
            self._first[frame] = self.one(frame)
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
        """Return all covariances, independent of earlier accesses."""
        return self.marginals().items()

    def values(self) -> ValuesView[Array]:
        """Return all covariances, independent of earlier accesses."""
        return self.marginals().values()

    @cached_property
    def _first(self) -> dict[int, Array]:
        return {}


def chi_square_quantile(probability: float, degrees: int) -> float:
    """Return a quantile of χ²; importing `scipy.stats` instead would take 0.4 s."""
    return 2.0 * float(gammaincinv(0.5 * degrees, probability))
