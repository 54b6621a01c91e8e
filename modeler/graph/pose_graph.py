"""The pose graph as a value: every edge judged so far."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from modeler.types import Edge


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Every edge judged so far. A value: adding edges makes a new graph."""

    edges: tuple[Edge, ...] = ()
    """In the order in which they were judged."""
    first: int | None = None
    """Number of the first accepted frame, whose camera frame is the object frame; None: the first edge's target."""

    def plus(self, edges: Iterable[Edge]) -> PoseGraph:
        """Return the graph with more edges."""
        return PoseGraph((*self.edges, *edges), self.first)

    @property
    def accepted(self) -> tuple[Edge, ...]:
        """The edges that take part."""
        return tuple(edge for edge in self.edges if edge.accepted)

    @property
    def root(self) -> int | None:
        """Number of the frame that holds the gauge; None in an empty graph."""
        if self.first is not None:
            return self.first
        return next((edge.target for edge in self.accepted), None)
