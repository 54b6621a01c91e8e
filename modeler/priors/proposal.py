"""Guesses at a motion that only tell where to look: they guide a sampler within what is independently known."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modeler.priors.general import GeneralPrior
from modeler.types import AbstractPoseDensity, AbstractPrior, Array, Edge, RayImage, SharedAxis, Solution

_TRIED = 4096  # draws by which the share of a guess within the support is told
_LEAST_SHARE = 0.01  # a guess with less of its mass within the support is of no use
_ROOM_DEG = 5.0  # for a guess that is sure: limits are there to look within, not to cut off


@dataclass(frozen=True)
class AbstractProposal(AbstractPrior):
    """A prior that only tells where to look, within another that is evidence and alone learns, grows or has an axis."""

    known: AbstractPrior = field(default_factory=GeneralPrior)
    """What is independently known of motions."""

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> AbstractPrior:
        """Return the prior over what is known by now."""
        return replace(self, known=self.known.learned(solution, edges))

    def shared_axis(self, views: Collection[RayImage]) -> SharedAxis | None:
        """Return the axis that all steps share, as what is known has it."""
        return self.known.shared_axis(views)

    def relaxed(self, steps: float) -> AbstractPrior:
        """Return the prior within limits that hold for several steps."""
        return replace(self, known=self.known.relaxed(steps))


@dataclass(frozen=True, eq=False)
class DefensiveMixture(AbstractPoseDensity):
    """A mixture of guesses and what is known, within the support of the latter, which alone is evidence.

    The guesses' density is part of the mixture's, so that weights `exp(log_evidence - log_density)` take it out again.
    The share that stays with what is known bounds those weights however wrong the guesses are (a defensive mixture).
    """

    known: AbstractPoseDensity
    """What is independently known, if only its limits."""
    proposals: tuple[AbstractPoseDensity, ...]
    """Where the motion may be."""
    inside: Array
    """(k,) share of each guess' mass within the support of what is known."""
    share: float
    """Share (0..1) of all guesses together in the mixture; equal among them."""
    evidence: bool = False

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""
        part = rng.integers(len(self.proposals), size=count)
        part[rng.random(count) >= self.share] = -1
        poses = np.empty((count, 4, 4))
        of_known = part < 0
        poses[of_known] = self.known.sample(int(of_known.sum()), rng)
        for number, guess in enumerate(self.proposals):
            places = np.flatnonzero(part == number)
            while len(places):  # each round places a share `inside` of what is left, at least one percent
                drawn = guess.sample(len(places), rng)
                fits = np.isfinite(self.known.log_density(drawn))
                poses[places[fits]] = drawn[fits]
                places = places[~fits]
        return poses

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4); -inf outside what is known."""
        total = self.known.log_density(target_from_source)
        fits = np.isfinite(total)
        poses = target_from_source if fits.all() else target_from_source[fits]
        mixed = total[fits] + np.log1p(-self.share)
        for guess, inside in zip(self.proposals, self.inside, strict=True):
            log_share = np.log(self.share / (len(self.proposals) * inside))
            mixed = np.logaddexp(mixed, guess.log_density(poses) + log_share)
        total[fits] = mixed
        return total

    def log_evidence(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of what is independently known."""
        return self.known.log_evidence(target_from_source)


def reach_deg(sigma_deg: float) -> float:
    """Return how far limits reach from a guess of a standard deviation, where it only tells where to look."""
    return min(4.0 * sigma_deg + _ROOM_DEG, 180.0)


def defensive_mixture(
    known: AbstractPoseDensity, proposals: Sequence[AbstractPoseDensity], share: float = 0.8
) -> AbstractPoseDensity:
    """Return what is known, guided by those guesses that lie within its support; itself where none does.

    Args:
        known: what is independently known, if only its limits.
        proposals: where the motion may be.
        share: of all guesses together in the mixture, 0 to 1.
    """
    rng = np.random.default_rng(0)  # the same guesses have the same density, whoever asks
    shares = [float(np.mean(np.isfinite(known.log_density(guess.sample(_TRIED, rng))))) for guess in proposals]
    useful = [number for number, inside in enumerate(shares) if inside >= _LEAST_SHARE]
    if not useful:
        return known
    return DefensiveMixture(
        known, tuple(proposals[number] for number in useful), np.array([shares[n] for n in useful]), share
    )
