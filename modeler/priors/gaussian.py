"""A Gaussian of any shape on SE(3), in the rotation and in where a point goes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.types import AbstractPoseDensity, Array


@dataclass(frozen=True, eq=False)
class Gaussian(AbstractPoseDensity):
    """`mean`'s rotation · exp(ω), and the place of a point: (ω, place - expected) ~ N(0, covariance)."""

    mean: Array
    """(4, 4) target_from_source."""
    covariance: Array
    """(6, 6) of the rotation vector in rad, then of the point's place in m, in target coordinates."""
    centre_m: Array
    """(3,) that point of the source."""
    evidence: bool = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""
        deviation = rng.normal(size=(count, 6)) @ self._root.T
        poses = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
        turn = se3.exp(np.concatenate([deviation[:, :3], np.zeros((count, 3))], axis=1))
        poses[:, :3, :3] = self.mean[:3, :3] @ turn[:, :3, :3]
        poses[:, :3, 3] = self._place_m + deviation[:, 3:] - poses[:, :3, :3] @ self.centre_m
        return poses

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4)."""
        deviation = self.deviations(target_from_source)
        whitened = np.asarray(np.linalg.solve(self._root, deviation.T), dtype=np.float64)
        half_rad = 0.5 * np.sqrt(np.sum(deviation[:, :3] ** 2, axis=1))
        # The uniform measure of rotations is (sin(θ/2) / (θ/2))² dω.
        measure = 2.0 * np.log(np.sinc(half_rad / np.pi))
        log_density = -0.5 * np.sum(whitened**2, axis=0) - measure - self._log_volume
        return np.asarray(log_density, dtype=np.float64)

    def deviations(self, target_from_source: Array) -> Array:
        """Return rotation vectors and places (n, 6) of motions (n, 4, 4), from the mean's."""
        turn = np.broadcast_to(np.eye(4), target_from_source.shape).copy()
        turn[:, :3, :3] = self.mean[:3, :3].T @ target_from_source[:, :3, :3]
        place_m = target_from_source[:, :3, :3] @ self.centre_m + target_from_source[:, :3, 3]
        return np.concatenate([se3.log(turn)[:, :3], place_m - self._place_m], axis=1)

    @cached_property
    def _root(self) -> Array:
        return np.asarray(np.linalg.cholesky(self.covariance), dtype=np.float64)

    @cached_property
    def _place_m(self) -> Array:
        return self.mean[:3, :3] @ self.centre_m + self.mean[:3, 3]

    @cached_property
    def _log_volume(self) -> float:
        return float(3.0 * np.log(2.0 * np.pi) + np.sum(np.log(np.diag(self._root))))


def fitted(motions: Array, weights: Array, centre_m: Array, spread: float = 1.0) -> Gaussian:
    """Return the Gaussian of weighted motions (n, 4, 4), its standard deviations scaled by `spread`.

    Args:
        motions: (n, 4, 4).
        weights: (n,), summing to 1.
        centre_m: (3,) point of the source whose place is told.
        spread: more than 1 for a proposal that is to cover them.
    """
    mean, _ = se3.mean(motions, weights, about_m=centre_m)
    deviation = Gaussian(mean, np.eye(6), centre_m).deviations(motions)
    offset = weights @ deviation
    mean[:3, 3] += offset[3:]
    deviation -= np.concatenate([np.zeros(3), offset[3:]])
    covariance = (weights[:, None] * deviation).T @ deviation
    floor = np.diag(np.repeat([1e-5, 1e-6], 3) ** 2)
    return Gaussian(mean, spread**2 * (covariance + floor), centre_m)
