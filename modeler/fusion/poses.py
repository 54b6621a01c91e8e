"""How far poses err on their own, as fusion needs to know it."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from modeler.types import Array, Solution


def own_covariances(solution: Solution) -> Mapping[int, Array]:
    """Return by frame number the covariance (6, 6) of each pose against the pose it is surest of beside it.

    Views that see the same surface are neighbours. What they err by together, drift since the first frame, does not
    tell which of them is right; what each errs by on its own does. Empty for less than two frames.
    """
    frames = sorted(solution.trajectory)
    found: dict[int, Array] = {}
    for before, after in pairwise(frames):
        for one, other in ((before, after), (after, before)):
            covariance = solution.relative_covariance(other, one)
            if one not in found or np.trace(covariance) < np.trace(found[one]):
                found[one] = covariance
    return found
