"""The fused mesh in the page: coarse enough for its viewer, and as a still picture."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.export import read_model
from modeler.export.mesh import sigma_rgb
from modeler.system.pictures import encoded, raycaster, tensor
from modeler.types import Array, InputError
from modeler.viz.drawings import ABOVE_LEFT
from modeler.viz.model_view import TRIANGLES, coarsened

_STEPS: Final = 32767  # of a coordinate from the centre to the farthest vertex: 16-bit whole numbers


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with properties of their corners."""

    vertices_m: Array
    """(v, 3) in the object frame."""
    normals: Array
    """(v, 3)."""
    triangles: npt.NDArray[np.int64]
    """(t, 3) vertex numbers."""
    colours: npt.NDArray[np.uint8] | None
    """(v, 3) RGB, where the input had colour."""
    certainty: npt.NDArray[np.uint8] | None
    """(v, 3) RGB of the sd of each vertex, pink where no view saw it; None if it is unknown."""
    total: int
    """Number of triangles before the mesh was made coarser."""

    @property
    def centre_m(self) -> Array:
        """Return the middle (3,) of the box around the mesh."""
        return 0.5 * (self.vertices_m.min(axis=0) + self.vertices_m.max(axis=0))

    @property
    def radius_m(self) -> float:
        """Return the distance of the farthest vertex from the centre."""
        return float(np.linalg.norm(self.vertices_m - self.centre_m, axis=1).max())


def read_mesh(path: Path) -> Mesh | None:
    """Return the mesh of a PLY file; None if there is none that can be drawn."""
    try:
        model = read_model(path)
    except InputError:
        return None
    attributes = [model.vertices_m, model.vertex_normals]
    if model.vertex_colours is not None:
        attributes.append(model.vertex_colours.astype(np.float64))
    if model.vertex_sigmas_m is not None:
        attributes.append(sigma_rgb(model.vertex_sigmas_m))
    vertices, kept = coarsened(np.concatenate(attributes, axis=1), model.triangles, TRIANGLES)
    used, kept = np.unique(kept, return_inverse=True)
    vertices = vertices[used]
    return Mesh(
        vertices_m=vertices[:, :3],
        normals=vertices[:, 3:6] / np.maximum(np.linalg.norm(vertices[:, 3:6], axis=1, keepdims=True), 1e-12),
        triangles=kept.reshape(-1, 3),
        colours=None if model.vertex_colours is None else np.rint(vertices[:, 6:9]).astype(np.uint8),
        certainty=None if model.vertex_sigmas_m is None else np.rint(vertices[:, -3:]).astype(np.uint8),
        total=len(model.triangles),
    )


def scene(mesh: Mesh, strips_m: list[Array], object_from_upright: Array) -> Mapping[str, Any]:
    """Return the data of the viewer as JSON values.

    Args:
        mesh: the model.
        strips_m: lines around it, each (n, 3): cameras.
        object_from_upright: (3, 3) right, down and forward as columns: initial orientation.
    """
    places = np.rint((mesh.vertices_m - mesh.centre_m) / mesh.radius_m * _STEPS).astype("<i2")
    lines = [np.repeat(strip, 2, axis=0)[1:-1] for strip in strips_m]
    segments = np.concatenate([np.zeros((0, 3)), *lines])
    return {
        "positions": _packed(places),
        "normals": _packed(np.rint(127.0 * mesh.normals).astype("i1")),
        "colours": None if mesh.colours is None else _packed(mesh.colours),
        "certainty": None if mesh.certainty is None else _packed(mesh.certainty),
        "triangles": _packed(mesh.triangles.astype("<u4")),
        "lines": _packed(((segments - mesh.centre_m) / mesh.radius_m).astype("<f4")),
        "count": int(mesh.triangles.size),
        "upright": (se3.Y_UP @ object_from_upright.T).T.ravel().round(6).tolist(),  # column by column
    }


def _packed(array: npt.NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


_SAMPLES: Final = 2  # rays along each side of a pixel, without which edges are jagged


def shade(
    vertices_m: Array,
    triangles: npt.NDArray[np.int64],
    colours: npt.NDArray[np.uint8] | None,
    object_from_camera: Array,
    size: tuple[int, int],
) -> npt.NDArray[np.uint8]:
    """Return a picture (h, w, 3) of a mesh under a light next to the camera, on white; back sides are drawn red.

    Args:
        vertices_m: (v, 3).
        triangles: (t, 3), counter-clockwise from outside.
        colours: (v, 3) RGB; None = grey.
        object_from_camera: (4, 4) pose of the camera (x right, y down, z forward) in the mesh's frame.
        size: height and width in px.
    """
    height, width = size[0] * _SAMPLES, size[1] * _SAMPLES
    focal = 0.5 * height / np.tan(np.radians(15.0))  # half of the vertical field of view
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    along = np.stack(
        [(columns - 0.5 * (width - 1)) / focal, (rows - 0.5 * (height - 1)) / focal, np.ones((height, width))], axis=-1
    )
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    rays = np.empty((height, width, 6), dtype=np.float32)
    rays[..., :3] = object_from_camera[:3, 3]
    rays[..., 3:] = along @ object_from_camera[:3, :3].T
    hits = {name: value.numpy() for name, value in raycaster(vertices_m, triangles).cast_rays(tensor(rays)).items()}
    seen = np.isfinite(hits["t_hit"])

    corners = triangles[hits["primitive_ids"][seen].astype(np.int64)]
    share = hits["primitive_uvs"][seen].astype(np.float64)
    share = np.stack([1.0 - share.sum(axis=1), share[:, 0], share[:, 1]], axis=1)
    normals = hits["primitive_normals"][seen].astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light = np.array([-0.35, -0.55, -1.0]) / np.linalg.norm([-0.35, -0.55, -1.0])
    facing = -np.sum(normals * rays[seen][:, 3:], axis=1)
    lit = np.clip(normals @ object_from_camera[:3, :3] @ light, 0.0, 1.0)
    base = np.full((len(corners), 3), 190.0)
    if colours is not None:
        base = np.einsum("nk,nkc->nc", share, colours[corners].astype(np.float64))
    base[facing < 0.0] = (200.0, 60.0, 50.0)
    lit = np.where(facing < 0.0, 0.4 - 0.6 * facing, lit)
    picture = np.full((height, width, 3), 255.0)
    picture[seen] = base * (0.25 + 0.75 * lit)[:, None]
    blocks = picture.reshape(size[0], _SAMPLES, size[1], _SAMPLES, 3)
    return np.clip(np.rint(blocks.mean(axis=(1, 3))), 0, 255).astype(np.uint8)


def portrait(mesh: Mesh, object_from_upright: Array, size: tuple[int, int]) -> bytes:
    """Return a picture (height, width) in px of an upright model, from above on the left, as JPEG.

    `object_from_upright` (3, 3) has right, down and forward as columns.
    """
    away = object_from_upright @ ABOVE_LEFT
    camera = look_at(mesh.centre_m, away, 4.2 * mesh.radius_m, -object_from_upright[:, 1])
    return encoded(shade(mesh.vertices_m, mesh.triangles, mesh.colours, camera, size), "JPEG")


def look_at(centre_m: Array, direction: Array, distance_m: float, up: Array) -> Array:
    """Return object_from_camera (4, 4) of a camera that looks at a point from a direction.

    Args:
        centre_m: (3,) point looked at.
        direction: (3,) from there to the camera.
        distance_m: between the two.
        up: (3,) up direction of the picture.
    """
    forward = -np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return se3.rigid(np.stack([right, np.cross(forward, right), forward], axis=1), centre_m - distance_m * forward)
