"""A robot's hand carries the object: its poses tell the motion, up to slip and calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modeler import se3
from modeler.priors.bumps import KernelMixture
from modeler.priors.general import GeneralPrior, relaxed_limits, turned_offset_m
from modeler.priors.proposal import defensive_mixture, reach_deg
from modeler.types import AbstractPoseDensity, AbstractPrior, Array, Edge, Frame, InputError, RayImage, Solution

_STEP_DEG = 25.0  # such as the limit of the offset is meant for
_SAME_TIME_S = 1e-3  # poses and frames that are no farther apart in time belong together


@dataclass(frozen=True)
class HeldPrior(AbstractPrior):
    """The object moves with the hand: target_from_source = hand at target · inverse of hand at source.

    What the hand's poses do not tell, its errors of calibration and the object's slip, turns about the hand. A frame
    whose time lies between two poses gets one on the way between them, the less sure the farther they are apart.
    """

    times_s: Array = field(compare=False, repr=False)
    """(n,) times of the hand's poses, growing, on the clock of the frames."""
    camera_from_hand: Array = field(compare=False, repr=False)
    """(n, 4, 4) poses of the hand in camera coordinates."""
    held_sigma_deg: float = 3.0
    """Standard deviation of slip and calibration error in the rotation of one motion, about each axis."""
    held_sigma_m: float = 0.008
    """Standard deviation of slip and calibration error in the shift of one motion, along each axis, at the hand."""
    max_gap_s: float = 1.0
    """Poses farther apart in time than this are not interpolated."""
    max_offset_m: float = 0.04
    """Largest distance between the centroids where the hand only tells where to look (returns to earlier views); for
    turns beyond 30 degrees it grows with them."""
    name: str = "the hand's trajectory"
    """What the poses were read from, for messages."""
    newest: int | None = None
    """The last frame of a sequence that is being built, from which on motions are evidence; None: no sequence."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source.

        Raises:
            InputError: where the hand's pose at one of the views is not known.
        """
        hand_at_source, unsure_of_source = self._hand(source.frame)
        hand_at_target, unsure_of_target = self._hand(target.frame)
        motion = hand_at_target @ se3.inverse(hand_at_source)
        sigma_rad, sigma_m = np.sqrt(
            np.array([np.radians(self.held_sigma_deg), self.held_sigma_m]) ** 2
            + unsure_of_source**2
            + unsure_of_target**2
        )
        moved = KernelMixture(motion[None], np.ones(1), hand_at_source[:3, 3], float(sigma_rad), float(sigma_m))
        if self.newest is None or target.index == self.newest:
            return moved
        # What the hand did up to an earlier view counts in the edges between; here it only tells where to look.
        offset_m = turned_offset_m(self.max_offset_m, float(se3.rotation_angle(motion)))
        limits = GeneralPrior(reach_deg(float(np.degrees(sigma_rad))), offset_m).between(source, target)
        return defensive_mixture(replace(limits, middle=motion[:3, :3]), [moved])

    def relaxed(self, steps: float) -> HeldPrior:
        """Return the prior with room for the offset of several steps; their motion is the hand's."""
        return replace(self, max_offset_m=relaxed_limits(_STEP_DEG, self.max_offset_m, steps)[1])

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> HeldPrior:
        """Return the prior that knows which frame came last."""
        return replace(self, newest=max(solution.trajectory, default=None))

    def _hand(self, frame: Frame) -> tuple[Array, Array]:
        """Return the hand's pose (4, 4) at a frame, and how unsure interpolation leaves it (2,): rad, m.

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
                f"{gap_s:g} s apart; complete the file, or allow for it with --max-gap-s"
            )
        before, behind = self.camera_from_hand[after - 1], self.camera_from_hand[after]
        share = (frame.time_s - self.times_s[after - 1]) / gap_s
        way = se3.log(se3.inverse(before) @ behind)
        # Halfway it may be off by a quarter of the way: a hand that waits first, or hurries.
        unsure = share * (1.0 - share) * np.array([np.linalg.norm(way[:3]), np.linalg.norm(way[3:])])
        return before @ se3.exp(share * way), unsure
