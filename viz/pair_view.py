"""The newest pair of views: its clouds before and after alignment, and how sure the posterior is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import rerun as rr

from modeler import se3
from modeler.export.placing import upright
from modeler.types import Array, Mode, Posterior, RayImage, Step
from modeler.viz import entities
from modeler.viz.drawings import (
    CLEAR,
    POINT_SIZE,
    VIEW_POINTS,
    Drawing,
    Ellipsoids,
    caption,
    rotated,
    rounded_down,
    scale_words,
    shaded,
    shown_posterior,
)
from modeler.viz.readings import worst_axis_sds

_DRAWS: Final = 80  # samples, of which each is still seen by itself
_PATHS: Final = (
    entities.PAIR_AXES,
    entities.PAIR_DRAWS,
    entities.GHOSTS,
    entities.GHOST_MEANS,
    entities.GHOST_TIPS,
    entities.GHOST_CENTRE_1_SIGMA,
    entities.GHOST_CENTRE_3_SIGMA,
    entities.GHOST_LABELS,
)


@dataclass(frozen=True, eq=False)
class Ghosts:
    """Samples of a posterior, magnified about the modes they belong to."""

    modes: tuple[Mode, ...]
    """Heaviest first; the posterior's Gaussian if it has none."""
    factor: float
    """Magnification; never less than 1."""
    poses: Array
    """(n, 4, 4) target_from_source as drawn."""
    mode_of: npt.NDArray[np.int64]
    """(n,) the mode of each sample."""


def draw_posterior(step: Step) -> Drawing:
    """Yield the posterior of the step's pair: to scale the source's axes, magnified the source and its centre.

    To scale, the axes at the mean and their ends under samples. Magnified, the source at every mode and at samples, the
    ends of its axes, and the ellipsoids of its centre.
    """
    posterior = shown_posterior(step)
    if posterior is None or step.view is None or not np.isfinite(posterior.pose.covariance).all():
        for path in _PATHS:
            yield path, CLEAR
        return
    view, mean, ghosts = step.view, posterior.pose.mean, magnified(posterior, step.view)
    yield (
        entities.PAIR_AXES,
        rr.Arrows3D(
            origins=np.tile(se3.transform(mean, view.centroid_m), (3, 1)),
            vectors=axes_length_m(view) * mean[:3, :3].T,
            colors=np.array(entities.AXIS_RGB, dtype=np.uint8),
            radii=rr.Radius.ui_points(0.75),
        ),
    )
    yield entities.PAIR_DRAWS, _tips(view, draws(posterior), 2.0)
    colours = np.array([entities.MODE_RGB[k % len(entities.MODE_RGB)] for k in range(len(ghosts.modes))])
    few = view.points_m[:: math.ceil(len(view.points_m) / 200)]
    points = np.concatenate([se3.transform(pose, few) for pose in ghosts.poses])
    dim = np.repeat((0.55 * colours[ghosts.mode_of]).astype(np.uint8), len(few), axis=0)
    yield entities.GHOSTS, rr.Points3D(points, colors=dim, radii=rr.Radius.ui_points(0.6))
    yield entities.GHOST_MEANS, _means(view, ghosts.modes, colours)
    yield entities.GHOST_TIPS, _tips(view, ghosts.poses, 2.5)
    yield from _centres(view, ghosts, colours)


def _tips(view: RayImage, poses: Array, points: float) -> rr.Points3D:
    """Return the ends of the object's axes at poses (n, 4, 4), as dots of a size on the screen."""
    ends = view.centroid_m + axes_length_m(view) * np.eye(3)
    places = np.einsum("nij,kj->nki", poses[:, :3, :3], ends) + poses[:, None, :3, 3]
    colours = np.tile(np.array(entities.AXIS_RGB, dtype=np.uint8), (len(poses), 1))
    return rr.Points3D(places.reshape(-1, 3), colors=colours, radii=rr.Radius.ui_points(points))


def _radius_m(view: RayImage) -> float:
    """Return the distance of the farthest point from the centroid."""
    return float(np.linalg.norm(view.points_m - view.centroid_m, axis=1).max())


def axes_length_m(view: RayImage) -> float:
    """Return the length of the object's axes as drawn: they stick out of it."""
    return 1.1 * _radius_m(view)


def draws(posterior: Posterior) -> Array:
    """Return samples (n, 4, 4) of a posterior, the same at every call.

    They are taken at even steps of the cumulative weight; without samples, they are the sigma points of the
    covariance.
    """
    if len(posterior.samples) > 0:
        cumulative = np.cumsum(posterior.weights)
        steps = (np.arange(_DRAWS) + 0.5) / _DRAWS * cumulative[-1]
        return posterior.samples[np.minimum(np.searchsorted(cumulative, steps), len(cumulative) - 1)]
    variances, axes = np.linalg.eigh(posterior.pose.covariance)
    sds = (np.sqrt(np.maximum(variances, 0.0)) * axes).T
    return posterior.pose.mean @ se3.exp(np.concatenate([sds, -sds]))


def magnified(posterior: Posterior, view: RayImage) -> Ghosts:
    """Return samples of a posterior, magnified by a round factor that separates them visibly.

    Each sample moves away from the mean of its own mode, about the object's centre; modes stay in place.
    """
    modes = posterior.modes or (Mode(1.0, posterior.pose),)
    centre = se3.translation(view.centroid_m)
    drawn = draws(posterior)
    drawn = drawn[np.linspace(0, len(drawn) - 1, min(20, len(drawn))).astype(np.int64)]  # as whole objects
    mode_of = np.array([_nearest(modes, pose) for pose in drawn])
    means = np.array([mode.pose.mean for mode in modes])[mode_of] @ centre
    factor = _factor(modes, view)
    poses = means @ se3.exp(factor * se3.log(se3.inverse(means) @ drawn @ centre)) @ se3.inverse(centre)
    return Ghosts(modes, factor, poses, mode_of)


def _nearest(modes: Sequence[Mode], pose: Array) -> int:
    """Return the number of the most probable mode of a sample (4, 4)."""
    if len(modes) == 1:
        return 0
    costs = []
    for mode in modes:
        xi = se3.log(se3.inverse(mode.pose.mean) @ pose)
        _, log_det = np.linalg.slogdet(mode.pose.covariance)
        costs.append(xi @ np.linalg.solve(mode.pose.covariance, xi) + log_det - 2.0 * math.log(max(mode.weight, 1e-9)))
    return int(np.argmin(costs))


def _factor(modes: Sequence[Mode], view: RayImage) -> float:
    """Return the magnification of the samples.

    The farthest point under the widest mode has an sd of 12 % of its distance from the centre as drawn, and the
    rotation one of 0.25 rad at most: beyond it a magnified spread no longer looks like one.
    """
    radius_m = _radius_m(view)
    widest_rad, widest_m = 0.0, 0.0
    for mode in modes:
        covariance = se3.covariance_about(mode.pose.covariance, view.centroid_m)
        turn_rad, shift_m = worst_axis_sds(covariance)
        widest_rad, widest_m = max(widest_rad, turn_rad), max(widest_m, math.hypot(radius_m * turn_rad, shift_m))
    if not widest_m > 0.0:
        return 1.0
    wanted = min(0.12 * radius_m / widest_m, 0.25 / max(widest_rad, 1e-9))
    return min(rounded_down(wanted), 1000.0) if wanted >= 1.0 else 1.0


def _means(view: RayImage, modes: Sequence[Mode], colours: npt.NDArray[np.int64]) -> rr.Points3D:
    """Return the source's cloud at the mean of every mode, of so many points that they stand out against samples."""
    stride = math.ceil(len(view.points_m) * len(modes) / 1_500)
    points, normals = view.points_m[::stride], view.normals[::stride]
    return rr.Points3D(
        np.concatenate([se3.transform(mode.pose.mean, points) for mode in modes]),
        colors=np.concatenate([shaded(tuple(rgb), normals) for rgb in colours.tolist()]),
        radii=rr.Radius.ui_points(1.0),
    )


def _centres(view: RayImage, ghosts: Ghosts, colours: npt.NDArray[np.int64]) -> Drawing:
    """Yield the covariance ellipsoids of the object's centre under every mode, and their captions."""
    poses = np.array([mode.pose.mean for mode in ghosts.modes])
    centres = np.array([se3.transform(pose, view.centroid_m) for pose in poses])
    covariances = np.array([mode.pose.covariance for mode in ghosts.modes])
    blocks = se3.covariance_about(covariances, view.centroid_m)[:, 3:, 3:]
    spread, styles = Ellipsoids.of(centres, rotated(poses, blocks), ghosts.factor), rr.components.FillMode
    yield entities.GHOST_CENTRE_1_SIGMA, spread.drawn(1.0, entities.UNCERTAINTY_RGB, styles.Solid)
    yield entities.GHOST_CENTRE_3_SIGMA, spread.drawn(3.0, entities.UNCERTAINTY_RGB, styles.DenseWireframe)
    # The heaviest mode's caption stands below the object, the others' one over another above it.
    down = 1.1 * axes_length_m(view) * np.array([1.0, *(-1.0 - 0.25 * np.arange(len(centres) - 1))])
    places = centres[0] + down[:, None] * upright(view)[:, 1]
    scale = f"spread {scale_words(ghosts.factor)}"
    shares = [f"mode {k + 1}: {100.0 * mode.weight:.0f} %" for k, mode in enumerate(ghosts.modes)]
    labels = [scale] if len(shares) == 1 else [f"{shares[0]}, {scale}", *shares[1:]]
    yield (
        entities.GHOST_LABELS,
        rr.Points3D(places, labels=labels, show_labels=True, radii=rr.Radius.ui_points(0.0), colors=colours),
    )


def draw_pair(step: Step) -> Drawing:
    """Yield the source and target clouds of the step's first registration in the target's camera frame."""
    posterior = shown_posterior(step)
    if posterior is None or step.view is None:
        for path in (entities.PAIR_TARGET, entities.PAIR_BEFORE, entities.PAIR_AFTER, entities.PAIR_CAPTION):
            yield path, CLEAR
        return
    identity = np.eye(4)
    yield entities.PAIR_TARGET, _view_points(step.views[posterior.target], identity, entities.TARGET_RGB)
    yield entities.PAIR_BEFORE, _view_points(step.view, identity, entities.SOURCE_RGB)
    yield entities.PAIR_AFTER, _view_points(step.view, posterior.pose.mean, entities.SOURCE_RGB)
    words = f"orange: frame {posterior.source}, teal: frame {posterior.target}"
    yield entities.PAIR_CAPTION, caption(below_m(step.views[posterior.target]), words, (200, 200, 200))


def below_m(view: RayImage) -> Array:
    """Return a point (3,) below the object of a view, for a caption."""
    return view.centroid_m + 1.2 * _radius_m(view) * upright(view)[:, 1]


def _view_points(view: RayImage, target_from_view: Array, rgb: entities.Rgb) -> rr.Points3D:
    """Return the surface points of a view, carried to the target's camera frame."""
    stride = math.ceil(max(len(view.points_m), 1) / VIEW_POINTS)
    points = se3.transform(target_from_view, view.points_m[::stride])
    return rr.Points3D(points, colors=shaded(rgb, view.normals[::stride]), radii=POINT_SIZE)
