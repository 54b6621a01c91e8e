"""The fused mesh, coarse enough for a page, as the viewer in the page takes it."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from modeler.export import read_model
from modeler.export.mesh import sigma_rgb
from modeler.types import Array, InputError
from viz.clouds import coarsened

_TRIANGLES: Final = 60_000
_STEPS: Final = 32767  # of a coordinate from the centre to the farthest vertex: 16-bit whole numbers


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with what is known of their corners."""

    vertices_m: Array
    """(v, 3) in the object frame."""
    normals: Array
    """(v, 3)."""
    triangles: npt.NDArray[np.int64]
    """(t, 3) vertex numbers."""
    colours: npt.NDArray[np.uint8] | None
    """(v, 3) RGB, where the input had colour."""
    certainty: npt.NDArray[np.uint8] | None
    """(v, 3) RGB that stands for the sd of each vertex, pink where it is made up; None where that is not known."""
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
    """Return the mesh of a PLY file; None where there is none that can be drawn."""
    try:
        model = read_model(path)
    except InputError:
        return None
    attributes = [model.vertices_m, model.vertex_normals]
    if model.vertex_colours is not None:
        attributes.append(model.vertex_colours.astype(np.float64))
    if model.vertex_sigmas_m is not None:
        attributes.append(sigma_rgb(model.vertex_sigmas_m))
    vertices, kept = coarsened(np.concatenate(attributes, axis=1), model.triangles, _TRIANGLES)
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
    """Return what the viewer draws, in values that JSON holds.

    Args:
        mesh: the model.
        strips_m: lines around it, each (n, 3): cameras.
        object_from_upright: (3, 3) right, down and forward as columns: how it stands at first.
    """
    eye_from_upright = np.diag([1.0, -1.0, -1.0])  # whose y is up and whose z points back
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
        "upright": (eye_from_upright @ object_from_upright.T).T.ravel().round(6).tolist(),  # column by column
    }


def _packed(array: npt.NDArray[Any]) -> str:
    """Return the bytes of an array as text."""
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
