"""Where the poses were, and how sure, before any loop was closed: along a chain errors only add up."""

from __future__ import annotations

import numpy as np

from modeler import se3
from modeler.graph.collapse import collapse_modes
from modeler.graph.factors import ROOT_SIGMA, Factor, SpanningTree, walk
from modeler.graph.pose_graph import PoseGraph
from modeler.types import PoseGaussian


def dead_reckoning(graph: PoseGraph) -> dict[int, PoseGaussian]:
    """Return object_from_camera by frame number along the edges that first connect each frame with the root.

    These are the poses that solutions have as `odometry`. Covariances are of first order.
    """
    root = graph.root
    if root is None:
        return {}
    tree = SpanningTree.of([Factor(edge, collapse_modes(edge.posterior)) for edge in graph.accepted], root).tree
    poses = {root: PoseGaussian(np.eye(4), ROOT_SIGMA**2 * np.eye(6))}
    for frame, neighbour, factor in walk(tree, root):
        before = poses[frame]
        motion = factor.pose if factor.target == frame else factor.pose.inverse()
        covariance = se3.composed_covariance(before.covariance, motion.mean, motion.covariance)
        poses[neighbour] = PoseGaussian(before.mean @ motion.mean, covariance)
    return poses
