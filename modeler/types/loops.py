"""How the edges of a graph hang together, and how many loops they close."""

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
    without = [edge for edge, closure in zip(edges, closures, strict=True) if not closure]
    return sum(closures) - (_parts(without, edges) - _parts(edges, edges))


def joined_without(edge: Edge, edges: Sequence[Edge]) -> bool:
    """Return whether the ends of one of some edges hang together by the others."""
    return _parts([other for other in edges if other is not edge], edges) == _parts(edges, edges)


def _parts(edges: Sequence[Edge], everything: Sequence[Edge]) -> int:
    """Return into how many parts the frames of all edges fall that are joined by some of them."""
    frames = np.unique([(edge.source, edge.target) for edge in everything])
    ends = np.searchsorted(frames, np.reshape([(edge.source, edge.target) for edge in edges], (-1, 2)))
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(frames), len(frames)))
    return int(connected_components(graph, directed=False)[0])
