"""Upright views of what stands on a support that the camera looks down on."""

from __future__ import annotations

import numpy as np

from modeler.types import Array, RayImage

_LEAST_BACK = 0.3  # of the way to the camera that lies across what is up: else it looks down from right above


def standing(up: Array) -> Array:
    """Return right, down and forward (3, 3), as columns, of a view from the camera's side in which `up` is up.

    Args:
        up: (3,) unit, in camera coordinates.

    Returns:
        The identity, which is the camera's own view, where the camera looks along `up`.
    """
    back = np.array([0.0, 0.0, -1.0])
    back = back - up * (up @ back)
    length = float(np.linalg.norm(back))
    if length < _LEAST_BACK:
        return np.eye(3)
    forward = -back / length
    return np.stack([np.cross(forward, up), -up, forward], axis=1)


def upright(view: RayImage) -> Array:
    """Return right, down and forward (3, 3), as columns, of a view in which the support of an object lies level.

    The identity, which is the camera's own view, where no support is seen.
    """
    return np.eye(3) if view.plane is None else standing(view.plane.normal)
