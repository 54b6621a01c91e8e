"""Proposals: densities derived from the images or the graph, which guide the search but are not evidence."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modeler import se3
from modeler.priors.general import GeneralPrior
from modeler.priors.mixtures import KernelMixture, defensive_mixture
from modeler.registration.features import FeatureMatcher
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    Array,
    Edge,
    PoseGaussian,
    RayImage,
    SharedAxis,
    Solution,
    checked,
)
from modeler.types.base import check_parameters

_MIN_SIGMA_RAD, _MIN_SIGMA_M = np.radians(2.0), 0.004
"""The search does not need more precision: halved or doubled, the dragon's sd change by 1 %."""
INFLATION = 2.0
"""Factor on the graph's standard deviations, which may be optimistic, and do not include systematic errors: 68 %
intervals become 95 % ones. Halved or doubled, builds of the dragon and of cap are the same."""
MAX_STEPS = 3.0
"""Beyond, constant velocity is no longer plausible; halved or doubled, the ablation's builds are the same."""


@dataclass(frozen=True)
class AbstractProposal(AbstractPrior):
    """Adds a proposal to another prior, whose evidence, limits, learning and axis it keeps."""

    known: AbstractPrior = field(default_factory=GeneralPrior)
    """The independent knowledge."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source; the independent knowledge alone if there is no proposal.

        Raises:
            InputError: if the views lack what `known` needs.
        """
        known = self.known.between(source, target)
        proposal = self.proposal(source, target, known)
        return known if proposal is None else defensive_mixture(known, [proposal])

    @abstractmethod
    def proposal(self, source: RayImage, target: RayImage, known: AbstractPoseDensity) -> AbstractPoseDensity | None:
        """Return the proposal density of target_from_source; None if the views or the graph yield none.

        Args:
            source: first view.
            target: second view.
            known: the independent knowledge of their motion.
        """

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> AbstractPrior:
        return replace(self, known=self.known.learned(solution, edges))

    def following(self, frame: int) -> AbstractPrior:
        return replace(self, known=self.known.following(frame))

    def shared_axis(self, views: Collection[RayImage]) -> SharedAxis | None:
        return self.known.shared_axis(views)

    def relaxed(self, steps: float) -> AbstractPrior:
        return replace(self, known=self.known.relaxed(steps))

    def unlimited(self) -> AbstractPrior | None:
        """Return the prior without limits on the motion, if those of its independent part are defaults, else None."""
        known = self.known.unlimited()
        return None if known is None else replace(self, known=known)


@dataclass(frozen=True)
class PredictedProposal(AbstractPrior):
    """The motion predicted from the poses so far, within the independent knowledge."""

    known: AbstractPrior
    """The independent knowledge."""
    expected: PoseGaussian
    """target_from_source of the pair."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        covariance = se3.covariance_about(self.expected.covariance, source.centroid_m)
        sigma_rad, sigma_m = (
            float(np.sqrt(np.linalg.eigvalsh(c)[-1])) for c in (covariance[:3, :3], covariance[3:, 3:])
        )
        sigmas = max(INFLATION * sigma_rad, _MIN_SIGMA_RAD), max(INFLATION * sigma_m, _MIN_SIGMA_M)
        guess = KernelMixture.about(self.expected.mean, source, *sigmas)
        return defensive_mixture(self.known.between(source, target), [guess])

    def relaxed(self, steps: float) -> PredictedProposal:
        return replace(self, known=self.known.relaxed(steps))


@checked
@dataclass(frozen=True)
class VelocityPrior(AbstractProposal):
    """Constant velocity: the motion continues as between the last two frames."""

    velocity_sigma_deg: float = 5.0  # it only proposes: halved or doubled, the same to 0.1 %
    """Standard deviation of the change of rotation from one motion to the next, about each axis."""
    velocity_sigma_m: float = 0.01  # doubled, the log density at the truth changes by 2.5 nats
    """Standard deviation of the change of the centroid's shift from one motion to the next, along each axis."""
    trajectory: tuple[tuple[int, Array], ...] = field(default=(), compare=False, repr=False)
    """Frame numbers and object_from_camera (4, 4) of the poses so far, in order of frames."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_parameters(self)

    def proposal(self, source: RayImage, target: RayImage, known: AbstractPoseDensity) -> KernelMixture | None:
        poses = dict(self.trajectory)
        if len(poses) < 2 or target.index not in poses or source.index in poses:
            return None
        (before, object_from_before), (last, object_from_last) = self.trajectory[-2:]
        pace = (source.index - last) / (last - before)
        if not 0.0 < pace <= MAX_STEPS:
            return None
        twist = se3.log(se3.inverse(object_from_before) @ object_from_last)
        predicted = se3.inverse(poses[target.index]) @ object_from_last @ se3.exp(pace * twist)
        sigmas = float(np.radians(self.velocity_sigma_deg)), self.velocity_sigma_m
        return KernelMixture.about(predicted, source, *(max(pace, 1.0) * sigma for sigma in sigmas))

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> VelocityPrior:
        trajectory = tuple(sorted(solution.trajectory.items(), key=lambda item: item[0]))
        return replace(self, known=self.known.learned(solution, edges), trajectory=trajectory)


@checked
@dataclass(frozen=True)
class FeaturesPrior(AbstractProposal):
    """Poses on which matches of FPFH features agree, each the centre of a kernel (`modeler.registration.features`)."""

    features_sigma_deg: float = 4.0  # halved or doubled, log densities at the truth change by 1.4 nats
    """Standard deviation of each kernel in rotation, about each axis."""
    features_sigma_m: float = 0.006  # halved or doubled, log densities at the truth change by 1.0 nats
    """Standard deviation of each kernel in the position of the centroid, along each axis."""
    kernels: int = 24  # with 12 or 48, log densities at the truth change by 0.25 nats
    """Largest number of kernels."""
    matcher: FeatureMatcher = field(default_factory=FeatureMatcher)
    """Matches the features."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_parameters(self)

    def proposal(self, source: RayImage, target: RayImage, known: AbstractPoseDensity) -> KernelMixture | None:
        """Return kernels about the poses with most consistent matches; None if there are too few."""
        motions, votes = self.matcher.motions(source, target)
        if len(motions):
            possible = np.isfinite(known.log_density(motions))
            motions, votes = motions[possible][: self.kernels], votes[possible][: self.kernels].astype(np.float64)
        if not len(motions):
            return None
        return KernelMixture(
            motions,
            votes**2 / np.sum(votes**2),
            centre_m=source.centroid_m,
            sigma_rad=float(np.radians(self.features_sigma_deg)),
            sigma_m=self.features_sigma_m,
            evidence=False,
        )
