"""How far poses err on their own, as fusion needs to know it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from modeler.types import Array, Edge, Solution


def own_covariances(solution: Solution, edges: Iterable[Edge]) -> Mapping[int, Array]:
    """Return by frame number the covariance (6, 6) of each pose, were the poses it is joined to exact.

    Views that see the same surface are neighbours. What they err by together, drift since the first frame, does not
    tell which of them is right; what each errs by on its own does.

    Args:
        solution: the poses.
        edges: as they were judged; those that take part tell.
    """
    information: dict[int, Array] = {}
    for edge in edges:
        if not solution.takes_part(edge):
            continue
        pose = solution.pose_of(edge)
        ends = ((edge.source, pose.covariance), (edge.target, pose.inverse().covariance))
        for frame, covariance in ends:
            if frame in solution.trajectory:
                information[frame] = information.get(frame, np.zeros((6, 6))) + np.linalg.inv(covariance)
    return {frame: np.linalg.inv(told).astype(np.float64) for frame, told in information.items()}
