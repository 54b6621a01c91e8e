"""The general prior: bounded rotation and offset between neighbouring views (paper, section IV)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from modeler import se3
from modeler.priors.mixtures import directions
from modeler.types import AbstractPoseDensity, AbstractPrior, Array, RayImage, checked
from modeler.types.base import MAX_LENGTH_M, check_parameters

_SMALL_DEG = 30.0
"""Turn up to which the limit of the centroids' offset is used as given: more than the usual step of 25°."""
LARGE_DEG = 75.0  # a sphere turned so far shows (1 + cos 75°) / 2 = 63 % of its surface seen before
_OFFSET_SHARE = 0.75  # of the object's size: 4 to 6 cm for boxes, bottles and caps of 15 to 20 cm on a turntable
_LEAST_SIZE_M = 1e-3  # of an object: that of a single point is 0
_MARGIN_DEG = 5.0  # of limits around confident proposals: they bound the search, and must not truncate the posterior


@checked
@dataclass(frozen=True)
class GeneralPrior(AbstractPrior):
    """Any rotation up to a limit, with the centroids of the two surfaces close to each other."""

    max_rotation_deg: float = 50.0  # two of the usual steps of 25°
    """Largest rotation between the two views."""
    max_offset_m: float | None = None
    """Largest distance between the target's centroid and the source's, transformed; None: 0.75 of the object's size."""
    limits_assumed: bool = False
    """Whether the limits are defaults: if nothing within them matches, any motion is possible."""
    steps: float = 1.0
    """Number of steps of a motion, at least 1: offsets add up."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_parameters(self)

    def between(self, source: RayImage, target: RayImage) -> GeneralDensity:
        offset_m = offset_limit_m(self.max_offset_m, self.steps, source, target)
        return GeneralDensity(source.centroid_m, target.centroid_m, np.deg2rad(self.max_rotation_deg), offset_m)

    def relaxed(self, steps: float) -> GeneralPrior:
        rotation_deg = relaxed_rotation_deg(self.max_rotation_deg, steps)
        return replace(self, max_rotation_deg=rotation_deg, steps=steps * self.steps)

    def unlimited(self) -> AnyMotion | None:
        return AnyMotion() if self.limits_assumed else None


@dataclass(frozen=True)
class AnyMotion(AbstractPrior):
    """Any rotation; the offset of the centroids is limited by the object's size."""

    max_offset: float = 2.0
    """Largest distance between the target's centroid and the source's, transformed, in units of the object's size.

    The centroids of opposite sides of a ball are 1.2 sizes apart, those of the end and the side of a rod 1.7.
    """

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_parameters(self)

    def between(self, source: RayImage, target: RayImage) -> GeneralDensity:
        return GeneralDensity(source.centroid_m, target.centroid_m, np.pi, self.reach_m(source, target))

    def reach_m(self, source: RayImage, target: RayImage) -> float:
        """Return the largest distance of the centroids."""
        return min(self.max_offset * max(source.size_m, target.size_m, _LEAST_SIZE_M), MAX_LENGTH_M)


@dataclass(frozen=True, eq=False)
class GeneralDensity(AbstractPoseDensity):
    """Uniform over rotations up to a limit and over a ball of centroid offsets."""

    source_centroid_m: Array
    """(3,)."""
    target_centroid_m: Array
    """(3,)."""
    max_rotation_rad: float
    """Largest angle of the rotation from `middle`."""
    max_offset_m: float
    """Largest distance between the target's centroid and the source's, transformed."""
    middle: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3) central rotation."""

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        angle = sample_angles(self.max_rotation_rad, count, rng)
        offset_m = directions(count, rng) * self.max_offset_m * rng.random((count, 1)) ** (1 / 3)
        motion = se3.exp(np.concatenate([angle[:, None] * directions(count, rng), np.zeros((count, 3))], axis=1))
        motion[:, :3, :3] = motion[:, :3, :3] @ self.middle
        motion[:, :3, 3] = self.target_centroid_m + offset_m - motion[:, :3, :3] @ self.source_centroid_m
        return motion

    def log_density(self, target_from_source: Array) -> Array:
        trace = np.einsum("nij,ij->n", target_from_source[:, :3, :3], self.middle)  # of the rotation from the middle
        offset_m = centroid_offset(target_from_source, self.source_centroid_m, self.target_centroid_m)
        inside = (trace >= 1.0 + 2.0 * np.cos(self.max_rotation_rad) - 1e-9) & (
            np.sum(offset_m**2, axis=1) <= self.max_offset_m**2
        )
        # The uniform measure of rotations up to an angle a is 8π (a - sin a), in units of rad³ at the identity.
        rotations = 8.0 * np.pi * (self.max_rotation_rad - np.sin(self.max_rotation_rad))
        offsets = 4.0 / 3.0 * np.pi * self.max_offset_m**3
        return np.where(inside, -np.log(rotations * offsets), -np.inf)


def relaxed_rotation_deg(max_rotation_deg: float, steps: float) -> float:
    """Return the limit of the rotation in degrees for a number of steps (at least 1).

    It is capped, as views farther apart share too little surface to be registered.
    """
    return max(max_rotation_deg, min(steps * max_rotation_deg, LARGE_DEG))


def offset_limit_m(max_offset_m: float | None, steps: float, source: RayImage, target: RayImage) -> float:
    """Return the limit of the centroids' offset in m.

    Args:
        max_offset_m: the limit of one step; None: a share of the object's size.
        steps: number of steps, at least 1.
        source: one view.
        target: another.
    """
    if max_offset_m is None:
        max_offset_m = _OFFSET_SHARE * max(source.size_m, target.size_m, _LEAST_SIZE_M)
    return min(steps * max_offset_m, MAX_LENGTH_M)


def turned_offset_m(max_offset_m: float, turn_rad: float) -> float:
    """Return the limit of the centroids' offset in m for a turn of any size; up to 30 degrees, the limit as given.

    The centroid of the visible surface lies in front of the object's centre, so that a turn by θ separates two of them
    by a chord proportional to 2 sin(θ/2).
    """
    turn_rad = np.clip(abs(np.remainder(turn_rad + np.pi, 2.0 * np.pi) - np.pi), *np.radians([_SMALL_DEG, LARGE_DEG]))
    chord = np.sin(turn_rad / 2.0) / np.sin(np.radians(_SMALL_DEG) / 2.0)
    return min(float(chord) * max_offset_m, MAX_LENGTH_M)


def sample_angles(limit_rad: float, count: int, rng: np.random.Generator) -> Array:
    """Draw angles (count,) of rotations that are uniform on SO(3) up to a limit: density ∝ 1 - cos(angle)."""
    angle = np.linspace(0.0, limit_rad, 4096)
    return np.interp(rng.random(count), (angle - np.sin(angle)) / (limit_rad - np.sin(limit_rad)), angle)


def centroid_offset(target_from_source: Array, source_centroid_m: Array, target_centroid_m: Array) -> Array:
    """Return the offsets (n, 3) in m of the source's centroid, transformed, from the target's."""
    return target_from_source[:, :3, :3] @ source_centroid_m + target_from_source[:, :3, 3] - target_centroid_m


def reach_deg(sigma_deg: float) -> float:
    """Return the half-width of limits around a proposal with a standard deviation, in degrees."""
    return min(4.0 * sigma_deg + _MARGIN_DEG, 180.0)
