"""Where to sample: Gaussians around the candidates of a search, over what is known of the motion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.kernels import mixture
from modeler.se3 import rows
from modeler.types import AbstractMotion, Array


@dataclass(frozen=True, eq=False)
class MixtureMotion(AbstractMotion):
    """A mixture of Gaussians on SE(3) that only proposes: what is known of the motion is another's."""

    known: AbstractMotion
    """The independent knowledge."""
    means: Array
    """(k, 4, 4) target_from_source."""
    spreads: Array
    """(k, 6, 6) lower triangular roots of the covariances of ξ about the centre."""
    log_weights: Array
    """(k,) of any sum of exponentials."""
    centre_m: Array
    """(3,) point of the source."""
    evidence: bool = False

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""
        chosen = rng.choice(len(self.means), count, p=np.exp(self._log_shares))
        xi = (self.spreads[chosen] @ rng.normal(size=(count, 6, 1)))[:, :, 0]
        return se3.moved(self.means[chosen], xi, self.centre_m)

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4)."""
        return mixture.log_densities(
            rows(target_from_source), rows(self.means), self._roots, self._log_shares, self.centre_m
        )

    def log_evidence(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of what is independently known of motions (n, 4, 4)."""
        return self.known.log_evidence(target_from_source)

    @cached_property
    def _log_shares(self) -> Array:
        top = self.log_weights.max()
        return self.log_weights - top - np.log(np.sum(np.exp(self.log_weights - top)))

    @cached_property
    def _roots(self) -> Array:
        """Upper triangular roots (k, 6, 6) of the precisions: with C = U Uᵀ and U upper triangular, U⁻¹."""
        flipped = (self.spreads @ self.spreads.transpose(0, 2, 1))[:, ::-1, ::-1]
        upper = np.linalg.cholesky(flipped)[:, ::-1, ::-1]
        return np.ascontiguousarray(np.triu(np.linalg.inv(upper)), dtype=np.float64)
