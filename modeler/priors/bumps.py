"""Round bumps on SE(3): a mixture of isotropic kernels about given motions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import i0e, i1e

from modeler import se3
from modeler.priors.directions import directions
from modeler.types import AbstractPoseDensity, Array

_NODES = 4097


@dataclass(frozen=True, eq=False)
class KernelMixture(AbstractPoseDensity):
    """A matrix Fisher kernel exp(κ (cos θ - 1)) in the rotation, κ = 1/σ², and a Gaussian in where a point goes.

    The kernel's integral over rotations is 8π² e⁻ᵏ (I₀(κ) - I₁(κ)). It needs no angle, so that many bumps cost little.
    """

    means: Array
    """(k, 4, 4) target_from_source, the middles of the bumps."""
    weights: Array
    """(k,) weight of each, summing to 1."""
    centre_m: Array
    """(3,) point of the source whose whereabouts the Gaussian holds, as beside an object's centroid."""
    sigma_rad: float
    """Standard deviation of the rotation, about each axis."""
    sigma_m: float
    """Standard deviation of the point's place, along each axis."""
    evidence: bool = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""
        middles = self.means[rng.choice(len(self.weights), count, p=self.weights)]
        angles, cumulative = self._angles
        angle_rad = np.interp(rng.random(count), cumulative, angles)
        vectors = np.concatenate([angle_rad[:, None] * directions(count, rng), np.zeros((count, 3))], axis=1)
        poses = middles.copy()
        poses[:, :3, :3] = middles[:, :3, :3] @ se3.exp(vectors)[:, :3, :3]
        place_m = middles[:, :3, :3] @ self.centre_m + middles[:, :3, 3] + rng.normal(0.0, self.sigma_m, (count, 3))
        poses[:, :3, 3] = place_m - poses[:, :3, :3] @ self.centre_m
        return poses

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4)."""
        rotations, places_m = self._flat(target_from_source)
        middle_rotations, middle_places_m = self._flat(self.means)
        # 2 (cos θ - 1) = trace(R_middleᵀ R) - 3, and the trace is a sum over elements.
        exponents = 0.5 * self._concentration * (rotations @ middle_rotations.T - 3.0)
        exponents -= (0.5 / self.sigma_m**2) * (
            np.sum(places_m**2, axis=1)[:, None]
            - 2.0 * places_m @ middle_places_m.T
            + np.sum(middle_places_m**2, axis=1)
        )
        exponents += np.log(self.weights)
        top = exponents.max(axis=1)
        return top + np.log(np.sum(np.exp(exponents - top[:, None]), axis=1)) - self._log_volume

    def _flat(self, motions: Array) -> tuple[Array, Array]:
        """Return rotations (n, 9), and where the point goes (n, 3) from the mean of where it is expected."""
        places_m = motions[:, :3, :3] @ self.centre_m + motions[:, :3, 3]
        # About their mean, so that squares of large places do not cancel.
        return motions[:, :3, :3].reshape(len(motions), 9), places_m - self._middle_m

    @cached_property
    def _middle_m(self) -> Array:
        return np.mean(self.means[:, :3, :3] @ self.centre_m + self.means[:, :3, 3], axis=0)

    @property
    def _concentration(self) -> float:
        return self.sigma_rad**-2.0

    @cached_property
    def _log_volume(self) -> float:
        rotations = 8.0 * np.pi**2 * (i0e(self._concentration) - i1e(self._concentration))
        return float(np.log(rotations) + 1.5 * np.log(2.0 * np.pi * self.sigma_m**2))

    @cached_property
    def _angles(self) -> tuple[Array, Array]:
        """Angles (m,) of the kernel's rotations, and their distribution function (m,)."""
        angles = np.linspace(0.0, min(np.pi, 10.0 * self.sigma_rad), _NODES)
        fall = 2.0 * np.sin(0.5 * angles) ** 2  # 1 - cos θ, which does not cancel
        density = fall * np.exp(-self._concentration * fall)
        cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
        return angles, cumulative / cumulative[-1]
