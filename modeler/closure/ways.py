"""Ways through the pose graph: over which edges two frames hang together most surely."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from modeler.types import Edge, Solution


@dataclass(frozen=True)
class Way:
    """The surest way from one frame to another."""

    edges: int
    """How many edges it leads over."""
    variance_rad2: float
    """Sum of their rotations' variances: with every other way beside it, the motion is at least as sure."""
    before: int
    """The frame before the last on the way; the start itself at the start."""


def ways(edges: Iterable[Edge], solution: Solution, start: int) -> Mapping[int, Way]:
    """Return the surest way from a frame to every other that hangs together with it (Dijkstra 1959).

    Args:
        edges: as they were judged; those that take part lead on.
        solution: the poses so far.
        start: number of the frame.
    """
    neighbours: dict[int, list[tuple[int, float]]] = {}
    for edge in edges:
        if solution.takes_part(edge):
            covariance = solution.pose_of(edge).covariance
            variance_rad2 = float(covariance[0, 0] + covariance[1, 1] + covariance[2, 2])
            neighbours.setdefault(edge.source, []).append((edge.target, variance_rad2))
            neighbours.setdefault(edge.target, []).append((edge.source, variance_rad2))
    found: dict[int, Way] = {}
    waiting = [(0.0, 0, start, start)]
    while waiting:
        variance_rad2, count, frame, before = heapq.heappop(waiting)
        if frame in found:
            continue
        found[frame] = Way(count, variance_rad2, before)
        for neighbour, step_rad2 in neighbours.get(frame, []):
            if neighbour not in found:
                heapq.heappush(waiting, (variance_rad2 + step_rad2, count + 1, neighbour, frame))
    return found


def along(found: Mapping[int, Way], frame: int) -> list[int]:
    """Return the frames on the way from the start to one of those found, both included; none where it is not."""
    if frame not in found:
        return []
    way = [frame]
    while found[way[-1]].before != way[-1]:
        way.append(found[way[-1]].before)
    return way[::-1]
