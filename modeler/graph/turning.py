"""What steps say of the axis about which they turn: where it lies, and what of them is no turn about it."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from modeler import se3
from modeler.graph.factors import Factor, inverse_right_jacobian
from modeler.types import Array

_LEAST_RAD = np.radians(5.0)  # a table that has turned by less in all shows no axis
_KEPT = [0, 1, 3, 4, 5]  # of a step without its turn


def surest_point(factors: Sequence[Factor]) -> Array:
    """Return the point (3,) in camera coordinates whose motion factors know best: where the object is."""
    inertia, moment = np.zeros((3, 3)), np.zeros(3)
    for factor in factors:  # least Σ E|υ + ω × p|²
        spread = factor.pose.covariance / np.trace(factor.pose.covariance[:3, :3])
        turns, mixed = spread[:3, :3], spread[:3, 3:]
        inertia += np.trace(turns) * np.eye(3) - turns
        moment += np.array([mixed[1, 2] - mixed[2, 1], mixed[2, 0] - mixed[0, 2], mixed[0, 1] - mixed[1, 0]])
    return np.asarray(np.linalg.solve(inertia, moment), dtype=np.float64)


def estimated_axis(trajectory: Mapping[int, Array], near_m: Array) -> Array | None:
    """Return camera_from_axis (4, 4) that the steps between consecutive frames share best; None where they hardly turn.

    The object turns about its third direction in the positive sense, seen from camera coordinates, as time goes back.

    Args:
        trajectory: object_from_camera (4, 4) by frame number.
        near_m: (3,) a point in camera coordinates, to which the origin is the nearest on the axis.
    """
    steps = np.stack([se3.inverse(trajectory[t]) @ trajectory[s] for t, s in itertools.pairwise(sorted(trajectory))])
    turns = se3.log(steps)[:, :3]
    if np.sum(np.linalg.norm(turns, axis=1)) < _LEAST_RAD:
        return None
    axis = np.linalg.svd(turns)[2][0]
    axis = axis if np.sum(turns @ axis) > 0.0 else -axis
    fixed = (np.eye(3) - steps[:, :3, :3]).reshape(-1, 3)
    # Points on the axis stay where they are.
    point = np.linalg.lstsq(np.vstack([fixed, axis]), np.append(steps[:, :3, 3].ravel(), axis @ near_m), rcond=None)[0]
    across = np.linalg.svd(axis[None])[2][1]
    camera_from_axis = np.eye(4)
    camera_from_axis[:3, :3] = np.stack([across, np.cross(axis, across), axis], axis=1)
    camera_from_axis[:3, 3] = point
    return camera_from_axis


def slip(
    object_from_target: Array, object_from_source: Array, camera_from_axis: Array
) -> tuple[Array, Array, Array, Array]:
    """Return what of steps is no turn about the axis (n, 5), and its derivatives (n, 5, 6) by ξ of the three poses.

    Tilt about the first two directions in rad, then shift along all three in m.

    Args:
        object_from_target: (n, 4, 4).
        object_from_source: (n, 4, 4).
        camera_from_axis: (4, 4).
    """
    target_from_source = se3.inverse(object_from_target) @ object_from_source
    step = se3.inverse(camera_from_axis) @ target_from_source @ camera_from_axis
    rotation = step[:, :3, :3]
    sine, cosine = rotation[:, 1, 0] - rotation[:, 0, 1], rotation[:, 0, 0] + rotation[:, 1, 1]
    turned = rotation[:, None] @ se3.hat(np.eye(3))  # derivatives by a turn from the right, (n, 3, 3, 3)
    slope = np.zeros((len(step), 6))  # of the angle
    slope[:, :3] = cosine[:, None] * (turned[:, :, 1, 0] - turned[:, :, 0, 1])
    slope[:, :3] -= sine[:, None] * (turned[:, :, 0, 0] + turned[:, :, 1, 1])
    slope /= (cosine**2 + sine**2)[:, None]
    angle = np.arctan2(sine, cosine)
    back = np.zeros((len(step), 6))
    back[:, 2] = -angle
    rest = se3.exp(back) @ step
    xi = se3.log(rest)
    held = np.eye(6) - se3.adjoint(se3.inverse(rest))[:, :, 2, None] * slope[:, None]
    derivative = (inverse_right_jacobian(xi) @ held)[:, _KEPT]
    of_source = derivative @ se3.adjoint(se3.inverse(camera_from_axis))
    of_target = -of_source @ se3.adjoint(se3.inverse(target_from_source))
    of_axis = derivative @ (np.eye(6) - se3.adjoint(se3.inverse(step)))
    return xi[:, _KEPT], of_target, of_source, of_axis
