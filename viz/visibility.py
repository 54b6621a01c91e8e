"""What one view saw, and where the registration puts the other view's points in it (paper, section III)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import rerun as rr

from modeler import se3
from modeler.kernels import point_likelihood as kernel
from modeler.rays import Sensor
from modeler.registration.visibility import VisibilityLikelihood
from modeler.types import Array, RayImage, Step
from viz import clouds, entities, images
from viz.drawings import CLEAR, Drawing

MISSING, BACKGROUND, OBJECT = 0, 1, 2
"""Areas of a picture: nothing was measured, something other than the object was, the object was."""
AGREES, HIDDEN, VIOLATION, NO_SAY = 0, 1, 2, 3
"""Verdicts on a point: on the measured surface, behind it, in front of it, where nothing is to be told."""

_POINTS: Final = 1_200
_VERDICT: Final = np.zeros(6, dtype=np.int8)  # by that of the likelihood
_VERDICT[[kernel.MATCHED, kernel.UNKNOWN]] = AGREES, NO_SAY
_VERDICT[[kernel.HIDDEN, kernel.BEHIND]] = HIDDEN
_VERDICT[[kernel.IN_FRONT, kernel.IN_EMPTY_SPACE]] = VIOLATION
_PATHS: Final = {
    AGREES: (entities.VISIBILITY_AGREES, entities.AGREES_RGB, 1.25),
    HIDDEN: (entities.VISIBILITY_HIDDEN, entities.HIDDEN_RGB, 1.0),
    NO_SAY: (entities.VISIBILITY_NO_SAY, entities.NO_SAY_RGB, 1.0),
    VIOLATION: (entities.VISIBILITY_VIOLATIONS, entities.VIOLATION_RGB, 3.0),
}


@dataclass(frozen=True, eq=False)
class ProjectedPoints:
    """The points of one view in the image of another."""

    pixels: Array
    """(n, 2) column and row in the image, of points inside it."""
    verdicts: npt.NDArray[np.int8]
    """(n,) one of the four verdicts each."""


def statics() -> Drawing:
    """Yield what is said once: the paper's colours of the areas."""
    names = {MISSING: "no measurement", BACKGROUND: "background", OBJECT: "object"}
    colours = zip(names.items(), entities.AREAS_RGB, strict=True)
    infos = [rr.AnnotationInfo(id=number, label=name, color=rgb) for (number, name), rgb in colours]
    yield entities.VISIBILITY_AREAS, rr.AnnotationContext(infos)


def drawing(step: Step) -> Drawing:
    """Yield the areas of the target's image, and the source's points in it under the mean of the step's first pair."""
    posterior = clouds.shown_posterior(step)
    paths = (entities.VISIBILITY_AREAS, entities.VISIBILITY_CAPTION, *(path for path, _, _ in _PATHS.values()))
    if posterior is None or step.view is None or not np.isfinite(posterior.pose.mean).all():
        for path in paths:
            yield path, CLEAR
        return
    target = step.views[posterior.target]
    stride = images.depth_stride_px(target.frame)
    yield entities.VISIBILITY_AREAS, rr.SegmentationImage(areas(target)[::stride, ::stride], draw_order=0.0)
    shown = projection(step.view, target, posterior.pose.mean)
    for order, (verdict, (path, rgb, points)) in enumerate(_PATHS.items()):
        chosen = shown.pixels[shown.verdicts == verdict]
        if len(chosen) == 0:
            yield path, CLEAR
        else:
            radius = rr.Radius.ui_points(points)
            yield path, rr.Points2D(chosen / stride, colors=rgb, radii=radius, draw_order=10.0 + order)
    if len(target.pixels):
        row, column = target.pixels.max(axis=0)[0], target.pixels.mean(axis=0)[1]
        below = np.array([column, row + 0.12 * np.ptp(target.pixels, axis=0).max()]) / stride
        style = {"colors": (200, 200, 200), "radii": rr.Radius.ui_points(0.0), "show_labels": True}
        yield entities.VISIBILITY_CAPTION, rr.Points2D(below, labels=caption(shown), **style)


def caption(shown: ProjectedPoints) -> str:
    """Say how many of the points that can be judged are where they may be."""
    judged = max(int(np.sum(shown.verdicts != NO_SAY)), 1)
    agree, hidden, front = (round(100 * np.sum(shown.verdicts == v) / judged) for v in (AGREES, HIDDEN, VIOLATION))
    return f"agree {agree} %, hidden {hidden} %, in front {front} %"


def areas(view: RayImage) -> npt.NDArray[np.uint8]:
    """Return what each pixel (h, w) saw."""
    measured = np.isfinite(view.frame.depth_m) & (view.frame.depth_m > 0)
    picture = np.where(measured, BACKGROUND, MISSING).astype(np.uint8)
    picture[measured if view.frame.mask is None else view.frame.mask] = OBJECT
    return picture


def projection(source: RayImage, target: RayImage, target_from_source: Array) -> ProjectedPoints:
    """Return where points of the source land in the target's image, and whether they may be there.

    The verdicts are those of `visibility`, from which an edge's overlap is counted, whatever method found the motion.
    """
    if min(len(source.points_m), len(target.points_m)) == 0:
        return ProjectedPoints(np.zeros((0, 2)), np.zeros(0, dtype=np.int8))
    likelihood, rng = VisibilityLikelihood(points=_POINTS), np.random.default_rng(0)
    projected = likelihood.between(_ready(source), _ready(target), rng).forward
    points_m = se3.transform(target_from_source, projected.points[:, :3])
    verdicts = _VERDICT[projected.classify(se3.rows(target_from_source))]
    camera = target.frame.camera
    ahead = points_m[:, 2] > 1e-6
    points_m, verdicts = points_m[ahead], verdicts[ahead]
    scale = np.array([camera.fx, camera.fy])
    pixels = scale * points_m[:, :2] / points_m[:, 2:] + np.array([camera.cx, camera.cy])
    columns, rows = np.rint(pixels).T
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    return ProjectedPoints(pixels[inside], verdicts[inside])


def _ready(view: RayImage) -> RayImage:
    """Return a view with the images that the likelihood looks up; steps hold earlier views without them."""
    return view if view.layers else Sensor(view.sigma_wh, view.sigma_r_m).ray_image(view.frame, view.plane)
