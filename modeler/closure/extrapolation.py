"""Where motions lead: on from the nearest two frames, along the graph, and back to where the object was."""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np

from modeler import se3
from modeler.closure.map_view import MapView
from modeler.closure.paths import ShortestPaths
from modeler.types import Array, PoseGaussian, Solution


def came_back(target: int, source: int, reach: ShortestPaths, map_view: MapView, *, away_deg: float) -> bool:
    """Return whether the object turned well away from a view before another frame, or on the way between the two.

    Args:
        target: number of the view.
        source: number of the other frame.
        reach: ways from the view that it hangs on.
        map_view: what is known so far.
        away_deg: what counts as well away.
    """
    frames = np.array(map_view.frames)
    between = (frames > min(target, source)) & (frames < max(target, source))
    rotations = [map_view.all_poses[between, :3, :3], map_view.poses(reach.along(target))[:, :3, :3]]
    cosine = 0.5 * (np.tensordot(np.concatenate(rotations), map_view.solution.trajectory[target][:3, :3], 2) - 1.0)
    return bool(cosine.min(initial=1.0) <= np.cos(np.radians(away_deg)))


def composed(way: PoseGaussian, motion: PoseGaussian) -> PoseGaussian:
    """Return the motion that leads on along a way, for independent errors."""
    return PoseGaussian(way.mean @ motion.mean, se3.composed_covariance(way.covariance, motion.mean, motion.covariance))


def extrapolated(solution: Solution, frames: Sequence[int], source: int) -> Array:
    """Return object_from_camera (4, 4) of a frame if the motion between the two of `frames` nearest to it is steady.

    For a new frame these are the last two; one that was left out lies between two, or before the first.
    """
    near, *other = heapq.nsmallest(2, frames, key=lambda frame: abs(frame - source))
    if not other:
        return solution.trajectory[near]
    pace = (source - near) / (near - other[0])
    return solution.trajectory[near] @ se3.exp(pace * se3.log(solution.relative(other[0], near)))
