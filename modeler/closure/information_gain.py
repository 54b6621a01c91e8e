"""Expected information gain of registering a view against earlier ones (method, eq. 9.1 and 9.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import numpy as np
from scipy.special import ndtr

from modeler import se3
from modeler.closure.map_view import MapView, ShortestPaths
from modeler.types import SOME_POINTS, SOME_VIEWS, Array

_MAX_EXACT = 6  # views whose gain is computed exactly: those with the largest bounds


@dataclass(frozen=True)
class Candidate:
    """An earlier view, with the expected information gain of an edge to it."""

    frame: int
    """Number of the view."""
    angle_deg: float
    """Predicted rotation between the two."""
    overlap: float
    """Predicted fraction (0..1) of the earlier view's surface that faces the new one's camera."""
    gain_nats: float
    """Expected information gain about the motion between the two."""


@dataclass(frozen=True, eq=False)
class InformationGain:
    """Expected information of edges between one view and earlier ones."""

    map_view: MapView
    """The map so far."""
    previous: int
    """The view to which an edge joins the new one; or the new view itself, if it is in the graph already."""
    expected: Array
    """object_from_camera (4, 4) of the new view."""
    systematic: Array
    """Covariance (6, 6) of an edge's systematic error, in the camera of `previous`."""
    max_angle_deg: float
    """Largest rotation in degrees across which views are registered."""
    has_own_edge: bool = True
    """Whether an edge joins the new view to `previous`; False: it is `previous`."""
    power: float = 2.0
    """Exponent of cos θ in the information of an edge over a rotation θ. A larger one prefers small rotations, which
    have less systematic error. Halved or doubled, builds of the dragon and of cap are the same."""

    @cached_property
    def paths(self) -> ShortestPaths:
        """Shortest paths from `previous`."""
        return self.map_view.shortest_paths(self.previous)

    def probability_within(self, frames: Sequence[int], angle_deg: Array) -> Array:
        """Return the probabilities (n,) that rotations to views are within `max_angle_deg`.

        Args:
            frames: numbers of the views.
            angle_deg: (n,) predicted rotations, with the variances of the shortest paths.
        """
        variance_rad2, _ = self.paths.to(frames)
        own_rad2 = _rotation_variance(self._one_edge) if self.has_own_edge and self._one_edge is not None else 0.0
        sigma_deg = np.maximum(np.degrees(np.sqrt(variance_rad2 + own_rad2)), 1e-6)
        return np.where(np.isinf(variance_rad2), 0.0, ndtr((self.max_angle_deg - angle_deg) / sigma_deg))

    def candidates(self, frames: Sequence[int], angle_deg: Array, min_gain_nats: float) -> list[Candidate]:
        """Return the most informative of some earlier views, largest gain first.

        The shortest path bounds the covariance of the motion, so that the covariance itself is computed for only a few
        views, however long the sequence.

        Args:
            frames: numbers of earlier views.
            angle_deg: (n,) predicted rotations to the new view.
            min_gain_nats: views of less gain are left out.
        """
        one_edge = self._one_edge
        if one_edge is None:
            return []
        within_rad = np.radians(np.minimum(angle_deg, self.max_angle_deg))
        found = np.cos(0.5 * within_rad) ** 2 * self.probability_within(frames, angle_deg)  # method, eq. 9.2
        relative_information = np.cos(within_rad) ** self.power
        path_rad2, length = self.paths.to(frames)
        known_rad2 = np.where(found > 0.0, path_rad2 + length * _rotation_variance(self.systematic), 0.0)
        # A view none of whose edges determined the rotation, as of a mug with its handle hidden, will not do so now.
        least_rad2 = self.map_view.network.least_variances_rad2(frames)
        scale = np.maximum(least_rad2 / _rotation_variance(one_edge), 1.0)
        ratio = float(self.has_own_edge) + known_rad2 / (scale * _rotation_variance(one_edge))
        bound_nats = 3.0 * found * np.log1p(relative_information * ratio)
        order = np.lexsort((np.array(frames), bound_nats))[::-1]
        candidates = []
        for k in order[bound_nats[order] >= min_gain_nats][:_MAX_EXACT]:
            overlap = self._overlap(frames[k])
            covariance = self.map_view.solution.relative_covariance(frames[k], self.previous)
            covariance = covariance + float(self.has_own_edge) * one_edge + float(length[k]) * self.systematic
            ratios = overlap * relative_information[k] * np.linalg.solve(scale[k] * one_edge, covariance)
            gain_nats = 0.5 * float(found[k] * np.linalg.slogdet(np.eye(6) + ratios)[1])  # method, eq. 9.1
            if gain_nats >= min_gain_nats:
                candidates.append(Candidate(frames[k], float(angle_deg[k]), overlap, gain_nats))
        return sorted(candidates, key=lambda candidate: -candidate.gain_nats)

    @cached_property
    def _one_edge(self) -> Array | None:
        """Mean covariance (6, 6) of the newest edges; None if there are none."""
        solution = self.map_view.solution
        edges = (edge for edge in reversed(self.map_view.edges) if solution.takes_part(edge))
        recent = [solution.pose_of(edge).covariance for edge in islice(edges, SOME_VIEWS)]
        return np.asarray(np.mean(recent, axis=0) + self.systematic) if recent else None

    def _overlap(self, frame: int) -> float:
        """Return the predicted fraction of a view's surface that faces the new view's camera."""
        view = self.map_view.views[frame]
        count = len(view.points_m)
        chosen = np.linspace(0, count - 1, min(SOME_POINTS, count)).astype(int)
        camera_from_frame = se3.inverse(self.expected) @ self.map_view.solution.trajectory[frame]
        points_m = se3.transform(camera_from_frame, view.points_m[chosen])
        normals = view.normals[chosen] @ camera_from_frame[:3, :3].T
        return float(np.mean(np.sum(points_m * normals, axis=1) < 0.0))


def _rotation_variance(covariance: Array) -> float:
    return float(np.trace(covariance[:3, :3]))
