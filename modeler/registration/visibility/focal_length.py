"""The focal length as a nuisance parameter of a pair, sampled with the pose (method, eq. 10.1 and 10.2)."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from modeler import se3
from modeler.se3 import rows
from modeler.types import Array


class FocalNuisance(NamedTuple):
    """What is known of the focal length, and how poses depend on it."""

    sigma: float = 0.0
    """Standard deviation of the logarithm of the true focal length over that of the views; 0 = it is known."""
    by_focal: Array = np.zeros(6)
    """(6,) derivative of a pose's ξ by that logarithm."""

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Draw logarithms (count,) of focal lengths."""
        return rng.normal(0.0, self.sigma, count) if self.sigma > 0.0 else np.zeros(count)

    def under(self, poses: Array, log_focal: Array) -> Array:
        """Return poses (n, 4, 4) under other focal lengths, given as logarithms (n,) of their factors."""
        return poses @ se3.exp(log_focal[:, None] * self.by_focal) if log_focal.any() else poses


KNOWN: Final = FocalNuisance()
"""A focal length that is known."""


def rows_under(poses: Array, log_focal: Array | None) -> Array:
    """Return the rows (n, 12) of poses (n, 4, 4) for kernels; under logarithms (n,) of focal lengths (n, 13)."""
    if log_focal is None or not log_focal.any():
        return rows(poses)
    return np.column_stack([rows(poses), np.exp(log_focal)])
