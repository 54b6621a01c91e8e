"""A registrar that returns ground truth, to measure the cost of everything else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import final

import numpy as np

from modeler import se3
from modeler.evaluation import true_motion
from modeler.types import (
    AbstractRegistrar,
    Array,
    Outcome,
    PoseGaussian,
    Posterior,
    ViewPair,
)


@final
@dataclass(frozen=True)
class Known(AbstractRegistrar):
    """The true motion with an error drawn from the reported covariance."""

    camera_from_model: Mapping[int, Array] = field(repr=False)
    """(4, 4) by frame number."""
    sigma_deg: float = 0.3
    """Standard deviation of the rotation about each axis."""
    sigma_m: float = 0.0005
    """Standard deviation of the object's place along each axis."""

    def posterior_of(self, pair: ViewPair) -> Posterior:
        """Return the posterior of target_from_source."""
        sigmas = np.repeat([np.radians(self.sigma_deg), self.sigma_m], 3)
        about_object = se3.translation(pair.source.centroid_m)
        error = about_object @ se3.exp(sigmas * pair.rng.normal(size=6)) @ se3.inverse(about_object)
        carried = se3.adjoint(about_object)
        pose = PoseGaussian(
            true_motion(self.camera_from_model, pair.target.index, pair.source.index) @ error,
            carried @ np.diag(sigmas**2) @ carried.T,
        )
        return Posterior(pair.source.index, pair.target.index, pose, Outcome.CONVERGED, overlap=0.8, seconds=0.0)
