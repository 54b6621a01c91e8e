"""A registrar some of whose closures lie, to see whether they are found out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np

from modeler import se3
from modeler.types import AbstractPoseDensity, AbstractRegistrar, Outcome, PoseGaussian, Posterior, RayImage


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

    def register(
        self,
        source: RayImage,
        target: RayImage,
        density: AbstractPoseDensity,
        *,
        rng: np.random.Generator,
        effort: float = 1.0,
    ) -> Posterior:
        """Return the posterior of target_from_source, or a lie with the truth's covariance, evidence and overlap."""
        posterior = self.registrar.register(source, target, density, rng=rng)
        dice = np.random.default_rng([source.index, target.index])  # the same pairs lie in every run
        if abs(source.index - target.index) == 1 or dice.random() >= self.share:
            return posterior
        axis = dice.normal(size=3)
        turn_rad = np.radians(dice.uniform(self.least_deg, 180.0)) * axis / np.linalg.norm(axis)
        about = se3.translation(source.centroid_m)
        wrong = about @ se3.exp(np.concatenate([turn_rad, np.zeros(3)])) @ se3.inverse(about)
        pose = PoseGaussian(posterior.pose.mean @ wrong, posterior.pose.covariance)
        return replace(posterior, pose=pose, modes=(), outcome=Outcome.CONVERGED)
