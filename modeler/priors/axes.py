"""First principal axes aligned: a guess at the motion of long objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.priors.directions import across_axis, directions_about
from modeler.priors.general import centroid_offset
from modeler.priors.proposal import AbstractProposal, defensive_mixture
from modeler.types import AbstractPoseDensity, Array, RayImage


@dataclass(frozen=True)
class AxesPrior(AbstractProposal):
    """The long axes of the two surfaces come to lie along each other, either way round; it proposes and is no evidence.

    Whatever turns about that axis is left open. Surfaces that are not long say nothing.
    """

    axes_sigma_deg: float = 6.0
    """Standard deviation of the angle between the axes, about each axis across them."""
    axes_sigma_m: float = 0.015
    """Standard deviation of the distance between the centroids, along each axis."""
    min_elongation: float = 1.6
    """Least ratio of the standard deviations along the first principal axis and the second."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source: that of what is known, unless both surfaces are long.

        Raises:
            InputError: where the views lack what `known` needs.
        """
        known = self.known.between(source, target)
        first, second = (long_axis(view.points_m, self.min_elongation) for view in (source, target))
        if first is None or second is None:
            return known
        aligned = Aligned(
            first,
            second,
            source_centroid_m=source.centroid_m,
            target_centroid_m=target.centroid_m,
            sigma_rad=float(np.radians(self.axes_sigma_deg)),
            sigma_m=self.axes_sigma_m,
        )
        return defensive_mixture(known, [aligned])


@dataclass(frozen=True, eq=False)
class Aligned(AbstractPoseDensity):
    """A von Mises-Fisher direction of one axis about another's line, any turn about it, a Gaussian centroid."""

    source_axis: Array
    """(3,) unit."""
    target_axis: Array
    """(3,) unit."""
    source_centroid_m: Array
    """(3,)."""
    target_centroid_m: Array
    """(3,)."""
    sigma_rad: float
    """Standard deviation of the angle between the axes, about each axis across them."""
    sigma_m: float
    """Standard deviation of the distance between the centroids, along each axis."""
    evidence: bool = False

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""
        carried = directions_about(self.target_axis, self.sigma_rad**-2.0, count, rng)
        turn = rng.uniform(0.0, 2.0 * np.pi, count)
        carried *= rng.choice([-1.0, 1.0], (count, 1))
        spun = se3.exp(np.concatenate([turn[:, None] * self.source_axis, np.zeros((count, 3))], axis=1))
        poses = _onto(self.source_axis, carried) @ spun
        place_m = self.target_centroid_m + rng.normal(0.0, self.sigma_m, (count, 3))
        poses[:, :3, 3] = place_m - poses[:, :3, :3] @ self.source_centroid_m
        return poses

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4)."""
        concentration = self.sigma_rad**-2.0
        cosine = np.abs(target_from_source[:, :3, :3] @ self.source_axis @ self.target_axis)
        # The measure of rotations is that of where one axis goes, times the turn about it.
        sphere = np.log(concentration / (-2.0 * np.pi * np.expm1(-2.0 * concentration)))
        either = np.logaddexp(concentration * (cosine - 1.0), -concentration * (cosine + 1.0)) - np.log(2.0)
        offset_m = centroid_offset(target_from_source, self.source_centroid_m, self.target_centroid_m)
        gaussian = -0.5 * np.sum(offset_m**2, axis=1) / self.sigma_m**2 - 1.5 * np.log(2.0 * np.pi * self.sigma_m**2)
        return sphere + either - np.log(2.0 * np.pi) + gaussian


def long_axis(points_m: Array, min_elongation: float) -> Array | None:
    """Return the first principal axis (3,) of points (n, 3); None where they are not that much longer than wide."""
    if len(points_m) < 3:
        return None
    variances, axes = np.linalg.eigh(np.cov(points_m.T))
    long = np.sqrt(variances[2]) >= min_elongation * np.sqrt(max(variances[1], 0.0))
    return np.asarray(axes[:, 2], dtype=np.float64) if long else None


def _onto(axis: Array, directions: Array) -> Array:
    """Return rotations (n, 4, 4) that carry a unit vector (3,) onto unit vectors (n, 3) by the shortest way."""
    crossed = np.cross(axis, directions)
    sine = np.linalg.norm(crossed, axis=1, keepdims=True)
    aside = np.where(sine > 1e-12, crossed / np.maximum(sine, 1e-300), across_axis(axis)[0])
    angle_rad = np.arctan2(sine, (directions @ axis)[:, None])
    return se3.exp(np.concatenate([angle_rad * aside, np.zeros_like(aside)], axis=1))
