"""Where the poses were, and how sure, before any loop was closed: edge after edge, errors only add up."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from modeler import se3
from modeler.types import Edge, PoseGaussian

_GAUGE: Final = PoseGaussian(np.eye(4), 1e-18 * np.eye(6))  # the first pose is where it is by definition


def poses(edges: Iterable[Edge], root: int) -> dict[int, PoseGaussian]:
    """Return object_from_camera of each frame that accepted edges reach from `root`, by dead reckoning.

    Covariances are of first order. A frame is reached by odometry where there is any.
    """
    found = {root: _GAUGE}
    waiting = sorted((edge for edge in edges if edge.accepted), key=lambda edge: edge.kind != "odometry")
    while onwards := next((edge for edge in waiting if (edge.source in found) != (edge.target in found)), None):
        known, new, pose = onwards.target, onwards.source, onwards.posterior.pose
        if new in found:
            known, new, pose = new, known, pose.inverse()
        covariance = se3.composed_covariance(found[known].covariance, pose.mean, pose.covariance)
        found[new] = PoseGaussian(found[known].mean @ pose.mean, covariance)
    return found
