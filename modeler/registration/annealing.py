"""An annealed sampler on SE(3): from a prior, through ever sharper likelihoods, to samples of the posterior."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from modeler.kernels.moves import propose
from modeler.se3 import matrices, rows
from modeler.types import AbstractMotion, Array

LogLikelihood = Callable[[Array], Array]  # (n, 4, 4) -> (n,)
_IMPOSSIBLE = -1e300  # log-likelihood where the prior has none; finite, so that differences are

Level = Callable[[Array], LogLikelihood]  # from the samples so far, (n, 4, 4), the next likelihood


@dataclass(frozen=True, eq=False)
class Population:
    """Equally weighted samples, and how they came about."""

    poses: Array
    """(n, 4, 4)."""
    log_likelihoods: Array
    """(n,) under the last level."""
    log_evidence: float
    """Log of the mean likelihood under the prior."""
    effective_samples: float
    """Kish's effective size, with samples that no move has parted since the last weighting counted as one."""
    pareto_k: float
    """Largest tail index of the weights over all weightings."""


@dataclass(frozen=True)
class AnnealedSampler:
    """Sequential Monte Carlo: weight, resample, move; temperatures bridge the steps where weights would collapse."""

    initial: int = 1200
    """Samples drawn at first."""
    particles: int = 500
    """Samples kept from the first weighting on."""
    moves: int = 1
    """Rounds of moves after a weighting."""
    final_particles: int = 1000
    """Samples of the result."""
    final_moves: int = 4
    """At most so many rounds of moves after the last weighting."""
    enough: float = 520.0
    """None are made, or no more, once the effective size of the result is this."""
    min_share: float = 0.4
    """Least effective share of the samples that a weighting may leave; with less, the step is cut."""

    def run(
        self, motion: AbstractMotion, levels: Sequence[Level], centre_m: Array, rng: np.random.Generator
    ) -> Population:
        """Return samples of what is known of a motion × last level.

        Args:
            motion: where to start, and what is known.
            levels: makers of log-likelihoods, from the bluntest to the one wanted; each is shown the samples so far.
            centre_m: (3,) point of the source about which moves turn.
            rng: source of all randomness.
        """
        poses = motion.sample(self.initial, rng)
        # A motion that is more than what is known, because it only proposes, is bridged like another level.
        previous = _excess(motion)
        prior, before, _ = _Blend(motion, previous, _nothing, 0.0).evaluate(poses)
        evidence, worst_tail = 0.0, -np.inf
        for number, make in enumerate(levels):
            level = make(poses)
            after = np.where(np.isfinite(prior), level(poses), _IMPOSSIBLE)
            reached = 0.0
            while reached < 1.0:
                share = min(self.min_share, self.particles * self.min_share / len(poses))
                step = _largest_step(after - before, 1.0 - reached, share)
                log_weights = step * (after - before)
                evidence += _log_mean_exp(log_weights)
                worst_tail = max(worst_tail, pareto_tail(log_weights))
                reached += step
                last = number == len(levels) - 1 and reached >= 1.0
                chosen = _resample(log_weights, self.final_particles if last else self.particles, rng)
                poses, prior, before, after = poses[chosen], prior[chosen], before[chosen], after[chosen]
                blend = _Blend(motion, previous, level, reached)
                for _ in range(self.final_moves if last else self.moves):
                    if last and _distinct(poses) >= self.enough:
                        break
                    _move(poses, (prior, before, after), blend=blend, centre_m=centre_m, rng=rng)
            before, previous = after, level
        return Population(poses, before, evidence, _distinct(poses), worst_tail)


@dataclass(frozen=True, eq=False)
class _Blend:
    """The density between two levels: prior × previous^(1 - reached) × level^reached."""

    motion: AbstractMotion
    previous: LogLikelihood
    level: LogLikelihood
    reached: float

    def evaluate(self, poses: Array) -> tuple[Array, Array, Array]:
        """Return log prior, log-likelihood under the previous and under this level, each (n,)."""
        prior = self.motion.log_evidence(poses)
        inside = np.isfinite(prior)
        before, after = np.zeros(len(poses)), np.full(len(poses), _IMPOSSIBLE)
        if inside.any():
            after[inside] = self.level(poses[inside])
            if self.reached < 1.0:
                before[inside] = self.previous(poses[inside])
        return prior, before, after

    def log_density(self, state: tuple[Array, Array, Array]) -> Array:
        """Return the log density (n,) of evaluated samples."""
        prior, before, after = state
        return prior + (1.0 - self.reached) * before + self.reached * after


def _nothing(poses: Array) -> Array:
    """Return the log-likelihood (n,) that says nothing of poses (n, 4, 4)."""
    return np.zeros(len(poses))


def _excess(motion: AbstractMotion) -> LogLikelihood:
    """Return what a motion's density holds beyond what is known: nothing, or a proposal."""
    if motion.evidence:
        return _nothing
    return lambda poses: motion.log_density(poses) - motion.log_evidence(poses)


def _move(
    poses: Array, state: tuple[Array, Array, Array], *, blend: _Blend, centre_m: Array, rng: np.random.Generator
) -> None:
    """Move every sample once, in place, by Metropolis steps along differences of other samples.

    Each half of the population moves along differences within the other half (differential evolution), so steps
    take the shape of the posterior whatever it is, and the density is left as it is.
    """
    count = len(poses)
    order = rng.permutation(count)
    halves = order[: count // 2], order[count // 2 :]
    for moving, still in (halves, halves[::-1]):
        first, second = rng.choice(still, len(moving)), rng.choice(still, len(moving))
        # 2.38 / √(2 d) is the best scale for a Gaussian in d = 6 dimensions; shorter ones serve curved posteriors.
        scales = 0.69 * rng.choice([1.0, 0.5, 0.25, 0.1], len(moving))
        jitter = rng.normal(size=(len(moving), 6)) * np.repeat([1e-4, 1e-5], 3)
        proposed = matrices(
            propose(rows(poses[moving]), rows(poses[first]), rows(poses[second]), scales, jitter, centre_m)
        )
        fresh = blend.evaluate(proposed)
        gain = blend.log_density(fresh) - blend.log_density((state[0][moving], state[1][moving], state[2][moving]))
        accept = np.log(rng.random(len(moving))) < gain
        winners = moving[accept]
        poses[winners] = proposed[accept]
        for values, new in zip(state, fresh, strict=True):
            values[winners] = new[accept]


def _distinct(poses: Array) -> float:
    """Return the effective number of motions (n, 4, 4) of which some are copies of others."""
    _, copies = np.unique(poses[:, 0, 3], return_counts=True)
    return len(poses) ** 2 / float(np.sum(copies**2))


def effective_samples(log_weights: Array) -> float:
    """Return Kish's effective sample size of unnormalised log weights (n,)."""
    weights = np.exp(log_weights - np.max(log_weights))
    return float(np.sum(weights) ** 2 / np.sum(weights**2))


def pareto_tail(log_weights: Array) -> float:
    """Return the Pareto tail index of importance weights (Zhang and Stephens 2009; Vehtari et al. 2024)."""
    count = len(log_weights)
    tail = int(min(0.2 * count, 3.0 * np.sqrt(count)))
    if tail < 5:
        return float("nan")
    ordered = np.sort(log_weights - np.max(log_weights))
    excess = np.exp(ordered[-tail:]) - np.exp(ordered[-tail - 1])
    if excess[-1] <= 0.0 or excess[0] <= 0.0:
        return -np.inf  # equal weights have no tail
    grid = 30 + int(np.sqrt(tail))
    quartile = excess[int(tail / 4 + 0.5) - 1]
    theta = 1.0 / excess[-1] + (1.0 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))) / (3.0 * quartile)
    shape = np.mean(np.log1p(-theta[:, None] * excess), axis=1)
    profile = tail * (np.log(-theta / shape) - shape - 1.0)
    weights = 1.0 / np.sum(np.exp(profile - profile[:, None]), axis=1)
    k = float(np.mean(np.log1p(-np.sum(weights * theta) * excess)))
    return (tail * k + 10.0 * 0.5) / (tail + 10.0)


def _largest_step(difference: Array, remaining: float, share: float) -> float:
    """Return the largest step of the exponent that leaves an effective share of the samples."""
    least = share * len(difference)
    if effective_samples(remaining * difference) >= least:
        return remaining
    low, high = 0.0, remaining
    for _ in range(16):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective_samples(middle * difference) > least else (low, middle)
    return min(max(low, 1e-4), remaining)


def _log_mean_exp(values: Array) -> float:
    top = float(np.max(values))
    return top + float(np.log(np.mean(np.exp(values - top))))


def _resample(log_weights: Array, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return `count` indices drawn by systematic resampling."""
    cumulative = np.cumsum(np.exp(log_weights - np.max(log_weights)))
    positions = (np.arange(count) + rng.random()) / count * cumulative[-1]
    return np.minimum(np.searchsorted(cumulative, positions), len(log_weights) - 1)
