"""How sure each pose of the graph is, drawn."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.types import Array, Edge, Step
from viz import entities, poses

Drawing = Iterator[tuple[str, rr.AsComponents]]

_LARGEST_3_SIGMA: Final = 0.3  # half axis of the largest ellipsoid of a chain, as a share of the object's distance
_CLEAR: Final = rr.Clear(recursive=False)


def drawing(step: Step) -> Drawing:
    """Yield the ellipsoids of the poses whose covariance is known."""
    size_m = poses.camera_size_m(step)
    paths = (entities.POSITION_1_SIGMA, entities.POSITION_3_SIGMA, entities.AXIS_TIPS_1_SIGMA, entities.MAGNIFICATION)
    covariances = step.solution.covariances
    known = [k for k in poses.shown(step) if k in covariances and step.views and np.isfinite(covariances[k]).all()]
    if not known:
        for path in paths:
            yield path, _CLEAR
        return
    factor = magnification(step.edges_so_far, poses.distance_m(step))
    known_poses = np.array([step.solution.trajectory[k] for k in known])
    rotations, centres = known_poses[:, :3, :3], known_poses[:, :3, 3]
    blocks = np.array([covariances[k] for k in known])
    half_axes, quaternions = ellipsoids(rotations @ blocks[:, 3:, 3:] @ np.swapaxes(rotations, 1, 2))
    for path, sigmas, style in (
        (entities.POSITION_1_SIGMA, 1.0, rr.components.FillMode.Solid),
        (entities.POSITION_3_SIGMA, 3.0, rr.components.FillMode.MajorWireframe),
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
        entities.AXIS_TIPS_1_SIGMA,
        rr.Ellipsoids3D(
            centers=(centres[:, None] + size_m * np.swapaxes(rotations, 1, 2)).reshape(-1, 3),
            half_sizes=factor * half_axes,
            quaternions=quaternions,
            colors=np.tile(np.array(entities.AXIS_RGB, dtype=np.uint8), (len(known), 1)),
            fill_mode=rr.components.FillMode.Solid,
        ),
    )
    below_object = step.views[min(step.views)].centroid_m + np.array([0.0, 4.0 * size_m, 0.0])
    yield (
        entities.MAGNIFICATION,
        rr.Points3D(
            below_object,
            labels=f"uncertainty drawn \N{MULTIPLICATION SIGN}{factor:g}",
            show_labels=True,
            radii=rr.Radius.ui_points(0.0),
            colors=entities.UNCERTAINTY_RGB,
        ),
    )


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
    wanted = _LARGEST_3_SIGMA * distance_m / (3.0 * sigma_m)
    decade = 10.0 ** math.floor(math.log10(wanted))
    return min(max(max(factor * decade for factor in (1, 2, 5) if factor * decade <= wanted), 0.1), 1000.0)


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
