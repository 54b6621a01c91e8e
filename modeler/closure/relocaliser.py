"""Which registration places a frame among the views, and what to register it against next where none does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.closure.consistency import Thresholds, flaw, modes, stands
from modeler.closure.consistency_model import ConsistencyModel
from modeler.closure.extrapolation import extrapolated
from modeler.closure.map_view import MapView
from modeler.types import ConfirmedBy, JoinsPrevious, NearExtrapolation, NotPlaced, Posterior, Reason, Relocalised


@dataclass(frozen=True, eq=False)
class Relocaliser:
    """Tells which of a frame's registrations places it.

    The previous view's is believed frame by frame. After lost frames, and where another view has to take its place, an
    object may be taken for another side of itself, which matches as well: such a registration is believed by itself
    only near where the motion led, and farther from there if that of another view agrees.
    """

    map_view: MapView
    """What is known so far."""
    thresholds: Thresholds
    """Of registrations."""
    consistency_model: ConsistencyModel
    """In what the graph foretells."""
    max_angle_deg: float
    """How far in degrees from where the motion led a registration is believed by itself."""
    steps: int = 1
    """How many frames lie between the previous view and this frame, this one counted."""

    def base(self, posteriors: Sequence[Posterior]) -> tuple[Posterior | None, Reason]:
        """Return the posterior that places a frame, and why.

        Args:
            posteriors: registrations of the frame, the previous view first.
        """
        if not posteriors:
            return None, NotPlaced()
        odometry = posteriors[0]
        if self._follows(odometry) and (self.steps == 1 or self._off_deg(odometry) <= self.max_angle_deg):
            return odometry, JoinsPrevious(odometry.outcome, odometry.overlap)
        standing = [posterior for posterior in posteriors if stands(posterior, self.thresholds)]
        for posterior in sorted(standing, key=lambda posterior: -posterior.overlap):
            off_deg = self._off_deg(posterior)
            # Near the end of what views can be registered across, one alone may be cut off there.
            turned_deg = float(np.degrees(se3.rotation_angle(posterior.pose.mean)))
            if max(off_deg, turned_deg) <= self.max_angle_deg:
                return posterior, _reason(posterior, odometry, NearExtrapolation(off_deg))
            if (witness := self._witness(posterior, standing)) is not None:
                return posterior, _reason(posterior, odometry, ConfirmedBy(witness.target))
        return None, NotPlaced()

    def next(self, posteriors: Sequence[Posterior]) -> int | None:
        """Return the earlier view to register a lost frame against next; None where none is left.

        A posterior that stands alone wants a witness: the view nearest to where it puts the frame. Otherwise the view
        nearest to where the motion leads comes first, then those farthest from all views tried.

        Args:
            posteriors: what was tried for the frame, the previous view first.
        """
        tried = [posterior.target for posterior in posteriors]
        left = [frame for frame in self.map_view.frames if frame not in tried]
        if not left:
            return None
        poses = self.map_view.poses(left)
        for posterior in (posterior for posterior in posteriors if stands(posterior, self.thresholds)):
            placed = self.map_view.solution.trajectory[posterior.target] @ posterior.pose.mean
            angle_deg = np.degrees(se3.rotation_angle(se3.inverse(poses) @ placed))
            if angle_deg.min() <= self.max_angle_deg:
                return left[int(np.argmin(angle_deg))]
        if len(tried) == 1:
            expected = extrapolated(self.map_view.solution, self.map_view.frames, posteriors[0].source)
            return left[int(np.argmin(se3.rotation_angle(se3.inverse(poses) @ expected)))]
        apart = [se3.rotation_angle(se3.inverse(pose) @ poses) for pose in self.map_view.poses(tried)]
        return left[int(np.argmax(np.min(apart, axis=0)))]

    def _follows(self, odometry: Posterior) -> bool:
        """Return whether the previous view's registration came to an end, and after lost frames matches like others."""
        matches = self.steps == 1 or not odometry.log_evidence < self.thresholds.least_nats
        return flaw(odometry) is None and matches

    def _witness(self, posterior: Posterior, standing: Sequence[Posterior]) -> Posterior | None:
        """Return a registration of another view that agrees with one not too far from where the motion led."""
        # A pace that changes at random from step to step goes astray with the root of their number.
        if self._off_deg(posterior) > float(np.sqrt(self.steps)) * self.max_angle_deg:
            return None
        reach = self.map_view.shortest_paths(posterior.target)
        others = (other for other in standing if other is not posterior)
        agreeing = (
            other
            for other in others
            if self.consistency_model.consistency_through(posterior, other, self.map_view, reach).consistent
        )
        return next(agreeing, None)

    def _off_deg(self, posterior: Posterior) -> float:
        """Return the angle between where a registration puts a frame and where the motion going on would have."""
        if len(self.map_view.frames) == 1:
            return 0.0
        expected = extrapolated(self.map_view.solution, self.map_view.frames, posterior.source)
        placed = self.map_view.solution.trajectory[posterior.target] @ modes(posterior)[0][1].mean
        return float(np.degrees(se3.rotation_angle(se3.inverse(expected) @ placed)))


def _reason(posterior: Posterior, odometry: Posterior, support: NearExtrapolation | ConfirmedBy) -> Reason:
    if posterior is odometry:
        return JoinsPrevious(posterior.outcome, posterior.overlap, support)
    return Relocalised(posterior.overlap, support)
