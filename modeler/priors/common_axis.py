"""The axis that several motions turn about, with its uncertainty: weighted least squares on SE(3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import logsumexp

from modeler import se3
from modeler.priors.about_axis import Axis
from modeler.priors.directions import across_axis
from modeler.types import Array, PoseGaussian, Posterior

_LEAST_PAIRS, _MOST_PAIRS = 3, 60  # the latest of many say enough
_LEAST_TURN_RAD = np.radians(5.0)
_STUDENT = 5.0  # degrees of freedom of the weights: few, so that motions that do not fit count little
_ITERATIONS = 30
_DECISIVE = np.log(500.0)  # odds at which the sense of turning is taken for known: three sure pairs tell 9³
_MOST_TOLD = np.log(9.0)  # by one pair: it may be all wrong, for one mode may have been missed


def common_axis(motions: Sequence[PoseGaussian], wobble_rad: float, wobble_m: float) -> Axis | None:
    """Return the axis that motions have in common; None where fewer than three turn far enough to show one.

    Each motion is exp(θ S) about the unit twist S = (d, -d × p) of the axis through p along d, its own angle θ free,
    and errs by its covariance and the wobble. Moving the axis by a twist ε moves the motion by (Ad(T⁻¹) - 1) ε.
    Motions that do not fit count less, as under a Student distribution; where the rest scatters more than its
    covariances say, the axis is the less sure for it.

    Args:
        motions: target_from_source, all before one and the same camera.
        wobble_rad: standard deviation of each motion's rotation that is no turn about the axis.
        wobble_m: standard deviation of its shift that no turn makes, at the axis' point.
    """
    turning = [motion for motion in motions if np.linalg.norm(se3.log(motion.mean)[:3]) >= _LEAST_TURN_RAD]
    turning = turning[-_MOST_PAIRS:]
    if len(turning) < _LEAST_PAIRS:
        return None
    direction, point_m = _begin(turning)
    wobble = np.repeat([wobble_rad, wobble_m], 3) ** 2
    information, scale = np.eye(4), 1.0
    for _ in range(_ITERATIONS):
        information, pull, misfit, weights = np.zeros((4, 4)), np.zeros(4), 0.0, 0.0
        for pose in turning:
            gap, slope = _gap(pose, direction, point_m, wobble)
            square = float(gap @ gap)
            weight = (_STUDENT + 5.0) / (_STUDENT + square)  # an axis fixes five of a motion's six numbers
            information += weight * slope.T @ slope
            pull += weight * slope.T @ gap
            misfit += weight * square
            weights += weight
        scale = max(misfit / max(5.0 * weights - 4.0, 1.0), 1.0)
        step = np.linalg.solve(information, pull)
        tilt, shift = np.split(step, 2)
        across = across_axis(direction)
        direction = se3.exp(np.concatenate([tilt @ across, np.zeros(3)]))[:3, :3] @ direction
        direction /= np.linalg.norm(direction)
        point_m = point_m + shift @ across
        if np.linalg.norm(step) < 1e-9:
            break
    covariance = scale * np.linalg.inv(information)
    sigmas = [float(np.sqrt(np.linalg.eigvalsh(block)[-1])) for block in (covariance[:2, :2], covariance[2:, 2:])]
    return Axis(direction, sigmas[0], point_m, sigmas[1])


def _gap(pose: PoseGaussian, direction: Array, point_m: Array, wobble: Array) -> tuple[Array, Array]:
    """Return how far a motion is from a turn about an axis (6,), and its slope (6, 4) with the axis, both whitened.

    The angle is whatever fits best. The four numbers are tilts about, and shifts along, two directions across the axis.
    """
    # All about the axis' point, which lies near the object: there rotation and shift are told apart best.
    motion = se3.translation(-point_m) @ pose.mean @ se3.translation(point_m)
    covariance = se3.covariance_about(pose.covariance, point_m) + np.diag(wobble)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    twist = np.concatenate([direction, np.zeros(3)])
    back = se3.inverse(se3.exp(_turn(motion, direction) * twist))
    along = whiten @ twist
    across_angle = np.eye(6) - np.outer(along, along) / (along @ along)
    moved = np.kron(np.eye(2), across_axis(direction).T)
    return (
        across_angle @ whiten @ se3.log(back @ motion),
        across_angle @ whiten @ (se3.adjoint(back) - np.eye(6)) @ moved,
    )


def turn_sense(posteriors: Sequence[Posterior], up: Array, step_rad: float, sigma_step_rad: float) -> int:
    """Return +1 where from frame to frame the object turns right-handed about `up`, -1 the other way, 0 not yet known.

    How sure a pair can be is bounded, so that it takes three of one mind. Turns by about half a circle tell nothing.

    Args:
        posteriors: of motions before one and the same camera.
        up: (3,) unit, the side to which the axis points.
        step_rad: turn from one frame number to the next, of either sign.
        sigma_step_rad: standard deviation of one step.
    """
    odds = 0.0
    for posterior in posteriors:
        steps = posterior.target - posterior.source
        turn_rad, variance = steps * step_rad, abs(steps) * sigma_step_rad**2
        forth, back = (_log_likelihood(posterior, up, turn, variance) for turn in (turn_rad, -turn_rad))
        odds += float(np.clip(forth - back, -_MOST_TOLD, _MOST_TOLD))
    return int(np.sign(odds)) if abs(odds) > _DECISIVE else 0


def _log_likelihood(posterior: Posterior, up: Array, turn_rad: float, variance: float) -> float:
    """Return the log likelihood, up to a constant, of a turn about `up` that is known with a variance in rad²."""
    parts = [(mode.weight, mode.pose) for mode in posterior.modes] or [(1.0, posterior.pose)]
    told, shares = [], []
    for weight, pose in parts:
        off_rad = np.remainder(se3.log(pose.mean)[:3] @ up - turn_rad + np.pi, 2.0 * np.pi) - np.pi
        whole = variance + up @ pose.covariance[:3, :3] @ up
        told.append(-0.5 * off_rad**2 / whole)
        shares.append(weight / np.sqrt(whole))
    return float(logsumexp(told, b=shares))


def _begin(motions: Sequence[PoseGaussian]) -> tuple[Array, Array]:
    """Return a first direction (3,), and the point (3,) of a first axis where the motions' shifts are surest."""
    vectors = np.array([se3.log(pose.mean)[:3] for pose in motions])
    direction = np.linalg.svd(vectors)[2][0]
    stay = np.vstack([np.eye(3) - pose.mean[:3, :3] for pose in motions])
    shifts = np.concatenate([pose.mean[:3, 3] for pose in motions])
    point_m = np.linalg.lstsq(stay, shifts, rcond=1e-2)[0]
    # A point x shifts by υ + ω × x; that varies least where hat(x) undoes what υ varies with ω.
    levers = [pose.covariance[3:, :3] @ np.linalg.inv(pose.covariance[:3, :3]) for pose in motions]
    lever = np.mean(levers, axis=0)
    surest_m = 0.5 * np.array([lever[2, 1] - lever[1, 2], lever[0, 2] - lever[2, 0], lever[1, 0] - lever[0, 1]])
    return direction, point_m + direction * (direction @ (surest_m - point_m))


def _turn(motion: Array, direction: Array) -> float:
    """Return the angle of the turn about `direction` (3,) nearest to a motion (4, 4)."""
    rotation = motion[:3, :3]
    sine = direction @ np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    cosine = np.trace(rotation) - direction @ rotation @ direction
    return float(np.arctan2(sine, cosine))
