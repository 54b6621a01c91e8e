"""The pose graph: cameras and edges, and the uncertainty of each before and after loop closure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import rerun as rr

from modeler import se3
from modeler.export.standing import upright
from modeler.graph import PoseGraph, dead_reckoning
from modeler.types import Array, Camera, Edge, Step
from viz import entities
from viz.drawings import CLEAR, Drawing, caption, ellipsoids, rounded_down, scale_words

OVER_THE_RING: Final = np.array([-0.45, -0.8, -0.4])
"""From the object towards the eye that looks at the whole graph."""

_POSES: Final = 150  # largest number of poses that are all drawn; of more, every n-th
_CAMERA_SIZE: Final = 0.1  # as a share of the distance to the object
_CAPTION: Final = 1.0  # of captions below the object, as a share of the distance to it


def draw_graph(step: Step) -> Drawing:
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


def draw_newest_camera(step: Step) -> Drawing:
    """Yield the camera of the step's frame."""
    current = step.solution.trajectory.get(step.frame.index)
    if current is None:
        yield entities.CURRENT, CLEAR
    else:
        style = (entities.CURRENT_RGB, 3.0)
        yield entities.CURRENT, _frusta(current[None], step.frame.camera, 1.3 * camera_size_m(step), style)


def shown(step: Step) -> list[int]:
    """Return the frames whose poses are drawn: all, or every n-th of many."""
    numbers = sorted(step.solution.trajectory)
    return numbers[:: math.ceil(max(len(numbers), 1) / _POSES)]


def camera_size_m(step: Step) -> float:
    """Return the length of a drawn camera and of its axes."""
    return _CAMERA_SIZE * distance_m(step)


def distance_m(step: Step) -> float:
    """Return the distance of the object from the camera in the first accepted view; 1 m before there is one."""
    if not step.views:
        return 1.0
    points_m = step.views[min(step.views)].points_m
    return float(np.linalg.norm(points_m[:: math.ceil(len(points_m) / 500)].mean(axis=0)))


def below_ring_m(step: Step) -> Array:
    """Return a point (3,) below the graph as seen by the initial eye, for a caption."""
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
            path = accepted if step.solution.takes_part(edge) else entities.REJECTED
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


_LARGEST_3_SIGMA: Final = 0.3  # half axis of the largest ellipsoid of a chain, as a share of the object's distance
_LARGEST_EDGE_SIGMA: Final = 0.12  # half axis of the largest ellipsoid of an edge, as a share of that distance
_AFTER: Final = (
    entities.POSITION_1_SIGMA,
    entities.POSITION_3_SIGMA,
    entities.AXIS_TIPS_1_SIGMA,
    entities.MAGNIFICATION,
)
_BEFORE: Final = (
    entities.BEFORE_POSITION_1_SIGMA,
    entities.BEFORE_POSITION_3_SIGMA,
    entities.BEFORE_AXIS_TIPS_1_SIGMA,
    entities.BEFORE_MAGNIFICATION,
)


def draw_uncertainty(step: Step) -> Drawing:
    """Yield the ellipsoids of the edges, of the poses, and of the poses of the chain before closure, all magnified."""
    factor = magnification(step.edges_so_far, distance_m(step))
    frames = shown(step)
    after = {frame: step.solution.covariances[frame] for frame in frames if frame in step.solution.covariances}
    yield from _of_poses(step, _AFTER, step.solution.trajectory, after, factor)
    root = next(iter(step.solution.odometry), None)  # the chain is walked outwards from it
    chain = dead_reckoning(PoseGraph(step.edges_so_far, root))
    chained = {k: chain[k].covariance for k in frames if k in chain and k in step.solution.odometry}
    yield from _of_poses(step, _BEFORE, step.solution.odometry, chained, factor)
    yield from _of_edges(step)


def _of_poses(
    step: Step, paths: Sequence[str], trajectory: Mapping[int, Array], covariances: Mapping[int, Array], factor: float
) -> Drawing:
    """Yield the ellipsoids of poses whose covariance is known, to the four paths of a set."""
    covariances = {k: covariance for k, covariance in covariances.items() if np.isfinite(covariance).all()}
    if not covariances or not step.views:
        for path in paths:
            yield path, CLEAR
        return
    size_m = camera_size_m(step)
    known_poses = np.array([trajectory[k] for k in covariances])
    rotations, centres = known_poses[:, :3, :3], known_poses[:, :3, 3]
    blocks = np.array(list(covariances.values()))
    half_axes, quaternions = ellipsoids(rotations @ blocks[:, 3:, 3:] @ np.swapaxes(rotations, 1, 2))
    one_sigma, three_sigma, tips_one_sigma, label = paths
    for path, sigmas, style in (
        (one_sigma, 1.0, rr.components.FillMode.Solid),
        (three_sigma, 3.0, rr.components.FillMode.MajorWireframe),
    ):
        yield (
            path,
            rr.Ellipsoids3D(
                centers=centres,
                half_sizes=sigmas * factor * half_axes,
                quaternions=quaternions,
                colors=entities.UNCERTAINTY_RGB,
                line_radii=rr.Radius.ui_points(0.75),
                fill_mode=style,
            ),
        )
    tips = np.concatenate(
        [axis_tip_covariances(rotation, block[:3, :3]) for rotation, block in zip(rotations, blocks, strict=True)]
    )
    half_axes, quaternions = ellipsoids(size_m**2 * tips)
    yield (
        tips_one_sigma,
        rr.Ellipsoids3D(
            centers=(centres[:, None] + size_m * np.swapaxes(rotations, 1, 2)).reshape(-1, 3),
            half_sizes=factor * half_axes,
            quaternions=quaternions,
            colors=np.tile(np.array(entities.AXIS_RGB, dtype=np.uint8), (len(blocks), 1)),
            fill_mode=rr.components.FillMode.Solid,
        ),
    )
    words = f"1 and 3 sd, {scale_words(factor)}"
    yield label, caption(below_ring_m(step), words, entities.UNCERTAINTY_RGB)


def _of_edges(step: Step) -> Drawing:
    """Yield an ellipsoid half way along each edge that takes part: the shift within 1 sd that its posterior allows."""
    trajectory = step.solution.trajectory
    edges = [
        edge
        for edge in step.edges_so_far
        if edge.source in trajectory and edge.target in trajectory and step.solution.takes_part(edge)
    ]
    edges = [edge for edge in edges if np.isfinite(edge.posterior.pose.covariance).all()]
    if not edges or not step.views:
        yield entities.EDGES_1_SIGMA, CLEAR
        yield entities.EDGES_MAGNIFICATION, CLEAR
        return
    ends = np.array([[trajectory[edge.target][:3, 3], trajectory[edge.source][:3, 3]] for edge in edges])
    rotations = np.array([trajectory[edge.source][:3, :3] for edge in edges])
    blocks = np.array([edge.posterior.pose.covariance[3:, 3:] for edge in edges])
    half_axes, quaternions = ellipsoids(rotations @ blocks @ np.swapaxes(rotations, 1, 2))
    factor = rounded_down(_LARGEST_EDGE_SIGMA * distance_m(step) / max(float(half_axes.max()), 1e-9))
    factor = min(max(factor, 0.1), 1000.0)
    yield (
        entities.EDGES_1_SIGMA,
        rr.Ellipsoids3D(
            centers=ends.mean(axis=1),
            half_sizes=factor * half_axes,
            quaternions=quaternions,
            colors=np.array([_edge_rgb(edge) for edge in edges], dtype=np.uint8),
            fill_mode=rr.components.FillMode.Solid,
        ),
    )
    words = f"edges: 1 sd, {scale_words(factor)}"
    yield entities.EDGES_MAGNIFICATION, caption(below_ring_m(step), words, entities.UNCERTAINTY_RGB)


def _edge_rgb(edge: Edge) -> entities.Rgb:
    return entities.CLOSURE_RGB if edge.kind == "closure" else entities.UNCERTAINTY_RGB


def magnification(edges: Sequence[Edge], distance_m: float) -> float:
    """Return the factor 0.1, 0.2, 0.5, 1, 2 … 1000 by which uncertainty is magnified.

    It follows from the accepted odometry edges alone and never grows with more of them, so that the ellipsoids that
    loop closure makes smaller also look smaller.
    """
    variances = [
        _largest_variance(edge.posterior.pose.covariance[3:, 3:])
        for edge in edges
        if edge.accepted and edge.kind == "odometry"
    ]
    variances = [variance for variance in variances if math.isfinite(variance) and variance > 0.0]
    if not variances:
        return 1.0
    sigma_m = math.sqrt(max(9.0 * variances[0], sum(variances)))  # room for nine edges from the start
    return min(max(rounded_down(_LARGEST_3_SIGMA * distance_m / (3.0 * sigma_m)), 0.1), 1000.0)


def axis_tip_covariances(rotation: Array, covariance: Array) -> Array:
    """Return the covariances (3, 3, 3) of the tips of a pose's three unit axes about its centre.

    A tip moves by R (ω × e) under the right perturbation ω of the rotation R.

    Args:
        rotation: (3, 3) of the pose.
        covariance: (3, 3) of ω.
    """
    jacobians = -rotation @ se3.hat(np.eye(3))
    return jacobians @ covariance @ np.swapaxes(jacobians, 1, 2)


def _largest_variance(covariance: Array) -> float:
    """Return the largest eigenvalue of a covariance; NaN where it is not finite."""
    return float(np.linalg.eigvalsh(covariance)[-1]) if np.isfinite(covariance).all() else float("nan")
