"""What may be known of one motion before the images are compared."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from modeler.types.arrays import Array


class AbstractPoseDensity(ABC):
    """What is known of one motion `target_from_source` before the images are compared: a density on SE(3)."""

    evidence: bool
    """True: independent knowledge that belongs in the edge. False: only proposes where to look."""

    @abstractmethod
    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""

    @abstractmethod
    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4) with respect to the uniform measure; -inf outside."""

    def log_evidence(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of what is independently known, the part of a motion that belongs in an edge.

        All of the density where it is evidence; where it only proposes, 0 within its support and -inf outside.
        """
        log_density = self.log_density(target_from_source)
        return log_density if self.evidence else np.where(np.isfinite(log_density), 0.0, -np.inf)
