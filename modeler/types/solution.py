"""Posteriors as edges of a graph, and the poses that it leads to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

from modeler import se3
from modeler.types.arrays import Array
from modeler.types.posteriors import PoseGaussian, Posterior
from modeler.types.reasons import Reason

EdgeKind = Literal["odometry", "closure", "span"]
"""What an edge is for: to place a frame, to close a loop with a view that the object had turned away from, or to span
several steps between frames that others placed."""


@dataclass(frozen=True, eq=False)
class Edge:
    """A posterior as the graph sees it: joined, or judged and left out."""

    posterior: Posterior
    """The registration behind the edge."""
    kind: EdgeKind
    """What the edge is for."""
    accepted: bool
    """Whether the edge takes part in the optimisation."""
    reason: Reason
    """Why; `explain` words it."""

    @property
    def source(self) -> int:
        """Frame number of the source view."""
        return self.posterior.source

    @property
    def target(self) -> int:
        """Frame number of the target view."""
        return self.posterior.target


def _unsolved(target: int, source: int) -> Array:
    """Refuse: nothing was solved."""
    raise KeyError(f"no motion from frame {source} to frame {target} was solved")


@dataclass(frozen=True, eq=False)
class Solution:
    """The optimised poses."""

    trajectory: Mapping[int, Array] = field(default_factory=dict)
    """object_from_camera (4, 4) by frame number."""
    covariances: Mapping[int, Array] = field(default_factory=dict)
    """Marginal covariance (6, 6) by frame number; the first frame's is the gauge's."""
    odometry: Mapping[int, Array] = field(default_factory=dict)
    """object_from_camera (4, 4) of the pairwise chain alone, before closure."""
    outliers: tuple[Edge, ...] = ()
    """Accepted edges that the optimisation left out because all others contradict them."""
    relative_covariance: Callable[[int, int], Array] = _unsolved
    """Covariance (6, 6) of `relative(target, source)`, worked out when called."""
    edge_poses: Mapping[tuple[int, int], PoseGaussian] = field(default_factory=dict)
    """target_from_source by (source, target) of edges that took part otherwise than by the posterior's own pose."""
    mode_weights: Mapping[tuple[int, int], Array] = field(default_factory=dict)
    """Weights (m,) that all edges together leave to the modes of an edge with several, by (source, target)."""
    camera_from_axis: Array | None = None
    """(4, 4), the third direction that about which all steps turn; None where that was not asked, or does not fit."""

    def takes_part(self, edge: Edge) -> bool:
        """Return whether an edge was accepted and the optimisation did not leave it out since."""
        return edge.accepted and edge not in self._left_out

    @cached_property
    def _left_out(self) -> frozenset[Edge]:
        return frozenset(self.outliers)

    def pose_of(self, edge: Edge) -> PoseGaussian:
        """Return target_from_source of an edge as it took part: of several modes, as all edges together have it."""
        posterior = edge.posterior
        if not self.edge_poses:
            return posterior.pose
        return self.edge_poses.get((posterior.source, posterior.target), posterior.pose)

    def relative_gaussian(self, target: int, source: int) -> PoseGaussian:
        """Return target_from_source between two different solved frames, with its uncertainty."""
        return PoseGaussian(self.relative(target, source), self.relative_covariance(target, source))

    def relative(self, target: int, source: int) -> Array:
        """Return target_from_source (4, 4) between two solved frames."""
        return se3.inverse(self.trajectory[target]) @ self.trajectory[source]
