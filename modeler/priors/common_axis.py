"""Estimation of the common axis of several steps, with its uncertainty, and of the sense of rotation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from modeler import se3
from modeler.priors.mixtures import across_axis
from modeler.significance import QUORUM
from modeler.types import Array, PoseGaussian, Posterior

_MAX_PAIRS = 60  # of many, the latest suffice
MIN_TURN_RAD = np.radians(5.0)  # below, a turn says little of its axis
_FREEDOM = 5.0  # degrees of freedom of Student's t: few, so that outliers count little
_ITERATIONS = 30  # at most, of reweighting: it ends where the axis settles
UNDECIDED = 1.0 / 500.0  # by three certain pairs it is 9⁻³ = 1 / 729
"""Probability of the opposite sense below which the sense counts as known, and which it then has."""
_MAX_LOG_ODDS = np.log(9.0)  # bound on the log odds of one pair, which may have missed the true mode


@dataclass(frozen=True, eq=False)
class Axis:
    """A line in camera coordinates, with its uncertainty."""

    direction: Array
    """(3,) unit."""
    sigma_direction_rad: float
    """Standard deviation of the direction, about each axis orthogonal to it; infinite: any direction."""
    point_m: Array | None = None
    """(3,) a point of the line; None if its position is unknown."""
    sigma_point_m: float = 0.0
    """Standard deviation of the point, along each axis orthogonal to the line."""


def common_axis(motions: Sequence[PoseGaussian], wobble_rad: float, wobble_m: float) -> Axis | None:
    """Fit the common axis of several motions by robust least squares on SE(3); None with fewer than three large turns.

    Each motion is exp(θ S) with the unit twist S = (d, -d × p) of the axis through p along d and an angle θ of its own,
    with errors of its covariance plus the wobble. Moving the axis by a twist ε moves the motion by (Ad(T⁻¹) - 1) ε.
    Outliers are downweighted by Student's t; if the inliers scatter more than their covariances predict, the axis'
    covariance is scaled up accordingly.

    Args:
        motions: target_from_source, all in the frame of one static camera.
        wobble_rad: standard deviation of each motion's rotation out of the axis.
        wobble_m: standard deviation of its shift, at the axis' point.
    """
    turning = [motion for motion in motions if np.linalg.norm(se3.log(motion.mean)[:3]) >= MIN_TURN_RAD]
    turning = turning[-_MAX_PAIRS:]
    if len(turning) < QUORUM:
        return None
    direction, point_m = _initial_axis(turning)
    wobble = np.repeat([wobble_rad, wobble_m], 3) ** 2
    information, scale = np.eye(4), 1.0
    for _ in range(_ITERATIONS):
        information, gradient, misfit, weights = np.zeros((4, 4)), np.zeros(4), 0.0, 0.0
        for pose in turning:
            residual, jacobian = _residual(pose, direction, point_m, wobble)
            square = float(residual @ residual)
            weight = (_FREEDOM + 5.0) / (_FREEDOM + square)  # an axis determines five of six coordinates
            information += weight * jacobian.T @ jacobian
            gradient += weight * jacobian.T @ residual
            misfit += weight * square
            weights += weight
        scale = max(misfit / max(5.0 * weights - 4.0, 1.0), 1.0)
        step = np.linalg.solve(information, gradient)
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


def _residual(pose: PoseGaussian, direction: Array, point_m: Array, wobble: Array) -> tuple[Array, Array]:
    """Return the residual (6,) of a motion from a pure turn about an axis, and its Jacobian (6, 4), both whitened.

    The angle is eliminated. The four parameters are tilts about, and shifts along, two normals of the axis.
    """
    # About a point of the axis near the object, rotation and shift are least correlated.
    motion = se3.translation(-point_m) @ pose.mean @ se3.translation(point_m)
    covariance = se3.covariance_about(pose.covariance, point_m) + np.diag(wobble)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    twist = np.concatenate([direction, np.zeros(3)])
    backward = se3.inverse(se3.exp(_turn(motion, direction) * twist))
    along = whiten @ twist
    across_angle = np.eye(6) - np.outer(along, along) / (along @ along)
    moved = np.kron(np.eye(2), across_axis(direction).T)
    return (
        across_angle @ whiten @ se3.log(backward @ motion),
        across_angle @ whiten @ (se3.adjoint(backward) - np.eye(6)) @ moved,
    )


def turn_sense(posteriors: Sequence[Posterior], up: Array, step_rad: float, sigma_step_rad: float) -> int:
    """Return the sense of rotation from frame to frame about `up`: +1 right-handed, -1 left-handed, 0 undetermined.

    The log odds of a pair are bounded, so that at least three must agree. Half turns are uninformative.

    Args:
        posteriors: in the frame of one static camera.
        up: (3,) unit, the axis' direction.
        step_rad: turn from one frame number to the next, of either sign.
        sigma_step_rad: standard deviation of one step.
    """
    odds = 0.0
    for posterior in posteriors:
        steps = posterior.target - posterior.source
        turn_rad, variance = steps * step_rad, abs(steps) * sigma_step_rad**2
        forward, backward = (_log_likelihood(posterior, up, turn, variance) for turn in (turn_rad, -turn_rad))
        odds += float(np.clip(forward - backward, -_MAX_LOG_ODDS, _MAX_LOG_ODDS))
    return int(np.sign(odds)) if abs(odds) > -np.log(UNDECIDED) else 0


def _log_likelihood(posterior: Posterior, up: Array, turn_rad: float, variance: float) -> float:
    """Return the log likelihood, up to a constant, of a turn about `up` with a variance in rad²."""
    parts = [(mode.weight, mode.pose) for mode in posterior.modes] or [(1.0, posterior.pose)]
    exponents, weights = [], []
    for weight, pose in parts:
        off_rad = np.remainder(se3.log(pose.mean)[:3] @ up - turn_rad + np.pi, 2.0 * np.pi) - np.pi
        whole = variance + up @ pose.covariance[:3, :3] @ up
        exponents.append(-0.5 * off_rad**2 / whole)
        weights.append(weight / np.sqrt(whole))
    return float(logsumexp(exponents, b=weights))


def _initial_axis(motions: Sequence[PoseGaussian]) -> tuple[Array, Array]:
    """Return an initial direction (3,), and the point (3,) of the initial axis at which the shifts are most certain."""
    vectors = np.array([se3.log(pose.mean)[:3] for pose in motions])
    direction = np.linalg.svd(vectors)[2][0]
    fixed = np.vstack([np.eye(3) - pose.mean[:3, :3] for pose in motions])
    shifts = np.concatenate([pose.mean[:3, 3] for pose in motions])
    point_m = np.linalg.lstsq(fixed, shifts, rcond=1e-2)[0]
    # A point x moves by υ + ω × x, whose variance is least if hat(x) cancels the correlation of υ with ω.
    levers = [pose.covariance[3:, :3] @ np.linalg.inv(pose.covariance[:3, :3]) for pose in motions]
    lever = np.mean(levers, axis=0)
    certain_m = 0.5 * np.array([lever[2, 1] - lever[1, 2], lever[0, 2] - lever[2, 0], lever[1, 0] - lever[0, 1]])
    return direction, point_m + direction * (direction @ (certain_m - point_m))


def _turn(motion: Array, direction: Array) -> float:
    """Return the angle of the turn about `direction` (3,) nearest to a motion (4, 4)."""
    rotation = motion[:3, :3]
    sine = direction @ np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    cosine = np.trace(rotation) - direction @ rotation @ direction
    return float(np.arctan2(sine, cosine))
