"""Motions that a search has found, each with the surroundings for which it stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.kernels import mixture
from modeler.types import Array, BoolArray


@dataclass(frozen=True, eq=False)
class Candidates:
    """Motions to which matching surface leads, each with a Gaussian for its surroundings."""

    poses: Array
    """(k, 4, 4) target_from_source, best first, coarse ones last."""
    scores: Array
    """(k,) how good they are beside each other (nats)."""
    spreads: Array
    """(k, 6, 6) lower triangular roots of the covariances of ξ about the source's centroid."""

    coarse: BoolArray
    """(k,) whether a candidate stands for the surroundings that surface, blurred, leaves open."""
    beyond: float = -np.inf
    """How much better (nats) than the best is what surface leads to beyond the prior's support."""
    low_overlap: bool = False
    """Whether so little surface matches that places were compared as `Search.low_overlap_points` says."""

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.poses)

    def distances(self, centre_m: Array) -> Array:
        """Return how far they are from each other (k, k), row i in standard deviations of the i-th one's surroundings.

        The distances are of ξ about a point (3,) of the source.
        """
        return mixture.distances(se3.rows(self.poses), self.spreads, centre_m)

    def beside(self, others: Candidates) -> Candidates:
        """Return them and others, in this order."""
        return Candidates(
            np.concatenate([self.poses, others.poses]),
            np.concatenate([self.scores, others.scores]),
            np.concatenate([self.spreads, others.spreads]),
            np.concatenate([self.coarse, others.coarse]),
            self.beyond,
            self.low_overlap,
        )

    def some(self, chosen: npt.NDArray[np.int64] | BoolArray) -> Candidates:
        """Return those chosen by number or by mask."""
        return Candidates(
            self.poses[chosen],
            self.scores[chosen],
            self.spreads[chosen],
            self.coarse[chosen],
            self.beyond,
            self.low_overlap,
        )

    def distinct(self, centre_m: Array, reach: float) -> Candidates:
        """Return one, the first, of each group that lie within each other's reach, in standard deviations."""
        kept: list[int] = []
        left, near = np.ones(len(self), dtype=bool), self.distances(centre_m) <= reach
        for number in range(len(self)):
            if left[number]:
                kept.append(number)
                left &= ~near[number]
        return self.some(np.array(kept, dtype=np.int64))
