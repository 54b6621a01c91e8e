"""A turntable turns the object by a commanded step about an axis: known, seen as the table's normal, or learnt."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from modeler.priors.about_axis import AboutAxis, Axis
from modeler.priors.axis_turn import AxisTurn
from modeler.priors.common_axis import common_axis, turn_sense
from modeler.priors.general import GeneralPrior, relaxed_limits, turned_offset_m
from modeler.priors.on_plane import WOBBLE_DEG, WOBBLE_M, no_plane, support
from modeler.priors.proposal import defensive_mixture, reach_deg
from modeler.priors.table import TablePrior
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    Edge,
    Plane,
    Posterior,
    RayImage,
    SharedAxis,
    Solution,
)

_UP = (0.0, -1.0, 0.0)  # against gravity for a camera held upright: y points down
_BROAD_DEG, _GIVEN_DEG = 30.0, 1.0
_LEAST = 1e-5  # rad or m: densities stay finite where somebody is wholly sure
_VAGUE_DEG = 20.0  # a direction known no better counts for nothing beside what steps show, in however many edges it is


@dataclass(frozen=True)
class TurntablePrior(AbstractPrior):
    """A commanded step, known up to its error, about an axis that stays where it is before the camera.

    From each frame to the next the object turns by `step_deg`, right-handed about the axis, which points up: away from
    the table, against gravity. Between frames i and j it has turned by (j - i) steps, whose errors add up. The axis is
    the one given, else the normal of the table where one is seen, else anywhere about the camera's up. Its position is
    free within `max_shift_m` unless it is given.
    """

    step_deg: float
    """Turn from one frame number to the next; negative: the other way round."""
    step_sigma_deg: float = 1.0
    """Standard deviation of one step."""
    step_sign: Literal["known", "unknown"] = "known"
    """Whether the sign of the step is meant; unknown: the table may turn either way, until several pairs tell."""
    axis_direction: tuple[float, float, float] | None = None
    """Direction of the axis in camera coordinates, of any length."""
    axis_point_m: tuple[float, float, float] | None = None
    """A point of the axis in camera coordinates."""
    axis_sigma_deg: float | None = None
    """Standard deviation of the axis' direction: 1 where it is given, the plane's own where a table is seen, else 30
    about the camera's up (-y). 180 or more: any direction."""
    axis_sigma_m: float = 0.005
    """Standard deviation of the axis' point, across the axis, where one is given."""
    max_shift_m: float = 0.05
    """Largest distance, across the axis, between the target's centroid and the source's, carried over; for turns
    beyond 30 degrees it grows with them."""
    wobble_deg: float = WOBBLE_DEG
    """Standard deviation of the rotation that is no turn about the axis."""
    wobble_m: float = WOBBLE_M
    """Standard deviation of the shift that no turn about the axis makes."""
    needs_table: bool = False
    """Whether views that show no table are refused: the product of table and step."""
    learnt: Axis | None = None
    """The axis that the pairs so far have in common, which tells where to look."""
    sense: int = 0
    """Which way round the pairs so far turn, right-handed about the axis +1, where `step_sign` does not tell and they
    do: it tells where to look."""
    newest: int | None = None
    """The last frame of a sequence that is being built, from which on steps are evidence; None: no sequence."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source.

        Raises:
            InputError: where a table is needed and neither view shows one.
        """
        plane = support(source, target)
        if plane is None and self.needs_table:
            raise no_plane(source, target)
        axis = self._axis(plane)
        density = self._motion(source, target, axis)
        if self.learnt is not None or self.sense:
            told = replace(self, step_sign="known", step_deg=self.sense * abs(self.step_deg)) if self.sense else self
            density = defensive_mixture(density, [told._motion(source, target, self.learnt or axis)])
        if self.newest is None or target.index == self.newest:
            return density
        # The steps that lead to an earlier view count in the edges between; here they only tell where to look.
        return defensive_mixture(self._limits(source, target), [density])

    def relaxed(self, steps: float) -> TurntablePrior:
        """Return the prior with room for the shift of several steps; their turn is counted by the frames' numbers."""
        step_deg = min(max(abs(self.step_deg), 1.0), 180.0)
        return replace(self, max_shift_m=relaxed_limits(step_deg, self.max_shift_m, steps)[1])

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> TurntablePrior:
        """Return the prior that knows the axis and the sense of turning which the pairs so far have in common."""
        telling = [edge for edge in edges if solution.takes_part(edge)]
        motions = [solution.pose_of(edge) for edge in telling]
        learnt = common_axis(motions, float(np.radians(self.wobble_deg)), self.wobble_m)
        sense = self._sense([edge.posterior for edge in telling]) if self.step_sign == "unknown" else 0
        return replace(self, learnt=learnt, sense=sense, newest=max(solution.trajectory, default=None))

    def shared_axis(self, views: Collection[RayImage]) -> SharedAxis | None:
        """Return the axis that all steps share, as far as the edge of each does not hold it; None where it is given.

        Edges hold the commanded step and that nothing climbs along the axis. They hold the axis' direction too where it
        is given or a table is seen, each the same one: there steps share its place alone.
        """
        if self.axis_point_m is not None:
            return None
        vague = all(self._axis(view.plane).sigma_direction_rad >= np.radians(_VAGUE_DEG) for view in views)
        return SharedAxis(float(np.radians(self.wobble_deg)) if vague else np.inf, self.wobble_m)

    def _sense(self, posteriors: Sequence[Posterior]) -> int:
        """Return which way round pairs turn, right-handed about the axis +1; 0 = not known."""
        up = np.array(_UP if self.axis_direction is None else self.axis_direction)
        step_rad, sigma_rad = np.radians([abs(self.step_deg), self.step_sigma_deg])
        return turn_sense(posteriors, up / np.linalg.norm(up), step_rad, sigma_rad)

    def _axis(self, plane: Plane | None) -> Axis:
        """Return what is known of the axis without comparing the images, on a table if one is seen."""
        if self.axis_direction is not None:
            direction, sigma_rad = np.array(self.axis_direction), np.radians(_GIVEN_DEG)
        elif plane is not None:
            direction, sigma_rad = plane.normal, plane.sigma_tilt_rad
        else:
            direction, sigma_rad = np.array(_UP), np.radians(_BROAD_DEG)
        if self.axis_sigma_deg is not None:
            sigma_rad = np.radians(self.axis_sigma_deg) if self.axis_sigma_deg < 180.0 else np.inf
        point_m = None if self.axis_point_m is None else np.array(self.axis_point_m)
        return Axis(direction / np.linalg.norm(direction), max(float(sigma_rad), _LEAST), point_m, self.axis_sigma_m)

    def _motion(self, source: RayImage, target: RayImage, axis: Axis) -> AboutAxis:
        """Return turns by the commanded steps about an axis."""
        expected = self._axis(support(source, target)).direction
        side = 1.0 if axis.direction @ expected >= 0.0 else -1.0  # a line that was learnt has no upper end
        steps = target.index - source.index
        turn = AxisTurn(
            axis=side * axis.direction,
            turn_rad=float(np.radians(steps * self.step_deg)),
            sigma_turn_rad=max(float(np.radians(self.step_sigma_deg) * np.sqrt(max(abs(steps), 1))), _LEAST),
            sigma_axis_rad=axis.sigma_direction_rad,
            sigma_wobble_rad=max(float(np.radians(self.wobble_deg)), _LEAST),
            either_way=self.step_sign == "unknown",
        )
        return AboutAxis(
            turn=turn,
            axis=axis,
            source_centroid_m=source.centroid_m,
            target_centroid_m=target.centroid_m,
            max_shift_m=self._shift_m(steps),
            wobble_m=max(self.wobble_m, _LEAST),
        )

    def _shift_m(self, steps: int) -> float:
        """Return the largest shift for so many steps: the centroid of what is seen lies before the axis, and turns."""
        return turned_offset_m(self.max_shift_m, float(np.radians(steps * self.step_deg)))

    def _limits(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return motions as far as the steps may reach, on the table where one is seen; all turns within are alike."""
        steps = target.index - source.index
        turn_deg = _on_circle(steps * self.step_deg)
        either_side_deg = reach_deg(float(self.step_sigma_deg * np.sqrt(abs(steps))))
        whole_deg = min(abs(turn_deg) + either_side_deg, 180.0)
        if support(source, target) is None:
            return GeneralPrior(whole_deg, self._shift_m(steps)).between(source, target)
        density = TablePrior(whole_deg, self._shift_m(steps)).between(source, target)
        if self.step_sign == "unknown" or either_side_deg >= 180.0:
            return density
        return replace(
            density, max_rotation_rad=float(np.radians(either_side_deg)), middle_rad=float(np.radians(turn_deg))
        )


def _on_circle(turn_deg: float) -> float:
    """Return a turn as one of -180 to 180 degrees."""
    return (turn_deg + 180.0) % 360.0 - 180.0
