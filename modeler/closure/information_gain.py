"""Which earlier views a new one should be registered against: those whose edge would tell most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from modeler import se3
from modeler.closure.map_view import MapView
from modeler.closure.paths import ShortestPaths
from modeler.types import Array

_ASKED = 6  # views whose motion's covariance is worked out: the most promising by a bound that costs little
_RECENT = 20  # edges judged last that tell how sure the next may be
_WITNESSES = 200  # points of a view asked whether the new view should see them


@dataclass(frozen=True)
class Candidate:
    """An earlier view, and what an edge to it would be worth."""

    frame: int
    """Number of the view."""
    angle_deg: float
    """Predicted rotation between the two."""
    overlap: float
    """Share (0..1) of the earlier view's surface that should face the new one's camera."""
    gain_nats: float
    """Information that the edge is expected to add to what is known of the motion between the two."""


@dataclass(frozen=True, eq=False)
class InformationGain:
    """What is expected of a new view's place among the earlier ones."""

    map_view: MapView
    """What is known so far."""
    previous: int
    """The view that the new one hangs on; or the new view itself, where it is in the graph already."""
    expected: Array
    """object_from_camera (4, 4) of the new view."""
    systematic: Array
    """Covariance (6, 6) of an edge's systematic error, in the camera of the view that the new one hangs on."""
    max_angle_deg: float
    """Largest rotation in degrees across which views are registered."""
    hangs: bool = True
    """Whether the new view hangs on `previous` by an edge of its own; False: it is `previous`."""
    power: float = 2.0
    """Of cos θ by which an edge over a turn θ tells less. More of them prefers small turns, which err less in ways that
    edges have in common and no loop shows."""

    @cached_property
    def reach(self) -> ShortestPaths:
        """The surest ways from the view that the new one hangs on."""
        return self.map_view.shortest_paths(self.previous)

    def within(self, frames: Sequence[int], angle_deg: Array) -> Array:
        """Return the chances (n,) that the turns to views are no larger than views are registered across.

        Args:
            frames: numbers of the views.
            angle_deg: (n,) predicted rotations to them, believed as surely as the surest ways there say.
        """
        variance_rad2, _ = self.reach.to(frames)
        one_edge_rad2 = _rotation_variance(self._one_edge) if self.hangs and self._one_edge is not None else 0.0
        sigma_deg = np.maximum(np.degrees(np.sqrt(variance_rad2 + one_edge_rad2)), 1e-6)
        return np.where(np.isinf(variance_rad2), 0.0, ndtr((self.max_angle_deg - angle_deg) / sigma_deg))

    def candidates(self, frames: Sequence[int], angle_deg: Array, least_nats: float) -> list[Candidate]:
        """Return the most promising of `frames`, whose predicted rotations to the new view are `angle_deg` (n,).

        An edge of covariance R between two frames whose motion is known with covariance P adds ½ log |1 + P R⁻¹| nats,
        if it is found. R is taken to be the mean of the newest edges', over the share of surface seen again and over a
        power of cos θ, as errors grow with the turn θ; the chance to find it to be what a sphere shows again,
        (1 + cos θ) / 2. The surest way through the graph bounds P, so that P itself is worked out for a few frames
        only, however long the sequence.

        Args:
            frames: numbers of earlier views.
            angle_deg: predicted rotation to each.
            least_nats: what tells less is left out.
        """
        one_edge = self._one_edge
        if one_edge is None:
            return []
        chance, tells = self._chance(frames, angle_deg), self._tells(angle_deg)
        way_rad2, length = self.reach.to(frames)
        known_rad2 = np.where(chance > 0.0, way_rad2 + length * _rotation_variance(self.systematic), 0.0)
        ratio = float(self.hangs) + known_rad2 / _rotation_variance(one_edge)
        bound_nats = 3.0 * chance * np.log1p(tells * ratio)
        order = np.lexsort((np.array(frames), bound_nats))[::-1]
        found = []
        for place in order[bound_nats[order] >= least_nats][:_ASKED]:
            frame = frames[place]
            overlap = self._overlap(frame)
            known = self.map_view.solution.relative_covariance(frame, self.previous)
            known = known + float(self.hangs) * one_edge + float(length[place]) * self.systematic
            more = overlap * tells[place] * np.linalg.solve(one_edge, known)
            gain_nats = 0.5 * float(chance[place] * np.linalg.slogdet(np.eye(6) + more)[1])
            if gain_nats >= least_nats:
                found.append(Candidate(frame, float(angle_deg[place]), overlap, gain_nats))
        return sorted(found, key=lambda candidate: -candidate.gain_nats)

    @cached_property
    def _one_edge(self) -> Array | None:
        """Covariance (6, 6) of an edge; None where there is none to go by."""
        edges = [edge for edge in self.map_view.edges[-_RECENT:] if self.map_view.solution.takes_part(edge)]
        recent = [self.map_view.solution.pose_of(edge).covariance for edge in edges]
        return np.asarray(np.mean(recent, axis=0) + self.systematic) if recent else None

    def _tells(self, angle_deg: Array) -> Array:
        """Return how much edges over angles (n,) tell, against one over none."""
        return np.cos(np.radians(np.minimum(angle_deg, self.max_angle_deg))) ** self.power

    def _chance(self, frames: Sequence[int], angle_deg: Array) -> Array:
        """Return the chances (n,) that edges are found."""
        shown_again = np.cos(0.5 * np.radians(np.minimum(angle_deg, self.max_angle_deg))) ** 2
        return shown_again * self.within(frames, angle_deg)

    def _overlap(self, frame: int) -> float:
        """Return the share of a view's surface that should face the new view's camera."""
        view = self.map_view.views[frame]
        chosen = np.linspace(0, len(view.points_m) - 1, min(_WITNESSES, len(view.points_m))).astype(int)
        camera_from_frame = se3.inverse(self.expected) @ self.map_view.solution.trajectory[frame]
        points_m = se3.transform(camera_from_frame, view.points_m[chosen])
        normals = view.normals[chosen] @ camera_from_frame[:3, :3].T
        return float(np.mean(np.sum(points_m * normals, axis=1) < 0.0))


def _rotation_variance(covariance: Array) -> float:
    return float(np.trace(covariance[:3, :3]))
