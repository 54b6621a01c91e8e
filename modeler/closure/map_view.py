"""The map as the closer uses it: poses, edges, shortest paths between frames, and extrapolation."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph, csr_array

from modeler import se3
from modeler.types import Array, Edge, PoseGaussian, RayImage, Solution


@dataclass(frozen=True, eq=False)
class MapView:
    """The accepted views, their poses, and the edges that constrain these."""

    views: Mapping[int, RayImage]
    """By frame number, in order of acceptance."""
    solution: Solution
    """The poses so far."""
    edges: Sequence[Edge] = ()
    """All edges so far, accepted or rejected."""
    keyframes: Sequence[int] | None = None
    """Views to which closures and spans may lead; None: all."""
    before: PathNetwork = field(default_factory=lambda: PathNetwork())
    """The network of earlier edges, if known."""

    @cached_property
    def targets(self) -> list[int]:
        """Numbers of the keyframes that have a pose, in order of acceptance."""
        return self.frames if self.keyframes is None else [k for k in self.keyframes if k in self.solution.trajectory]

    @cached_property
    def frames(self) -> list[int]:
        """Numbers of the views that have a pose, in order of acceptance."""
        return [frame for frame in self.views if frame in self.solution.trajectory]

    @cached_property
    def all_poses(self) -> Array:
        """object_from_camera (n, 4, 4) of these."""
        return self.poses(self.frames)

    def poses(self, frames: Sequence[int]) -> Array:
        """Return object_from_camera (n, 4, 4) of frames."""
        return np.array([self.solution.trajectory[frame] for frame in frames]).reshape(-1, 4, 4)

    def shortest_paths(self, start: int) -> ShortestPaths:
        """Return the paths of least rotation variance from a frame to all others."""
        return self.network.shortest_paths(start)

    def nearest_in_time(self, frame: int) -> list[int]:
        """Return the numbers of the two views nearest in time to a frame, nearest first, or of one if there is one."""
        return heapq.nsmallest(2, self.frames, key=lambda view: abs(view - frame))

    def extrapolated(self, frame: int) -> Array:
        """Return object_from_camera (4, 4) of a frame, extrapolated from the two views nearest in time (eq. 9.9).

        For a new frame these are the last two; a lost frame lies between two, or before the first.
        """
        near, *other = self.nearest_in_time(frame)
        if not other:
            return self.solution.trajectory[near]
        pace = (frame - near) / (near - other[0])  # method, eq. 9.9
        return self.solution.trajectory[near] @ se3.exp(pace * se3.log(self.solution.relative(other[0], near)))

    def came_back(self, target: int, source: int, paths: ShortestPaths, *, away_deg: float) -> bool:
        """Return whether the object turned away from a view before another frame, or on the path between the two.

        Args:
            target: number of the view.
            source: number of the other frame.
            paths: from the view against which the other frame is registered.
            away_deg: rotation from which on it has turned away.
        """
        frames = np.array(self.frames)
        between = (frames > min(target, source)) & (frames < max(target, source))
        rotations = [self.all_poses[between, :3, :3], self.poses(paths.along(target))[:, :3, :3]]
        cosine = 0.5 * (np.tensordot(np.concatenate(rotations), self.solution.trajectory[target][:3, :3], 2) - 1.0)
        return bool(cosine.min(initial=1.0) <= np.cos(np.radians(away_deg)))  # method, eq. 9.8

    @cached_property
    def network(self) -> PathNetwork:
        """The network of shortest paths."""
        return self.before.plus(self.edges, self.solution)


def composed(first: PoseGaussian, then: PoseGaussian) -> PoseGaussian:
    """Return the motion `first`, then `then`, for independent errors: mean `then.mean @ first.mean`."""
    covariance = se3.composed_covariance(then.covariance, first.mean, first.covariance)
    by_focal = first.by_focal + se3.adjoint(se3.inverse(first.mean)) @ then.by_focal
    return PoseGaussian(then.mean @ first.mean, covariance, by_focal)


@dataclass(frozen=True)
class ShortestPath:
    """The path of least rotation variance from one frame to another."""

    edges: int
    """Number of edges."""
    variance_rad2: float
    """Sum of their rotation variances: an upper bound of the motion's."""
    before: int
    """The last frame but one on the path; the start itself at the start."""


@dataclass(frozen=True, eq=False)
class ShortestPaths(Mapping[int, ShortestPath]):
    """The paths of least rotation variance from one frame to all connected ones, by frame number."""

    index: Mapping[int, int] = field(default_factory=dict)
    """Index of each frame in the arrays."""
    distances_rad2: Array = field(default_factory=lambda: np.zeros(0))
    """(n,) sums of variances; infinite without a path."""
    before: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(n,) index of the last frame but one on the path; its own at the start, and without a path."""

    def __getitem__(self, frame: int) -> ShortestPath:
        """Return the path to one frame."""
        index = self.index[frame]
        if np.isinf(self.distances_rad2[index]):
            raise KeyError(frame)
        before = self._frames[self.before[index]]
        return ShortestPath(int(self.lengths[index]), float(self.distances_rad2[index]), before)

    def __iter__(self) -> Iterator[int]:
        """Yield the connected frames."""
        return (frame for frame, index in self.index.items() if np.isfinite(self.distances_rad2[index]))

    def __len__(self) -> int:
        """Return the number of connected frames."""
        return int(np.count_nonzero(np.isfinite(self.distances_rad2)))

    @cached_property
    def lengths(self) -> npt.NDArray[np.int64]:
        """Number of edges of each path, (n,)."""
        length, before = (self.before != np.arange(len(self.before))).astype(np.int64), self.before
        while True:  # pointer doubling
            further = length[before]
            if not further.any():
                return length
            length, before = length + further, before[before]

    def to(self, frames: Sequence[int]) -> tuple[Array, npt.NDArray[np.int64]]:
        """Return variances (n,) in rad² of the paths to frames, infinite without one, and their lengths (n,)."""
        indices = np.array([self.index.get(frame, -1) for frame in frames], dtype=np.int64)
        known = indices >= 0
        return np.where(known, self.distances_rad2[indices], np.inf), np.where(known, self.lengths[indices], 0)

    def along(self, frame: int) -> list[int]:
        """Return the frames on the path from the start to one, both included; none without a path."""
        if frame not in self:
            return []
        path = [self.index[frame]]
        while self.before[path[-1]] != path[-1]:
            path.append(int(self.before[path[-1]]))
        return [self._frames[index] for index in reversed(path)]

    @cached_property
    def _frames(self) -> list[int]:
        return list(self.index)


@dataclass(frozen=True, eq=False)
class PathNetwork:
    """The edges that take part, weighted by their rotation variance. Immutable: `plus` returns a new one."""

    edges: Sequence[Edge] = ()
    """All edges, whether they take part or not."""
    solution: Solution = field(default_factory=Solution)
    """Determines which take part, and with which poses."""
    ends: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    """(m, 2) source and target of those that do."""
    edge_variances_rad2: Array = field(default_factory=lambda: np.zeros(0))
    """(m,) their rotation variances."""

    @classmethod
    def of(cls, edges: Sequence[Edge], solution: Solution) -> PathNetwork:
        """Return the network of edges, with their poses in a solution."""
        return cls().plus(edges, solution)

    def plus(self, edges: Sequence[Edge], solution: Solution) -> PathNetwork:
        """Return the network of other edges; only what differs is computed."""
        known, old = len(self.edges), self.solution
        same = tuple(edges[:known]) == tuple(self.edges) and solution.outliers == old.outliers
        if known and not (same and old.edge_poses.items() <= solution.edge_poses.items()):
            return PathNetwork().plus(edges, solution)
        new = [edge for edge in edges[known:] if solution.takes_part(edge)]
        ends = np.array([(edge.source, edge.target) for edge in new], dtype=np.int64).reshape(-1, 2)
        variances = np.array([solution.pose_of(edge).rotation_variance_rad2 for edge in new], dtype=np.float64)
        both = np.concatenate([self.ends, ends]), np.concatenate([self.edge_variances_rad2, variances])
        return PathNetwork(edges, solution, *both)

    @cached_property
    def index(self) -> Mapping[int, int]:
        """Index of each frame in the matrix."""
        return {frame: index for index, frame in enumerate(self._indexed[0].tolist())}

    @cached_property
    def variances_rad2(self) -> csr_array:
        """(n, n) from frame to frame, sparse."""
        size, indices = len(self._indexed[0]), self._indexed[1]
        rows, columns = np.concatenate([indices, indices[:, ::-1]]).T
        variances = np.tile(self.edge_variances_rad2, 2)
        order = np.lexsort((variances, columns, rows))
        rows, columns, variances = rows[order], columns[order], variances[order]
        first = np.ones(len(order), dtype=bool)  # of several edges between two frames, that of least variance
        first[1:] = (np.diff(rows) != 0) | (np.diff(columns) != 0)
        return csr_array((variances[first], (rows[first], columns[first])), shape=(size, size))

    @cached_property
    def _indexed(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        frames, indices = np.unique(self.ends, return_inverse=True)
        return frames, indices.reshape(-1, 2)

    def least_variances_rad2(self, frames: Sequence[int]) -> Array:
        """Return the least rotation variance (n,) of the edges of each frame; infinite without an edge."""
        return self._least_rad2[[self.index.get(frame, -1) for frame in frames]]

    @cached_property
    def _least_rad2(self) -> Array:
        """(n + 1,) by index of the frame; the last, infinite, is for frames without an edge."""
        least = np.full(len(self._indexed[0]) + 1, np.inf)
        np.minimum.at(least, self._indexed[1], self.edge_variances_rad2[:, None])
        return least

    def shortest_paths(self, start: int) -> ShortestPaths:
        """Return the shortest paths from a frame to all connected ones (Dijkstra 1959)."""
        if start not in self.index:
            return ShortestPaths({start: 0}, np.zeros(1), np.zeros(1, dtype=np.int64))
        index = self.index[start]
        distances, before = csgraph.dijkstra(self.variances_rad2, indices=index, return_predecessors=True)
        own = np.arange(len(before))
        return ShortestPaths(self.index, distances, np.where(before < 0, own, before).astype(np.int64))
