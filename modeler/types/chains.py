"""Motions along the chains of a forest, between any two of its frames, at a cost that hardly grows with their length.

Each frame keeps the motion over 2^k edges towards its root (Bender and Farach-Colton, The level ancestor problem
simplified, 2004), so that a chain of n edges is composed of log n motions, and many chains at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.types.base import Array
from modeler.types.posteriors import PoseGaussian

_Numbers = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Chains:
    """A forest of frames, and the motions along it."""

    index: Mapping[int, int]
    """Of each frame in the arrays."""
    root: _Numbers
    """(n,) index of the root of its tree."""
    depth: _Numbers
    """(n,) number of edges to the root."""
    above: _Numbers
    """(levels, n) index of the frame 2^k edges nearer to the root; the root where there are fewer."""
    means: Array
    """(levels, n, 4, 4) motion from each frame to that one."""
    covariances: Array
    """(levels, n, 6, 6) of these."""

    @classmethod
    def of(cls, motions: Sequence[tuple[int, int, PoseGaussian]]) -> Chains:
        """Return the forest of (target, source, target_from_source); of edges that make a cycle some are left out."""
        neighbours: dict[int, list[tuple[int, PoseGaussian]]] = {}
        for target, source, pose in motions:
            neighbours.setdefault(target, []).append((source, pose))
            neighbours.setdefault(source, []).append((target, pose.inverse()))
        index: dict[int, int] = {}
        roots, depths, parents, poses = [], [], [], []
        for first in neighbours:
            waiting = [(first, len(index), PoseGaussian(np.eye(4), np.zeros((6, 6))))]
            for frame, parent, pose in waiting:
                if frame in index:
                    continue
                number = index[frame] = len(index)
                roots.append(number if parent == number else roots[parent])
                depths.append(0 if parent == number else depths[parent] + 1)
                parents.append(parent)
                poses.append(pose)
                waiting += [(other, number, motion) for other, motion in neighbours[frame] if other not in index]
        above = [np.array(parents, dtype=np.int64)]
        means = [np.array([pose.mean for pose in poses]).reshape(-1, 4, 4)]
        covariances = [np.array([pose.covariance for pose in poses]).reshape(-1, 6, 6)]
        for _ in range(max(depths, default=0).bit_length()):
            up, mean, covariance = above[-1], means[-1], covariances[-1]
            above.append(up[up])
            means.append(mean[up] @ mean)
            covariances.append(se3.composed_covariance(covariance[up], mean, covariance))
        return cls(index, np.array(roots), np.array(depths), np.array(above), np.array(means), np.array(covariances))

    def joined(self, target: int, source: int) -> bool:
        """Return whether a chain connects two frames."""
        both = self.index.get(target), self.index.get(source)
        return None not in both and self.root[both[0]] == self.root[both[1]]

    def motions(self, pairs: Sequence[tuple[int, int]]) -> tuple[list[PoseGaussian], _Numbers]:
        """Return target_from_source along the chain of each pair (target, source) that is joined, and their lengths."""
        ends = np.array([[self.index[frame] for frame in pair] for pair in pairs], dtype=np.int64).reshape(-1, 2).T
        heights = self.depth[ends] - self._common_depth(*ends)
        (target, target_covariance), (source, source_covariance) = map(self._lifted, ends, heights)
        means = se3.inverse(target) @ source
        covariances = se3.composed_covariance(
            se3.inverse_covariance(target, target_covariance), source, source_covariance
        )
        return [PoseGaussian(*motion) for motion in zip(means, covariances, strict=True)], heights.sum(axis=0)

    def _common_depth(self, one: _Numbers, other: _Numbers) -> _Numbers:
        """Return the depth (m,) of the deepest frame above or at both of two (m,)."""
        level = np.minimum(self.depth[one], self.depth[other])
        one, other = (self._ancestors(some, self.depth[some] - level) for some in (one, other))
        depth = np.where(one == other, level, 0)
        for up in self.above[::-1]:
            apart = up[one] != up[other]
            one, other = np.where(apart, up[one], one), np.where(apart, up[other], other)
        return np.where(one == other, depth, self.depth[one] - 1)

    def _ancestors(self, frames: _Numbers, heights: _Numbers) -> _Numbers:
        """Return the indices (m,) of the frames that lie the given number of edges (m,) above others (m,)."""
        for level, up in enumerate(self.above):
            frames = np.where(heights >> level & 1, up[frames], frames)
        return frames

    def _lifted(self, frames: _Numbers, heights: _Numbers) -> tuple[Array, Array]:
        """Return mean (m, 4, 4) and covariance (m, 6, 6) of the motion to the frame a number of edges (m,) above."""
        mean, covariance = np.tile(np.eye(4), (len(frames), 1, 1)), np.zeros((len(frames), 6, 6))
        for level, up in enumerate(self.above):
            some = np.flatnonzero(heights >> level & 1)
            at = frames[some]
            covariance[some] = se3.composed_covariance(self.covariances[level, at], mean[some], covariance[some])
            mean[some] = self.means[level, at] @ mean[some]
            frames = np.where(heights >> level & 1, up[frames], frames)
        return mean, covariance
