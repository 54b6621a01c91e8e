"""The square root of the information of many variables, clique by clique, brought up to date where rows change.

Householder QR of all rows along a sparse ordering leaves U with UᵀU their information: cliques of variables, each given
some of those of the cliques above it. Rows that are new or no longer hold concern the cliques on the ways from their
variables to the roots alone (Kaess et al., iSAM2: Incremental smoothing and mapping using the Bayes tree, IJRR 2012).
Those are eliminated again, beside what the cliques below them say of their variables.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, combinations

import gtsam
import numpy as np
from scipy.linalg import get_lapack_funcs

from modeler.types import Array

Rows = Mapping[int, Array]
"""By variable, blocks (m, 6) of whitened rows."""
_DISSECTED = 8  # variables from which nested dissection orders them: ways to the roots are then short
_DEEP = 40  # cliques on a way to a root from which it is eliminated again, that it be short
_PANEL = 32  # columns that LAPACK reflects at once
(_qr,) = get_lapack_funcs(("geqrf",))


@dataclass(frozen=True, eq=False)
class Clique:
    """Some variables given some others: upper (6 f, 6 f) of the former, beside (6 f, 6 p) of the latter."""

    inner: tuple[int, ...]
    outer: tuple[int, ...]
    upper: Array
    beside: Array
    passed: Array
    """(m, 6 p), what it and all below it say of the outer ones."""
    rows: tuple[Rows, ...]
    """Those that name an inner variable and none of a clique below."""

    @property
    def said(self) -> Rows:
        """What it and all below it say of the outer variables, as rows."""
        return {frame: self.passed[:, 6 * place : 6 * place + 6] for place, frame in enumerate(self.outer)}


@dataclass(frozen=True, eq=False)
class SquareRoot:
    """A value: `plus` makes a new one, which shares with the old what stayed."""

    homes: Mapping[int, Clique] = field(default_factory=dict)
    """The clique that has a variable as an inner one."""
    rank: Mapping[int, int] = field(default_factory=dict)
    """By variable, when it is eliminated: lower ones first."""
    below: Mapping[Clique, tuple[Clique, ...]] = field(default_factory=dict)
    """The cliques that hang on each, where there are any."""

    def parent(self, clique: Clique) -> Clique | None:
        """Return the clique on which another hangs: it holds all of that one's outer variables."""
        return self.homes[min(clique.outer, key=self.rank.__getitem__)] if clique.outer else None

    def way(self, variables: Iterable[int]) -> list[Clique]:
        """Return the cliques between variables and the roots, children first."""
        found: dict[Clique, int] = {}
        for variable in variables:
            clique: Clique | None = self.homes[variable]
            while clique is not None and clique not in found:
                found[clique] = self.rank[clique.inner[-1]]
                clique = self.parent(clique)
        return sorted(found, key=found.__getitem__)

    def all(self) -> list[Clique]:
        """Return all cliques, parents before children."""
        return sorted(set(self.homes.values()), key=lambda clique: -self.rank[clique.inner[-1]])

    def plus(self, new: Sequence[Rows], gone: Sequence[Rows] = ()) -> SquareRoot:
        """Return the square root with new rows and without some others.

        Args:
            new: of variables that hang together with the others once all are in.
            gone: those that no longer hold, known by identity.
        """
        count: dict[int, int] = {}
        for variable in chain.from_iterable(new):
            count[variable] = count.get(variable, 0) + (variable not in self.homes)
        hanging = [rows for rows in new if _hangs(rows, count) and not self._deep(rows)]
        joining = [rows for rows in new if not any(rows is leaf for leaf in hanging)]
        grown = self._eliminated(joining, gone) if joining or gone else self
        while hanging:
            ready = [rows for rows in hanging if sum(variable in grown.homes for variable in rows) == len(rows) - 1]
            if not ready:
                return grown._eliminated(hanging, ())
            grown = grown._hung(ready)
            hanging = [rows for rows in hanging if not any(rows is done for done in ready)]
        return grown

    def _deep(self, rows: Rows) -> bool:
        """Return whether the ways from the variables of rows that are in to the roots are long."""
        return len(self.way(variable for variable in rows if variable in self.homes)) >= _DEEP

    def _hung(self, leaves: Sequence[Rows]) -> SquareRoot:
        """Return the square root with variables that one row each ties to one that is in."""
        homes, rank, below = dict(self.homes), dict(self.rank), dict(self.below)
        lowest = min(rank.values(), default=0)
        for number, rows in enumerate(leaves):
            (leaf,) = (variable for variable in rows if variable not in self.homes)
            (clique,) = _cliques([rows], [leaf])
            homes[leaf], rank[leaf] = clique, lowest - 1 - number
            for other in clique.outer:
                below[homes[other]] = (*below.get(homes[other], ()), clique)
        return SquareRoot(homes, rank, below)

    def _eliminated(self, new: Sequence[Rows], gone: Sequence[Rows]) -> SquareRoot:
        """Return the square root with all cliques eliminated again that rows concern."""
        left_out = {id(rows) for rows in gone}
        concerned = dict.fromkeys(chain.from_iterable((*new, *gone)))
        apart = self.way(variable for variable in concerned if variable in self.homes)
        taken = set(apart)
        hanging = [clique for parent in apart for clique in self.below.get(parent, ()) if clique not in taken]
        rows = [row for clique in apart for row in clique.rows if id(row) not in left_out]
        rows += new
        said = [clique.said for clique in hanging if len(clique.passed)]
        order = _ordering([*rows, *said])
        homes, rank, below = dict(self.homes), dict(self.rank), dict(self.below)
        for clique in apart:
            below.pop(clique, None)
        highest = max(rank.values(), default=0)
        rank.update((variable, highest + 1 + number) for number, variable in enumerate(order))
        cliques = _cliques(rows, order, said)
        homes.update((variable, clique) for clique in cliques for variable in clique.inner)
        for clique in (*hanging, *cliques):
            if clique.outer:
                parent = homes[min(clique.outer, key=rank.__getitem__)]
                below[parent] = (*below.get(parent, ()), clique)
        return SquareRoot(homes, rank, below)


def _hangs(rows: Rows, count: Mapping[int, int]) -> bool:
    """Return whether rows tie one new variable, of which no others tell, to one other at most."""
    height = len(next(iter(rows.values())))
    return height == 6 and len(rows) <= 2 and sorted(count[variable] for variable in rows) in ([1], [0, 1])


def _ordering(rows: Sequence[Rows]) -> list[int]:
    """Return the variables in an order in which to eliminate them."""
    variables = list(dict.fromkeys(chain.from_iterable(rows)))
    graph = gtsam.SymbolicFactorGraph()
    for one in variables:
        graph.push_factor(one)
    for one, other in dict.fromkeys(pair for some in rows for pair in combinations(sorted(some), 2)):
        graph.push_factor(one, other)
    dissected = len(variables) >= _DISSECTED
    order = gtsam.Ordering.MetisSymbolicFactorGraph if dissected else gtsam.Ordering.ColamdSymbolicFactorGraph
    found = order(graph)
    return [found.at(number) for number in range(found.size())]


def _cliques(rows: Sequence[Rows], order: Sequence[int], said: Sequence[Rows] = ()) -> list[Clique]:
    """Return the cliques that rows leave when variables are eliminated in an order, children before parents.

    Args:
        rows: those that are the cliques' own.
        order: the variables; others that are named are given.
        said: rows that stand for cliques below.
    """
    place = {variable: number for number, variable in enumerate(order)}
    first: list[list[Rows]] = [[] for _ in order]  # rows, by the variable that is eliminated first
    heard: list[list[Rows]] = [[] for _ in order]  # those said, likewise
    named: list[set[int]] = [set() for _ in order]  # those a variable has in common with what is eliminated later
    for lists, more in ((first, rows), (heard, said)):
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
    home = list(range(len(order)))  # of each variable, the last of its clique
    joined: set[int] = set()
    for number in reversed(range(len(order))):
        above = parent[number]
        if above is not None and above not in joined and len(named[number]) == len(named[above]) + 1:
            joined.add(above)
            home[number] = home[above]
    members: dict[int, list[int]] = {}
    for number, last in enumerate(home):
        members.setdefault(last, []).append(number)
    cliques: list[Clique] = []
    for last, numbers in sorted(members.items()):
        inner = tuple(order[number] for number in numbers)
        outer = tuple(sorted(named[last], key=lambda other: place.get(other, len(order))))
        own, below = ([some for number in numbers for some in lists[number]] for lists in (first, heard))
        clique = _clique(inner, outer, own, below)
        cliques.append(clique)
        above = parent[last]
        if above is not None and len(clique.passed):
            heard[above].append(clique.said)
    return cliques


def _clique(inner: tuple[int, ...], outer: tuple[int, ...], own: Sequence[Rows], said: Sequence[Rows]) -> Clique:
    """Return the clique that rows leave."""
    column = {variable: 6 * number for number, variable in enumerate((*inner, *outer))}
    stacked = [*own, *said]
    heights = [len(next(iter(some.values()))) for some in stacked]
    matrix = np.zeros((sum(heights), 6 * len(column)), order="F")
    row = 0
    for some, height in zip(stacked, heights, strict=True):
        for variable, block in some.items():
            matrix[row : row + height, column[variable] : column[variable] + 6] = block
        row += height
    reflected, *_ = _qr(matrix, lwork=_PANEL * matrix.shape[1], overwrite_a=1)
    upper = np.triu(reflected[: min(matrix.shape)])
    size = 6 * len(inner)
    own_part = np.asfortranarray(upper[:size, :size])  # as BLAS takes it
    return Clique(inner, outer, own_part, upper[:size, size:], upper[size:, size:], tuple(own))
