"""How sure each edge and each pose of the graph is, drawn: before loop closure and after."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.graph import PoseGraph, dead_reckoning
from modeler.types import Array, Edge, Step
from viz import clouds, entities, poses
from viz.drawings import CLEAR, Drawing

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


def drawing(step: Step) -> Drawing:
    """Yield the ellipsoids of the edges, of the poses, and of the poses of the chain before closure, all magnified."""
    factor = magnification(step.edges_so_far, poses.distance_m(step))
    shown = poses.shown(step)
    after = {frame: step.solution.covariances[frame] for frame in shown if frame in step.solution.covariances}
    yield from _of_poses(step, _AFTER, step.solution.trajectory, after, factor)
    root = next(iter(step.solution.odometry), None)  # the chain is walked outwards from it
    chain = dead_reckoning(PoseGraph(step.edges_so_far, root))
    chained = {k: chain[k].covariance for k in shown if k in chain and k in step.solution.odometry}
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
    size_m = poses.camera_size_m(step)
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
    yield label, clouds.caption(poses.below_ring_m(step), words, entities.UNCERTAINTY_RGB)


def scale_words(factor: float) -> str:
    """Say how many times larger than life something is drawn."""
    return "to scale" if factor == 1.0 else f"drawn \N{MULTIPLICATION SIGN}{factor:g}"


def _of_edges(step: Step) -> Drawing:
    """Yield an ellipsoid half way along each edge that takes part: the shift within 1 sd that its posterior allows."""
    trajectory = step.solution.trajectory
    edges = [
        edge
        for edge in step.edges_so_far
        if edge.source in trajectory and edge.target in trajectory and poses.takes_part(edge, step)
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
    factor = rounded_down(_LARGEST_EDGE_SIGMA * poses.distance_m(step) / max(float(half_axes.max()), 1e-9))
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
    yield entities.EDGES_MAGNIFICATION, clouds.caption(poses.below_ring_m(step), words, entities.UNCERTAINTY_RGB)


def _edge_rgb(edge: Edge) -> entities.Rgb:
    return entities.CLOSURE_RGB if edge.kind == "closure" else entities.UNCERTAINTY_RGB


def magnification(edges: Sequence[Edge], distance_m: float) -> float:
    """Return the factor 0.1, 0.2, 0.5, 1, 2 … 1000 by which uncertainty is drawn larger than life.

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


def rounded_down(number: float) -> float:
    """Return the largest of …, 0.5, 1, 2, 5, 10, … that is not above a positive number."""
    decade = 10.0 ** math.floor(math.log10(number))
    return max(factor * decade for factor in (1, 2, 5) if factor * decade <= number)


def ellipsoids(covariances: Array) -> tuple[Array, Array]:
    """Return the half axes (n, 3) at one sd and the orientations (n, 4: x, y, z, w) of covariances (n, 3, 3)."""
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, not a reflection
    half_axes = np.sqrt(np.maximum(variances, 0.0))
    thinnest = np.maximum(0.02 * half_axes.max(axis=1, keepdims=True), 1e-9)  # a disc without thickness is not drawn
    return np.maximum(half_axes, thinnest), Rotation.from_matrix(axes).as_quat()


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
