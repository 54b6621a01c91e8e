"""An image wrapped around a mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from modeler.types import Array, ObjectModel

SIDE_PX = 2048  # of the image: common in programs that read textures
PADDING_PX = 4  # charts keep this distance, so that colours do not bleed when the image is shrunk
TRIANGLES = 8_000  # of a mesh whose detail is in the image
_FILLED = 0.6  # share of the image that charts fill
PIECE = 1_000  # triangles that are unwrapped at once: the time grows with more than the square of their number

Paint = Callable[[Array, Array, npt.NDArray[np.uint8]], npt.NDArray[np.uint8]]
"""From points (n, 3) and normals (n, 3) in the object frame, and RGB (n, 3) of the vertices there, to RGB (n, 3)."""


@dataclass(frozen=True, eq=False)
class Texture:
    """Where the vertices of a mesh lie in an image."""

    uv: Array
    """(v, 2) places in the image, 0..1: u to the right, v upwards from the lower edge."""
    image: npt.NDArray[np.uint8]
    """(h, w, 3) RGB."""
    texel_m: float
    """Side of a pixel of the image on the surface."""


def textured(model: ObjectModel, paint: Paint, side_px: int = SIDE_PX) -> tuple[ObjectModel, Texture]:
    """Return the model with vertices doubled along seams, and its texture.

    Args:
        model: the mesh.
        paint: gives points of the surface their colours.
        side_px: of the image, a square that the surface fills.
    """
    import xatlas

    corners = model.vertices_m[model.triangles]
    area_m2 = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    texel_m = (
        float(np.sqrt(area_m2 / _FILLED)) / side_px
    )  # approximately: packing determines how much room the charts leave
    atlas = xatlas.Atlas()
    # In texels and from the origin: the library compares lengths with constants.
    texels = ((model.vertices_m - model.vertices_m.mean(axis=0)) / texel_m).astype(np.float32)
    used = []
    for piece in _pieces(corners.mean(axis=1), PIECE):
        vertices, triangles = np.unique(model.triangles[piece], return_inverse=True)
        atlas.add_mesh(texels[vertices], triangles.reshape(-1, 3).astype(np.uint32))
        used.append(vertices)
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    packing.texels_per_unit, packing.padding, packing.bilinear = 1.0, PADDING_PX, True
    atlas.generate(charts, packing)
    parts = [atlas[number] for number in range(len(used))]
    origin = np.concatenate([vertices[part[0]] for vertices, part in zip(used, parts, strict=True)])
    starts = np.cumsum([0, *(len(part[0]) for part in parts)])
    triangles = np.concatenate([part[1] + start for part, start in zip(parts, starts, strict=False)])
    places = np.concatenate([part[2] for part in parts])
    wrapped = replace(
        model,
        vertices_m=model.vertices_m[origin],
        triangles=triangles.astype(np.int64),
        vertex_normals=model.vertex_normals[origin],
        vertex_colours=None if model.vertex_colours is None else model.vertex_colours[origin],
        vertex_views=None if model.vertex_views is None else model.vertex_views[origin],
        vertex_sigmas_m=None if model.vertex_sigmas_m is None else model.vertex_sigmas_m[origin],
    )
    packed = max(atlas.width, atlas.height)
    shares = places.astype(np.float64) * np.array([atlas.width, atlas.height]) / packed
    image = _baked(wrapped, shares * side_px, side_px, paint)
    return wrapped, Texture(np.stack([shares[:, 0], 1.0 - shares[:, 1]], axis=1), image, texel_m * packed / side_px)


def _pieces(centres_m: Array, most: int) -> list[npt.NDArray[np.int64]]:
    """Return the numbers of triangles in compact pieces of limited size, given their centres (t, 3)."""
    waiting, pieces = [np.arange(len(centres_m))], []
    while waiting:
        piece = waiting.pop()
        if len(piece) <= most:
            pieces.append(piece)
            continue
        axis = int(np.argmax(np.ptp(centres_m[piece], axis=0)))
        order = piece[np.argsort(centres_m[piece, axis], kind="stable")]
        waiting += [order[: len(order) // 2], order[len(order) // 2 :]]
    return pieces


def _baked(model: ObjectModel, places_px: Array, side_px: int, paint: Paint) -> npt.NDArray[np.uint8]:
    """Return the image (s, s, 3): every pixel in or next to a chart shows the point of the surface nearest to it.

    Args:
        model: the mesh.
        places_px: (v, 2) column and row of its vertices, pixel centres at halves.
        side_px: s.
        paint: gives points their colours.
    """
    import open3d as o3d

    flat = np.concatenate([places_px, np.zeros((len(places_px), 1))], axis=1).astype(np.float32)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor.from_numpy(flat), o3d.core.Tensor.from_numpy(model.triangles.astype(np.uint32)))
    columns, rows = np.meshgrid(np.arange(side_px) + 0.5, np.arange(side_px) + 0.5)
    pixels = np.stack([columns, rows, np.zeros_like(rows)], axis=-1).reshape(-1, 3).astype(np.float32)
    found = scene.compute_closest_points(o3d.core.Tensor.from_numpy(pixels))
    off = np.linalg.norm(found["points"].numpy() - pixels, axis=1)
    near = off <= PADDING_PX
    triangle = model.triangles[found["primitive_ids"].numpy()[near].astype(np.int64)]
    second, third = found["primitive_uvs"].numpy()[near].astype(np.float64).T
    shares = np.stack([1.0 - second - third, second, third], axis=1)
    points = np.einsum("nk,nkc->nc", shares, model.vertices_m[triangle])
    normals = np.einsum("nk,nkc->nc", shares, model.vertex_normals[triangle])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    at_vertices = np.full_like(model.vertices_m, 128.0) if model.vertex_colours is None else model.vertex_colours
    between = np.rint(np.einsum("nk,nkc->nc", shares, at_vertices[triangle])).astype(np.uint8)
    colours = paint(points, normals, between)
    image = np.full((len(pixels), 3), np.rint(colours.mean(axis=0)) if len(colours) else 128, dtype=np.uint8)
    image[near] = colours
    return image.reshape(side_px, side_px, 3)
