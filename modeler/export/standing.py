"""Upright views of an object on a support seen from above, or turned in front of the camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from modeler.export.reading import poses_of
from modeler.types import Array, RayImage

_LEAST_BACK = 0.3  # least horizontal part of the direction to the camera: else it looks straight down
_WIDE, _FLAT = 0.1, 0.3  # a ring is no line, and all but plane

UpSource = Literal["support", "ring", "camera"]
"""Source of the up direction: the support, the ring of the cameras, or the first image."""


def standing(up: Array) -> Array:
    """Return right, down and forward (3, 3), as columns, of a view from the camera's side in which `up` is up.

    Args:
        up: (3,) unit, in camera coordinates.

    Returns:
        The identity, which is the camera's own view, if the camera looks along `up`.
    """
    back = np.array([0.0, 0.0, -1.0])
    back = back - up * (up @ back)
    length = float(np.linalg.norm(back))
    if length < _LEAST_BACK:
        return np.eye(3)
    forward = -back / length
    return np.stack([np.cross(forward, up), -up, forward], axis=1)


def upright(view: RayImage) -> Array:
    """Return right, down and forward (3, 3), as columns, of a view in which the support of an object is level.

    The identity, which is the camera's own view, if no support is seen.
    """
    return np.eye(3) if view.plane is None else standing(view.plane.normal)


def model_upright(report: Mapping[str, Any]) -> Array:
    """Return right, down and forward (3, 3), as columns, of a view in which the model of a run stands upright.

    The support is level in it; without one, the ring of cameras around it; without a ring, it is the view of the first
    frame's camera.

    Args:
        report: of a run in which frames were accepted.
    """
    up, source = model_up(report)
    return np.eye(3) if source == "camera" else standing(up)


def model_up(report: Mapping[str, Any]) -> tuple[Array, UpSource]:
    """Return the up direction (3,) in the object frame of a run, and its source.

    Args:
        report: of a run in which frames were accepted.
    """
    up = report.get("up")  # which reports of earlier versions have not
    if up is not None:
        up = np.array(up, dtype=np.float64)
        return up / np.linalg.norm(up), "support"
    up = _ring_up(np.array([pose.mean[:3, 3] for pose in poses_of(report).values()]))
    return (np.array([0.0, -1.0, 0.0]), "camera") if up is None else (up, "ring")


def level_axes(up: Array) -> Array:
    """Return right, forward and up (3, 3), as columns, of level axes that face as the camera does.

    Forward leads away from the camera; where it looks down along `up`, towards the upper edge of the image.

    Args:
        up: (3,) unit, in camera coordinates.
    """
    for ahead in (np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])):
        forward = ahead - up * (up @ ahead)
        length = float(np.linalg.norm(forward))
        if length >= _LEAST_BACK:
            break
    forward = forward / length
    return np.stack([np.cross(forward, up), forward, up], axis=1)


def _ring_up(centres_m: Array) -> Array | None:
    """Return the up direction (3,) of a ring of cameras at (n, 3); None if there is no ring."""
    long, wide, high = np.pad(np.linalg.svd(centres_m - centres_m.mean(axis=0), compute_uv=False), (0, 3))[:3]
    return ring_axes(centres_m)[1] if wide > _WIDE * long and high < _FLAT * wide else None


def ring_axes(centres_m: Array) -> tuple[Array, Array]:
    """Return the right (3,) and up (3,) directions for pictures of a ring of cameras.

    From above the first camera's left is on the left; from the side, its up is up.

    Args:
        centres_m: (n, 3) where the cameras are, in the object frame.
    """
    middle = centres_m.mean(axis=0)
    spread = np.linalg.svd(centres_m - middle)[2] if len(centres_m) > 2 else np.eye(3)[[0, 2, 1]]
    across = spread[0] * (np.sign(spread[0, 0]) or 1.0)
    up = np.cross(spread[0], spread[1])
    return across, -up if up[1] > 0 else up  # y is down
