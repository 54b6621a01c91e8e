"""Importance sampling on SE(3) that learns from its samples where to draw the next ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.kernels import mixture
from modeler.registration.mixture import Gaussians
from modeler.registration.posterior import FLOOR
from modeler.types import AbstractPoseDensity, Array

LogLikelihood = Callable[[Array], Array]  # (n, 4, 4) -> (n,)
_PARAMETERS = 28.0  # of one Gaussian more: mean, covariance, share


@dataclass(frozen=True, eq=False)
class WeightedSamples:
    """Weighted samples, and how they came about."""

    poses: Array
    """(n, 4, 4), no two the same."""
    weights: Array
    """(n,), their sum 1."""
    log_likelihoods: Array
    """(n,)."""
    log_evidence: float
    """Log of the mean likelihood under what is known."""
    pareto_k: float
    """Tail index of the weights of everything that was drawn."""

    @property
    def effective_samples(self) -> float:
        """Kish's effective size."""
        return 1.0 / float(np.sum(self.weights**2))


@dataclass(frozen=True, eq=False)
class _Drawn:
    """All samples so far, and what each weighs."""

    poses: Array
    """(n, 4, 4)."""
    log_likelihoods: Array
    """(n,); -inf where what is known excludes a pose."""
    log_target: Array
    """(n,) log of the product of what is known and the likelihood."""
    log_density: Array
    """(n,) log of how many samples are to be expected at each, per unit of the uniform measure."""

    @property
    def log_weights(self) -> Array:
        """Logs (n,) of weights whose mean is the evidence."""
        return self.log_target - self.log_density + np.log(len(self.poses))

    def spread_over(self, more: Gaussians) -> _Drawn:
        """Return the same samples when others are drawn from more Gaussians, weighted by their number."""
        return replace(self, log_density=np.logaddexp(self.log_density, more.log_density(self.poses)))

    def beside(self, other: _Drawn) -> _Drawn:
        """Return them and others."""
        return _Drawn(
            np.concatenate([self.poses, other.poses]),
            np.concatenate([self.log_likelihoods, other.log_likelihoods]),
            np.concatenate([self.log_target, other.log_target]),
            np.concatenate([self.log_density, other.log_density]),
        )


@dataclass(frozen=True)
class AdaptiveSampler:
    """Adaptive multiple importance sampling (Cornuet, Marin, Mira and Robert 2012).

    Each round draws from a Gaussian with the mean and covariance of the weighted samples so far. All samples are
    weighed beside the mixture of everything that was drawn from, so that a bad Gaussian costs samples, not truth. While
    the weights are too uneven to tell a covariance, they are tempered for the next Gaussian.
    """

    initial: int = 400
    """Samples of the first round; what they miss altogether, later ones may miss too."""
    draws: int = 200
    """Samples of a later round, at least."""
    enough: float = 580.0
    """Effective size with which no further round is needed."""
    max_draws: int = 8000
    """No further round begins after so many samples."""
    least: float = 80.0
    """Least effective size of the samples to which a Gaussian is fitted."""
    widening: float = 1.1
    """How much wider than these the next ones lie."""
    yields: float = 0.75
    """Share of a round that is expected to be effective where nothing is tempered: so many are drawn as are missing."""
    kept: int = 750
    """Samples of the result, at most."""

    def run(
        self, density: AbstractPoseDensity, log_likelihood: LogLikelihood, centre_m: Array, rng: np.random.Generator
    ) -> WeightedSamples:
        """Return samples of what is known of a motion × likelihood.

        Args:
            density: where to draw first, and what is known; its density is normalised, as every density's is.
            log_likelihood: of poses (n, 4, 4), (n,); asked only where what is known allows.
            centre_m: (3,) point of the source about which Gaussians turn.
            rng: source of all randomness.
        """
        first = density.sample(self.initial, rng)
        log_count = float(np.log(self.initial))

        def weighed(poses: Array, log_density: Array) -> _Drawn:
            log_known = density.log_evidence(poses)
            possible = np.isfinite(log_known)
            log_likelihoods = np.full(len(poses), -np.inf)
            if possible.any():
                log_likelihoods[possible] = log_likelihood(poses[possible])
            return _Drawn(poses, log_likelihoods, log_known + log_likelihoods, log_density)

        drawn, learnt = weighed(first, log_count + density.log_density(first)), None
        log_weights = drawn.log_weights
        while (effective := effective_samples(log_weights)) < self.enough and len(drawn.poses) < self.max_draws:
            told = effective >= self.least
            power = 1.0 if told else _power(log_weights, self.least)
            count = max(int((self.enough - effective) / self.yields) + 1, self.draws) if told else self.draws
            new = self._fitted(drawn.poses, normalised(power * log_weights), centre_m).times(count)
            learnt = new if learnt is None else learnt.beside(new)
            fresh = new.sample(count, rng)
            log_density = np.logaddexp(log_count + density.log_density(fresh), learnt.log_density(fresh))
            drawn = drawn.spread_over(new).beside(weighed(fresh, log_density))
            log_weights = drawn.log_weights
        chosen, weights = thinned(normalised(log_weights), self.kept, rng)
        return WeightedSamples(
            drawn.poses[chosen],
            weights,
            drawn.log_likelihoods[chosen],
            log_mean_exp(log_weights),
            pareto_tail(log_weights),
        )

    def _fitted(self, poses: Array, weights: Array, centre_m: Array) -> Gaussians:
        """Return a Gaussian of weighted poses (n, 4, 4), or several where these are plainly not one."""
        mean, _ = se3.mean(poses, weights, about_m=centre_m, iterations=3)
        shares, means, covariances = zip(*self._parts(se3.difference(mean, poses, centre_m), weights), strict=True)
        spreads = self.widening * np.linalg.cholesky(np.stack(covariances))
        return Gaussians(se3.moved(mean, np.stack(means), centre_m), spreads, np.log(shares), centre_m)

    def _parts(self, xi: Array, weights: Array) -> list[tuple[float, Array, Array]]:
        """Return share, mean (6,) and covariance (6, 6) of the Gaussians that weighted ξ (n, 6) are taken for.

        They are cut in two across the principal axis of least kurtosis, where they are spread evenly or in two heaps,
        if two Gaussians make them more likely by more than their further parameters would (Akaike 1974).
        """
        share, mean, covariance = _moments(xi, weights)
        whole = [(share, mean, covariance)]
        effective = share**2 / np.sum(weights**2)
        if effective < 0.99 * self.least:
            return whole
        scales, axes = np.linalg.eigh(covariance)
        side = mixture.sides(xi, weights, mean, axes / np.sqrt(scales))
        halves = [(xi[chosen], weights[chosen]) for chosen in (side, ~side)]
        gain = 0.5 * np.linalg.slogdet(covariance)[1]
        for half in halves:
            part, _, narrower = _moments(*half)
            gain += part / share * (np.log(part / share) - 0.5 * np.linalg.slogdet(narrower)[1])
        return [part for half in halves for part in self._parts(*half)] if gain > _PARAMETERS / effective else whole


def _moments(xi: Array, weights: Array) -> tuple[float, Array, Array]:
    """Return the sum of weights (n,), and mean (6,) and covariance (6, 6) of ξ (n, 6)."""
    total, mean, covariance = mixture.moments(xi, weights)
    return total, mean, covariance + FLOOR


def thinned(weights: Array, count: int, rng: np.random.Generator) -> tuple[npt.NDArray[np.int64], Array]:
    """Return the numbers (k,) of at most `count` samples, and weights (k,) under which they stand for all.

    The heavy ones stay as they are. Of the light ones some stay, by systematic sampling, and all weigh the same, as
    much as makes every sample weigh on average what it did (Fearnhead and Clifford 2003).

    Args:
        weights: (n,), their sum 1.
        count: at most so many are kept.
        rng: source of all randomness.
    """
    possible = np.flatnonzero(weights)
    if len(possible) <= count:
        return possible, weights[possible]
    descending = np.sort(weights)[::-1]
    remaining = np.cumsum(descending[::-1])[::-1]
    places = count - np.arange(count)  # left once so many of the heaviest have theirs
    heavy = int(np.argmax(descending[:count] * places <= remaining[:count]))
    level = remaining[heavy] / places[heavy]
    light = np.flatnonzero(weights < level)
    ticks = np.floor(np.cumsum(weights[light]) / level + rng.random())
    chosen = np.concatenate([np.flatnonzero(weights >= level), light[np.diff(ticks, prepend=0.0) > 0.0]])
    kept = np.maximum(weights[chosen], level)
    return chosen, kept / kept.sum()


def normalised(log_weights: Array) -> Array:
    """Return weights (n,) of sum 1; even ones where all are 0."""
    top = np.max(log_weights)
    weights = np.exp(log_weights - top) if np.isfinite(top) else np.ones(len(log_weights))
    return weights / np.sum(weights)


def effective_samples(log_weights: Array) -> float:
    """Return Kish's effective sample size of unnormalised log weights (n,)."""
    return 1.0 / float(np.sum(normalised(log_weights) ** 2))


def pareto_tail(log_weights: Array) -> float:
    """Return the Pareto tail index of importance weights (Zhang and Stephens 2009; Vehtari et al. 2024)."""
    count = len(log_weights)
    tail = int(min(0.2 * count, 3.0 * np.sqrt(count)))
    if tail < 5 or not np.isfinite(np.max(log_weights)):
        return float("nan")
    ordered = np.sort(log_weights - np.max(log_weights))
    excess = np.exp(ordered[-tail:]) - np.exp(ordered[-tail - 1])
    if excess[-1] <= 0.0 or excess[0] <= 0.0:
        return -np.inf  # equal weights have no tail
    grid = 30 + int(np.sqrt(tail))
    quartile = excess[int(tail / 4 + 0.5) - 1]
    theta = 1.0 / excess[-1] + (1.0 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))) / (3.0 * quartile)
    shape = np.mean(np.log1p(-theta[:, None] * excess), axis=1)
    weights = normalised(tail * (np.log(-theta / shape) - shape - 1.0))
    k = float(np.mean(np.log1p(-np.sum(weights * theta) * excess)))
    return (tail * k + 10.0 * 0.5) / (tail + 10.0)


def log_mean_exp(values: Array) -> float:
    """Return the log of the mean of exponentials (n,)."""
    return float(np.logaddexp.reduce(values)) - float(np.log(len(values)))


def _power(log_weights: Array, least: float) -> float:
    """Return the largest power of weights that leaves so large an effective size."""
    possible = log_weights[np.isfinite(log_weights)]
    low, high = 0.0, 1.0
    for _ in range(16):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective_samples(middle * possible) > least else (low, middle)
    return max(low, 1e-4)
