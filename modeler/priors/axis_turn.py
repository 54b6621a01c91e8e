"""A turn by about a known angle about an axis whose direction is more or less known: a density on rotations."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.priors.directions import directions_about
from modeler.types import Array

_REACH = 8.0  # standard deviations of the turn that are drawn
_NODES = 4097


@dataclass(frozen=True, eq=False)
class AxisTurn:
    """Wrapped Gaussian turn θ about an axis of von Mises-Fisher direction, plus a small wobble of the bearing.

    A rotation by θ about `a` is also one by -θ about -a; both count, so that the density is smooth on all of SO(3) and
    an axis of wholly unknown direction needs no case of its own. The uniform measure of rotations is 4 sin²(θ/2) dθ da.
    A wobble of σ_w tips the axis by σ_w / (2 sin(θ/2)), the more the smaller the turn; below σ_w it hides the axis
    and keeps the density finite.
    """

    axis: Array
    """(3,) unit; the expected direction, about which turns are right-handed."""
    turn_rad: float
    """Expected turn, of any size."""
    sigma_turn_rad: float
    """Standard deviation of the turn."""
    sigma_axis_rad: float
    """Standard deviation of the axis' direction, about each direction across it; infinite: any direction."""
    sigma_wobble_rad: float
    """Standard deviation of what the rotation does besides turning, about each direction across the axis."""
    either_way: bool = False
    """Whether the sign of the turn is unknown."""

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw rotations (count, 3, 3)."""
        offsets, _, cumulative = self._turns
        turn = self.turn_rad + np.interp(rng.random(count), cumulative, offsets)
        if self.either_way:
            turn = turn * rng.choice([-1.0, 1.0], count)
        concentration = np.maximum(self._concentration(spread(turn)), 1e-9)
        axes = directions_about(self.axis, concentration, count, rng)
        return se3.exp(np.concatenate([turn[:, None] * axes, np.zeros((count, 3))], axis=1))[:, :3, :3]

    def log_density(self, angle_rad: Array, cosine: Array) -> Array:
        """Return the log density (n,) of rotations by angles (n,) in [0, π], by the cosine (n,) of their axis' tilt."""
        measure = spread(angle_rad)
        concentration = np.maximum(self._concentration(measure), 1e-9)
        forth = self._log_turn(angle_rad) + concentration * (cosine - 1.0)
        back = self._log_turn(-angle_rad) - concentration * (cosine + 1.0)
        normaliser = concentration / (-2.0 * np.pi * np.expm1(-2.0 * concentration) * self._share)
        return np.logaddexp(forth, back) + np.log(normaliser / (measure + self.sigma_wobble_rad**2))

    def line(self, angle_rad: Array, axes: Array) -> tuple[Array, Array]:
        """Return how the axes of rotations lie, from what was expected and what the rotations show.

        Args:
            angle_rad: (n,) in [0, π].
            axes: (n, 3) unit.

        Returns:
            (n, 3) unit directions up to their sign, and (n,) their variances in rad².
        """
        shown = spread(angle_rad) / self.sigma_wobble_rad**2
        known = self.sigma_axis_rad**-2.0
        side = np.where(axes @ self.axis < 0.0, -1.0, 1.0)
        lines = known * self.axis + (shown * side)[:, None] * axes
        lengths = np.linalg.norm(lines, axis=1, keepdims=True)
        return np.where(lengths > 0.0, lines / np.maximum(lengths, 1e-300), self.axis), 1.0 / (known + shown + 1.0)

    def _concentration(self, measure: Array) -> Array:
        """Return κ of the axis' direction about the expected one, for turns by their 4 sin²(θ/2)."""
        if np.isinf(self.sigma_axis_rad):
            return np.zeros_like(measure)
        return measure / (self.sigma_axis_rad**2 * measure + self.sigma_wobble_rad**2)

    def _log_turn(self, angle_rad: Array) -> Array:
        """Return the log density (n,) of turns by angles (n,) on the circle."""
        forth = self._log_wrapped(angle_rad - self.turn_rad)
        if not self.either_way:
            return forth
        return np.logaddexp(forth, self._log_wrapped(angle_rad + self.turn_rad)) - np.log(2.0)

    def _log_wrapped(self, offset_rad: Array) -> Array:
        offset = offset_rad - 2.0 * np.pi * np.rint(offset_rad / (2.0 * np.pi))
        turns = int(np.ceil(max(_REACH * self.sigma_turn_rad / (2.0 * np.pi) - 0.5, 0.0)))
        logs = [-0.5 * ((offset + 2.0 * np.pi * k) / self.sigma_turn_rad) ** 2 for k in range(-turns, turns + 1)]
        total = logs[0] if len(logs) == 1 else np.logaddexp.reduce(logs, axis=0)
        return total - np.log(np.sqrt(2.0 * np.pi) * self.sigma_turn_rad)

    @cached_property
    def _turns(self) -> tuple[Array, float, Array]:
        """Offsets of the turn (k,) from the expected, the share that the wobble does not hide, their CDF (k,)."""
        offsets = np.linspace(-_REACH, _REACH, _NODES) * self.sigma_turn_rad
        measure = spread(self.turn_rad + offsets)
        density = np.exp(-0.5 * (offsets / self.sigma_turn_rad) ** 2) * measure / (measure + self.sigma_wobble_rad**2)
        cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
        total = cumulative[-1] * (offsets[1] - offsets[0]) / (np.sqrt(2.0 * np.pi) * self.sigma_turn_rad)
        return offsets, float(total), cumulative / cumulative[-1]

    @property
    def _share(self) -> float:
        return self._turns[1]


def spread(angle_rad: Array) -> Array:
    """Return 4 sin²(θ/2) of angles: the squared distance a turn carries a point at unit distance from its axis."""
    return 4.0 * np.sin(0.5 * angle_rad) ** 2


def angles_and_axes(rotations: Array) -> tuple[Array, Array]:
    """Return the angles (n,) in [0, π] and the axes (n, 3) of rotations (n, 3, 3)."""
    twice_sine = np.stack(
        [
            rotations[:, 2, 1] - rotations[:, 1, 2],
            rotations[:, 0, 2] - rotations[:, 2, 0],
            rotations[:, 1, 0] - rotations[:, 0, 1],
        ],
        axis=1,
    )
    length = np.sqrt(np.sum(twice_sine**2, axis=1))
    twice_cosine = rotations[:, 0, 0] + rotations[:, 1, 1] + rotations[:, 2, 2] - 1.0
    angle_rad = np.arctan2(length, twice_cosine)
    axes = twice_sine / np.maximum(length, 1e-300)[:, None]
    half_turns = (length < 1e-3) & (twice_cosine < 0.0)
    if half_turns.any():  # there the difference of R and its transpose says nothing of the axis
        motions = np.broadcast_to(np.eye(4), (int(half_turns.sum()), 4, 4)).copy()
        motions[:, :3, :3] = rotations[half_turns]
        vectors = se3.log(motions)[:, :3]
        axes[half_turns] = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return angle_rad, axes
