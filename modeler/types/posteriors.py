"""Gaussians on SE(3), the modes of a posterior, and the posterior of a pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.types.base import Array, Outcome

_NO_POSES = np.zeros((0, 4, 4))
_NO_WEIGHTS = np.zeros(0)  # shared: empty arrays of its own take an edge half a kilobyte


@dataclass(frozen=True, eq=False)
class PoseGaussian:
    """A Gaussian on SE(3): `mean @ exp(ξ)` with ξ ~ N(0, covariance)."""

    mean: Array
    """(4, 4)."""
    covariance: Array
    """(6, 6) of ξ: rotation in rad first, then translation in m."""
    by_focal: Array = field(default_factory=lambda: np.zeros(6))
    """(6,) derivative of ξ by the logarithm of the camera's focal length, common to all images and not observable from
    one (method, eq. 10.2); 0 if unknown. The covariance is conditional on the focal length."""

    def inverse(self) -> PoseGaussian:
        """Return the Gaussian of the inverse motion."""
        covariance = se3.inverse_covariance(self.mean, self.covariance)
        return PoseGaussian(se3.inverse(self.mean), covariance, -se3.adjoint(self.mean) @ self.by_focal)

    def under(self, log_factor: float) -> PoseGaussian:
        """Return the Gaussian under a focal length, given as the logarithm of its factor."""
        return replace(self, mean=self.mean @ se3.exp(log_factor * self.by_focal))

    def widened(self, sigma_focal: float) -> PoseGaussian:
        """Return the Gaussian for a focal length whose logarithm has a standard deviation."""
        return replace(self, covariance=self.covariance + sigma_focal**2 * np.outer(self.by_focal, self.by_focal))

    @cached_property
    def rotation_variance_rad2(self) -> float:
        """Variance of the rotation, summed over its three directions."""
        return float(self.covariance[0, 0] + self.covariance[1, 1] + self.covariance[2, 2])


@dataclass(frozen=True, eq=False)
class Mode:
    """One of several separate modes of a posterior."""

    weight: float
    """Share (0..1) of the posterior's mass."""
    pose: PoseGaussian
    """target_from_source: mean and covariance of this mode alone."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """The posterior of the motion between two views, from their images and a prior."""

    source: int
    """Frame number of the source view."""
    target: int
    """Frame number of the target view."""
    pose: PoseGaussian
    """target_from_source: mean and covariance; with separate modes, the heaviest one's mean and the spread of all."""
    outcome: Outcome
    overlap: float
    """Share (0..1) of the surface that both cameras should see, at the mean, that both do see."""
    least_overlap: float = field(default=0.0, kw_only=True)
    """Overlap below which the method considers the surfaces not to match, whatever the outcome."""
    contradicted: bool = field(default=False, kw_only=True)
    """Whether the images contradict the mean more than 99 of 100 right ones, if the method can test this."""
    colour_correlation: float = field(default=float("nan"), kw_only=True)
    """Correlation of the colours of matching surface at the mean, the largest of several bands; NaN: not compared."""
    independent_colours: float = field(default=0.0, kw_only=True)
    """Number of independent ones."""
    samples: Array = field(default_factory=lambda: _NO_POSES)
    """(n, 4, 4) samples of target_from_source; empty if the method draws none."""
    weights: Array = field(default_factory=lambda: _NO_WEIGHTS)
    """(n,) weights of the samples, summing to 1."""
    modes: tuple[Mode, ...] = ()
    """The separate modes, heaviest first, with weights that sum to 1; empty for a single mode, or if unknown."""
    effective_samples: float = float("nan")
    pareto_k: float = float("nan")
    """Tail index of the weights; above 0.7 their mean is unreliable."""
    log_marginal_likelihood: float = float("nan")
    """Log of the mean likelihood under the prior, relative to no match at all (nats)."""
    seconds: float = float("nan")
    """Wall time of the registration in s."""
    beyond: Array = field(default_factory=lambda: _NO_POSES)
    """(1, 4, 4) target_from_source that matches far better and lies beyond the limits of the prior; (0, 4, 4): none."""

    @property
    def usable(self) -> bool:
        """Whether the posterior may become an edge."""
        return self.outcome in (Outcome.CONVERGED, Outcome.AMBIGUOUS)

    @property
    def convincing(self) -> bool:
        """Whether the result is a pose that the images do not contradict."""
        return self.usable and not self.contradicted

    @property
    def matches(self) -> bool:
        """Whether the surfaces overlap enough at the mean; at a limit of the prior they may not."""
        return self.outcome is not Outcome.NO_OVERLAP and self.overlap > 0.0 and self.overlap >= self.least_overlap

    def under(self, log_factor: float) -> Posterior:
        """Return the posterior, without its samples, under a focal length, given as the logarithm of its factor."""
        modes = tuple(replace(mode, pose=mode.pose.under(log_factor)) for mode in self.modes)
        return replace(self.without_samples(), pose=self.pose.under(log_factor), modes=modes)

    def without_samples(self) -> Posterior:
        """Return the posterior without its samples, most of its memory, which are not needed after acceptance tests."""
        return replace(self, samples=_NO_POSES, weights=_NO_WEIGHTS)


def are_separate(modes: Sequence[Mode]) -> bool:
    """Return whether any mode is farther from the first than two equal Gaussians with a single peak may be: 2 sd."""
    if len(modes) < 2:
        return False
    first, *others = (mode.pose for mode in modes)
    xi = se3.log(se3.inverse(first.mean) @ np.stack([other.mean for other in others]))
    spread = 0.5 * (first.covariance + np.stack([other.covariance for other in others]))
    squares = np.sum(xi * np.linalg.solve(spread, xi[..., None])[..., 0], axis=-1)
    return bool(squares.max() > 2.0**2)


def pooled(modes: Sequence[Mode], weights: Array | None = None) -> PoseGaussian:
    """Return a Gaussian with the mean of the heaviest mode, and the second moment of all modes about it.

    The mean of several modes is near none of them; the heaviest alone would be overconfident.

    Args:
        modes: at least one.
        weights: (m,) weights of the modes; None: their own.
    """
    weights = np.array([mode.weight for mode in modes]) if weights is None else weights
    heaviest = modes[int(np.argmax(weights))].pose
    mean = heaviest.mean
    offsets = se3.log(se3.inverse(mean) @ np.stack([mode.pose.mean for mode in modes]))
    spread = np.stack([mode.pose.covariance for mode in modes]) + offsets[:, :, None] * offsets[:, None, :]
    return PoseGaussian(mean, np.tensordot(weights / np.sum(weights), spread, 1), heaviest.by_focal)
