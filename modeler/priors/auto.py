"""Free motion, or motion on a table: which of the two it is, the images decide."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from modeler.priors.general import GeneralPrior
from modeler.priors.mixtures import Alternatives
from modeler.priors.table import TablePrior, support
from modeler.types import AbstractPoseDensity, AbstractPrior, RayImage

_TABLE_PROBABILITY = 0.5  # even odds; motion on a table is about 12 nats denser than free motion of the same limits


@dataclass(frozen=True)
class AutoPrior(AbstractPrior):
    """A mixture of free motion and of motion on the table, if the views show one.

    Where the images agree with motion on the table, the posterior is as certain as under the table prior; where they
    contradict it, as for an object that is lifted, it is that of free motion.
    """

    free: AbstractPrior = field(default_factory=lambda: GeneralPrior(limits_assumed=True))
    """Of an object that leaves its table, or has none."""
    table: AbstractPrior = field(default_factory=lambda: TablePrior(limits_assumed=True))
    """Of an object that stays on its table."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source."""
        free = self.free.between(source, target)
        if support(source, target) is None:
            return free
        on_table = self.table.between(source, target)
        return Alternatives((on_table, free), np.array([_TABLE_PROBABILITY, 1.0 - _TABLE_PROBABILITY]))

    def relaxed(self, steps: float) -> AutoPrior:
        """Return the prior with limits for several steps."""
        return replace(self, free=self.free.relaxed(steps), table=self.table.relaxed(steps))

    def unlimited(self) -> AutoPrior | None:
        """Return the prior without limits on the motion, where these are assumed."""
        free, table = self.free.unlimited(), self.table.unlimited()
        return None if free is None or table is None else replace(self, free=free, table=table)
