"""What is called chance: the probabilities, standard deviations and counts by which tests and gates decide."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import chdtri

OUTSIDE: Final = 0.05
"""Probability of an error that may remain of a pose: the complement of 95 % regions."""
UNLIKELY: Final = 0.01
"""Probability of chance below which a test of a single thing takes it for none: by convention."""
SELDOM: Final = 1e-3
"""The same of a test of a whole run, or of what each of its edges has to pass."""
RARE: Final = 1e-6
"""The same of a test of each pair or solution: one of 100 runs of 100 of them fails by chance."""
SIGMAS: Final = 3.0
"""Standard deviations beyond which noise hardly reaches: 3 of 1,000 normal errors."""
QUORUM: Final = 3
"""Observations that confirm each other: two may agree by chance."""


def radius(probability: float) -> float:
    """Return the Mahalanobis distance that the error of a pose exceeds with a probability: the root of χ²₆."""
    return float(np.sqrt(chdtri(6, probability)))


def nats_from_mode(probability: float) -> float:
    """Return how far below its mode, in nats, the density of a Gaussian of a pose is at that distance."""
    return 0.5 * float(chdtri(6, probability))
