"""How many loops the edges of a graph close."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from modeler.types.solution import Edge


def loops_closed(edges: Sequence[Edge]) -> int:
    """Return how many of the closures among edges close a loop: those that nothing would fall apart without.

    A closure that alone joins a frame, or all that hangs from it, to the others is checked by nothing: where two
    views have little in common and the frame after them is placed by an early view, there is a tree and no loop.
    """
    closures = [edge.kind == "closure" for edge in edges]
    if not any(closures):
        return 0
    numbers, ends = np.unique([(edge.source, edge.target) for edge in edges], return_inverse=True)
    ends = ends.reshape(-1, 2)
    joined_without = _parts(ends[~np.array(closures)], len(numbers)) - _parts(ends, len(numbers))
    return sum(closures) - joined_without


def _parts(ends: np.ndarray, count: int) -> int:
    """Return into how many parts so many nodes fall that are joined by pairs (n, 2) of their numbers."""
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    return int(connected_components(graph, directed=False)[0])
