"""The model: its cloud as it grows, its mesh, merged clouds, where it is tracked, and what to observe of it next."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from modeler import se3
from modeler.export.mesh import MADE_UP_RGB
from modeler.system.disk_arrays import release
from modeler.tracking import ModelRenderer, Tracked
from modeler.types import Array, BoolArray, Frame, ObjectModel, RayImage, Step, areas_m2
from modeler.viz import entities
from modeler.viz.blueprint import FROM_THE_SIDE, framed, near, spatial
from modeler.viz.drawings import CLEAR, POINT_SIZE, VIEW_POINTS, Drawing, Ellipsoids, rotated, shaded
from modeler.viz.images import draw_outlined, stride_px

if TYPE_CHECKING:
    from modeler.suggestion import Belief, Suggestions

TRIANGLES: Final = 60_000  # of a mesh as drawn, in a recording or on a page, and points of all views, recorded once
_PLAIN: Final = (215, 215, 215)  # surface without colour


def draw_model(step: Step) -> Drawing:
    """Yield the model's cloud while it grows, and its mesh in place of the cloud on the last step."""
    model = step.model
    meshed = step.last and model is not None and len(model.triangles) > 0
    if model is None or meshed:
        yield entities.CLOUD, CLEAR
    else:
        stride = math.ceil(max(len(model.points_m), 1) / 15_000)  # recorded again and again
        normals = model.normals[::stride]
        colours = shaded(_PLAIN, normals) if model.colours is None else model.colours[::stride]
        yield entities.CLOUD, rr.Points3D(model.points_m[::stride], colors=colours, radii=POINT_SIZE)
    yield entities.MESH, mesh(model) if model is not None and meshed else CLEAR


def mesh(model: ObjectModel) -> rr.Mesh3D:
    """Return the mesh, coarse enough for the recording to stay small; interpolated surface is tinted."""
    colours = np.tile(_PLAIN, (len(model.vertices_m), 1)) if model.vertex_colours is None else model.vertex_colours
    colours = colours.astype(np.float64)
    if model.vertex_views is not None:
        made_up = model.vertex_views == 0
        colours[made_up] = 0.5 * (colours[made_up] + MADE_UP_RGB)
    attributes = np.concatenate([model.vertices_m, model.vertex_normals, colours], axis=1)
    vertices, triangles = coarsened(attributes, model.triangles, TRIANGLES)
    return rr.Mesh3D(
        vertex_positions=vertices[:, :3],
        vertex_normals=vertices[:, 3:6],
        triangle_indices=triangles,
        vertex_colors=np.rint(vertices[:, 6:]).astype(np.uint8),
    )


def coarsened(vertices: Array, triangles: npt.NDArray[np.int64], limit: int) -> tuple[Array, npt.NDArray[np.int64]]:
    """Merge vertices that share a cell of a grid until at most `limit` triangles remain.

    Args:
        vertices: (v, 3 + k) positions in m, then k attributes that are averaged with them.
        triangles: (t, 3) vertex numbers.
        limit: how many triangles may remain.
    """
    area_m2 = float(areas_m2(vertices[:, :3], triangles).sum())
    cell_m = max(math.sqrt(1.5 * area_m2 / limit), 1e-9)  # side of a cell that holds two triangles on average
    merged, kept = vertices, triangles
    while len(kept) > limit:
        cells = np.floor((vertices[:, :3] - vertices[:, :3].min(axis=0)) / cell_m).astype(np.int64)
        _, rows, columns = cells.max(axis=0) + 1
        numbers = (cells[:, 0] * rows + cells[:, 1]) * columns + cells[:, 2]
        _, cell_of, count = np.unique(numbers, return_inverse=True, return_counts=True)
        merged = np.stack([np.bincount(cell_of, column) for column in vertices.T], axis=1) / count[:, None]
        kept = cell_of[triangles]
        kept = kept[(kept[:, 0] != kept[:, 1]) & (kept[:, 1] != kept[:, 2]) & (kept[:, 2] != kept[:, 0])]
        cell_m *= 1.15
    return merged, kept


def draw_merged_clouds(step: Step) -> Drawing:
    """Yield the merged points along the chain of edges and after optimisation, on the last step alone."""
    if step.last and len(step.solution.trajectory) > 1:
        yield entities.MERGED_BEFORE, _merged_points(step, step.solution.odometry)
        yield entities.MERGED_AFTER, _merged_points(step, step.solution.trajectory)


def _merged_points(step: Step, poses: Mapping[int, Array]) -> rr.Points3D:
    """Return the points of all views that have a pose, a colour a view from blue to yellow."""
    frames = [frame for frame in sorted(poses) if frame in step.views]
    stride = math.ceil(max(sum(len(step.views[frame].points_m) for frame in frames), 1) / TRIANGLES)
    parts = []
    for frame in frames:
        parts.append(se3.transform(poses[frame], step.views[frame].points_m[::stride]))
        release(step.views[frame].points_m)
    along = np.linspace(0.0, 2.0, max(len(frames), 2))[: len(frames)]
    ramps = (70, 40, 255), (100, 190, 225), (255, 190, 60)  # red, green and blue at the first, middle and last view
    shades = np.stack([np.interp(along, [0.0, 1.0, 2.0], ramp) for ramp in ramps], axis=1)
    colours = np.repeat(np.rint(shades), [len(part) for part in parts], axis=0)
    return rr.Points3D(
        np.concatenate([np.zeros((0, 3)), *parts]), colors=colours.astype(np.uint8), radii=rr.Radius.ui_points(1.25)
    )


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
        stride = math.ceil(len(found.view.points_m) / VIEW_POINTS)
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


WORDS: Final = "next/words"
SEEN_CELLS: Final = "world/cells/seen"
UNSEEN_CELLS: Final = "world/cells/unseen"
SEEN: Final = "next/seen_percent"
POSE_SD: Final = "next/pose_sd_deg"


def draw_next(belief: Belief, found: Suggestions) -> Drawing:
    """Yield drawings of the belief about poses and surface, and of the suggested actions."""
    lines = [f"**{found.summary}**", "", *(f"1. {each.words}" for each in found.best)]
    yield WORDS, rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
    cells, size_m = belief.cells, 0.5 * belief.cells.cell_m
    open_ = belief.can_be_seen & ~cells.seen & ~cells.under
    yield SEEN_CELLS, rr.Points3D(cells.points_m[cells.seen], colors=entities.CAMERA_RGB, radii=size_m)
    yield UNSEEN_CELLS, rr.Points3D(cells.points_m[open_], colors=entities.SOURCE_RGB, radii=size_m)
    yield SEEN, rr.Scalars(100.0 * found.seen)
    yield POSE_SD, rr.Scalars(found.pose_deg)


def next_tab(first: RayImage | None) -> rrb.Container:
    """Return a layout of observed and unseen surface, the frame, the list, and the values over time."""
    cells = spatial(
        "Observed (grey), and where unseen surface may be (orange)",
        [SEEN_CELLS, UNSEEN_CELLS, entities.CAMERAS, entities.POSITION_3_SIGMA],
        near(first, FROM_THE_SIDE, 10.0),
    )
    words = rrb.TextDocumentView(origin=WORDS, name="What to do next, best first")
    times = rrb.Horizontal(
        rrb.TimeSeriesView(origin=SEEN, name="Observed, % of the visible surface"),
        rrb.TimeSeriesView(origin=POSE_SD, name="Largest standard deviation of a rotation, °"),
    )
    return rrb.Horizontal(
        rrb.Vertical(cells, times, row_shares=[2.0, 1.0]), rrb.Vertical(framed(first), words), name="What to do next"
    )
