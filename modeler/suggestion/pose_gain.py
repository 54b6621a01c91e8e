"""Information of further edges about the poses: covariances of frames of a graph, before and after.

Errors are those of object coordinates, δ_k with true object_from_camera(k) = exp(δ_k) object_from_camera(k): an edge
with covariance Σ measures δ_source − δ_target with the information Ω = Adᵀ Σ⁻¹ Ad, Ad that of source_from_object
(method, eq. 14.1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from modeler import se3
from modeler.types import Array, Edge, Solution


def edge_information(object_from_source: Array, covariance: Array) -> Array:
    """Return the information (6, 6) on δ_source − δ_target of an edge with the covariance of target_from_source."""
    adjoint = se3.adjoint(se3.inverse(object_from_source))
    information = adjoint.T @ np.linalg.solve(covariance, adjoint)
    return 0.5 * (information + information.T)


@dataclass(frozen=True, eq=False)
class Gain:
    """Information of the edges of one new frame about the earlier poses."""

    nats: float
    """Decrease of ½ log det of their joint covariance."""
    covariances: Mapping[int, Array]
    """(6, 6) of δ afterwards by frame number, including the new frame."""


@dataclass(frozen=True, eq=False)
class PoseGraphBelief:
    """The joint Gaussian of solved poses."""

    marginals: Mapping[int, Array]
    """(6, 6) of δ by frame number."""
    places: Mapping[int, int]
    """Place of each frame in the system of equations; the root, which has no error, is not in it."""
    factorised: SuperLU | None
    """Of their information; None if there is but one frame."""
    _columns: dict[int, Array] = field(default_factory=dict)

    @classmethod
    def of(cls, edges: Sequence[Edge], solution: Solution) -> PoseGraphBelief:
        """Return the belief of the edges that take part in a solution."""
        poses = solution.trajectory
        used = [e for e in edges if solution.takes_part(e) and e.source in poses and e.target in poses]
        root = min(poses, key=lambda frame: (float(np.trace(solution.covariances[frame])), frame))
        places = {frame: k for k, frame in enumerate(frame for frame in poses if frame != root)}
        marginals = {}
        for frame, pose in poses.items():
            adjoint = se3.adjoint(pose)
            marginals[frame] = adjoint @ solution.covariances[frame] @ adjoint.T
        if not places:
            return cls(marginals, places, None)
        blocks: dict[tuple[int, int], Array] = {}
        for edge in used:
            information = edge_information(poses[edge.source], solution.pose_of(edge).covariance)
            ends = [(places[frame], sign) for frame, sign in ((edge.source, 1.0), (edge.target, -1.0)) if frame != root]
            for row, one in ends:
                for column, other in ends:
                    blocks[row, column] = blocks.get((row, column), np.zeros((6, 6))) + one * other * information
        cells = np.arange(6)
        rows = np.concatenate([np.repeat(6 * row + cells, 6) for row, _ in blocks])
        columns = np.concatenate([np.tile(6 * column + cells, 6) for _, column in blocks])
        values = np.concatenate([block.ravel() for block in blocks.values()])
        size = 6 * len(places)
        return cls(marginals, places, splu(csc_matrix((values, (rows, columns)), shape=(size, size))))

    def covariance(self, frame: int, other: int) -> Array:
        """Return the covariance (6, 6) of δ of two frames."""
        if frame not in self.places or other not in self.places:
            return np.zeros((6, 6))
        if other not in self._columns:
            assert self.factorised is not None
            units = np.zeros((6 * len(self.places), 6))
            units[6 * self.places[other] : 6 * self.places[other] + 6] = np.eye(6)
            self._columns[other] = self.factorised.solve(units)
        row = 6 * self.places[frame]
        return self._columns[other][row : row + 6]

    def gain(self, edges: Sequence[tuple[int, Array]], new: int) -> Gain:
        """Return the information gain of edges between a new frame and others (method, eq. 14.2).

        Args:
            edges: frame and information (6, 6) of the edge between it and the new frame, see `edge_information`.
            new: number of the new frame.
        """
        targets, some = [target for target, _ in edges], np.stack([information for _, information in edges])
        joint = np.block([[self.covariance(one, other) for other in targets] for one in targets])
        joint = 0.5 * (joint + joint.T)
        total = np.linalg.inv(some.sum(axis=0))
        stacked = np.concatenate(list(some), axis=1)  # (6, 6 m)
        added = np.zeros_like(joint)
        for k, information in enumerate(some):
            added[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = information
        added = added - stacked.T @ total @ stacked
        inner = np.eye(len(joint)) + added @ joint
        after = joint @ np.linalg.inv(inner)
        reduction = np.linalg.solve(inner, added)  # of the covariances, between the targets
        covariances = {}
        for frame, marginal in self.marginals.items():
            across = np.concatenate([self.covariance(frame, target) for target in targets], axis=1)
            covariances[frame] = marginal - across @ reduction @ across.T
        carried = total @ stacked
        covariances[new] = total + carried @ after @ carried.T
        return Gain(max(0.5 * float(np.linalg.slogdet(inner)[1]), 0.0), covariances)
