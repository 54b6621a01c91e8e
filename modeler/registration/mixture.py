"""Gaussians on SE(3): to draw from, and to weigh what was drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.kernels import mixture
from modeler.se3 import rows
from modeler.types import AbstractPoseDensity, Array


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Weighted Gaussians of ξ, each about a pose of its own."""

    means: Array
    """(k, 4, 4) target_from_source."""
    spreads: Array
    """(k, 6, 6) lower triangular roots of the covariances of ξ about the centre."""
    log_weights: Array
    """(k,) of any sum of exponentials."""
    centre_m: Array
    """(3,) point of the source."""

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4), each Gaussian by its share of the weight."""
        chosen = rng.choice(len(self.means), count, p=np.exp(self.log_weights - self.log_weight))
        xi = np.einsum("nij,nj->ni", self.spreads[chosen], rng.normal(size=(count, 6)))
        return se3.moved(self.means[chosen], xi, self.centre_m)

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log (n,) of the weighted sum of densities at motions (n, 4, 4)."""
        return mixture.log_densities(
            rows(target_from_source), rows(self.means), *self._shapes, self.log_weights, self.centre_m
        )

    def times(self, factor: float) -> Gaussians:
        """Return the same with so many times the weight."""
        return replace(self, log_weights=self.log_weights + np.log(factor))

    def beside(self, other: Gaussians) -> Gaussians:
        """Return them and others about the same centre."""
        return Gaussians(
            np.concatenate([self.means, other.means]),
            np.concatenate([self.spreads, other.spreads]),
            np.concatenate([self.log_weights, other.log_weights]),
            self.centre_m,
        )

    @cached_property
    def log_weight(self) -> float:
        """Log of the sum of the weights."""
        return float(np.logaddexp.reduce(self.log_weights))

    @cached_property
    def _shapes(self) -> tuple[Array, Array]:
        """Upper triangular roots (k, 6, 6) of the precisions; largest variances (k, 2) of rotation and translation.

        With C = U Uᵀ and U upper triangular, a root is U⁻¹.
        """
        covariances = self.spreads @ self.spreads.transpose(0, 2, 1)
        upper = np.linalg.cholesky(covariances[:, ::-1, ::-1])[:, ::-1, ::-1]
        blocks = np.stack([covariances[:, :3, :3], covariances[:, 3:, 3:]], axis=1)
        roots = np.ascontiguousarray(np.triu(np.linalg.inv(upper)), dtype=np.float64)
        return roots, np.ascontiguousarray(np.linalg.eigvalsh(blocks)[:, :, -1], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class MixtureProposal(AbstractPoseDensity):
    """Gaussians that only propose: what is known of the motion is another's."""

    known: AbstractPoseDensity
    """The independent knowledge."""
    gaussians: Gaussians
    """Where to draw."""
    evidence: bool = False

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""
        return self.gaussians.sample(count, rng)

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4)."""
        return self.gaussians.log_density(target_from_source) - self.gaussians.log_weight

    def log_evidence(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of what is independently known of motions (n, 4, 4)."""
        return self.known.log_evidence(target_from_source)
