"""Turns about an axis in space, as surely as the axis and the angle are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modeler.priors.axis_turn import AxisTurn, angles_and_axes, spread
from modeler.priors.general import centroid_offset
from modeler.priors.table import sample_disc
from modeler.types import AbstractPoseDensity, Array


@dataclass(frozen=True, eq=False)
class Axis:
    """A line in camera coordinates, as surely as it is known."""

    direction: Array
    """(3,) unit."""
    sigma_direction_rad: float
    """Standard deviation of the direction, about each axis across it; infinite: any direction."""
    point_m: Array | None = None
    """(3,) a point of the line; None where its position is not known."""
    sigma_point_m: float = 0.0
    """Standard deviation of the point, along each axis across the line."""


@dataclass(frozen=True, eq=False)
class AboutAxis(AbstractPoseDensity):
    """A turn about an axis that does not shift along it.

    Where the axis lies is read off a motion itself, as well as its rotation shows it, and off what was expected. Where
    its position is not known, the source's centroid comes to lie on a disc across the axis about the target's.
    """

    turn: AxisTurn
    """The rotation."""
    axis: Axis
    """The axis expected."""
    source_centroid_m: Array
    """(3,)."""
    target_centroid_m: Array
    """(3,)."""
    max_shift_m: float
    """Radius of the disc."""
    wobble_m: float
    """Standard deviation of the shift that no turn about the axis makes."""
    evidence: bool = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""
        poses = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
        rotations = self.turn.sample(count, rng)
        poses[:, :3, :3] = rotations
        angle_rad, axes = angles_and_axes(rotations)
        lines, variance = self.turn.line(angle_rad, axes)
        carried, aim = self._anchor
        across = _across(lines, rng)
        if self.axis.point_m is None:
            aside = sample_disc(self.max_shift_m, count, rng)
        else:
            aside = rng.normal(size=(count, 2)) * self._sigma_across_m(angle_rad)[:, None]
        along = rng.normal(size=count) * self._sigma_along_m(variance) + self._lift_m(lines)
        place_m = aim + (aside[:, None] @ across)[:, 0] + along[:, None] * lines
        poses[:, :3, 3] = place_m - rotations @ carried
        return poses

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4); -inf outside."""
        angle_rad, axes = angles_and_axes(target_from_source[:, :3, :3])
        lines, variance = self.turn.line(angle_rad, axes)
        rotation = self.turn.log_density(angle_rad, axes @ self.turn.axis)
        carried, aim = self._anchor
        offset_m = centroid_offset(target_from_source, carried, aim)
        along_m = np.sum(offset_m * lines, axis=1)
        aside_m2 = np.sum(offset_m**2, axis=1) - along_m**2
        sigma_along_m = self._sigma_along_m(variance)
        along = -0.5 * ((along_m - self._lift_m(lines)) / sigma_along_m) ** 2 - np.log(
            np.sqrt(2.0 * np.pi) * sigma_along_m
        )
        if self.axis.point_m is None:
            across = np.where(aside_m2 <= self.max_shift_m**2, -np.log(np.pi * self.max_shift_m**2), -np.inf)
        else:
            sigma_m = self._sigma_across_m(angle_rad)
            across = -0.5 * aside_m2 / sigma_m**2 - np.log(2.0 * np.pi * sigma_m**2)
        return rotation + along + across

    @property
    def _anchor(self) -> tuple[Array, Array]:
        """The point that is carried over, and where it should come to lie."""
        if self.axis.point_m is None:
            return self.source_centroid_m, self.target_centroid_m
        return self.axis.point_m, self.axis.point_m

    def _lift_m(self, lines: Array) -> Array:
        """Return how far (n,) along lines (n, 3) the carried point lies from where it should be: it does not climb."""
        carried, aim = self._anchor
        return lines @ (carried - aim)

    def _sigma_along_m(self, variance: Array) -> Array:
        """Return the standard deviation (n,) along lines of variances (n,) in rad²."""
        if self.axis.point_m is not None:  # points of the axis stay, whatever its direction
            return np.full(len(variance), self.wobble_m)
        return np.sqrt(self.wobble_m**2 + self.max_shift_m**2 * variance)  # a tilted axis lifts what shifts across it

    def _sigma_across_m(self, angle_rad: Array) -> Array:
        """Return the standard deviation (n,) across the axis of where turns by angles (n,) carry its point."""
        return np.sqrt(self.wobble_m**2 + spread(angle_rad) * self.axis.sigma_point_m**2)


def _across(lines: Array, rng: np.random.Generator) -> Array:
    """Return two unit vectors (n, 2, 3) across each of lines (n, 3), their bearing drawn at random."""
    crossed = np.cross(lines, rng.normal(size=lines.shape))
    first = np.asarray(crossed / np.linalg.norm(crossed, axis=1, keepdims=True), dtype=np.float64)
    return np.stack([first, np.cross(lines, first)], axis=1).astype(np.float64)
