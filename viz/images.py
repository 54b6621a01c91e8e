"""Camera images, and the points of the new view projected into the image it is registered to."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import rerun as rr

from modeler import se3
from modeler.kernels import point_likelihood as kernel
from modeler.registration.visibility import VisibilityLikelihood
from modeler.system.pictures import encoded
from modeler.types import Array, BoolArray, Frame, RayImage, SensorNoise, Step
from modeler.views import Sensor
from modeler.viz import entities
from modeler.viz.drawings import CLEAR, Drawing, shown_posterior

_DEPTH_UNITS_PER_M: Final = 1000.0  # finer units make the picture no better and the file several times larger


def draw_frame(step: Step) -> Drawing:
    """Yield the colour image, the depth image, and the mask of the step's frame with its outline in both."""
    return draw_outlined(step.frame, step.segmentation.mask)


def draw_outlined(frame: Frame, mask: BoolArray) -> Drawing:
    """Yield a frame's colour and depth images, and a mask (h, w) with its outline in both."""
    stride, coarse = stride_px(frame), depth_stride_px(frame)
    if frame.colour is None:
        yield entities.COLOUR, CLEAR
    else:
        jpeg = encoded(frame.colour[::stride, ::stride], "JPEG")
        yield entities.COLOUR, rr.EncodedImage(contents=jpeg, media_type="image/jpeg", draw_order=0.0)
    yield entities.DEPTH, _depth_png(frame.depth_m[::coarse, ::coarse], mask[::coarse, ::coarse])
    stride = coarse if frame.colour is None else stride  # the report lays it over the colours, else over the depth
    yield entities.MASK, rr.SegmentationImage(mask[::stride, ::stride].astype(np.uint8), draw_order=-1.0)
    for path, mask_stride in ((entities.OUTLINE, stride), (entities.DEPTH_OUTLINE, coarse)):
        lines = outline(mask[::mask_stride, ::mask_stride])
        drawn = rr.LineStrips2D(lines, colors=entities.OUTLINE_RGB, radii=rr.Radius.ui_points(1.0), draw_order=5.0)
        yield path, drawn if len(lines) else CLEAR


def outline(mask: BoolArray) -> npt.NDArray[np.float32]:
    """Return the lines (n, 2, 2: column and row of both ends) between the pixels of a mask (h, w) and all others.

    They follow the sides of pixels, whose corners are at whole numbers.
    """
    inside = np.pad(mask, 1).astype(np.int8)
    level = _runs(np.diff(inside, axis=0))
    upright = _runs(np.diff(inside, axis=1).T)
    return (np.concatenate([level, upright[:, :, ::-1]]) - 1.0).astype(np.float32)


def _runs(change: npt.NDArray[np.int8]) -> Array:
    """Return runs of one value other than 0 along rows (h + 1, w + 2) as lines (n, 2, 2: column and row)."""
    begins_ends = np.diff(change, axis=1, prepend=np.int8(0), append=np.int8(0)) != 0
    before = np.pad(change, ((0, 0), (1, 0)))[begins_ends] != 0
    after = np.pad(change, ((0, 0), (0, 1)))[begins_ends] != 0
    rows, columns = np.nonzero(begins_ends)
    places = np.stack([columns, rows + 1], axis=1).astype(np.float64)
    return np.stack([places[after], places[before]], axis=1)


def stride_px(frame: Frame) -> int:
    """Return the stride at which images of the frame are drawn: half a million pixels at most."""
    return math.ceil(math.sqrt(frame.depth_m.size / 500_000))


def depth_stride_px(frame: Frame) -> int:
    """Return the stride of depth images: larger, as they compress slowly and finer ones show no more."""
    return math.ceil(math.sqrt(frame.depth_m.size / 100_000))


def _depth_png(depth_m: npt.NDArray[np.float32], mask: BoolArray) -> rr.EncodedDepthImage:
    """Return a depth image (h, w) in m as 16-bit PNG, its colours spread over the object and a little around it."""
    units = np.nan_to_num(depth_m * _DEPTH_UNITS_PER_M, nan=0.0, posinf=0.0, neginf=0.0)
    pixels = np.clip(np.rint(units), 0, np.iinfo(np.uint16).max).astype(np.uint16)
    return rr.EncodedDepthImage(
        blob=encoded(pixels, "PNG", compress_level=1, compress_type=3),  # by run lengths: the quickest, and small
        media_type="image/png",
        meter=_DEPTH_UNITS_PER_M,
        depth_range=_depth_range(pixels, mask),
        draw_order=0.0,
    )


def _depth_range(pixels: npt.NDArray[np.uint16], mask: BoolArray) -> tuple[float, float]:
    """Return the depths, in units of the image, that the ends of the colour scale stand for."""
    chosen = pixels[mask & (pixels > 0)][::4]
    if chosen.size == 0:
        chosen = pixels[pixels > 0]
    if chosen.size == 0:
        return 0.0, 1.0
    near, far = np.percentile(chosen, (1, 99))
    margin = max(0.5 * (far - near), 1.0)
    return float(near - margin), float(far + margin)


MISSING, BACKGROUND, OBJECT = range(3)
"""Areas of a picture: nothing was measured, something other than the object was, the object was."""
AGREES, HIDDEN, VIOLATION, NO_SAY = range(4)
"""Verdicts on a point: on the measured surface, behind it, in front of it, or without a measurement."""

_VERDICT: Final = np.zeros(len(kernel.CLASSES), dtype=np.int8)  # by that of the likelihood
_VERDICT[[kernel.MATCHED, kernel.UNKNOWN]] = AGREES, NO_SAY
_VERDICT[[kernel.HIDDEN, kernel.BEHIND]] = HIDDEN
_VERDICT[[kernel.IN_FRONT, kernel.IN_EMPTY_SPACE, kernel.IN_SUPPORT]] = VIOLATION
_PATHS: Final = {
    AGREES: (entities.VISIBILITY_AGREES, entities.SOURCE_RGB, 1.25),
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


def draw_area_colours() -> Drawing:
    """Yield the colours of the areas, as in the paper."""
    names = {MISSING: "no measurement", BACKGROUND: "background", OBJECT: "object"}
    colours = zip(names.items(), entities.AREAS_RGB, strict=True)
    infos = [rr.AnnotationInfo(id=number, label=name, color=rgb) for (number, name), rgb in colours]
    yield entities.VISIBILITY_AREAS, rr.AnnotationContext(infos)


def draw_projected_points(step: Step) -> Drawing:
    """Yield the areas of the target's image, and the source's points in it under the mean of the step's first pair."""
    posterior = shown_posterior(step)
    paths = (entities.VISIBILITY_AREAS, entities.VISIBILITY_CAPTION, *(path for path, _, _ in _PATHS.values()))
    if posterior is None or step.view is None or not np.isfinite(posterior.pose.mean).all():
        for path in paths:
            yield path, CLEAR
        return
    target = step.views[posterior.target]
    stride = depth_stride_px(target.frame)
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
        yield entities.VISIBILITY_CAPTION, rr.Points2D(below, labels=caption_of(shown), **style)


def caption_of(shown: ProjectedPoints) -> str:
    """Return the shares of the points with a measurement that agree, are hidden, and lie in front."""
    judged = max(int(np.sum(shown.verdicts != NO_SAY)), 1)
    agree, hidden, front = (round(100 * np.sum(shown.verdicts == v) / judged) for v in (AGREES, HIDDEN, VIOLATION))
    return f"agree {agree} %, hidden {hidden} %, in front {front} %"


def areas(view: RayImage) -> npt.NDArray[np.uint8]:
    """Return the class of each pixel (h, w)."""
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
    likelihood, rng = VisibilityLikelihood(points=1_200), np.random.default_rng(0)  # more would hide what is below
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
    return view if view.layers else Sensor(SensorNoise(view.sigma_wh, view.sigma_r_m)).ray_image(view.frame, view.plane)
