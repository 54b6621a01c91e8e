"""A loop is closed where a closure is more than what holds the graph together."""

import numpy as np
import pytest

from modeler.types import Edge, EdgeKind, Outcome, PoseGaussian, Posterior, Stated, loops_closed


def edge(source: int, target: int, kind: EdgeKind = "odometry") -> Edge:
    return Edge(
        Posterior(source, target, PoseGaussian(np.eye(4), np.eye(6)), Outcome.CONVERGED, 1.0), kind, True, Stated("")
    )


CHAIN = [edge(1, 0), edge(2, 1), edge(3, 2)]


@pytest.mark.parametrize(
    ("edges", "loops"),
    [
        ([], 0),
        (CHAIN, 0),
        ([*CHAIN, edge(3, 1, "span")], 0),
        ([*CHAIN, edge(3, 0, "closure")], 1),
        ([*CHAIN, edge(3, 0, "closure"), edge(2, 0, "closure")], 2),
        ([edge(1, 0), edge(3, 0, "closure"), edge(2, 3)], 0),  # nothing leads from 1 to 2
        ([edge(1, 0), edge(3, 0, "closure"), edge(2, 3), edge(2, 1, "closure")], 1),
        ([edge(1, 0), edge(3, 0, "closure"), edge(2, 3), edge(2, 1, "span")], 1),
    ],
)
def test_closures_that_hold_the_graph_together_close_no_loop(edges: list[Edge], loops: int) -> None:
    assert loops_closed(edges) == loops
    assert loops_closed(edges[::-1]) == loops
