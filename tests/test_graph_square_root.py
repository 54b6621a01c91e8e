"""Square roots of information: whatever came, went and hung on, the squares are those of the rows that are left."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from modeler.graph.covariance import Rows, SquareRoot
from modeler.types import Array


def _row(rng: np.random.Generator, *variables: int) -> Rows:
    return {variable: rng.normal(size=(6, 6)) for variable in variables}


def _information(rows: Sequence[Rows]) -> Array:
    """All rows, dense, squared."""
    variables = sorted({variable for some in rows for variable in some})
    dense = [np.hstack([some.get(variable, np.zeros((6, 6))) for variable in variables]) for some in rows]
    stacked = np.vstack(dense)
    return stacked.T @ stacked


def _square(root: SquareRoot) -> Array:
    variables, cliques = sorted(root.clique_of), root.cliques()
    size = 6 * len(variables)
    total = np.zeros((size, size))
    for clique in cliques:
        columns = np.concatenate([6 * variables.index(v) + np.arange(6) for v in (*clique.frontals, *clique.separator)])
        block = np.hstack([clique.r, clique.s])
        total[np.ix_(columns, columns)] += block.T @ block
    return total


def _assert_hangs_together(root: SquareRoot) -> None:
    """Ways lead from every clique to a root, and parents hold what hangs on them."""
    for clique in root.cliques():
        parent = root.parent(clique)
        if parent is not None:
            assert set(clique.separator) <= {*parent.frontals, *parent.separator}
            assert clique in root.children[parent]
            assert root.rank[clique.frontals[-1]] < root.rank[parent.frontals[-1]]
    assert sum(len(below) for below in root.children.values()) == sum(
        bool(clique.separator) for clique in root.cliques()
    )
    np.testing.assert_array_equal(sorted(v for c in root.cliques() for v in c.frontals), sorted(root.clique_of))


@pytest.mark.parametrize("seed", range(6))
def test_it_is_the_square_root_of_the_rows_that_are_left(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root, tree, loops = SquareRoot(), [_row(rng, 0)], []
    root = root.plus(tree)
    for step in range(1, 30):
        added = [_row(rng, step, int(rng.integers(max(0, step - 3), step)))]
        if rng.random() < 0.3:
            added.append(_row(rng, *rng.choice(step, size=min(step, 2), replace=False).tolist()))
        gone = [loops.pop(int(rng.integers(len(loops))))] if loops and rng.random() < 0.2 else []
        before, square = root, _square(root)
        root = root.plus(added, gone)
        tree, loops = [*tree, added[0]], [*loops, *added[1:]]
        np.testing.assert_allclose(_square(root), _information([*tree, *loops]), atol=1e-9)
        np.testing.assert_array_equal(_square(before), square)  # a value
        _assert_hangs_together(root)
    assert len(root.cliques()) > 5


def test_what_hangs_on_one_row_leaves_all_else_alone() -> None:
    rng = np.random.default_rng(0)
    trunk = SquareRoot().plus([_row(rng, 0), *(_row(rng, k, k + 1) for k in range(20)), _row(rng, 0, 20)])
    grown = trunk.plus([_row(rng, 21, 20), _row(rng, 31)]).plus([_row(rng, 30, 21)])
    assert set(trunk.cliques()) < set(grown.cliques())
    assert len(grown.cliques()) == len(trunk.cliques()) + 3
    _assert_hangs_together(grown)


def test_a_row_concerns_the_cliques_above_its_variables_alone() -> None:
    rng = np.random.default_rng(1)
    chain = [_row(rng, 0), *(_row(rng, k, k + 1) for k in range(300))]
    root = SquareRoot().plus(chain)
    grown = root.plus([_row(rng, 150, 300)])
    assert set(root.cliques()) - set(grown.cliques()) == set(root.path_to_roots([150, 300]))
    assert len(root.path_to_roots([150, 300])) < 30


def test_ways_stay_short_however_long_a_chain_grows() -> None:
    rng = np.random.default_rng(2)
    root, rows = SquareRoot(), [_row(rng, 0), *(_row(rng, k, k + 1) for k in range(400))]
    for row in rows:
        root = root.plus([row])
        assert len(root.path_to_roots([max(root.clique_of)])) <= 41
    _assert_hangs_together(root)
    np.testing.assert_allclose(_square(root), _information(rows), atol=1e-9)
