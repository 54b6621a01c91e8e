"""The newest pair of clouds before and after alignment, and the growing model."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt
import rerun as rr

from modeler import se3
from modeler.export.mesh import MADE_UP_RGB
from modeler.export.standing import upright
from modeler.types import Array, ObjectModel, Posterior, RayImage, Step
from viz import entities
from viz.drawings import CLEAR, Drawing

_PAIR_POINTS: Final = 6_000
_MODEL_POINTS: Final = 15_000
_TRIANGLES: Final = 60_000
_PLAIN: Final = 215.0  # grey of surface without colour
_POINT_SIZE: Final = rr.Radius.ui_points(1.75)


def statics() -> Drawing:
    """Yield what is said once: which way is up."""
    for path in (entities.PAIR, entities.WORLD):
        yield path, rr.ViewCoordinates.RDF


def pair_drawing(step: Step) -> Drawing:
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


def shown_posterior(step: Step) -> Posterior | None:
    """Return the first registration of the step's frame to a view that is at hand: the odometry pair."""
    own = (posterior for posterior in step.posteriors if posterior.source == step.frame.index)
    return next((posterior for posterior in own if posterior.target in step.views), None)


def below_m(view: RayImage) -> Array:
    """Return a point (3,) below what a view saw of the object, where a caption has room."""
    centre = view.centroid_m
    return centre + 1.2 * float(np.linalg.norm(view.points_m - centre, axis=1).max()) * upright(view)[:, 1]


def caption(at_m: Array, words: str, rgb: entities.Rgb) -> rr.Points3D:
    """Return words that stand at a point (3,)."""
    return rr.Points3D(at_m, labels=words, show_labels=True, radii=rr.Radius.ui_points(0.0), colors=rgb)


def model_drawing(step: Step) -> Drawing:
    """Yield the model's cloud while it grows, and its mesh in place of the cloud on the last step."""
    model = step.model
    meshed = step.last and model is not None and len(model.triangles) > 0
    if model is None or meshed:
        yield entities.CLOUD, CLEAR
    else:
        stride = math.ceil(max(len(model.points_m), 1) / _MODEL_POINTS)
        normals = model.normals[::stride]
        colours = shaded((215, 215, 215), normals) if model.colours is None else model.colours[::stride]
        yield entities.CLOUD, rr.Points3D(model.points_m[::stride], colors=colours, radii=_POINT_SIZE)
    yield entities.MESH, _mesh(model) if model is not None and meshed else CLEAR


def shaded(rgb: entities.Rgb, normals: Array) -> npt.NDArray[np.uint8]:
    """Return a colour (n, 3) that is darker the more steeply a surface with `normals` (n, 3) is seen from frame 0."""
    light = 0.35 + 0.65 * np.abs(normals @ np.array([-0.36, -0.48, -0.8]))
    return np.clip(light[:, None] * np.array(rgb), 0, 255).astype(np.uint8)


def _view_points(view: RayImage, target_from_view: Array, rgb: entities.Rgb) -> rr.Points3D:
    """Return the surface points of a view, carried to the target's camera frame."""
    stride = math.ceil(max(len(view.points_m), 1) / _PAIR_POINTS)
    points = se3.transform(target_from_view, view.points_m[::stride])
    return rr.Points3D(points, colors=shaded(rgb, view.normals[::stride]), radii=_POINT_SIZE)


def _mesh(model: ObjectModel) -> rr.Mesh3D:
    """Return the mesh, coarse enough for the recording to stay small; surface that nobody saw is tinted."""
    colours = np.full(model.vertices_m.shape, _PLAIN) if model.vertex_colours is None else model.vertex_colours
    colours = colours.astype(np.float64)
    if model.vertex_views is not None:
        made_up = model.vertex_views == 0
        colours[made_up] = 0.5 * (colours[made_up] + MADE_UP_RGB)
    attributes = np.concatenate([model.vertices_m, model.vertex_normals, colours], axis=1)
    vertices, triangles = coarsened(attributes, model.triangles, _TRIANGLES)
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
    a, b, c = np.moveaxis(vertices[triangles, :3], 1, 0)
    area_m2 = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    cell_m = max(math.sqrt(1.5 * area_m2 / limit), 1e-9)  # cells hold about so much surface, of two triangles
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
