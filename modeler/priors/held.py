"""The held prior: a robot's hand carries the object, and its poses give the motion up to slip and calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modeler import se3
from modeler.priors.checks import check_parameters
from modeler.priors.general import GeneralPrior, reach_deg, relaxed_limits, turned_offset_m
from modeler.priors.mixtures import KernelMixture, defensive_mixture
from modeler.types import AbstractPoseDensity, AbstractPrior, Array, Edge, Frame, InputError, RayImage, Solution

_STEP_DEG = 25.0  # step to which `max_offset_m` refers
_SAME_TIME_S = 1e-3  # poses and frames at most so far apart count as simultaneous


@dataclass(frozen=True)
class HeldPrior(AbstractPrior):
    """The object moves with the hand: target_from_source = hand at target · inverse of hand at source.

    Calibration errors and slip are rotations and shifts at the hand. A frame between two poses gets an interpolated
    pose, whose uncertainty grows with their distance.
    """

    times_s: Array = field(compare=False, repr=False)
    """(n,) times of the hand's poses, increasing, on the clock of the frames."""
    camera_from_hand: Array = field(compare=False, repr=False)
    """(n, 4, 4) poses of the hand in camera coordinates."""
    held_sigma_deg: float = 3.0
    """Standard deviation of slip and calibration error in the rotation of one motion, about each axis."""
    held_sigma_m: float = 0.008
    """Standard deviation of slip and calibration error in the shift of one motion, along each axis, at the hand."""
    max_gap_s: float = 1.0
    """Poses farther apart in time than this are not interpolated."""
    max_offset_m: float = 0.04
    """Largest distance between the centroids where the hand is only a proposal (returns to earlier views); it
    grows with turns beyond 30 degrees."""
    name: str = "the hand's trajectory"
    """Source of the poses, for messages."""
    newest: int | None = None
    """The last frame of a running sequence: motions to it are evidence; None: no sequence, all motions are."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_parameters(self)

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source.

        Raises:
            InputError: where the hand's pose at one of the views is unknown.
        """
        hand_at_source, error_at_source = self._hand(source.frame)
        hand_at_target, error_at_target = self._hand(target.frame)
        motion = hand_at_target @ se3.inverse(hand_at_source)
        sigma_rad, sigma_m = np.sqrt(
            np.array([np.radians(self.held_sigma_deg), self.held_sigma_m]) ** 2
            + error_at_source**2
            + error_at_target**2
        )
        moved = KernelMixture(motion[None], np.ones(1), hand_at_source[:3, 3], float(sigma_rad), float(sigma_m))
        if self.newest is None or target.index == self.newest:
            return moved
        # The hand's motion to an earlier view already counts in the edges between; here it may only propose.
        offset_m = turned_offset_m(self.max_offset_m, float(se3.rotation_angle(motion)))
        limits = GeneralPrior(reach_deg(float(np.degrees(sigma_rad))), offset_m).between(source, target)
        return defensive_mixture(replace(limits, middle=motion[:3, :3]), [moved])

    def relaxed(self, steps: float) -> HeldPrior:
        """Return the prior with limits for several steps; their motion is the hand's."""
        return replace(self, max_offset_m=relaxed_limits(_STEP_DEG, self.max_offset_m, steps)[1])

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> HeldPrior:
        """Return the prior with the number of the last frame."""
        return replace(self, newest=max(solution.trajectory, default=None))

    def _hand(self, frame: Frame) -> tuple[Array, Array]:
        """Return the hand's pose (4, 4) at a frame, and its standard deviation (2,) from interpolation: rad, m.

        Raises:
            InputError: where there are no poses near enough in time.
        """
        after = int(np.searchsorted(self.times_s, frame.time_s))
        for number in (after - 1, after):
            if 0 <= number < len(self.times_s) and abs(self.times_s[number] - frame.time_s) <= _SAME_TIME_S:
                return self.camera_from_hand[number], np.zeros(2)
        if not 0 < after < len(self.times_s):
            raise InputError(
                f"{self.name}: has no pose for frame {frame.index} at {frame.time_s:g} s, its times are "
                f"{self.times_s[0]:g} to {self.times_s[-1]:g} s; leave the frame out or complete the file"
            )
        gap_s = float(self.times_s[after] - self.times_s[after - 1])
        if gap_s > self.max_gap_s + _SAME_TIME_S:
            raise InputError(
                f"{self.name}: has no pose for frame {frame.index} at {frame.time_s:g} s, those around it are "
                f"{gap_s:g} s apart; complete the file, or allow larger gaps (max_gap_s)"
            )
        before, behind = self.camera_from_hand[after - 1], self.camera_from_hand[after]
        share = (frame.time_s - self.times_s[after - 1]) / gap_s
        way = se3.log(se3.inverse(before) @ behind)
        # At the middle, the standard deviation is a quarter of the way, for a hand with uneven speed.
        error = share * (1.0 - share) * np.array([np.linalg.norm(way[:3]), np.linalg.norm(way[3:])])
        return before @ se3.exp(share * way), error
