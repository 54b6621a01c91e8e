"""Shortest paths through the pose graph: over which edges two frames hang together most surely."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph, csr_array

from modeler.types import Array, Edge, Solution


@dataclass(frozen=True)
class ShortestPath:
    """The surest way from one frame to another."""

    edges: int
    """How many edges it leads over."""
    variance_rad2: float
    """Sum of their rotations' variances: with every other way beside it, the motion is at least as sure."""
    before: int
    """The frame before the last on the way; the start itself at the start."""


@dataclass(frozen=True, eq=False)
class ShortestPaths(Mapping[int, ShortestPath]):
    """The surest ways from one frame to all that hang together with it, by their numbers."""

    places: Mapping[int, int] = field(default_factory=dict)
    """Where each frame stands in the arrays."""
    distances_rad2: Array = field(default_factory=lambda: np.zeros(0))
    """(n,) sums of variances; infinite where no way leads."""
    before: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(n,) place of the frame before the last on the way; its own at the start, and where no way leads."""

    def __getitem__(self, frame: int) -> ShortestPath:
        """Return the way to one frame."""
        place = self.places[frame]
        if np.isinf(self.distances_rad2[place]):
            raise KeyError(frame)
        before = self._frames[self.before[place]]
        return ShortestPath(int(self.lengths[place]), float(self.distances_rad2[place]), before)

    def __iter__(self) -> Iterator[int]:
        """Yield the frames to which ways lead."""
        return (frame for frame, place in self.places.items() if np.isfinite(self.distances_rad2[place]))

    def __len__(self) -> int:
        """Return to how many frames ways lead."""
        return int(np.count_nonzero(np.isfinite(self.distances_rad2)))

    @cached_property
    def lengths(self) -> npt.NDArray[np.int64]:
        """How many edges each way leads over, (n,)."""
        length, before = (self.before != np.arange(len(self.before))).astype(np.int64), self.before
        while True:  # twice as far back each time
            further = length[before]
            if not further.any():
                return length
            length, before = length + further, before[before]

    def to(self, frames: Sequence[int]) -> tuple[Array, npt.NDArray[np.int64]]:
        """Return variances (n,) in rad² of the ways to frames, infinite where none leads, and their lengths (n,)."""
        places = np.array([self.places.get(frame, -1) for frame in frames], dtype=np.int64)
        known = places >= 0
        return np.where(known, self.distances_rad2[places], np.inf), np.where(known, self.lengths[places], 0)

    def along(self, frame: int) -> list[int]:
        """Return the frames on the way from the start to one, both included; none where no way leads there."""
        if frame not in self:
            return []
        way = [self.places[frame]]
        while self.before[way[-1]] != way[-1]:
            way.append(int(self.before[way[-1]]))
        return [self._frames[place] for place in reversed(way)]

    @cached_property
    def _frames(self) -> list[int]:
        return list(self.places)


@dataclass(frozen=True, eq=False)
class PathNetwork:
    """The edges that take part, by how sure they are of the rotation between their frames."""

    places: Mapping[int, int]
    """Where each frame stands in the matrix."""
    variances_rad2: csr_array
    """(n, n), from frame to frame."""

    @classmethod
    def of(cls, edges: Sequence[Edge], solution: Solution) -> PathNetwork:
        """Return the network of edges, as they were judged, by what a solution makes of them."""
        taking_part = [edge for edge in edges if solution.takes_part(edge)]
        ends = np.array([(edge.posterior.source, edge.posterior.target) for edge in taking_part], dtype=np.int64)
        sure = np.array([solution.pose_of(edge).rotation_variance_rad2 for edge in taking_part])
        frames, places = np.unique(ends.reshape(-1, 2), return_inverse=True)
        places = places.reshape(-1, 2)
        rows, columns = np.concatenate([places, places[:, ::-1]]).T
        order = np.lexsort((np.tile(sure, 2), columns, rows))
        rows, columns, sure = rows[order], columns[order], np.tile(sure, 2)[order]
        first = np.ones(len(order), dtype=bool)  # of several edges between two frames, the surest
        first[1:] = (np.diff(rows) != 0) | (np.diff(columns) != 0)
        size = len(frames)
        matrix = csr_array((sure[first], (rows[first], columns[first])), shape=(size, size))
        return cls({frame: place for place, frame in enumerate(frames.tolist())}, matrix)

    def shortest_paths(self, start: int) -> ShortestPaths:
        """Return the surest way from a frame to every other that hangs together with it (Dijkstra 1959)."""
        if start not in self.places:
            return ShortestPaths({start: 0}, np.zeros(1), np.zeros(1, dtype=np.int64))
        place = self.places[start]
        distances, before = csgraph.dijkstra(self.variances_rad2, indices=place, return_predecessors=True)
        own = np.arange(len(before))
        return ShortestPaths(self.places, distances, np.where(before < 0, own, before).astype(np.int64))
