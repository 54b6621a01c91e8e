"""Adaptive importance sampling on SE(3): Gaussian mixtures as proposals, and the weights of separate modes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.kernels import mixture
from modeler.registration.posterior import (
    FLOOR,
    KNOWN,
    MIN_MODE_SHARE,
    NEGLIGIBLE_VARIANCE,
    FocalNuisance,
    effective_samples,
    normalised,
    pareto_tail,
)
from modeler.se3 import rows
from modeler.types import AbstractPoseDensity, Array

LogLikelihood = Callable[[Array, Array], Array]  # (n, 4, 4), (n,) -> (n,)

_NEGLIGIBLE = 1e-6  # of the heaviest weight: lighter samples are left out of fits
_INFLATION, _WIDE_FRACTION = 2.0, 0.3  # a fifth fewer rounds on a printed carton, a tenth on others; 0.5 is similar
_PER_ROUND = 4  # a round draws a quarter of the samples so far, or more: it goes through all; 28 % less for a carton
_EM_STEPS, _MEAN_STEPS = 4, 2  # proposals need no convergence
_MIN_PART = 0.05  # of the weight: the few samples of a smaller part do not determine a Gaussian
_LEAST_POWER = 0.5  # of the weights of a result: variances are at most doubled


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """A mixture of Gaussians of ξ, each about its own mean pose."""

    means: Array
    """(k, 4, 4) target_from_source."""
    spreads: Array
    """(k, 6, 6) lower triangular roots of the covariances of ξ about the centre."""
    log_weights: Array
    """(k,) logarithms of the weights, which need not sum to 1."""
    centre_m: Array
    """(3,) point of the source."""

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw poses (count, 4, 4)."""
        chosen = rng.choice(len(self.means), count, p=np.exp(self.log_weights - self.log_weight))
        xi = np.einsum("nij,nj->ni", self.spreads[chosen], rng.normal(size=(count, 6)))
        return se3.moved(self.means[chosen], xi, self.centre_m)

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log (n,) of the weighted sum of densities at poses (n, 4, 4)."""
        return mixture.log_densities(
            rows(target_from_source), rows(self.means), *self._shapes, self.log_weights, self.centre_m
        )

    def times(self, factor: float) -> GaussianMixture:
        """Return the mixture with its weights multiplied by a factor."""
        return replace(self, log_weights=self.log_weights + np.log(factor))

    def plus(self, other: GaussianMixture) -> GaussianMixture:
        """Return the Gaussians of both mixtures, which have the same centre."""
        return GaussianMixture(
            np.concatenate([self.means, other.means]),
            np.concatenate([self.spreads, other.spreads]),
            np.concatenate([self.log_weights, other.log_weights]),
            self.centre_m,
        )

    def defensive(self) -> GaussianMixture:
        """Return the defensive mixture, with a fraction of its weight on wider Gaussians (Hesterberg 1995).

        If a posterior has heavier tails than its proposal, a few samples there would dominate.
        """
        wide = replace(self, spreads=_INFLATION * self.spreads).times(_WIDE_FRACTION)
        return self.times(1.0 - _WIDE_FRACTION).plus(wide)

    @cached_property
    def log_weight(self) -> float:
        """Log of the sum of the weights."""
        return float(np.logaddexp.reduce(self.log_weights))

    @cached_property
    def _shapes(self) -> tuple[Array, Array]:
        """Upper triangular roots (k, 6, 6) of the precisions; largest variances (k, 2) of rotation and translation.

        With C = U Uᵀ and U upper triangular, a root is U⁻¹.
        """
        covariances = self.spreads @ self.spreads.transpose(0, 2, 1)
        upper = np.linalg.cholesky(covariances[:, ::-1, ::-1])[:, ::-1, ::-1]
        blocks = np.stack([covariances[:, :3, :3], covariances[:, 3:, 3:]], axis=1)
        roots = np.ascontiguousarray(np.triu(np.linalg.inv(upper)), dtype=np.float64)
        return roots, np.ascontiguousarray(np.linalg.eigvalsh(blocks)[:, :, -1], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class MixtureProposal(AbstractPoseDensity):
    """A Gaussian mixture as a proposal, with another density as the evidence."""

    known: AbstractPoseDensity
    """The prior."""
    gaussians: GaussianMixture
    """The proposal."""
    evidence: bool = False

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        return self.gaussians.sample(count, rng)

    def log_density(self, target_from_source: Array) -> Array:
        return self.gaussians.log_density(target_from_source) - self.gaussians.log_weight

    def log_prior(self, target_from_source: Array) -> Array:
        return self.known.log_prior(target_from_source)


@dataclass(frozen=True, eq=False)
class WeightedSamples:
    """Weighted samples of one mode."""

    poses: Array
    """(n, 4, 4), all different, under the focal length of the views to first order."""
    weights: Array
    """(n,), their sum 1."""
    log_likelihoods: Array
    """(n,)."""
    log_marginal_likelihood: float
    """Log of the mean likelihood under the prior."""
    pareto_k: float
    """Pareto tail index of the weights of all samples drawn."""
    log_focal: Array = field(default_factory=lambda: np.zeros(0))
    """(n,) logarithms of the samples' focal lengths over that of the views; empty if it is known."""
    nuisance: FocalNuisance = KNOWN
    """How poses depend on it."""

    @property
    def under_focal_lengths(self) -> Array:
        """The poses (n, 4, 4), each under its own focal length."""
        return self.nuisance.under(self.poses, self.log_focal)

    def conditional(self, centre_m: Array) -> WeightedSamples:
        """Return samples given the focal length of the views, and how they depend on it (method, eq. 10.2).

        What is left of this beyond first order is their regression on it.

        Args:
            centre_m: (3,) point of the source about which their mean is taken.
        """
        if not self.log_focal.any():
            return self
        mean, _ = se3.mean(self.poses, self.weights, about_m=centre_m)
        apart = self.weights * (self.log_focal - self.weights @ self.log_focal)
        if not (variance := float(apart @ self.log_focal)) > 0.0:  # a single sample has all weight
            return self
        by_focal = apart @ se3.log(se3.inverse(mean) @ self.poses) / variance
        rest = self.nuisance._replace(by_focal=by_focal)
        total = self.nuisance._replace(by_focal=self.nuisance.by_focal + by_focal)
        return replace(self, poses=rest.under(self.poses, -self.log_focal), nuisance=total)

    @property
    def effective_samples(self) -> float:
        """Kish's effective size."""
        return 1.0 / float(np.sum(self.weights**2))


def weigh_modes(modes: Sequence[WeightedSamples]) -> list[tuple[float, WeightedSamples]]:
    """Return the modes with their posterior probabilities, heaviest first, without negligible ones."""
    mass = normalised(np.array([mode.log_marginal_likelihood for mode in modes]))
    kept = [number for number in np.argsort(-mass, kind="stable") if mass[number] >= MIN_MODE_SHARE]
    return [(float(mass[number] / mass[kept].sum()), modes[number]) for number in kept]


@dataclass(frozen=True, eq=False)
class _Draws:
    """All samples so far and their importance weights."""

    poses: Array
    """(n, 4, 4), see `WeightedSamples`."""
    log_focal: Array
    """(n,)."""
    log_likelihoods: Array
    """(n,); -inf outside the prior's support."""
    log_target: Array
    """(n,) log of the product of prior and likelihood."""
    log_density: Array
    """(n,) log of the expected density of samples, Σ N_t q_t."""

    @property
    def log_weights(self) -> Array:
        """Log weights (n,); the mean of the weights is the evidence (method, eq. 5.4)."""
        return self.log_target - self.log_density + np.log(len(self.poses))

    def reweighted(self, new: GaussianMixture) -> _Draws:
        """Return the same samples after adding a proposal, weighted by its sample count, to the mixture."""
        return replace(self, log_density=np.logaddexp(self.log_density, new.log_density(self.poses)))

    def plus(self, other: _Draws) -> _Draws:
        """Return both sets of samples."""
        return _Draws(
            np.concatenate([self.poses, other.poses]),
            np.concatenate([self.log_focal, other.log_focal]),
            np.concatenate([self.log_likelihoods, other.log_likelihoods]),
            np.concatenate([self.log_target, other.log_target]),
            np.concatenate([self.log_density, other.log_density]),
        )


@dataclass(frozen=True)
class AdaptiveSampler:
    """Adaptive multiple importance sampling (Cornuet, Marin, Mira and Robert 2012; method, eq. 5.4).

    Each round draws from a Gaussian with the moments of the weighted samples so far. All samples are weighted against
    the mixture of all proposals, so that a bad one costs samples, not correctness. While the weights are too uneven to
    determine a covariance, they are tempered for the next proposal, which has two Gaussians, and at the end for the
    result, if a power of at least a half is enough. Proposals are defensive mixtures.
    """

    draws: int = 200
    """Least samples per round; regions that the first round misses may also be missed by later ones. With 400, as long,
    with 100 1.4 times."""
    samples: int = 300
    """Effective sample size at which the rounds end, and largest number of samples in the result: means scatter by 0.06
    sd, a fifth of what the choice of points moves them by."""
    max_draws: int = 8000
    """Number of samples after which no further round begins."""
    min_effective: float = 100.0
    """Least effective sample size that determines a covariance: of a proposal, and of a usable result."""

    def run(
        self,
        proposal: AbstractPoseDensity,
        log_likelihood: LogLikelihood,
        centre_m: Array,
        rng: np.random.Generator,
        *,
        nuisance: FocalNuisance = KNOWN,
    ) -> WeightedSamples:
        """Return samples of prior × likelihood.

        Args:
            proposal: first proposal, normalised; its evidence is the prior.
            log_likelihood: of poses (n, 4, 4) under logarithms (n,) of focal lengths, (n,); called only inside the
                prior's support.
            centre_m: (3,) point of the source about which Gaussians are fitted.
            rng: source of all randomness.
            nuisance: the focal length; proposals are for poses under that of the views.
        """
        first = proposal.sample(self.draws, rng)
        log_count = float(np.log(self.draws))

        def weighted(poses: Array, log_density: Array) -> _Draws:
            log_focal = nuisance.draw(len(poses), rng)
            moved = nuisance.under(poses, log_focal)
            log_prior = proposal.log_prior(moved)
            possible = np.isfinite(log_prior)
            log_likelihoods = np.full(len(poses), -np.inf)
            if possible.any():
                log_likelihoods[possible] = log_likelihood(moved[possible], log_focal[possible])
            return _Draws(poses, log_focal, log_likelihoods, log_prior + log_likelihoods, log_density)

        drawn, fitted = weighted(first, log_count + proposal.log_density(first)), None
        log_weights = drawn.log_weights
        while (effective := effective_samples(log_weights)) < self.samples and len(drawn.poses) < self.max_draws:
            if effective >= self.min_effective:
                new = _fitted(drawn.poses, normalised(log_weights), centre_m)
            else:
                power = _power(log_weights, self.min_effective)
                new = _fitted_two(drawn.poses, normalised(power * log_weights), centre_m)
            count = max(self.draws, len(drawn.poses) // _PER_ROUND)
            new = new.defensive().times(count)
            fitted = new if fitted is None else fitted.plus(new)
            poses = new.sample(count, rng)
            log_density = np.logaddexp(log_count + proposal.log_density(poses), fitted.log_density(poses))
            drawn = drawn.reweighted(new).plus(weighted(poses, log_density))
            log_weights = drawn.log_weights
        # A likelihood that is rough, as noise makes it, leaves few samples: they say where the mode is, not how narrow.
        room = 1.0 / self.min_effective - 1.0 / self.samples  # thinning adds up to 1 / n to the squares of the weights
        least = 1.0 / room if room > 0.0 else self.min_effective  # fewer samples than are needed may be asked for
        power = _power(log_weights, least) if effective < least else 1.0
        tempered = power * log_weights if power >= _LEAST_POWER else log_weights
        chosen, weights = thinned(normalised(tempered), self.samples, rng)
        return WeightedSamples(
            drawn.poses[chosen],
            weights,
            drawn.log_likelihoods[chosen],
            _log_mean_exp(log_weights),
            pareto_tail(log_weights),
            drawn.log_focal[chosen],
            nuisance,
        )


def _fitted(poses: Array, weights: Array, centre_m: Array) -> GaussianMixture:
    """Return the Gaussian fitted to weighted poses (n, 4, 4)."""
    heavy = weights > _NEGLIGIBLE * weights.max()
    mean, covariance = se3.mean(poses[heavy], weights[heavy], about_m=centre_m, iterations=_MEAN_STEPS)
    spread = np.asarray(np.linalg.cholesky(covariance + FLOOR), dtype=np.float64)
    return GaussianMixture(mean[None], spread[None], np.zeros(1), centre_m)


def _fitted_two(poses: Array, weights: Array, centre_m: Array) -> GaussianMixture:
    """Return two Gaussians fitted to weighted poses (n, 4, 4) by expectation maximisation; one if one is enough.

    A single Gaussian does not fit a narrow peak on a broad ridge, such as that of a label on a ball.
    """
    one = _fitted(poses, weights, centre_m)
    heavy = weights > _NEGLIGIBLE * weights.max()
    poses, weights = poses[heavy], weights[heavy]
    xi = se3.difference(one.means[0], poses, centre_m)
    white = np.asarray(np.linalg.solve(one.spreads[0], xi.T).T, dtype=np.float64)
    near = np.argsort(np.sum(white**2, axis=1))
    core = np.zeros(len(weights))
    core[near[np.cumsum(weights[near]) <= 0.5 * weights.sum()]] = 1.0
    members = weights * np.stack([core, 1.0 - core])
    if not mixture.separate_two(white, weights, members, _EM_STEPS, _MIN_PART, NEGLIGIBLE_VARIANCE):
        return one
    parts = [_fitted(poses, of / of.sum(), centre_m).times(0.5) for of in members]
    return parts[0].plus(parts[1])


def thinned(weights: Array, count: int, rng: np.random.Generator) -> tuple[npt.NDArray[np.int64], Array]:
    """Return indices (k,) of at most `count` samples, and weights (k,) under which they represent all.

    Heavy samples are kept. Light ones are resampled systematically to equal weights, so that the expected weight of
    every sample is unchanged (Fearnhead and Clifford 2003).

    Args:
        weights: (n,), their sum 1.
        count: largest number of samples to keep.
        rng: source of all randomness.
    """
    possible = np.flatnonzero(weights)
    if len(possible) <= count:
        return possible, weights[possible]
    descending = np.sort(weights)[::-1]
    remaining = np.cumsum(descending[::-1])[::-1]
    free = count - np.arange(count)  # slots left after that many of the heaviest
    heavy = int(np.argmax(descending[:count] * free <= remaining[:count]))
    level = remaining[heavy] / free[heavy]
    light = np.flatnonzero(weights < level)
    ticks = np.floor(np.cumsum(weights[light]) / level + rng.random())
    chosen = np.concatenate([np.flatnonzero(weights >= level), light[np.diff(ticks, prepend=0.0) > 0.0]])
    kept = np.maximum(weights[chosen], level)
    return chosen, kept / kept.sum()


def _log_mean_exp(values: Array) -> float:
    """Return the log of the mean of exponentials (n,)."""
    return float(np.logaddexp.reduce(values)) - float(np.log(len(values)))


def _power(log_weights: Array, least: float) -> float:
    """Return the largest power of the weights that leaves an effective size of at least `least`."""
    possible = log_weights[np.isfinite(log_weights)]
    low, high = 0.0, 1.0
    for _ in range(8):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective_samples(middle * possible) > least else (low, middle)
    return max(low, 1e-4)
