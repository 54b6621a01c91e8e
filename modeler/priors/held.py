"""The held prior: a robot's hand carries the object, and its poses determine the motion unless it regrasps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modeler import se3
from modeler.priors.general import GeneralPrior, offset_limit_m, reach_deg, turned_offset_m
from modeler.priors.mixtures import Alternatives, KernelMixture, defensive_mixture
from modeler.types import AbstractPoseDensity, AbstractPrior, Edge, HandPoses, RayImage, Solution, checked
from modeler.types.base import ParameterError, check_parameters

_REGRASPED_SHARE = 0.5  # of the samples: either may be true, and the search must cover both


@checked
@dataclass(frozen=True)
class HeldPrior(AbstractPrior):
    """The object moves with the hand: target_from_source = hand at target · inverse of hand at source.

    Calibration errors and slip are rotations and shifts at the hand. A frame between two poses gets an interpolated
    pose, whose uncertainty grows with their distance.

    Between two frames the hand may have regrasped the object. Then its motion is uninformative, and the prior is
    `regrasped`; the images decide (method, eq. 3.5).
    """

    hand: HandPoses
    """Poses of the hand by time."""
    held_sigma_deg: float = 3.0  # halved or doubled, log densities at the truth change by 0.4 nats
    """Standard deviation of slip and calibration error in the rotation of one motion, about each axis."""
    held_sigma_m: float = 0.008  # halved or doubled, log densities at the truth change by 0.9 nats
    """Standard deviation of slip and calibration error in the shift of one motion, along each axis, at the hand."""
    regrasp_probability: float = 0.02  # halved or doubled, log densities at the truth change by 0.02 nats
    """Probability that the hand regrasps the object from one frame to the next."""
    regrasped: AbstractPrior = field(default_factory=lambda: GeneralPrior(limits_assumed=True))
    """Prior of the object's motion in a regrasp; evidence."""
    steps: float = GeneralPrior.steps
    """Number of steps of a motion."""
    max_offset_m: float | None = None
    """Largest distance between the centroids if the hand is only a proposal (returns to earlier views); it grows with
    turns beyond 30 degrees. None: 0.75 of the object's size."""
    previous: int | None = None
    """The frame relative to which a new one is placed: motions from it are evidence, others are not; None: all are."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_parameters(self)
        check_parameters(self.hand)
        if self.regrasp_probability >= 1.0:
            raise ParameterError("regrasp_probability", self.regrasp_probability, "a probability below 1")

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        hand_at_source, error_at_source = self.hand.at(source.frame)
        hand_at_target, error_at_target = self.hand.at(target.frame)
        motion = hand_at_target @ se3.inverse(hand_at_source)
        sigma_rad, sigma_m = np.sqrt(
            np.array([np.radians(self.held_sigma_deg), self.held_sigma_m]) ** 2
            + error_at_source**2
            + error_at_target**2
        )
        moved = KernelMixture(motion[None], np.ones(1), hand_at_source[:3, 3], float(sigma_rad), float(sigma_m))
        if self.previous is None or target.index == self.previous:
            regrasped = self.regrasped.between(source, target)
            probability = 1.0 - (1.0 - self.regrasp_probability) ** self.steps
            known = Alternatives((moved, regrasped), np.array([1.0 - probability, probability]))  # method, eq. 3.5
            return defensive_mixture(known, [regrasped], _REGRASPED_SHARE)
        # The hand's motion to an earlier view is already part of the edges in between; here it is only a proposal,
        # within limits about it or, after a regrasp, about zero motion; weights by volume make the density uniform.
        offset_m = offset_limit_m(self.max_offset_m, self.steps, source, target)
        offset_m = turned_offset_m(offset_m, float(se3.rotation_angle(motion)))
        limits = GeneralPrior(reach_deg(float(np.degrees(sigma_rad))), offset_m).between(source, target)
        within = (replace(limits, middle=motion[:3, :3]), self.regrasped.between(source, target))
        volumes = np.exp([-float(part.log_density(part.sample(1, np.random.default_rng(0)))[0]) for part in within])
        return defensive_mixture(Alternatives(within, volumes / volumes.sum()), [moved])

    def relaxed(self, steps: float) -> HeldPrior:
        """Return the prior with limits for several steps; their motion is the hand's unless it regrasps."""
        return replace(self, regrasped=self.regrasped.relaxed(steps), steps=steps * self.steps)

    def unlimited(self) -> HeldPrior | None:
        regrasped = self.regrasped.unlimited()
        return None if regrasped is None else replace(self, regrasped=regrasped)

    def following(self, frame: int) -> HeldPrior:
        return replace(self, previous=frame)

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> HeldPrior:
        """Return the prior with the number of the last frame."""
        return replace(self, previous=max(solution.trajectory, default=None))
