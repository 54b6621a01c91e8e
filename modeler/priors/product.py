"""Combinations of priors: two that both hold, and free motion or motion on a table, of which the images decide."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from modeler.priors.general import GeneralPrior
from modeler.priors.mixtures import Alternatives, Gaussian, fitted
from modeler.priors.table import TablePrior, support
from modeler.significance import RARE, nats_from_mode
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    Array,
    Edge,
    InputError,
    RayImage,
    SharedAxis,
    Solution,
    checked,
)

_DRAWS = 5000  # samples a round; with half or twice as many, log densities at the truth change by 0.1 nats at most
_FITTED = 1000  # of these, to which a Gaussian is fitted: its standard deviations are then known to 2 %
_ROUNDS = 5  # with 2 or 10, log densities at the truth change by 0.1 nats at most
_GAUSSIAN_SHARE = 0.8
"""Of the samples; the rest, of either factor, keeps weights bounded where the Gaussian is too narrow."""
_INFLATION = 1.3  # factor on the fitted Gaussian's standard deviations, so that weights stay bounded
_OVERSAMPLING = 4
"""Samples drawn for one that is returned; with 2 or 8, log densities at the truth are the same to 0.1 %."""


@checked
@dataclass(frozen=True)
class ProductPrior(AbstractPrior):
    """Two independent priors that both hold, such as a held object on a table."""

    first: AbstractPrior
    """One prior."""
    second: AbstractPrior
    """The other."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        product = multiplied(self.first.between(source, target), self.second.between(source, target), source.centroid_m)
        if product is None:
            raise InputError(
                f"the two priors allow no common motion between frames {source.index} and {target.index}; "
                "give larger sigmas or limits, or only one prior"
            )
        return product

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> ProductPrior:
        return replace(self, first=self.first.learned(solution, edges), second=self.second.learned(solution, edges))

    def following(self, frame: int) -> ProductPrior:
        return replace(self, first=self.first.following(frame), second=self.second.following(frame))

    def shared_axis(self, views: Collection[RayImage]) -> SharedAxis | None:
        return self.first.shared_axis(views) or self.second.shared_axis(views)

    def relaxed(self, steps: float) -> ProductPrior:
        return replace(self, first=self.first.relaxed(steps), second=self.second.relaxed(steps))

    def unlimited(self) -> ProductPrior | None:
        first, second = self.first.unlimited(), self.second.unlimited()
        if first is None and second is None:
            return None
        return replace(self, first=first or self.first, second=second or self.second)


@dataclass(frozen=True, eq=False)
class Product(AbstractPoseDensity):
    """The normalised product of two densities, importance sampled from both and a Gaussian fitted to the product."""

    first: AbstractPoseDensity
    """One density."""
    second: AbstractPoseDensity
    """The other."""
    gaussian: Gaussian
    """The Gaussian fitted to the product."""
    log_volume: float
    """Log of the integral of the product."""

    @property
    def evidence(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether all of the density is evidence."""
        return self.first.evidence and self.second.evidence

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw poses (count, 4, 4), by resampling several times as many."""
        drawn, log_weights = _weighted(self.first, self.second, self.gaussian, _OVERSAMPLING * count + 200, rng)
        return drawn[rng.permutation(resampled(np.exp(log_weights - log_weights.max()), count, rng))]

    def log_density(self, target_from_source: Array) -> Array:
        return (
            self.first.log_density(target_from_source) + self.second.log_density(target_from_source) - self.log_volume
        )

    def log_prior(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of the independent knowledge of both at poses (n, 4, 4)."""
        known = self.first.log_prior(target_from_source) + self.second.log_prior(target_from_source)
        return known - self.log_volume if self.evidence else known


def multiplied(first: AbstractPoseDensity, second: AbstractPoseDensity, centre_m: Array) -> Product | None:
    """Return the product of two densities; None if they are disjoint or contradict each other.

    A Gaussian is fitted to weighted samples of both, then to weighted samples of itself and both (population Monte
    Carlo).

    Args:
        first: one density.
        second: another.
        centre_m: (3,) point of the source whose position the Gaussian describes.
    """
    rng = np.random.default_rng(0)  # equal densities give equal products
    gaussian, log_volume = None, -np.inf
    for _ in range(_ROUNDS):
        drawn, log_weights = _weighted(first, second, gaussian, _DRAWS, rng)
        top = log_weights.max()
        if not np.isfinite(top):
            return None
        weights = np.exp(log_weights - top)
        log_volume = float(top + np.log(weights.mean()))
        chosen = drawn[resampled(weights, _FITTED, rng)]
        gaussian = fitted(chosen, np.full(_FITTED, 1.0 / _FITTED), centre_m, _INFLATION)
    assert gaussian is not None
    product = Product(first, second, gaussian, log_volume)
    drawn = product.sample(_FITTED, rng)
    for part in (first, second):
        usual, here = (np.median(part.log_density(poses)) for poses in (part.sample(_FITTED, rng), drawn))
        if here < usual - nats_from_mode(RARE):
            return None
    return product


def resampled(weights: Array, count: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """Return `count` indices in proportion to weights (n,), by systematic resampling."""
    cumulative = np.cumsum(weights)
    positions = (np.arange(count) + rng.random()) / count * cumulative[-1]
    return np.minimum(np.searchsorted(cumulative, positions), len(weights) - 1)


def _weighted(
    first: AbstractPoseDensity,
    second: AbstractPoseDensity,
    gaussian: Gaussian | None,
    count: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Draw motions (n, 4, 4) from two densities and a Gaussian, with log weights (n,) for the product of the two."""
    parts: list[tuple[AbstractPoseDensity, float]] = [(first, 0.5), (second, 0.5)]
    if gaussian is not None:
        rest = 0.5 * (1.0 - _GAUSSIAN_SHARE)
        parts = [(first, rest), (second, rest), (gaussian, _GAUSSIAN_SHARE)]
    drawn = np.concatenate([part.sample(int(np.ceil(share * count)), rng) for part, share in parts])
    logs = [part.log_density(drawn) for part, _ in parts]
    mixture = np.logaddexp.reduce([log + np.log(share) for log, (_, share) in zip(logs, parts, strict=True)], axis=0)
    return drawn, logs[0] + logs[1] - mixture


@dataclass(frozen=True)
class AutoPrior(AbstractPrior):
    """A mixture of free motion and motion on the table, if the views show one (method, eq. 3.3).

    If the images agree with motion on the table, the posterior is that of the table prior; if they contradict it, as
    for an object that is lifted, it is that of free motion.
    """

    free: AbstractPrior = field(default_factory=lambda: GeneralPrior(limits_assumed=True))
    """Prior of an object that leaves the table, or of one without a table."""
    table: AbstractPrior = field(default_factory=lambda: TablePrior(limits_assumed=True))
    """Prior of an object that stays on the table."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        free = self.free.between(source, target)
        if support(source, target) is None:
            return free
        on_table = self.table.between(source, target)
        # Even odds: motion on a table is about 12 nats denser than free motion of the same limits.
        return Alternatives((on_table, free), np.array([0.5, 0.5]))

    def relaxed(self, steps: float) -> AutoPrior:
        return replace(self, free=self.free.relaxed(steps), table=self.table.relaxed(steps))

    def unlimited(self) -> AutoPrior | None:
        free, table = self.free.unlimited(), self.table.unlimited()
        return None if free is None or table is None else replace(self, free=free, table=table)
