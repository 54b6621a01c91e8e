"""Closed triangle meshes, and their files."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.sequences.image_files import MAX_PIXELS
from modeler.sequences.input_files import input_errors
from modeler.system.regular_files import read_regular
from modeler.types import Array, InputError

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of one or several closed parts, which may overlap and stand for their union."""

    vertices_m: Array
    """(v, 3)."""
    triangles: IntArray
    """(t, 3) vertex numbers, counter-clockwise from outside."""
    albedo: npt.NDArray[np.uint8]
    """(t, 3) RGB of the triangles."""
    part: IntArray
    """(t,) number of the closed part that each triangle belongs to."""
    uv: Array | None = None
    """(t, 3, 2) texture coordinates of the triangles' corners, v upwards; NaN for those without, None without any."""
    picture: npt.NDArray[np.uint8] | None = None
    """(h, w, 3) RGB image that came with the mesh; of several meshes, the first that has one."""

    @staticmethod
    def single(vertices_m: Array, triangles: IntArray) -> Mesh:
        """Return a mesh of one part in light grey."""
        count = len(triangles)
        albedo = np.full((count, 3), 190, np.uint8)
        return Mesh(vertices_m, np.asarray(triangles, np.int64), albedo, np.zeros(count, np.int64))

    @staticmethod
    def joined(meshes: list[Mesh]) -> Mesh:
        """Return the union of meshes."""
        first_vertex = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
        first_part = np.cumsum([0, *(mesh.part.max(initial=-1) + 1 for mesh in meshes)])
        return Mesh(
            np.concatenate([mesh.vertices_m for mesh in meshes]),
            np.concatenate([mesh.triangles + first for mesh, first in zip(meshes, first_vertex, strict=False)]),
            np.concatenate([mesh.albedo for mesh in meshes]),
            np.concatenate([mesh.part + first for mesh, first in zip(meshes, first_part, strict=False)]),
            _joined_uv(meshes),
            next((mesh.picture for mesh in meshes if mesh.picture is not None), None),
        )

    def moved(self, target_from_source: Array) -> Mesh:
        """Return the mesh after a rigid motion (4, 4)."""
        return replace(self, vertices_m=se3.transform(target_from_source, self.vertices_m))

    def scaled(self, factors: tuple[float, float, float]) -> Mesh:
        """Return the mesh stretched along its axes by positive factors."""
        return replace(self, vertices_m=self.vertices_m * np.array(factors))

    def painted(self, rgb: tuple[int, int, int]) -> Mesh:
        """Return the mesh in one colour."""
        albedo = np.broadcast_to(np.array(rgb, np.uint8), self.albedo.shape).copy()
        return replace(self, albedo=albedo)

    def corners(self) -> Array:
        """Return the corners (t, 3, 3) of the triangles."""
        return self.vertices_m[self.triangles]

    def only(self, keep: npt.NDArray[np.bool_]) -> Mesh:
        """Return the triangles where `keep` (t,) holds, without unused vertices."""
        used, triangles = np.unique(self.triangles[keep], return_inverse=True)
        return Mesh(self.vertices_m[used], triangles.reshape(-1, 3), self.albedo[keep], self.part[keep])


def _joined_uv(meshes: list[Mesh]) -> Array | None:
    """Return the texture coordinates (t, 3, 2) of several meshes; None if no mesh has any."""
    if all(mesh.uv is None for mesh in meshes):
        return None
    return np.concatenate(
        [np.full((len(mesh.triangles), 3, 2), np.nan) if mesh.uv is None else mesh.uv for mesh in meshes]
    )


@contextmanager
def opened_mesh(path: Path) -> Iterator[Any]:
    """Read triangles with finite corners by trimesh; what its parsers, and the block, raise becomes one line."""
    import trimesh  # slow to import, and only needed here

    with input_errors(path, "mesh", "convert it to PLY"):
        mesh = trimesh.load_mesh(io.BytesIO(read_regular(path)), file_type=path.suffix[1:].lower(), process=True)
        if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
            raise InputError(f"{path}: holds no triangles with finite corners; give a triangle mesh.")
        yield mesh


def read_mesh(path: Path, scale: float, *, textured: bool = False) -> Mesh:
    """Return the triangles of a mesh file (PLY, OBJ, STL, GLB, ...), its lengths times `scale` in m."""
    with opened_mesh(path) as loaded:
        vertices, triangles = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
        uv, picture = _texture(loaded.visual) if textured else (None, None)
    mesh = Mesh.single(vertices * scale, triangles)
    return mesh if uv is None or len(uv) != len(vertices) else replace(mesh, uv=uv[triangles], picture=picture)


def _texture(visual: object) -> tuple[Array | None, npt.NDArray[np.uint8] | None]:
    """Return the texture coordinates (v, 2) and the image (h, w, 3) of a trimesh; None if missing."""
    uv, material = getattr(visual, "uv", None), getattr(visual, "material", None)
    images = [getattr(material, name, None) for name in ("baseColorTexture", "image")]
    image = next((image for image in images if image is not None), None)
    if image is not None and image.width * image.height > MAX_PIXELS:
        raise ValueError(f"its image has more than {MAX_PIXELS // 1_000_000} million pixels")
    coordinates = None if uv is None else np.asarray(uv, np.float64).reshape(-1, 2)
    return coordinates, None if image is None else np.asarray(image.convert("RGB"), np.uint8)
