"""What two views say about the motion between them, and who says it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.types.arrays import Array
from modeler.types.densities import AbstractPoseDensity
from modeler.types.outcomes import Outcome
from modeler.types.views import RayImage


@dataclass(frozen=True, eq=False)
class PoseGaussian:
    """A Gaussian on SE(3): `mean @ exp(ξ)` with ξ ~ N(0, covariance)."""

    mean: Array
    """(4, 4)."""
    covariance: Array
    """(6, 6) of ξ: rotation in rad first, then translation in m."""

    def inverse(self) -> PoseGaussian:
        """Return the Gaussian of the inverse motion."""
        return PoseGaussian(se3.inverse(self.mean), se3.inverse_covariance(self.mean, self.covariance))

    @cached_property
    def rotation_variance_rad2(self) -> float:
        """Variance of the rotation, summed over its three directions."""
        return float(self.covariance[0, 0] + self.covariance[1, 1] + self.covariance[2, 2])


@dataclass(frozen=True, eq=False)
class Mode:
    """One of several separate places where a posterior has its mass."""

    weight: float
    """Share (0..1) of the mass."""
    pose: PoseGaussian
    """target_from_source: mean and covariance of this part alone."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """What two views and a prior say about the motion between them."""

    source: int
    """Frame number of the source view."""
    target: int
    """Frame number of the target view."""
    pose: PoseGaussian
    """target_from_source: mean and covariance; where there are separate modes, at the heaviest, and as wide as all."""
    outcome: Outcome
    """How the attempt ended."""
    overlap: float
    """Share (0..1) of the surface that should be seen by both cameras at the mean and is."""
    least_overlap: float = field(default=0.0, kw_only=True)
    """Overlap with less of which the method takes the surfaces not to match, whatever else the outcome tells."""
    samples: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """(n, 4, 4) samples of target_from_source; empty where the method draws none."""
    weights: Array = field(default_factory=lambda: np.zeros(0))
    """(n,) weights of the samples, summing to 1."""
    modes: tuple[Mode, ...] = ()
    """The separate modes, heaviest first, whose weights sum to 1; empty where there is but one, or none are told."""
    effective_samples: float = float("nan")
    """Effective sample size."""
    pareto_k: float = float("nan")
    """Tail index of the weights; above 0.7 their mean is not to be trusted."""
    log_evidence: float = float("nan")
    """Log of the mean likelihood under the prior, against nothing matching (nats)."""
    seconds: float = float("nan")
    """Wall time of the registration in s."""

    @property
    def usable(self) -> bool:
        """Whether the posterior may become an edge."""
        return self.outcome in (Outcome.CONVERGED, Outcome.AMBIGUOUS)

    @property
    def matches(self) -> bool:
        """Whether there is enough surface in common at the mean: at a prior's limit a posterior may find none."""
        return self.outcome is not Outcome.NO_OVERLAP and self.overlap > 0.0 and self.overlap >= self.least_overlap

    def without_samples(self) -> Posterior:
        """Return the posterior as it is kept once it is judged: nothing asks for its samples, which are most of it."""
        return replace(self, samples=np.zeros((0, 4, 4)), weights=np.zeros(0))


class AbstractRegistrar(ABC):
    """A registration method: parameters as fields, one pure method."""

    @abstractmethod
    def register(
        self, source: RayImage, target: RayImage, density: AbstractPoseDensity, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the posterior of target_from_source. Failure is the posterior's outcome, never an exception."""
