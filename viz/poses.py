"""The pose graph: cameras and edges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import rerun as rr

from modeler import se3
from modeler.export.standing import upright
from modeler.types import Array, Camera, Edge, Step
from viz import entities
from viz.drawings import CLEAR, Drawing

OVER_THE_RING: Final = np.array([-0.45, -0.8, -0.4])
"""From the object towards the eye that looks at the whole graph."""

_POSES: Final = 150  # of more than so many poses every n-th is drawn
_CAMERA_SIZE: Final = 0.1  # as a share of the distance to the object
_CAPTION: Final = 1.0  # of captions below the object, as a share of the distance to it


def drawing(step: Step) -> Drawing:
    """Yield all cameras and the edges between them, in the object frame."""
    trajectory = step.solution.trajectory
    poses = np.array([trajectory[k] for k in shown(step)]).reshape(-1, 4, 4)
    size_m = camera_size_m(step)
    yield entities.CAMERAS, _frusta(poses, step.frame.camera, size_m, (entities.CAMERA_RGB, 1.0))
    yield entities.AXES, _axes(poses, size_m)
    chain = [step.solution.odometry[k][:3, 3] for k in sorted(step.solution.odometry)]
    yield entities.CHAIN, _lines([chain] if len(chain) > 1 else [], entities.CHAIN_RGB, 1.0)
    before = np.array([step.solution.odometry[k] for k in shown(step) if k in step.solution.odometry]).reshape(-1, 4, 4)
    yield entities.BEFORE_CAMERAS, _frusta(before, step.frame.camera, size_m, (entities.CHAIN_RGB, 1.0))
    yield from _edges(step)


def newest_drawing(step: Step) -> Drawing:
    """Yield the camera of the step's frame."""
    current = step.solution.trajectory.get(step.frame.index)
    if current is None:
        yield entities.CURRENT, CLEAR
    else:
        style = (entities.CURRENT_RGB, 3.0)
        yield entities.CURRENT, _frusta(current[None], step.frame.camera, 1.3 * camera_size_m(step), style)


def takes_part(edge: Edge, step: Step) -> bool:
    """Return whether an edge was accepted and not left out by the optimisation since."""
    return step.solution.takes_part(edge)


def shown(step: Step) -> list[int]:
    """Return the frames whose poses are drawn: all, or of many every n-th."""
    numbers = sorted(step.solution.trajectory)
    return numbers[:: math.ceil(max(len(numbers), 1) / _POSES)]


def camera_size_m(step: Step) -> float:
    """Return the length of a drawn camera and of its axes."""
    return _CAMERA_SIZE * distance_m(step)


def distance_m(step: Step) -> float:
    """Return how far the object was from the camera in the first accepted view; 1 m before there is one."""
    if not step.views:
        return 1.0
    points_m = step.views[min(step.views)].points_m
    return float(np.linalg.norm(points_m[:: math.ceil(len(points_m) / 500)].mean(axis=0)))


def below_ring_m(step: Step) -> Array:
    """Return a point (3,) that the eye over the whole graph sees below it: where a caption has room."""
    first = step.views[min(step.views)]
    towards_eye = OVER_THE_RING / np.linalg.norm(OVER_THE_RING)
    down = np.array([0.0, 1.0, 0.0]) - towards_eye[1] * towards_eye
    return first.centroid_m + upright(first) @ down * (_CAPTION * distance_m(step) / np.linalg.norm(down))


def _edges(step: Step) -> Drawing:
    """Yield the edges as lines between camera centres; an edge of a frame without a pose has no place."""
    trajectory = step.solution.trajectory
    lines: dict[str, list[list[Array]]] = {entities.ODOMETRY: [], entities.CLOSURE: [], entities.REJECTED: []}
    for edge in step.edges_so_far:
        if edge.source in trajectory and edge.target in trajectory:
            accepted = entities.CLOSURE if edge.kind == "closure" else entities.ODOMETRY
            path = accepted if takes_part(edge, step) else entities.REJECTED
            lines[path].append([trajectory[edge.target][:3, 3], trajectory[edge.source][:3, 3]])
    yield entities.ODOMETRY, _lines(lines[entities.ODOMETRY], entities.ODOMETRY_RGB, 1.5)
    yield entities.CLOSURE, _lines(lines[entities.CLOSURE], entities.CLOSURE_RGB, 2.5)
    yield entities.REJECTED, _lines(lines[entities.REJECTED], entities.REJECTED_RGB, 1.5)


def _lines(strips: Sequence[Array | list[Array]], rgb: entities.Rgb, points: float) -> rr.AsComponents:
    """Return line strips `points` wide on the screen, or nothing where there are none."""
    return rr.LineStrips3D(strips, colors=rgb, radii=rr.Radius.ui_points(points)) if strips else CLEAR


def _frusta(poses: Array, camera: Camera, size_m: float, style: tuple[entities.Rgb, float]) -> rr.AsComponents:
    """Return the cameras at `poses` (n, 4, 4) as pyramids `size_m` long, each one line strip."""
    across = (np.array([0, camera.width, camera.width, 0]) - camera.cx) / camera.fx
    down = (np.array([0, 0, camera.height, camera.height]) - camera.cy) / camera.fy
    corners = size_m * np.stack([across, down, np.ones(4)], axis=1)
    tip = np.zeros(3)
    outline = np.array([tip, *corners, corners[0], tip, corners[1], corners[2], tip, corners[3]])
    return _lines([se3.transform(pose, outline) for pose in poses], *style)


def _axes(poses: Array, size_m: float) -> rr.AsComponents:
    """Return the axes of the poses (n, 4, 4): x red, y green, z blue."""
    if len(poses) == 0:
        return CLEAR
    return rr.Arrows3D(
        origins=np.repeat(poses[:, :3, 3], 3, axis=0),
        vectors=size_m * np.swapaxes(poses[:, :3, :3], 1, 2).reshape(-1, 3),
        colors=np.tile(np.array(entities.AXIS_RGB, dtype=np.uint8), (len(poses), 1)),
        radii=rr.Radius.ui_points(1.0),
    )
