"""Pose graphs in the text format of g2o."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modeler.export.tum import pose_text
from modeler.types import Array, Edge, Solution

_TRANSLATION_FIRST = np.array([3, 4, 5, 0, 1, 2])


def g2o_text(edges: Sequence[Edge], solution: Solution) -> str:
    """Return the solved graph as VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines, numbers written in full.

    Vertices are object_from_camera, edges `target source target_from_source` as they took part: of an edge with several
    modes, the one that the loops chose. Information matrices are of translation first, then rotation in rad, as g2o
    orders them and GTSAM reads and writes them. (g2o itself measures rotation by the vector part of a quaternion, half
    the angle: it takes such files, GTSAM's too, for twice as vague in rotation.)

    Args:
        edges: those that take part are written: accepted, no outliers, both ends solved.
        solution: the poses.
    """
    lines = [
        f"VERTEX_SE3:QUAT {frame} {pose_text(solution.trajectory[frame])}" for frame in sorted(solution.trajectory)
    ]
    for edge in edges:
        solved = edge.target in solution.trajectory and edge.source in solution.trajectory
        if solved and solution.takes_part(edge):
            pose = solution.pose_of(edge)
            numbers = " ".join(repr(float(value)) for value in _upper_triangle(pose.covariance))
            lines.append(f"EDGE_SE3:QUAT {edge.target} {edge.source} {pose_text(pose.mean)} {numbers}")
    return "".join(f"{line}\n" for line in lines)


def _upper_triangle(covariance: Array) -> Array:
    """Return the upper triangle (21,), row by row, of the information (6, 6) that belongs to a covariance (6, 6)."""
    permuted = covariance[np.ix_(_TRANSLATION_FIRST, _TRANSLATION_FIRST)]
    whitening = np.linalg.inv(np.linalg.cholesky(permuted))
    return (whitening.T @ whitening)[np.triu_indices(6)]
