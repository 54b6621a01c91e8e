"""What a closer goes by: all that is known of the frames so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modeler.closure.paths import PathNetwork, ShortestPaths
from modeler.types import Array, Edge, RayImage, Solution


@dataclass(frozen=True, eq=False)
class MapView:
    """The accepted views, their poses, and the edges that these rest on."""

    views: Mapping[int, RayImage]
    """By frame number, in order of acceptance."""
    solution: Solution
    """The poses so far."""
    edges: Sequence[Edge] = ()
    """Every edge judged so far."""

    @cached_property
    def frames(self) -> list[int]:
        """Numbers of the views that have a pose, in order of acceptance."""
        return [frame for frame in self.views if frame in self.solution.trajectory]

    @cached_property
    def all_poses(self) -> Array:
        """object_from_camera (n, 4, 4) of these."""
        return self.poses(self.frames)

    def shortest_paths(self, start: int) -> ShortestPaths:
        """Return the surest ways from a frame to all others."""
        return self._network.shortest_paths(start)

    def poses(self, frames: Sequence[int]) -> Array:
        """Return object_from_camera (n, 4, 4) of frames."""
        return np.array([self.solution.trajectory[frame] for frame in frames]).reshape(-1, 4, 4)

    @cached_property
    def _network(self) -> PathNetwork:
        return PathNetwork.of(self.edges, self.solution)
