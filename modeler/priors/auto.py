"""Free motion, or motion on a table; the images decide."""

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
    """A mixture of free motion and motion on the table, if the views show one (method, eq. 3.3).

    If the images agree with motion on the table, the posterior is that of the table prior; if they contradict it, as
    for an object that is lifted, it is that of free motion.
    """

    free: AbstractPrior = field(default_factory=lambda: GeneralPrior(limits_assumed=True))
    """Prior of an object that leaves the table, or of one without a table."""
    table: AbstractPrior = field(default_factory=lambda: TablePrior(limits_assumed=True))
    """Prior of an object that stays on the table."""

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
        """Return the prior without limits on the motion, if these are defaults, else None."""
        free, table = self.free.unlimited(), self.table.unlimited()
        return None if free is None or table is None else replace(self, free=free, table=table)
