"""What is usual where nothing is told: motions are small, and an object on a table mostly stays on it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from modeler.priors.general import GeneralPrior
from modeler.priors.mixtures import Alternatives
from modeler.priors.table import TablePrior, support
from modeler.types import AbstractPoseDensity, AbstractPrior, Array, RayImage

_STAYS = 0.5  # nobody said either; the images decide, as motion on a table is some 12 nats denser than free motion


@dataclass(frozen=True)
class UsualPrior(AbstractPrior):
    """Free motion, or motion on the table that the views show; which of the two it was, the images decide."""

    free: AbstractPrior = field(default_factory=lambda: GeneralPrior(limits_assumed=True))
    """What is known of an object that leaves its table, or has none."""
    table: AbstractPrior = field(default_factory=lambda: TablePrior(limits_assumed=True))
    """What is known of one that stays on it."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source."""
        free = self.free.between(source, target)
        if support(source, target) is None:
            return free
        return Alternatives((self.table.between(source, target), free), np.array([_STAYS, 1.0 - _STAYS]))

    def doubts(self, motion: Array, source: RayImage, target: RayImage) -> bool:
        """Return whether a motion leaves the table, which is as unusual as a large motion on it."""
        if support(source, target) is None:
            return False
        table, free = (prior.between(source, target).log_density(motion[None]) for prior in (self.table, self.free))
        return bool(table[0] < free[0])

    def relaxed(self, steps: float) -> UsualPrior:
        """Return the prior with limits for several steps."""
        return replace(self, free=self.free.relaxed(steps), table=self.table.relaxed(steps))

    def unlimited(self) -> UsualPrior | None:
        """Return the prior without limits on the motion, where these are assumed."""
        free, table = self.free.unlimited(), self.table.unlimited()
        return None if free is None or table is None else replace(self, free=free, table=table)
