"""How sure the poses were before any loop was closed: edge after edge, errors only add up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from modeler import se3
from modeler.types import Array, Edge, Step

_GAUGE: Final = 1e-18 * np.eye(6)  # the first pose is where it is by definition


def covariances(step: Step) -> dict[int, Array]:
    """Return the covariance (6, 6) of each pose of the pairwise chain, by frame number, of first order.

    A frame is reached along accepted edges from the first, by odometry where there is any.
    """
    chain = step.solution.odometry
    if not chain:
        return {}
    found = {next(iter(chain)): _GAUGE}  # the chain is walked outwards from its root
    waiting = sorted((edge for edge in step.edges_so_far if edge.accepted), key=lambda edge: edge.kind != "odometry")
    while reaching := next((edge for edge in waiting if (edge.source in found) != (edge.target in found)), None):
        frame, covariance = _onwards(reaching, found)
        found[frame] = covariance
    return {frame: covariance for frame, covariance in found.items() if frame in chain}


def _onwards(edge: Edge, found: Mapping[int, Array]) -> tuple[int, Array]:
    """Return the frame that an edge leads to from a frame already found, and the covariance of its pose."""
    pose = edge.posterior.pose if edge.target in found else edge.posterior.pose.inverse()
    start, end = (edge.target, edge.source) if edge.target in found else (edge.source, edge.target)
    return end, se3.composed_covariance(found[start], pose.mean, pose.covariance)
