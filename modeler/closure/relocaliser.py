"""Selection of the registration that places a frame and, if none does, of the next view to try."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from modeler import se3
from modeler.closure.consistency import ConsistencyModel, LikelihoodBound, Thresholds, failure, modes
from modeler.closure.map_view import MapView
from modeler.types import ConfirmedBy, JoinsPrevious, NearExtrapolation, NotPlaced, Posterior, Reason, Relocalised


@dataclass(frozen=True, eq=False)
class Placement:
    """Which registration places a frame, if one does, and why."""

    base: Posterior | None = None
    """The registration; None: none does."""
    reason: Reason = field(default_factory=NotPlaced)
    """Why."""


@dataclass(frozen=True, eq=False)
class Relocaliser:
    """Selects which of a frame's registrations places it.

    Usually it is that of the previous view. After lost frames, or if another view has to replace it, one side of the
    object may match another: such a registration is accepted alone only near the extrapolated motion, and farther away
    if that of another view is consistent with it.
    """

    map_view: MapView
    """The map so far."""
    thresholds: Thresholds
    """Requirements on registrations."""
    evidence: LikelihoodBound
    """Bound from the run's edges."""
    consistency: ConsistencyModel
    """Test of registrations against each other."""
    max_angle_deg: float
    """Largest rotation in degrees from the extrapolated motion at which a registration is accepted alone."""
    steps: int
    """Number of frames from the previous view to this one."""

    def placement(self, posteriors: Sequence[Posterior]) -> Placement:
        """Return the posterior that places a frame, and why.

        Args:
            posteriors: registrations of the frame, the previous view first.
        """
        if not posteriors:
            return Placement()
        odometry = posteriors[0]
        if self._continues(odometry) and (self.steps == 1 or self._angle_off_deg(odometry) <= self.max_angle_deg):
            return Placement(odometry, JoinsPrevious(odometry.outcome, odometry.overlap))
        candidates = [posterior for posterior in posteriors if self.thresholds.places_alone(posterior, self.evidence)]
        for posterior in sorted(candidates, key=lambda posterior: -posterior.overlap):
            off_deg = self._angle_off_deg(posterior)
            # At the largest rotation that can be registered, the posterior may be truncated.
            rotation_deg = float(np.degrees(se3.rotation_angle(posterior.pose.mean)))
            support: NearExtrapolation | ConfirmedBy | None = NearExtrapolation(off_deg)
            if max(off_deg, rotation_deg) > self.max_angle_deg:
                support = self._confirmation(posterior, candidates)
            if support is None:
                continue
            if posterior is odometry:
                return Placement(posterior, JoinsPrevious(posterior.outcome, posterior.overlap, support))
            return Placement(posterior, Relocalised(posterior.overlap, support))
        return Placement()

    def next_target(self, posteriors: Sequence[Posterior]) -> int | None:
        """Return the earlier view to register a lost frame against next; None if none is left.

        A single acceptable posterior needs confirmation by the view nearest to its pose. Otherwise the view nearest to
        the extrapolated motion comes first, then those farthest from all views tried.

        Args:
            posteriors: registrations of the frame so far, the previous view first.
        """
        tried = [posterior.target for posterior in posteriors]
        untried = [frame for frame in self.map_view.frames if frame not in tried]
        if not untried:
            return None
        poses = self.map_view.poses(untried)
        for posterior in posteriors:
            if self.thresholds.places_alone(posterior, self.evidence):
                placed = self.map_view.solution.trajectory[posterior.target] @ posterior.pose.mean
                angle_deg = np.degrees(se3.rotation_angle(se3.inverse(poses) @ placed))
                if angle_deg.min() <= self.max_angle_deg:
                    return untried[int(np.argmin(angle_deg))]
        if len(tried) == 1:
            expected = self.map_view.extrapolated(posteriors[0].source)
            return untried[int(np.argmin(se3.rotation_angle(se3.inverse(poses) @ expected)))]
        distances = [se3.rotation_angle(se3.inverse(pose) @ poses) for pose in self.map_view.poses(tried)]
        return untried[int(np.argmax(np.min(distances, axis=0)))]

    def _continues(self, odometry: Posterior) -> bool:
        """Return whether the previous view's registration is valid and, after lost frames, has enough evidence."""
        matches = self.steps == 1 or not odometry.log_marginal_likelihood < self.evidence.min_nats
        return failure(odometry) is None and matches

    def _confirmation(self, posterior: Posterior, candidates: Sequence[Posterior]) -> ConfirmedBy | None:
        """Return a consistent registration of another view, if this one is near the extrapolated motion; else None."""
        # The error of extrapolating a random walk grows with the root of the number of steps.
        if self._angle_off_deg(posterior) > float(np.sqrt(self.steps)) * self.max_angle_deg:
            return None
        paths = self.map_view.shortest_paths(posterior.target)
        for other in candidates:
            if other is not posterior:
                if self.consistency.consistency_through(posterior, other, self.map_view, paths).consistent:
                    return ConfirmedBy(other.target)
        return None

    def _angle_off_deg(self, posterior: Posterior) -> float:
        """Return the angle between a registration's pose of the frame and the extrapolated motion's."""
        if len(self.map_view.frames) == 1:
            return 0.0
        expected = self.map_view.extrapolated(posterior.source)
        placed = self.map_view.solution.trajectory[posterior.target] @ modes(posterior)[0][1].mean
        return float(np.degrees(se3.rotation_angle(se3.inverse(expected) @ placed)))
