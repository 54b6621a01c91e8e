"""An object that is tracked: the model in the frame, with the region of its place."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import rerun as rr

from modeler import se3
from modeler.tracking import ModelRenderer, Tracked
from modeler.types import BoolArray, Frame, ObjectModel
from modeler.viz import entities
from modeler.viz.drawings import CLEAR, POINT_SIZE, Drawing, Ellipsoids, rotated
from modeler.viz.images import draw_outlined, stride_px
from modeler.viz.model_view import mesh

_POINTS: Final = 8_000


def draw_tracked_model(model: ObjectModel) -> Drawing:
    """Yield the model, in its own frame, for all times."""
    yield entities.TRACKED_MESH, mesh(model)


def draw_tracked(frame: Frame, found: Tracked, renderer: ModelRenderer) -> Drawing:
    """Yield a frame with the model's outline, and in 3D the model in its pose among the points of the object."""
    if found.pose is None:
        yield from draw_outlined(frame, _sought(found, frame))
        yield entities.TRACKED_MODEL, rr.Transform3D(scale=1e-9)  # not in sight
        yield entities.TRACKED_PLACE_3_SIGMA, CLEAR
    else:
        yield from draw_outlined(frame, renderer.silhouette(found.pose.mean, frame.camera, stride_px(frame))[0])
        pose = found.pose.mean
        yield entities.TRACKED_MODEL, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
        about = se3.covariance_about(found.pose.covariance, renderer.centre_m)[3:, 3:]
        place = Ellipsoids.of(se3.transform(pose, renderer.centre_m[None]), rotated(pose[None], about[None]))
        wires = rr.components.FillMode.MajorWireframe
        yield entities.TRACKED_PLACE_3_SIGMA, place.drawn(3.0, entities.UNCERTAINTY_RGB, wires)
    if found.view is None:
        yield entities.TRACKED_POINTS, CLEAR
    else:
        stride = math.ceil(len(found.view.points_m) / _POINTS)
        points_m = found.view.points_m[::stride]
        yield entities.TRACKED_POINTS, rr.Points3D(points_m, colors=entities.SOURCE_RGB, radii=POINT_SIZE)
    yield entities.TRACKED_WORDS, rr.TextDocument(words(found), media_type=rr.MediaType.MARKDOWN)


def _sought(found: Tracked, frame: Frame) -> BoolArray:
    """Return the pixels (h, w) of a frame in which the object was looked for."""
    mask: BoolArray = np.zeros((frame.camera.height, frame.camera.width), dtype=bool)
    if found.view is not None and found.view.frame.mask is not None:
        step = round(frame.camera.fx / found.view.frame.camera.fx)  # registration may use every few pixels
        wide = found.view.frame.mask.repeat(step, axis=0).repeat(step, axis=1)[: len(mask), : mask.shape[1]]
        mask[: len(wide), : wide.shape[1]] = wide
    return mask


def words(found: Tracked) -> str:
    """Return what is known of the object in a frame, in words."""
    said = f"Frame {found.frame}: **{found.outcome}**"
    if found.pose is None:
        return f"{said}, {found.reason}"
    if not found.usable:
        said += f", not of use: {found.reason}"
    rivals = ", ".join(f"{100.0 * mode.weight:.0f} %" for mode in found.modes)
    return said + (f"; modes {rivals}" if rivals else "")
