"""What is searched, and the candidates that a search finds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.kernels import mixture
from modeler.registration.visibility.likelihood import PairLikelihood
from modeler.types import AbstractPoseDensity, Array, BoolArray, PoseGaussian

_MODE_DISTANCE = 3.5  # standard deviations between neighbouring candidates of one mode


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses found by the search, each with a Gaussian of its surroundings."""

    poses: Array
    """(k, 4, 4) target_from_source, best first."""
    scores: Array
    """(k,) tempered log-likelihoods (nats)."""
    spreads: Array
    """(k, 6, 6) lower triangular roots of the covariances of ξ about the source's centroid (method.md, eq. 11)."""
    beyond_gain: float = -np.inf
    """How much better (nats) than the best candidate a pose beyond the prior's support is."""

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self.poses)

    def distances(self, centre_m: Array) -> Array:
        """Return distances (k, k) of ξ about a point (3,), row i in standard deviations of candidate i."""
        return mixture.mahalanobis_distances(se3.rows(self.poses), self.spreads, centre_m)

    def select(self, chosen: npt.NDArray[np.int64] | BoolArray) -> Candidates:
        """Return candidates by index or mask."""
        return replace(
            self,
            poses=self.poses[chosen],
            scores=self.scores[chosen],
            spreads=self.spreads[chosen],
        )

    def modes(self, centre_m: Array) -> list[Candidates]:
        """Return the candidates by mode, the best mode first.

        Two candidates share a mode where a chain of candidates connects them, each link within 3.5 standard deviations
        of both its ends. A ridge, such as the spin of a can, is one mode.
        """
        near = self.distances(centre_m) <= _MODE_DISTANCE
        linked = near & near.T
        label = np.arange(len(self))
        for number in range(len(self)):  # connected components, each labelled by its best candidate
            neighbours = np.unique(label[linked[number]])
            label[np.isin(label, neighbours)] = neighbours[0]
        return [self.select(label == name) for name in np.unique(label)]


@dataclass(frozen=True, eq=False)
class Problem:
    """What is searched: the likelihood of a pair within a prior."""

    pair: PairLikelihood
    density: AbstractPoseDensity
    """The prior."""
    gaussian: PoseGaussian
    """Mean and covariance of the prior, of ξ about the pair's centre."""
    basin: Array
    """Standard deviations (6,) of a basin of attraction."""

    def possible(self, poses: Array) -> BoolArray:
        """Return whether (n,) poses (n, 4, 4) are in the prior's support."""
        return np.isfinite(self.density.log_evidence(poses))

    def spreads(self, poses: Array, blur_m: float) -> Array:
        """Return roots (n, 6, 6) of covariances from matching surface and the prior (method.md, eq. 11)."""
        _, matrices = self.pair.normal_equations(poses, blur_m, stride=2)
        held = self.pair.temper * matrices + np.linalg.inv(self.gaussian.covariance)
        return np.asarray(np.linalg.cholesky(np.linalg.inv(held)), dtype=np.float64)
