"""Closed triangle meshes: what shapes are made of, and the files they come from and go to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.types import Array, InputError

IntArray = npt.NDArray[np.int64]


@final
@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of one or several closed parts, which may overlap; their union is meant."""

    vertices_m: Array
    """(v, 3)."""
    triangles: IntArray
    """(t, 3) vertex numbers, counter-clockwise from outside."""
    albedo: npt.NDArray[np.uint8]
    """(t, 3) RGB of the triangles."""
    part: IntArray
    """(t,) number of the closed part that each triangle belongs to."""

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
        )

    def moved(self, target_from_source: Array) -> Mesh:
        """Return the mesh after a rigid motion (4, 4)."""
        vertices_m = se3.transform(target_from_source, self.vertices_m)
        return Mesh(vertices_m, self.triangles, self.albedo, self.part)

    def scaled(self, factors: tuple[float, float, float]) -> Mesh:
        """Return the mesh stretched along its axes by positive factors."""
        return Mesh(self.vertices_m * np.array(factors), self.triangles, self.albedo, self.part)

    def painted(self, rgb: tuple[int, int, int]) -> Mesh:
        """Return the mesh in one colour."""
        albedo = np.broadcast_to(np.array(rgb, np.uint8), self.albedo.shape).copy()
        return Mesh(self.vertices_m, self.triangles, albedo, self.part)

    def corners(self) -> Array:
        """Return the corners (t, 3, 3) of the triangles."""
        return self.vertices_m[self.triangles]

    def only(self, keep: npt.NDArray[np.bool_]) -> Mesh:
        """Return the triangles where `keep` (t,) holds, without unused vertices."""
        used, triangles = np.unique(self.triangles[keep], return_inverse=True)
        return Mesh(self.vertices_m[used], triangles.reshape(-1, 3), self.albedo[keep], self.part[keep])


def ply_bytes(mesh: Mesh) -> bytes:
    """Return the mesh as a binary PLY file, in m, with a colour at each triangle."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment lengths in m, model frame\n"
        f"element vertex {len(mesh.vertices_m)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.triangles)}\nproperty list uchar int vertex_indices\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    )
    faces = np.zeros(len(mesh.triangles), [("count", "u1"), ("corners", "<i4", 3), ("rgb", "u1", 3)])
    faces["count"], faces["corners"], faces["rgb"] = 3, mesh.triangles, mesh.albedo
    return header.encode() + mesh.vertices_m.astype("<f4").tobytes() + faces.tobytes()


def read_mesh(path: Path, scale: float) -> Mesh:
    """Return the triangles of a mesh file (PLY, OBJ, STL, GLB, ...), its lengths times `scale` in m.

    Raises:
        InputError: where the file is missing, cannot be read or holds no triangle.
    """
    import trimesh  # slow to import, and only needed here

    if not path.is_file():
        raise InputError(f"{path}: no such mesh; check the path, which is relative to the recipe.")
    try:
        loaded = trimesh.load_mesh(path, process=True)
        vertices, triangles = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
    except Exception as error:  # trimesh's readers raise whatever their parsers raise
        why = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: cannot be read as a mesh ({why}); convert it to PLY.") from None
    if len(triangles) == 0 or not np.isfinite(vertices).all():
        raise InputError(f"{path}: holds no triangles with finite corners; give a triangle mesh.")
    return Mesh.single(vertices * scale, triangles)
