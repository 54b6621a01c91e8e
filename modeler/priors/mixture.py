"""One of several pieces of knowledge holds, nobody knows which: the mixture of their densities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modeler.types import AbstractMotion, AbstractPrior, Array, Edge, RayImage, Solution


@dataclass(frozen=True)
class MixturePrior(AbstractPrior):
    """Either of two priors holds: on the table, unless somebody picks the object up.

    Knowledge and a mere guess do not mix so: give the guess (velocity, axes, features) what is known as its `known`.
    """

    first: AbstractPrior
    """One, which is evidence."""
    second: AbstractPrior
    """The other, which is evidence."""
    first_share: float = 0.5
    """How probable (0..1) the first is."""

    def between(self, source: RayImage, target: RayImage) -> Mixture:
        """Return the density of target_from_source.

        Raises:
            InputError: where one of the two does not apply.
        """
        return Mixture(self.first.between(source, target), self.second.between(source, target), self.first_share)

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> MixturePrior:
        """Return the mixture of what both learnt."""
        return replace(self, first=self.first.learned(solution, edges), second=self.second.learned(solution, edges))

    def grown(self, steps: float) -> MixturePrior:
        """Return the mixture with limits that hold for several steps."""
        return replace(self, first=self.first.grown(steps), second=self.second.grown(steps))


@dataclass(frozen=True, eq=False)
class Mixture(AbstractMotion):
    """The weighted sum of two densities."""

    first: AbstractMotion
    second: AbstractMotion
    first_share: float
    """Weight (0..1) of the first."""
    evidence: bool = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""
        of_first = rng.random(count) < self.first_share
        poses = np.empty((count, 4, 4))
        poses[of_first] = self.first.sample(int(of_first.sum()), rng)
        poses[~of_first] = self.second.sample(int((~of_first).sum()), rng)
        return poses

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4); -inf outside both."""
        return self._sum(self.first.log_density(target_from_source), self.second.log_density(target_from_source))

    def log_evidence(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of what is independently known."""
        return self._sum(self.first.log_evidence(target_from_source), self.second.log_evidence(target_from_source))

    def _sum(self, first: Array, second: Array) -> Array:
        return np.logaddexp(first + np.log(self.first_share), second + np.log1p(-self.first_share))
