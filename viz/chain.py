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
    around: dict[int, list[Edge]] = {}
    for edge in sorted((edge for edge in edges if edge.accepted), key=lambda edge: edge.kind != "odometry"):
        around.setdefault(edge.target, []).append(edge)
        around.setdefault(edge.source, []).append(edge)
    found = {root: _GAUGE}
    for kind in ("odometry", "closure"):  # closures only where odometry leads no further
        waiting = list(found)
        for known in waiting:
            for edge in around.get(known, []):
                new = edge.source if edge.target == known else edge.target
                if new not in found and (edge.kind == "odometry" or kind == "closure"):
                    found[new] = _onwards(found[known], edge, from_target=edge.target == known)
                    waiting.append(new)
    return found


def _onwards(pose: PoseGaussian, edge: Edge, *, from_target: bool) -> PoseGaussian:
    """Return object_from_camera at the other end of an edge, from the pose at one end."""
    motion = edge.posterior.pose if from_target else edge.posterior.pose.inverse()
    covariance = se3.composed_covariance(pose.covariance, motion.mean, motion.covariance)
    return PoseGaussian(pose.mean @ motion.mean, covariance)
