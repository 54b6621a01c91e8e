"""A turntable in the graph: one axis, unknown but the same for all steps, about which the object turns.

Between consecutive frames target_from_source = A Rz(θ) exp(slip) A⁻¹, with A = camera_from_axis, the axis its third
direction. A is a variable that all steps share, so that what the images of each say of it serves all, and counts once.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.graph.chi_square import chi_square_quantile
from modeler.graph.factors import Factor, inverse_right_jacobian
from modeler.graph.square_root import Rows
from modeler.graph.turning import estimated_axis, slip, surest_point
from modeler.types import Array

_AXIS = gtsam.symbol("a", 0)  # frames are numbered far below
# Standard deviations of A about where it is sought, rad and m. A turn about the axis changes nothing and is held; a
# shift along it moves the point about which the object tilts, which lies within the object; the rest is all but free.
_AXIS_SIGMAS = np.array([1.0, 1.0, 1e-4, 1.0, 1.0, 0.03])
_PLACE_SIGMAS = np.array([0.01, 0.01, *_AXIS_SIGMAS[2:]])  # where steps say nothing of its direction
_ITERATIONS, _HALVINGS = 50, 10  # of Gauss and Newton, and of one step of theirs that overshoots
_TOLERANCE = 1e-6  # of half the squared Mahalanobis distance: where a step lowers it by less, the next is nothing
_FITS = 1.0 - 1e-6  # of tables that are as they are said to be; the others cost a hundred times more


@dataclass(frozen=True, eq=False)
class AxisSolution:
    """A solution with a common axis."""

    poses: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    rows: Sequence[Rows]
    """What the axis says there: whitened, of errors in object coordinates, as `marginals` takes them."""
    camera_from_axis: Array
    """(4, 4), the axis the third direction."""


@dataclass(frozen=True)
class CommonAxis:
    """What is known of a turntable, beyond what the edges know: they must not hold it already.

    How far it turns in a step is none of it: where that is known, edges hold it.
    """

    sigma_tilt_rad: float = float(np.radians(0.2))
    """How far the object tilts against the axis in a step: wobble of the table, slip on it. Infinite where edges hold
    the axis' direction: what steps then share is its place."""
    sigma_shift_m: float = 0.0005
    """How far it slips across the axis in a step. Some centimetres make a table on which it is pushed about: what steps
    then share is the table's normal."""
    sigma_lift_m: float = 0.0005
    """How far it moves along the axis in a step; infinite where edges hold that."""

    def solved(self, factors: Sequence[Factor], trajectory: Mapping[int, Array], root: int) -> AxisSolution | None:
        """Return the poses that meet factors and axis best; None where there is no axis that factors allow.

        Args:
            factors: all that take part.
            trajectory: object_from_camera (4, 4) by frame number, not far off.
            root: the frame whose pose is the identity.
        """
        if len(trajectory) < 2:
            return None
        start = estimated_axis(trajectory, surest_point(factors))
        if start is None:
            return None
        known = _Known(self, factors, list(trajectory), root, start)
        alone = _half_square(known.rows({**trajectory, _AXIS: start})[: len(factors)])
        poses, rows = known.minimised({**trajectory, _AXIS: start})
        if not self._fits(rows[len(factors) + 1 :], 2.0 * (_half_square(rows) - alone)):
            return None
        to_object = {key: se3.adjoint(se3.inverse(pose)) for key, pose in poses.items() if key != _AXIS}
        said: list[Rows] = [
            {key: block @ to_object[key] if key in to_object else block for key, block in blocks.items()}
            for blocks, _ in rows[len(factors) :]
        ]
        return AxisSolution({frame: poses[frame] for frame in trajectory}, said, poses[_AXIS])

    def _fits(self, steps: Sequence[tuple[Rows, Array]], cost: float) -> bool:
        """Return whether steps may share an axis that adds `cost` to the squared distance of factors from poses.

        That is chi² with as many degrees of freedom as the axis says more than has to be found: two numbers of its
        direction, two of its place.
        """
        told = np.isfinite([self.sigma_tilt_rad, self.sigma_shift_m])
        stacked = [np.hstack(list(blocks.values())) for blocks, _ in steps]
        conditions = sum(int(np.count_nonzero(step.any(axis=1))) for step in stacked)
        conditions -= 2 * int(np.count_nonzero(told))
        return conditions <= 0 or cost <= chi_square_quantile(_FITS, conditions)


@dataclass(frozen=True, eq=False)
class _Known:
    """All that is known of poses and axis: factors, a loose guess of the axis, and how little steps slip."""

    axis: CommonAxis
    factors: Sequence[Factor]
    frames: Sequence[int]
    root: int
    start: Array

    def rows(self, poses: Mapping[int, Array]) -> list[tuple[Rows, Array]]:
        """Return whitened derivatives by variable, blocks (m, 6), and errors (m,): of factors, the guess, and steps.

        Args:
            poses: object_from_camera (4, 4) by frame number, and camera_from_axis.
        """
        targets, sources = (
            np.stack([poses[frame] for frame in ends])
            for ends in ([factor.target for factor in self.factors], [factor.source for factor in self.factors])
        )
        target_from_source = se3.inverse(targets) @ sources
        xi = se3.log(se3.inverse(np.stack([factor.pose.mean for factor in self.factors])) @ target_from_source)
        whiten = np.stack([factor.root_information for factor in self.factors])
        of_source = whiten @ inverse_right_jacobian(xi)
        of_target = -of_source @ se3.adjoint(se3.inverse(target_from_source))
        errors = (whiten @ xi[..., None])[..., 0]
        rows: list[tuple[Rows, Array]] = [
            (self._free({factor.target: to, factor.source: of}), error)
            for factor, to, of, error in zip(self.factors, of_target, of_source, errors, strict=True)
        ]
        away = se3.log(se3.inverse(self.start) @ poses[_AXIS])
        away[2] = 0.0
        sigmas = _AXIS_SIGMAS if np.isfinite(self.axis.sigma_tilt_rad) else _PLACE_SIGMAS
        rows.append(({_AXIS: np.diag(1.0 / sigmas)}, away / sigmas))
        steps = list(itertools.pairwise(sorted(self.frames)))
        for (target, source), error, *blocks in zip(steps, *self._slips(poses, np.array(steps)), strict=True):
            rows.append((self._free({target: blocks[0], source: blocks[1], _AXIS: blocks[2]}), error))
        return rows

    def minimised(self, poses: dict[int, Array]) -> tuple[dict[int, Array], list[tuple[Rows, Array]]]:
        """Return poses and axis that meet all best, and what `rows` says there: Gauss and Newton, from not far off."""
        rows = self.rows(poses)
        for _ in range(_ITERATIONS):
            linear = gtsam.GaussianFactorGraph()
            for blocks, error in rows:
                linear.add(_gaussian_factor(blocks, -error))
            step = linear.eliminateMultifrontal(gtsam.Ordering.OrderingType.COLAMD, gtsam.EliminateQR).optimize()
            moved, moved_rows = poses, rows
            for halvings in range(_HALVINGS):
                moved = {
                    key: pose if key == self.root else pose @ se3.exp(0.5**halvings * step.at(key))
                    for key, pose in poses.items()
                }
                moved_rows = self.rows(moved)
                if _half_square(moved_rows) <= _half_square(rows):
                    break
            fallen = _half_square(rows) - _half_square(moved_rows)
            if fallen < 0.0:
                break
            poses, rows = moved, moved_rows
            if fallen <= _TOLERANCE:
                break
        return poses, rows

    def _free(self, blocks: Rows) -> Rows:
        return {key: block for key, block in blocks.items() if key != self.root}

    def _slips(self, poses: Mapping[int, Array], steps: npt.NDArray[np.int64]) -> list[Array]:
        """Return `slip` of steps (n, 2) between a target and a source, whitened."""
        axis, apart = self.axis, steps[:, 1] - steps[:, 0]
        targets, sources = (np.stack([poses[int(frame)] for frame in ends]) for ends in steps.T)
        across = (axis.sigma_shift_m, axis.sigma_shift_m, axis.sigma_lift_m)
        sigmas = np.array([axis.sigma_tilt_rad, axis.sigma_tilt_rad, *across])
        whiten = 1.0 / (np.sqrt(apart)[:, None] * sigmas)
        error, *derivatives = slip(targets, sources, poses[_AXIS])
        return [whiten * error, *(whiten[..., None] * derivative for derivative in derivatives)]


def _half_square(rows: Sequence[tuple[Rows, Array]]) -> float:
    return 0.5 * float(sum(error @ error for _, error in rows))


def _gaussian_factor(rows: Rows, right: Array) -> gtsam.JacobianFactor:
    """Return rows of one to three variables, and their right sides (m,), as GTSAM takes them."""
    (key, block), *more = rows.items()
    unit = gtsam.noiseModel.Unit.Create(len(block))
    if not more:
        return gtsam.JacobianFactor(key, block, right, unit)
    if len(more) == 1:
        return gtsam.JacobianFactor(key, block, *more[0], right, unit)
    return gtsam.JacobianFactor(key, block, *more[0], *more[1], right, unit)
