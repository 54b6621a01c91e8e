"""Where the graph expects a motion: a guess, since all that it follows from already counts in edges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modeler import se3
from modeler.priors.bumps import KernelMixture
from modeler.priors.proposal import defensive_mixture
from modeler.types import AbstractPoseDensity, AbstractPrior, PoseGaussian, RayImage

_LEAST_RAD, _LEAST_M = np.radians(2.0), 0.004  # of the guess: a search finds what lies so near by itself
_WIDER = 2.0  # than the graph says: its covariances hold no systematic error


@dataclass(frozen=True)
class PredictedProposal(AbstractPrior):
    """The motion that the poses so far foretell, within what is known; it proposes and is no evidence."""

    known: AbstractPrior
    """What is independently known of motions."""
    expected: PoseGaussian
    """target_from_source of the two views for which it is asked."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source.

        Raises:
            InputError: where the views lack what the prior needs.
        """
        covariance = se3.covariance_about(self.expected.covariance, source.centroid_m)
        sigma_rad, sigma_m = (
            float(np.sqrt(np.linalg.eigvalsh(c)[-1])) for c in (covariance[:3, :3], covariance[3:, 3:])
        )
        guess = KernelMixture(
            self.expected.mean[None],
            np.ones(1),
            centre_m=source.centroid_m,
            sigma_rad=max(_WIDER * sigma_rad, _LEAST_RAD),
            sigma_m=max(_WIDER * sigma_m, _LEAST_M),
            evidence=False,
        )
        return defensive_mixture(self.known.between(source, target), [guess])

    def relaxed(self, steps: float) -> PredictedProposal:
        """Return the prior within limits that hold for several steps."""
        return replace(self, known=self.known.relaxed(steps))
