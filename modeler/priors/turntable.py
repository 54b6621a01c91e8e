"""The turntable prior: a commanded step about an axis that is given, the table's normal, or learned."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from modeler import se3
from modeler.priors.common_axis import UNDECIDED, Axis, common_axis, turn_sense
from modeler.priors.general import GeneralPrior, centroid_offset, offset_limit_m, reach_deg, turned_offset_m
from modeler.priors.mixtures import NODES, defensive_mixture, directions_about
from modeler.priors.table import WOBBLE_DEG, WOBBLE_M, TablePrior, no_plane, sample_disc, support
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    Array,
    Edge,
    Plane,
    Posterior,
    RayImage,
    SharedAxis,
    Solution,
    checked,
)
from modeler.types.base import check_parameters

_REACH = 8.0  # standard deviations of the turn that are sampled
_UP = (0.0, -1.0, 0.0)  # opposite to gravity for an upright camera: y points down
_BROAD_DEG, _GIVEN_DEG = 30.0, 1.0  # sd of an upright camera's up, which adds little to the steps; of a given axis
_FLOOR = 1e-5  # of standard deviations in rad or m: keeps densities finite if 0 is given


@dataclass(frozen=True, eq=False)
class AxisTurn:
    """A density of rotations: a wrapped Gaussian turn θ about an axis of von Mises-Fisher direction, with wobble.

    A rotation by θ about `a` equals one by -θ about -a; both terms are summed, so that the density is smooth on SO(3)
    and an unknown axis needs no special case. The uniform measure of rotations is 4 sin²(θ/2) dθ da. A wobble σ_w tilts
    the apparent axis by σ_w / (2 sin(θ/2)); for turns below σ_w it dominates, and keeps the density finite.
    """

    axis: Array
    """(3,) unit; the expected direction, about which turns are right-handed."""
    turn_rad: float
    """Expected turn, unbounded."""
    sigma_turn_rad: float
    """Standard deviation of the turn."""
    sigma_axis_rad: float
    """Standard deviation of the axis' direction, about each direction orthogonal to it; infinite: any direction."""
    sigma_wobble_rad: float
    """Standard deviation of the rotation's remainder, about each direction orthogonal to the axis."""
    opposite: float = 0.0
    """Probability (0..1) that the turn has the opposite sign."""

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw rotations (count, 3, 3)."""
        offsets, _, cumulative = self._turns
        turn = self.turn_rad + np.interp(rng.random(count), cumulative, offsets)
        if self.opposite:
            turn = turn * rng.choice([-1.0, 1.0], count, p=[self.opposite, 1.0 - self.opposite])
        concentration = np.maximum(self._concentration(spread(turn)), 1e-9)
        axes = directions_about(self.axis, concentration, count, rng)
        return se3.exp(np.concatenate([turn[:, None] * axes, np.zeros((count, 3))], axis=1))[:, :3, :3]

    def log_density(self, angle_rad: Array, cosine: Array) -> Array:
        """Return the log density (n,) of rotations by angles (n,) in [0, π], their axes at cosines (n,) to `axis`."""
        measure = spread(angle_rad)
        concentration = np.maximum(self._concentration(measure), 1e-9)
        forward = self._log_turn(angle_rad) + concentration * (cosine - 1.0)
        backward = self._log_turn(-angle_rad) - concentration * (cosine + 1.0)
        normaliser = concentration / (-2.0 * np.pi * np.expm1(-2.0 * concentration) * self._share)
        return np.logaddexp(forward, backward) + np.log(normaliser / (measure + self.sigma_wobble_rad**2))

    def line(self, angle_rad: Array, axes: Array) -> tuple[Array, Array]:
        """Return posterior directions of the axes, given the expected one and the rotations' own.

        Args:
            angle_rad: (n,) in [0, π].
            axes: (n, 3) unit.

        Returns:
            (n, 3) unit directions up to sign, and (n,) their variances in rad².
        """
        measured = spread(angle_rad) / self.sigma_wobble_rad**2
        known = self.sigma_axis_rad**-2.0
        side = np.where(axes @ self.axis < 0.0, -1.0, 1.0)
        lines = known * self.axis + (measured * side)[:, None] * axes
        lengths = np.linalg.norm(lines, axis=1, keepdims=True)
        return np.where(lengths > 0.0, lines / np.maximum(lengths, 1e-300), self.axis), 1.0 / (known + measured + 1.0)

    def _concentration(self, measure: Array) -> Array:
        """Return the concentration κ of the axis about the expected one, given 4 sin²(θ/2)."""
        if np.isinf(self.sigma_axis_rad):
            return np.zeros_like(measure)
        return measure / (self.sigma_axis_rad**2 * measure + self.sigma_wobble_rad**2)

    def _log_turn(self, angle_rad: Array) -> Array:
        """Return the log density (n,) of turns by angles (n,) on the circle."""
        forward = self._log_wrapped(angle_rad - self.turn_rad)
        if not self.opposite:
            return forward
        backward = self._log_wrapped(angle_rad + self.turn_rad)
        return np.logaddexp(forward + np.log1p(-self.opposite), backward + np.log(self.opposite))

    def _log_wrapped(self, offset_rad: Array) -> Array:
        offset = offset_rad - 2.0 * np.pi * np.rint(offset_rad / (2.0 * np.pi))
        turns = int(np.ceil(max(_REACH * self.sigma_turn_rad / (2.0 * np.pi) - 0.5, 0.0)))
        logs = [-0.5 * ((offset + 2.0 * np.pi * k) / self.sigma_turn_rad) ** 2 for k in range(-turns, turns + 1)]
        total = logs[0] if len(logs) == 1 else np.logaddexp.reduce(logs, axis=0)
        return total - np.log(np.sqrt(2.0 * np.pi) * self.sigma_turn_rad)

    @cached_property
    def _turns(self) -> tuple[Array, float, Array]:
        """Offsets (k,) of the turn from its mean, the normaliser due to wobble, and their CDF (k,)."""
        offsets = np.linspace(-_REACH, _REACH, NODES) * self.sigma_turn_rad
        measure = spread(self.turn_rad + offsets)
        density = np.exp(-0.5 * (offsets / self.sigma_turn_rad) ** 2) * measure / (measure + self.sigma_wobble_rad**2)
        cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
        total = cumulative[-1] * (offsets[1] - offsets[0]) / (np.sqrt(2.0 * np.pi) * self.sigma_turn_rad)
        return offsets, float(total), cumulative / cumulative[-1]

    @property
    def _share(self) -> float:
        return self._turns[1]


def spread(angle_rad: Array) -> Array:
    """Return 4 sin²(θ/2) of angles: the squared displacement of a point at unit distance from the axis."""
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
    if half_turns.any():  # there R - Rᵀ vanishes and does not determine the axis
        motions = np.broadcast_to(np.eye(4), (int(half_turns.sum()), 4, 4)).copy()
        motions[:, :3, :3] = rotations[half_turns]
        vectors = se3.log(motions)[:, :3]
        axes[half_turns] = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return angle_rad, axes


@dataclass(frozen=True, eq=False)
class AboutAxis(AbstractPoseDensity):
    """A turn about an axis without translation along it.

    The axis' direction is estimated from the pose's own rotation and the expected axis. If the axis' position is
    unknown, the source's centroid is uniform on a disc orthogonal to the axis, about the target's.
    """

    turn: AxisTurn
    """The rotation."""
    axis: Axis
    """The expected axis."""
    source_centroid_m: Array
    """(3,)."""
    target_centroid_m: Array
    """(3,)."""
    max_shift_m: float
    """Radius of the disc."""
    wobble_m: float
    """Standard deviation of the shift that is not due to the turn about the axis."""

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        poses = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
        rotations = self.turn.sample(count, rng)
        poses[:, :3, :3] = rotations
        angle_rad, axes = angles_and_axes(rotations)
        lines, variance = self.turn.line(angle_rad, axes)
        anchor, expected = self._anchor
        across = _across(lines, rng)
        if self.axis.point_m is None:
            lateral = sample_disc(self.max_shift_m, count, rng)
        else:
            lateral = rng.normal(size=(count, 2)) * self._sigma_across_m(angle_rad)[:, None]
        along = rng.normal(size=count) * self._sigma_along_m(variance) + self._lift_m(lines)
        place_m = expected + (lateral[:, None] @ across)[:, 0] + along[:, None] * lines
        poses[:, :3, 3] = place_m - rotations @ anchor
        return poses

    def log_density(self, target_from_source: Array) -> Array:
        angle_rad, axes = angles_and_axes(target_from_source[:, :3, :3])
        lines, variance = self.turn.line(angle_rad, axes)
        rotation = self.turn.log_density(angle_rad, axes @ self.turn.axis)
        anchor, expected = self._anchor
        offset_m = centroid_offset(target_from_source, anchor, expected)
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
        """A point of the source, and its expected position in the target."""
        if self.axis.point_m is None:
            return self.source_centroid_m, self.target_centroid_m
        return self.axis.point_m, self.axis.point_m

    def _lift_m(self, lines: Array) -> Array:
        """Return the offset (n,) along lines (n, 3) of the point from its mean; the motion preserves it."""
        anchor, expected = self._anchor
        return lines @ (anchor - expected)

    def _sigma_along_m(self, variance: Array) -> Array:
        """Return the standard deviation (n,) along lines of variances (n,) in rad²."""
        if self.axis.point_m is not None:  # points of the axis are fixed, whatever its direction
            return np.full(len(variance), self.wobble_m)
        return np.sqrt(self.wobble_m**2 + self.max_shift_m**2 * variance)  # a tilted axis converts shifts into lifts

    def _sigma_across_m(self, angle_rad: Array) -> Array:
        """Return the standard deviation (n,), orthogonal to the axis, of the point after turns by angles (n,)."""
        return np.sqrt(self.wobble_m**2 + spread(angle_rad) * self.axis.sigma_point_m**2)


def _across(lines: Array, rng: np.random.Generator) -> Array:
    """Return two unit vectors (n, 2, 3) orthogonal to each of lines (n, 3), with random bearing."""
    crossed = np.cross(lines, rng.normal(size=lines.shape))
    first = np.asarray(crossed / np.linalg.norm(crossed, axis=1, keepdims=True), dtype=np.float64)
    return np.stack([first, np.cross(lines, first)], axis=1).astype(np.float64)


@checked
@dataclass(frozen=True)
class TurntablePrior(AbstractPrior):
    """A commanded step with a known error, about an axis that is fixed relative to the camera.

    From frame to frame the object turns by `step_deg`, right-handed about the axis, which points up: away from the
    table, against gravity. Between frames i and j it turns by (j - i) steps, whose errors accumulate. The axis is the
    one given, else the normal of the table if one is seen, else broadly about the camera's up. Its position is free
    within `max_shift_m` unless it is given.
    """

    step_deg: float
    """Turn from one frame number to the next; negative: left-handed."""
    step_sigma_deg: float = 1.0  # as marks of a turntable are met by hand
    """Standard deviation of one step."""
    step_sign: Literal["known", "unknown"] = "known"
    """Whether the sign of the step is known; unknown: either sense, until several pairs determine it."""
    axis_direction: tuple[float, float, float] | None = None
    """Direction of the axis in camera coordinates, of any length."""
    axis_point_m: tuple[float, float, float] | None = None
    """A point of the axis in camera coordinates."""
    axis_sigma_deg: float | None = None
    """Standard deviation of the axis' direction. None: 1 if it is given, the plane's own if a table is seen, else 30
    about the camera's up (-y). 180 or more: any direction."""
    axis_sigma_m: float = 0.005  # halved or doubled, log densities are the same
    """Standard deviation of the axis' point, orthogonal to the axis, if one is given."""
    max_shift_m: float | None = None
    """Largest distance, orthogonal to the axis, between the target's centroid and the source's, transformed; it grows
    with turns beyond 30 degrees. None: 0.75 of the object's size."""
    wobble_deg: float = WOBBLE_DEG
    """Standard deviation of the rotation out of the axis."""
    wobble_m: float = WOBBLE_M
    """Standard deviation of the shift that is not due to the turn about the axis."""
    steps: float = GeneralPrior.steps
    """Number of steps of a motion, at least 1: shifts add up."""
    needs_table: bool = False
    """Whether views without a table are rejected: the product of table and step."""
    learned_axis: Axis | None = None
    """The common axis of the pairs so far, used as a proposal."""
    sense: int = 0
    """Sense of rotation of the pairs so far, +1 right-handed about the axis, if `step_sign` is unknown: one for all
    steps. 0: undetermined."""
    previous: int | None = None
    """The frame relative to which a new one is placed: steps from it are evidence, others are not; None: all are."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_parameters(self)

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        plane = support(source, target)
        if plane is None and self.needs_table:
            raise no_plane(source, target)
        axis = self._axis(plane)
        density = self._density(source, target, axis)
        if self.learned_axis is not None:
            density = defensive_mixture(density, [self._density(source, target, self.learned_axis)])
        if self.previous is None or target.index == self.previous:
            return density
        # The steps to an earlier view are already part of the edges in between; here they are only a proposal.
        return defensive_mixture(self._limits(source, target), [density])

    def relaxed(self, steps: float) -> TurntablePrior:
        """Return the prior with limits for several steps; their turn follows from the frame numbers."""
        return replace(self, steps=steps * self.steps)

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> TurntablePrior:
        """Return the prior with the common axis and sense of rotation of the pairs so far."""
        accepted = [edge for edge in edges if solution.takes_part(edge)]
        motions = [solution.pose_of(edge) for edge in accepted]
        learned_axis = common_axis(motions, float(np.radians(self.wobble_deg)), self.wobble_m)
        sense = self._sense([edge.posterior for edge in accepted]) if self.step_sign == "unknown" else 0
        return replace(self, learned_axis=learned_axis, sense=sense, previous=max(solution.trajectory, default=None))

    def following(self, frame: int) -> TurntablePrior:
        return replace(self, previous=frame)

    def shared_axis(self, views: Collection[RayImage]) -> SharedAxis | None:
        """Return the axis that all steps share, beyond the information in each edge; None if the axis is given.

        Edges contain the commanded step and that nothing moves along the axis. If the direction is given or a table is
        seen, they also contain the direction, and steps share only the axis' position.
        """
        if self.axis_point_m is not None:
            return None
        unknown = all(self._axis(view.plane).sigma_direction_rad >= np.radians(_BROAD_DEG) for view in views)
        return SharedAxis(float(np.radians(self.wobble_deg)) if unknown else np.inf, self.wobble_m)

    def _sense(self, posteriors: Sequence[Posterior]) -> int:
        """Return the sense of rotation of pairs, +1 right-handed about the axis; 0 = undetermined."""
        up = np.array(_UP if self.axis_direction is None else self.axis_direction)
        step_rad, sigma_rad = np.radians([abs(self.step_deg), self.step_sigma_deg])
        return turn_sense(posteriors, up / np.linalg.norm(up), step_rad, sigma_rad)

    def _axis(self, plane: Plane | None) -> Axis:
        """Return the axis as known independently of the registrations, from the table if one is seen."""
        if self.axis_direction is not None:
            direction, sigma_rad = np.array(self.axis_direction), np.radians(_GIVEN_DEG)
        elif plane is not None:
            direction, sigma_rad = plane.normal, plane.sigma_tilt_rad
        else:
            direction, sigma_rad = np.array(_UP), np.radians(_BROAD_DEG)
        if self.axis_sigma_deg is not None:
            sigma_rad = np.radians(self.axis_sigma_deg) if self.axis_sigma_deg < 180.0 else np.inf
        point_m = None if self.axis_point_m is None else np.array(self.axis_point_m)
        return Axis(direction / np.linalg.norm(direction), max(float(sigma_rad), _FLOOR), point_m, self.axis_sigma_m)

    def _density(self, source: RayImage, target: RayImage, axis: Axis) -> AboutAxis:
        """Return the density of turns by the commanded steps about an axis."""
        expected = self._axis(support(source, target)).direction
        side = 1.0 if axis.direction @ expected >= 0.0 else -1.0  # the sign of a learned axis is arbitrary
        steps = target.index - source.index
        turn = AxisTurn(
            axis=side * axis.direction,
            turn_rad=float(np.radians(steps * (self.sense * abs(self.step_deg) or self.step_deg))),
            sigma_turn_rad=max(float(np.radians(self.step_sigma_deg) * np.sqrt(max(abs(steps), 1))), _FLOOR),
            sigma_axis_rad=axis.sigma_direction_rad,
            sigma_wobble_rad=max(float(np.radians(self.wobble_deg)), _FLOOR),
            opposite=0.0 if self.step_sign == "known" else UNDECIDED if self.sense else 0.5,
        )
        return AboutAxis(
            turn=turn,
            axis=axis,
            source_centroid_m=source.centroid_m,
            target_centroid_m=target.centroid_m,
            max_shift_m=self._shift_m(source, target),
            wobble_m=max(self.wobble_m, _FLOOR),
        )

    def _shift_m(self, source: RayImage, target: RayImage) -> float:
        """Return the largest shift between two views: the centroid of the visible surface turns about the axis."""
        shift_m = offset_limit_m(self.max_shift_m, self.steps, source, target)
        return turned_offset_m(shift_m, float(np.radians((target.index - source.index) * self.step_deg)))

    def _limits(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the uniform density within reach of the steps, on the table if one is seen."""
        steps = target.index - source.index
        turn_deg = (steps * self.step_deg + 180.0) % 360.0 - 180.0
        half_width_deg = reach_deg(float(self.step_sigma_deg * np.sqrt(abs(steps))))
        limit_deg = min(abs(turn_deg) + half_width_deg, 180.0)
        if support(source, target) is None:
            return GeneralPrior(limit_deg, self._shift_m(source, target)).between(source, target)
        density = TablePrior(limit_deg, self._shift_m(source, target)).between(source, target)
        if self.step_sign == "unknown" or half_width_deg >= 180.0:
            return density
        return replace(
            density, max_rotation_rad=float(np.radians(half_width_deg)), middle_rad=float(np.radians(turn_deg))
        )


def turntable_in(prior: AbstractPrior) -> TurntablePrior | None:
    """Return the turntable prior that is, or is part of, a prior; None if there is none."""
    if isinstance(prior, TurntablePrior):
        return prior
    values = [getattr(prior, field.name) for field in fields(prior)] if is_dataclass(prior) else []
    parts = (turntable_in(value) for value in values if isinstance(value, AbstractPrior))
    return next((part for part in parts if part is not None), None)
