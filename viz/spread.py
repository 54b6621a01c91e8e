"""How far the posterior of the newest pair spreads: the ends of the object's axes under draws from it."""

from __future__ import annotations

from typing import Final

import numpy as np
import rerun as rr

from modeler import se3
from modeler.types import Array, Posterior, RayImage, Step
from viz import clouds, entities
from viz.drawings import CLEAR, Drawing

_DRAWS: Final = 80
_LENGTH: Final = 1.1  # of the axes, in distances of the farthest point from the centroid: they stick out of the object


def drawing(step: Step) -> Drawing:
    """Yield the axes of the source at the mean of the pair's posterior, and their ends under draws from it."""
    posterior = clouds.shown_posterior(step)
    if posterior is None or step.view is None or not np.isfinite(posterior.pose.covariance).all():
        yield entities.PAIR_AXES, CLEAR
        yield entities.PAIR_DRAWS, CLEAR
        return
    centre = step.view.centroid_m
    length_m = axes_length_m(step.view)
    ends = centre + length_m * np.eye(3)
    mean = posterior.pose.mean
    colours = np.array(entities.AXIS_RGB, dtype=np.uint8)
    yield (
        entities.PAIR_AXES,
        rr.Arrows3D(
            origins=np.tile(se3.transform(mean, centre), (3, 1)),
            vectors=length_m * mean[:3, :3].T,
            colors=colours,
            radii=rr.Radius.ui_points(0.75),
        ),
    )
    poses = draws(posterior)
    points = np.einsum("nij,kj->nki", poses[:, :3, :3], ends) + poses[:, None, :3, 3]
    yield (
        entities.PAIR_DRAWS,
        rr.Points3D(points.reshape(-1, 3), colors=np.tile(colours, (len(poses), 1)), radii=rr.Radius.ui_points(2.0)),
    )


def axes_length_m(view: RayImage) -> float:
    """Return the length of the object's axes as drawn."""
    return _LENGTH * float(np.linalg.norm(view.points_m - view.centroid_m, axis=1).max())


def draws(posterior: Posterior) -> Array:
    """Return motions (n, 4, 4) that stand for a posterior, the same at every call.

    They are samples at even steps of the cumulative weight; of a method without samples, the motions one sd along
    each axis of the covariance to either side.
    """
    if len(posterior.samples) > 0:
        cumulative = np.cumsum(posterior.weights)
        steps = (np.arange(_DRAWS) + 0.5) / _DRAWS * cumulative[-1]
        return posterior.samples[np.minimum(np.searchsorted(cumulative, steps), len(cumulative) - 1)]
    variances, axes = np.linalg.eigh(posterior.pose.covariance)
    sds = (np.sqrt(np.maximum(variances, 0.0)) * axes).T
    return posterior.pose.mean @ se3.exp(np.concatenate([sds, -sds]))
