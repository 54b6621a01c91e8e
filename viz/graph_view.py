"""The pose graph: cameras and edges, and the uncertainty of each before and after loop closure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import rerun as rr

from modeler import se3
from modeler.export.placing import upright
from modeler.graph import PoseGraph, dead_reckoning
from modeler.types import Array, Camera, Edge, PoseGaussian, Step
from modeler.viz import entities
from modeler.viz.drawings import CLEAR, Drawing, Ellipsoids, caption, pyramid, rotated, rounded_down, scale_words
from modeler.viz.readings import pose_table

OVER_THE_RING: Final = np.array([-0.45, -0.8, -0.4])  # from the object towards the eye that looks at the whole graph


def draw_graph(step: Step) -> Drawing:
    """Yield all cameras and the edges between them, in the object frame."""
    trajectory = step.solution.trajectory
    poses = np.array([trajectory[k] for k in shown(step)]).reshape(-1, 4, 4)
    size_m = camera_size_m(step)
    yield entities.CAMERAS, _frusta(poses, step.frame.camera, size_m, (entities.CAMERA_RGB, 1.0))
    yield entities.AXES, _axes(poses, size_m)
    chain = [step.solution.odometry[k][:3, 3] for k in sorted(step.solution.odometry)]
    yield entities.CHAIN, _lines([chain] if len(chain) > 1 else [], entities.BEFORE_RGB, 1.0)
    yield from _edges(step)


def draw_newest_camera(step: Step) -> Drawing:
    """Yield the camera of the step's frame."""
    current = step.solution.trajectory.get(step.frame.index)
    if current is None:
        yield entities.CURRENT, CLEAR
    else:
        style = (entities.SOURCE_RGB, 3.0)
        yield entities.CURRENT, _frusta(current[None], step.frame.camera, 1.3 * camera_size_m(step), style)


def shown(step: Step) -> list[int]:
    """Return the frames whose poses are drawn: all of up to 150, or every n-th of more."""
    numbers = sorted(step.solution.trajectory)
    return numbers[:: math.ceil(max(len(numbers), 1) / 150)]


def camera_size_m(step: Step) -> float:
    """Return the length of a drawn camera and of its axes."""
    return 0.1 * distance_m(step)


def distance_m(step: Step) -> float:
    """Return the distance of the object from the camera in the first accepted view; 1 m before there is one."""
    if not step.views:
        return 1.0
    points_m = step.views[min(step.views)].points_m
    return float(np.linalg.norm(points_m[:: math.ceil(len(points_m) / 500)].mean(axis=0)))


def _edges(step: Step) -> Drawing:
    """Yield the edges as lines between camera centres; an edge of a frame without a pose has no place."""
    trajectory = step.solution.trajectory
    lines: dict[str, list[list[Array]]] = {entities.ODOMETRY: [], entities.CLOSURE: [], entities.REJECTED: []}
    for edge in step.edges_so_far:
        if edge.source in trajectory and edge.target in trajectory:
            accepted = entities.CLOSURE if edge.kind in ("closure", "join") else entities.ODOMETRY
            path = accepted if step.solution.takes_part(edge) else entities.REJECTED
            lines[path].append([trajectory[edge.target][:3, 3], trajectory[edge.source][:3, 3]])
    yield entities.ODOMETRY, _lines(lines[entities.ODOMETRY], entities.ODOMETRY_RGB, 1.5)
    yield entities.CLOSURE, _lines(lines[entities.CLOSURE], entities.CLOSURE_RGB, 2.5)
    yield entities.REJECTED, _lines(lines[entities.REJECTED], entities.REJECTED_RGB, 1.5)


def _lines(strips: Sequence[Array | list[Array]], rgb: entities.Rgb, points: float) -> rr.AsComponents:
    """Return line strips `points` wide on the screen, or nothing if there are none."""
    return rr.LineStrips3D(strips, colors=rgb, radii=rr.Radius.ui_points(points)) if strips else CLEAR


def _frusta(poses: Array, camera: Camera, size_m: float, style: tuple[entities.Rgb, float]) -> rr.AsComponents:
    """Return the cameras at `poses` (n, 4, 4) as pyramids `size_m` long, each one line strip."""
    across = (np.array([0, camera.width, camera.width, 0]) - camera.cx) / camera.fx
    down = (np.array([0, 0, camera.height, camera.height]) - camera.cy) / camera.fy
    outline = pyramid(size_m * np.stack([across, down, np.ones(4)], axis=1))
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


_SOLID: Final = rr.components.FillMode.Solid
_WIRE: Final = rr.components.FillMode.MajorWireframe


def draw_uncertainty(step: Step) -> Drawing:
    """Yield the ellipsoids of the poses before and after closure and of the edges, all magnified alike, and a table.

    Before closure, poses have the covariances of the chain of consecutive edges.
    """
    factor = magnification(step.edges_so_far, distance_m(step))
    root = next(iter(step.solution.odometry), None)  # the chain is walked outwards from it
    chain = {
        frame: pose
        for frame, pose in dead_reckoning(PoseGraph(step.edges_so_far, root)).items()
        if frame in step.solution.odometry
    }
    covariances = step.solution.covariances
    poses = {k: PoseGaussian(step.solution.trajectory[k], covariances[k]) for k in shown(step) if k in covariances}
    before = _positions([chain[frame] for frame in poses if frame in chain], factor)
    after = _positions(list(poses.values()), factor)
    yield entities.BEFORE_POSITION_3_SIGMA, before.drawn(3.0, entities.BEFORE_RGB, _WIRE)
    yield entities.POSITION_3_SIGMA, after.drawn(3.0, entities.UNCERTAINTY_RGB, _WIRE)
    yield entities.POSITION_1_SIGMA, after.drawn(1.0, entities.UNCERTAINTY_RGB, _SOLID)
    yield from _of_edges(step, factor)
    words = f"positions within 1 and 3 sd, {scale_words(factor)}: violet before closure, yellow after"
    yield entities.MAGNIFICATION, _below_ring(step, words if len(after.centres_m) else "")
    yield entities.POSES, rr.TextDocument(pose_table(step, chain, shown(step)), media_type=rr.MediaType.MARKDOWN)


def _positions(poses: Sequence[PoseGaussian], factor: float) -> Ellipsoids:
    """Return the ellipsoids of the positions of poses whose covariance is known."""
    poses = [pose for pose in poses if np.isfinite(pose.covariance).all()]
    means = np.array([pose.mean for pose in poses]).reshape(-1, 4, 4)
    blocks = np.array([pose.covariance[3:, 3:] for pose in poses]).reshape(-1, 3, 3)
    return Ellipsoids.of(means[:, :3, 3], rotated(means, blocks), factor)


def _of_edges(step: Step, factor: float) -> Drawing:
    """Yield an ellipsoid half way along each edge that takes part: the shift within 1 sd that its posterior allows."""
    trajectory = step.solution.trajectory
    edges = [
        edge
        for edge in step.edges_so_far
        if edge.source in trajectory and edge.target in trajectory and step.solution.takes_part(edge)
    ]
    edges = [edge for edge in edges if np.isfinite(edge.posterior.pose.covariance).all()]
    ends = np.array([[trajectory[edge.target][:3, 3], trajectory[edge.source][:3, 3]] for edge in edges])
    sources = np.array([trajectory[edge.source] for edge in edges]).reshape(-1, 4, 4)
    blocks = np.array([edge.posterior.pose.covariance[3:, 3:] for edge in edges]).reshape(-1, 3, 3)
    spreads = Ellipsoids.of(ends.reshape(-1, 2, 3).mean(axis=1), rotated(sources, blocks), factor)
    closures = np.array([edge.kind in ("closure", "join") for edge in edges], dtype=np.bool_)
    colours = np.where(closures[:, None], entities.CLOSURE_RGB, entities.UNCERTAINTY_RGB).astype(np.uint8)
    yield entities.EDGES_1_SIGMA, spreads.drawn(1.0, colours, _SOLID)
    words = f"edges within 1 sd, {scale_words(factor)}"
    yield entities.EDGES_MAGNIFICATION, _below_ring(step, words if edges else "")


def _below_ring(step: Step, words: str) -> rr.AsComponents:
    """Return a caption below the graph as seen by the initial eye; nothing without words or where nothing is drawn."""
    if not (words and step.views):
        return CLEAR
    first = step.views[min(step.views)]
    towards_eye = OVER_THE_RING / np.linalg.norm(OVER_THE_RING)
    down = np.array([0.0, 1.0, 0.0]) - towards_eye[1] * towards_eye
    at_m = first.centroid_m + upright(first) @ down * (distance_m(step) / np.linalg.norm(down))
    return caption(at_m, words, entities.UNCERTAINTY_RGB)


def magnification(edges: Sequence[Edge], distance_m: float) -> float:
    """Return the factor 0.1, 0.2, 0.5, 1, 2 … 1000 by which uncertainty is magnified.

    It follows from the accepted odometry edges alone and never grows with more of them, so that the ellipsoids that
    loop closure makes smaller also look smaller.
    """
    blocks = [e.posterior.pose.covariance[3:, 3:] for e in edges if e.accepted and e.kind == "odometry"]
    finite = np.array([block for block in blocks if np.isfinite(block).all()]).reshape(-1, 3, 3)
    variances = [variance for variance in np.linalg.eigvalsh(finite)[:, -1].tolist() if variance > 0.0]
    if not variances:
        return 1.0
    sigma_m = math.sqrt(max(9.0 * variances[0], sum(variances)))  # room for nine edges from the start
    largest_m = 0.3 * distance_m  # half axis of the largest ellipsoid of a chain
    return min(max(rounded_down(largest_m / (3.0 * sigma_m)), 0.1), 1000.0)
