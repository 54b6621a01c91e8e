"""A registrar some of whose closures lie, to see whether they are found out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np

from modeler import se3
from modeler.types import AbstractRegistrar, Outcome, PoseGaussian, Posterior, ViewPair


@final
@dataclass(frozen=True)
class Lying(AbstractRegistrar):
    """Another registrar, but a share of the pairs that are no neighbours come out somewhere else, and sure of it."""

    registrar: AbstractRegistrar
    """Asked for all."""
    share: float
    """Of the pairs."""
    least_deg: float = 10.0
    """Lies are turned about the object by so much at least; 180 at most."""

    def posterior_of(self, pair: ViewPair) -> Posterior:
        """Return the posterior of target_from_source, or a lie with the truth's covariance, evidence and overlap."""
        posterior = self.registrar.posterior_of(pair)
        dice = np.random.default_rng([pair.source.index, pair.target.index])  # the same pairs lie in every run
        if abs(pair.source.index - pair.target.index) == 1 or dice.random() >= self.share:
            return posterior
        axis = dice.normal(size=3)
        turn_rad = np.radians(dice.uniform(self.least_deg, 180.0)) * axis / np.linalg.norm(axis)
        about = se3.translation(pair.source.centroid_m)
        wrong = about @ se3.exp(np.concatenate([turn_rad, np.zeros(3)])) @ se3.inverse(about)
        pose = PoseGaussian(posterior.pose.mean @ wrong, posterior.pose.covariance)
        return replace(posterior, pose=pose, modes=(), outcome=Outcome.CONVERGED)
