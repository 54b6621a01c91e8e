"""The object stays on its support: it turns about the plane's normal and shifts in the plane (paper, section IV)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modeler.priors.general import relaxed_limits
from modeler.priors.on_plane import WOBBLE_DEG, WOBBLE_M, OnPlane, on_plane
from modeler.types import AbstractPoseDensity, AbstractPrior, Array, RayImage


@dataclass(frozen=True)
class TablePrior(AbstractPrior):
    """Motion in the support plane, as surely as the plane is known."""

    max_rotation_deg: float = 50.0
    """Largest rotation about the plane's normal between the two views."""
    max_shift_m: float = 0.05
    """Largest distance, in the plane, between the target's centroid and the source's, carried over."""
    sigma_tilt_deg: float = WOBBLE_DEG
    """Standard deviation of the rotation out of the plane, on top of the plane's own uncertainty."""
    sigma_height_m: float = WOBBLE_M
    """Standard deviation of the motion along the normal, on top of the plane's own uncertainty."""

    def between(self, source: RayImage, target: RayImage) -> TableDensity:
        """Return the density of target_from_source.

        Raises:
            InputError: where neither view shows a support plane.
        """
        limit_rad = float(np.radians(self.max_rotation_deg))
        plane = on_plane(
            source,
            target,
            turn_rad=limit_rad,
            shift_m=self.max_shift_m,
            sigma_tilt_rad=np.radians(self.sigma_tilt_deg),
            sigma_lift_m=self.sigma_height_m,
        )
        return TableDensity(plane, limit_rad, self.max_shift_m)

    def relaxed(self, steps: float) -> TablePrior:
        """Return the prior whose limits hold for several steps; what ties the motion to the plane stays."""
        rotation_deg, shift_m = relaxed_limits(self.max_rotation_deg, self.max_shift_m, steps)
        return replace(self, max_rotation_deg=rotation_deg, max_shift_m=shift_m)


@dataclass(frozen=True, eq=False)
class TableDensity(AbstractPoseDensity):
    """Uniform turn and shift in a plane, Gaussian tilt and lift out of it."""

    plane: OnPlane
    """Where the object stands."""
    max_rotation_rad: float
    """Largest turn from the middle, either way."""
    max_shift_m: float
    """Radius of the disc, in the plane, of where the target's centroid lies from the source's, carried over."""
    middle_rad: float = 0.0
    """The turn from which the limit counts."""
    evidence: bool = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""
        turn_rad = self.middle_rad + rng.uniform(-self.max_rotation_rad, self.max_rotation_rad, count)
        return self.plane.motions(turn_rad, sample_disc(self.max_shift_m, count, rng), rng)

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4); -inf outside."""
        turn_rad, shift_m, out_of_plane = self.plane.coordinates(target_from_source)
        turn_rad = np.abs(np.remainder(turn_rad - self.middle_rad + np.pi, 2.0 * np.pi) - np.pi)
        inside = (turn_rad <= self.max_rotation_rad) & (np.sum(shift_m**2, axis=1) <= self.max_shift_m**2)
        uniform = -np.log(2.0 * self.max_rotation_rad * np.pi * self.max_shift_m**2)
        return np.where(inside, out_of_plane + uniform, -np.inf)


def sample_disc(radius_m: float, count: int, rng: np.random.Generator) -> Array:
    """Draw points (count, 2) evenly over a disc about the origin."""
    distance_m = radius_m * np.sqrt(rng.random((count, 1)))
    bearing = rng.uniform(0.0, 2.0 * np.pi, count)
    return distance_m * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
