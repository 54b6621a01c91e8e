"""Candidate actions: turns on the table, pokes, laying the object on its side, and poses that a robot can reach."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from modeler import se3
from modeler.priors import Poke
from modeler.priors.mixtures import across_axis
from modeler.priors.poke import STEPS, pushed
from modeler.suggestion.surface_cells import Stand
from modeler.types import Array, Plane, RayImage

Action = Literal["turn", "poke", "lay", "pose"]


@dataclass(frozen=True)
class Candidate:
    """One action, and the resulting motion of the object."""

    action: Action
    turn_deg: float = 0.0
    """Turn about the table's normal, right-handed about up."""
    poke: Poke | None = None
    """The push, in the coordinates of the last camera."""
    new_from_last: tuple[tuple[float, ...], ...] | None = None
    """Of a pose: the motion (4, 4) of the object, from its camera coordinates now to those after the action."""
    name: str = ""
    """Name given by the user."""
    cost: float = 1.0
    """Divisor of gains, such as time."""
    sigmas: tuple[float, float] | None = None
    """Standard deviations in rad and m with which the pose is reached; None: those of the run's prior."""

    def motion(self, last: RayImage, stand: Stand, object_from_last: Array) -> Array:
        """Return new_from_last (4, 4), the expected motion of the object in the camera's coordinates."""
        if self.new_from_last is not None:
            return np.array(self.new_from_last, dtype=np.float64)
        if self.poke is not None:
            assert last.plane is not None
            return poked(self.poke, last, last.plane)
        last_from_object = se3.inverse(object_from_last)
        if self.action == "lay":
            return last_from_object @ _laid(stand, object_from_last) @ object_from_last
        return last_from_object @ stand.turned(np.radians(self.turn_deg)) @ object_from_last


def turns(step_deg: float) -> list[Candidate]:
    """Return turns by multiples of a step, either way, up to half a turn."""
    counts = range(1, int(180.0 / step_deg + 1e-9) + 1)
    return [Candidate("turn", turn_deg=sign * k * step_deg) for k in counts for sign in (1.0, -1.0)]


def pokes(last: RayImage, stand: Stand, object_from_last: Array) -> list[Candidate]:
    """Return pushes along the table at the sides of the object that the camera sees, which turn it either way.

    Args:
        last: the view before the action, with its support plane.
        stand: pose of the object on its table.
        object_from_last: (4, 4) of that view.
    """
    if last.plane is None:
        return []
    last_from_stand = se3.inverse(object_from_last) @ stand.object_from_stand
    local_m = se3.transform(se3.inverse(last_from_stand), last.points_m)
    eye = se3.inverse(last_from_stand)[:3, 3]
    towards = np.append(eye[:2] / max(float(np.linalg.norm(eye[:2])), 1e-9), 0.0)
    across = np.array([-towards[1], towards[0], 0.0])
    found = []
    for side in (1.0, -1.0):
        reach = side * local_m @ across
        at_m = local_m[reach >= np.quantile(reach, 0.95)].mean(axis=0)
        for ahead in (-1.0, 1.0):
            direction = last_from_stand[:3, :3] @ (ahead * towards)
            point = se3.transform(last_from_stand, at_m[None])[0]
            push = Poke(_triple(point), _triple(direction), 0.03)  # 3 cm turn an object of 10 cm by 20° or more
            turn_rad = float(se3.log(poked(push, last, last.plane))[:3] @ last.plane.normal)
            found.append(Candidate("poke", turn_deg=float(np.degrees(turn_rad)), poke=push))
    return found


def poked(poke: Poke, last: RayImage, plane: Plane) -> Array:
    """Return the motion (4, 4) of the object in the camera by a push, as expected by the prior."""
    axes = across_axis(plane.normal)
    seen = last.points_m @ axes.T
    way = axes @ np.array(poke.direction)
    step = poke.length_m / STEPS * way / np.linalg.norm(way)
    radius_m = np.sqrt(np.sum(np.var(seen, axis=0)))
    contact = axes @ np.array(poke.point_m) - seen.mean(axis=0)
    turn, shift = pushed(contact[None], step[None], np.array([radius_m]))
    centre = last.centroid_m
    turned = se3.moved(np.eye(4), np.append(turn[0] * plane.normal, np.zeros(3)), centre)
    return se3.translation(shift[0] @ axes) @ turned


def _laid(stand: Stand, object_from_last: Array) -> Array:
    """Return the motion (4, 4) in the object frame that turns the object's bottom to the camera."""
    eye = se3.inverse(stand.object_from_stand) @ object_from_last[:, 3]
    towards = eye[:2] / max(float(np.linalg.norm(eye[:2])), 1e-9)
    axis = np.array([towards[1], -towards[0], 0.0])  # down becomes the direction to the camera
    tip = np.eye(4)
    tip[:3, :3] = se3.exp(np.append(0.5 * np.pi * axis, np.zeros(3)))[:3, :3]
    middle = se3.translation(np.array([0.0, 0.0, 0.5 * stand.height_m]))
    lowered = se3.translation(np.array([0.0, 0.0, stand.radius_m]))
    motion = lowered @ tip @ se3.inverse(middle)
    return stand.object_from_stand @ motion @ se3.inverse(stand.object_from_stand)


def _triple(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
