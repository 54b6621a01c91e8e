"""What one view saw, and where the registration puts the other view's points in it (paper, section III)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import rerun as rr
from scipy import ndimage

from modeler import se3
from modeler.types import Array, BoolArray, RayImage, Step
from viz import clouds, entities, images
from viz.drawings import CLEAR, Drawing

MISSING, BACKGROUND, OBJECT = 0, 1, 2
"""Areas of a picture: nothing was measured, something other than the object was, the object was."""
AGREES, HIDDEN, VIOLATION, NO_SAY = 0, 1, 2, 3
"""Verdicts on a point: on the measured surface, behind it, in front of it, where nothing was measured."""

_POINTS: Final = 1_200
_SIGMAS: Final = 4.0  # closer to the surface than this a point agrees with it
_DEAD: Final = 1.25  # width of the rim of the silhouette, in lateral sds, where pixels are mixed and judge nothing
_PATHS: Final = {
    AGREES: (entities.VISIBILITY_AGREES, entities.AGREES_RGB, 1.25),
    HIDDEN: (entities.VISIBILITY_HIDDEN, entities.HIDDEN_RGB, 1.0),
    NO_SAY: (entities.VISIBILITY_NO_SAY, entities.NO_SAY_RGB, 1.0),
    VIOLATION: (entities.VISIBILITY_VIOLATIONS, entities.VIOLATION_RGB, 3.0),
}


@dataclass(frozen=True, eq=False)
class Projection:
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


def caption(shown: Projection) -> str:
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


def projection(source: RayImage, target: RayImage, target_from_source: Array) -> Projection:
    """Return where points of the source land in the target's image, and whether they may be there.

    A point may hide behind what a pixel measured, but not hang in front of it; a pixel without a measurement has no
    say (paper, eq. pbd: the erf). Distances are along the normal of the measured surface, in sds of its noise.
    """
    stride = math.ceil(max(len(source.points_m), 1) / _POINTS)
    points_m = se3.transform(target_from_source, source.points_m[::stride])
    normals = source.normals[::stride] @ target_from_source[:3, :3].T
    camera = target.frame.camera
    ahead = points_m[:, 2] > 1e-6
    points_m, normals = points_m[ahead], normals[ahead]
    scale = np.array([camera.fx, camera.fy])
    pixels = scale * points_m[:, :2] / points_m[:, 2:] + np.array([camera.cx, camera.cy])
    columns, rows = np.rint(pixels).astype(np.int64).T
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    points_m, normals, pixels = points_m[inside], normals[inside], pixels[inside]
    return Projection(pixels, _verdicts(points_m, normals, (rows[inside], columns[inside]), target))


def _verdicts(
    points_m: Array, normals: Array, at: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]], target: RayImage
) -> npt.NDArray[np.int8]:
    """Return the verdicts on points (n, 3) with normals (n, 3) at pixels (rows, columns) of the target."""
    depth_m = target.frame.depth_m[at]
    mask = target.frame.mask
    measured = np.isfinite(depth_m) & (depth_m > 0)
    facing = np.sum(normals * points_m, axis=1) < 0
    tolerance_m = _SIGMAS * math.sqrt(2.0) * target.sigma_r_m
    in_front_m = np.where(measured, depth_m, np.inf) - points_m[:, 2]
    number_at = np.full(target.frame.depth_m.shape, -1, dtype=np.int64)
    number_at[tuple(target.pixels.T)] = np.arange(len(target.pixels))
    number = number_at[at]
    planar = number >= 0
    on = number[planar]
    in_front_m[planar] = np.sum(target.normals[on] * (points_m[planar] - target.points_m[on]), axis=1)
    verdicts = np.full(len(points_m), HIDDEN, dtype=np.int8)
    verdicts[facing & (np.abs(in_front_m) <= tolerance_m)] = AGREES
    verdicts[in_front_m > tolerance_m] = VIOLATION
    if mask is not None:
        # Object pixels without a local plane, and the rim around the silhouette, are mixed and judge nothing.
        rim_px = 2 * math.ceil(_DEAD * max(target.sigma_wh * target.frame.camera.fx, 1.0)) + 1
        near = _dilated(mask, rim_px)[at]
        verdicts[(verdicts == VIOLATION) & ~planar & near] = NO_SAY
    verdicts[~measured] = NO_SAY
    return verdicts


def _dilated(mask: BoolArray, size_px: int) -> BoolArray:
    """Return the mask (h, w) grown to squares of `size_px` about its pixels."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    grown = np.zeros_like(mask)
    if len(rows):
        box = tuple(slice(max(int(ends[0]) - size_px, 0), int(ends[-1]) + size_px + 1) for ends in (rows, columns))
        grown[box] = ndimage.maximum_filter(mask[box], size=size_px)
    return grown
