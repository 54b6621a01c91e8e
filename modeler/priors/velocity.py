"""The motion goes on at the pace of the last two frames: a guess, since the images already counted in their edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modeler import se3
from modeler.priors.bumps import KernelMixture
from modeler.priors.proposal import AbstractProposal, defensive_mixture
from modeler.types import AbstractPoseDensity, Array, Edge, RayImage, Solution

_MOST_STEPS = 3.0  # beyond, it is anybody's guess


@dataclass(frozen=True)
class VelocityPrior(AbstractProposal):
    """Constant velocity within what is known; it proposes and is no evidence."""

    velocity_sigma_deg: float = 5.0
    """Standard deviation of the change of rotation from one motion to the next, about each axis."""
    velocity_sigma_m: float = 0.01
    """Standard deviation of the change of the centroid's shift from one motion to the next, along each axis."""
    trajectory: tuple[tuple[int, Array], ...] = field(default=(), compare=False, repr=False)
    """Frame numbers and object_from_camera (4, 4) of the poses so far, in order of frames."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source: that of what is known, until two frames have shown a pace.

        Raises:
            InputError: where the views lack what `known` needs.
        """
        known = self.known.between(source, target)
        poses = dict(self.trajectory)
        if len(poses) < 2 or target.index not in poses or source.index in poses:
            return known
        (before, object_from_before), (last, object_from_last) = self.trajectory[-2:]
        pace = (source.index - last) / (last - before)
        if not 0.0 < pace <= _MOST_STEPS:
            return known
        twist = se3.log(se3.inverse(object_from_before) @ object_from_last)
        predicted = se3.inverse(poses[target.index]) @ object_from_last @ se3.exp(pace * twist)
        guess = KernelMixture(
            predicted[None],
            np.ones(1),
            centre_m=source.centroid_m,
            sigma_rad=float(np.radians(self.velocity_sigma_deg) * max(pace, 1.0)),
            sigma_m=self.velocity_sigma_m * max(pace, 1.0),
            evidence=False,
        )
        return defensive_mixture(known, [guess])

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> VelocityPrior:
        """Return the prior that goes on from the poses so far."""
        trajectory = tuple(sorted(solution.trajectory.items(), key=lambda item: item[0]))
        return replace(self, known=self.known.learned(solution, edges), trajectory=trajectory)
