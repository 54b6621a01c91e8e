"""Closed triangle meshes: their files, rays cast at them, and the outer surface of several."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.sequences.image_files import MAX_PIXELS
from modeler.sequences.input_files import input_errors
from modeler.system.pictures import raycaster, tensor
from modeler.system.regular_files import read_regular
from modeler.types import Array, BoolArray, InputError

if TYPE_CHECKING:
    import open3d as o3d


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


_SHORT = 1.0 - 2e-3
"""Light is followed up to just in front of the surface it should reach, which would else block itself."""


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of a bundle of rays."""

    depth_m: Array
    """(h, w) distance along the optical axis; NaN where nothing was met."""
    incidence_rad: Array
    """(h, w) angle between ray and normal; NaN where nothing was met."""
    points_m: Array
    """(h, w, 3) camera coordinates of the hits; NaN without a hit."""
    albedo: npt.NDArray[np.uint8]
    """(h, w, 3) RGB of the hits."""
    triangle: IntArray
    """(h, w) number of the triangle that was met; 0 if nothing was."""
    weights: Array
    """(h, w, 3) barycentric coordinates in it."""

    def over(self, other: Hits, first: BoolArray) -> Hits:
        """Return these hits where `first` (h, w) holds, the others elsewhere."""
        wide = first[..., None]
        return Hits(
            np.where(first, self.depth_m, other.depth_m),
            np.where(first, self.incidence_rad, other.incidence_rad),
            np.where(wide, self.points_m, other.points_m),
            np.where(wide, self.albedo, other.albedo),
            np.where(first, self.triangle, other.triangle),
            np.where(wide, self.weights, other.weights),
        )


@dataclass(frozen=True, eq=False)
class Caster:
    """A mesh made ready for rays; one without triangles is met by no ray."""

    mesh: Mesh
    """The scene to intersect."""

    @cached_property
    def _scene(self) -> o3d.t.geometry.RaycastingScene:
        return raycaster(self.mesh.vertices_m, self.mesh.triangles)

    def cast(self, rays: Array, camera_from_mesh: Array) -> Hits:
        """Follow rays (h, w, 3) of unit depth from the camera's centre."""
        shape = rays.shape[:2]
        if not len(self.mesh.triangles):
            missed = np.full(shape, np.nan)
            nowhere = np.full((*shape, 3), np.nan)
            return Hits(missed, missed, nowhere, np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.int64), nowhere)
        mesh_from_camera = se3.inverse(camera_from_mesh)
        turned = rays @ mesh_from_camera[:3, :3].T
        origins = np.broadcast_to(mesh_from_camera[:3, 3], turned.shape)
        found = self._scene.cast_rays(tensor(np.concatenate([origins, turned], axis=-1)))
        depth_m = found["t_hit"].numpy().astype(np.float64)
        met = np.isfinite(depth_m)
        depth_m = np.where(met, depth_m, np.nan)
        facing = np.abs(np.sum(found["primitive_normals"].numpy() * turned, axis=-1)) / np.linalg.norm(turned, axis=-1)
        incidence_rad = np.where(met, np.arccos(np.clip(facing, 0.0, 1.0)), np.nan)
        triangle = np.where(met, found["primitive_ids"].numpy(), 0).astype(np.int64)
        second, third = np.moveaxis(found["primitive_uvs"].numpy().astype(np.float64), -1, 0)
        weights = np.stack([1.0 - second - third, second, third], axis=-1)
        return Hits(depth_m, incidence_rad, rays * depth_m[..., None], self.mesh.albedo[triangle], triangle, weights)

    def blocks(self, lamp_m: Array, points_m: Array, camera_from_mesh: Array) -> BoolArray:
        """Return where (h, w) the mesh stands between a lamp (3,) and points (h, w, 3), all in camera coordinates."""
        if not len(self.mesh.triangles):
            return np.zeros(points_m.shape[:2], bool)
        mesh_from_camera = se3.inverse(camera_from_mesh)
        lamp = se3.transform(mesh_from_camera, lamp_m)
        away = (np.nan_to_num(points_m) - lamp_m) @ mesh_from_camera[:3, :3].T
        rays = np.concatenate([np.broadcast_to(lamp, away.shape), away], axis=-1)
        return self._scene.test_occlusions(tensor(rays), tnear=0.0, tfar=_SHORT).numpy()


def inside(mesh: Mesh, points_m: Array) -> BoolArray:
    """Return which points (n, 3) lie inside one closed part."""
    found = raycaster(mesh.vertices_m, mesh.triangles).compute_occupancy(tensor(points_m), nsamples=3)
    return found.numpy() > 0.5


_COARSE_M, _FINE_M = 0.01, 0.001  # longest edges of triangles near a cut, and at it


def outer_surface(mesh: Mesh) -> Mesh:
    """Return the mesh without surface inside other parts; cuts between parts are accurate to a millimetre.

    Triangles that two parts cut are halved until they are small; the pieces inside another part are left out.
    """
    parts = int(mesh.part.max(initial=0)) + 1
    if parts == 1:
        return mesh
    others = [mesh.only(mesh.part == number) for number in range(parts)]
    corners, albedo, part = mesh.corners(), mesh.albedo, mesh.part
    done: list[Mesh] = []
    while len(corners):
        hidden = _hidden(corners, part, others)
        longest_m = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
        near_m = np.where(part[:, None] == np.arange(parts), np.inf, _box_gap(corners, others)).min(axis=1)
        whole = (hidden.all(axis=1) | ~hidden.any(axis=1)) & (longest_m <= _COARSE_M) | (near_m > 0.0)
        settled = whole | (longest_m <= _FINE_M)
        kept = settled & ~hidden[:, 0]
        pieces = np.arange(3 * int(kept.sum())).reshape(-1, 3)
        done.append(Mesh(corners[kept].reshape(-1, 3), pieces, albedo[kept], part[kept]))
        corners = _halved(corners[~settled])
        albedo, part = np.repeat(albedo[~settled], 2, axis=0), np.repeat(part[~settled], 2)
    return _welded(Mesh.joined(done), parts)


def _hidden(corners: Array, part: IntArray, others: list[Mesh]) -> BoolArray:
    """Return which of centre and corners (t, 4) of triangles lie, just off their face, inside another part."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    centre = corners.mean(axis=1, keepdims=True)
    # Corners are drawn in a little, so that a corner that touches another part does not count as cut by it.
    points = np.concatenate([centre, centre + 0.98 * (corners - centre)], axis=1) + 1e-5 * normals[:, None]
    hidden = np.zeros(points.shape[:2], bool)
    for number, other in enumerate(others):
        asked = part != number
        if asked.any():
            hidden[asked] |= inside(other, points[asked].reshape(-1, 3)).reshape(-1, 4)
    return hidden


def _box_gap(corners: Array, others: list[Mesh]) -> Array:
    """Return the distances (t, parts) of triangles from the bounding box of each part; 0 if they touch it."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    gaps = [np.maximum(low - o.vertices_m.max(axis=0), o.vertices_m.min(axis=0) - high) for o in others]
    return np.maximum(np.stack(gaps, axis=1).max(axis=2), 0.0)


def _halved(corners: Array) -> Array:
    """Return both halves (2t, 3, 3) of triangles, cut across their longest edge."""
    lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    order = (np.argmax(lengths, axis=1)[:, None] + np.arange(3)) % 3  # the longest edge runs from first to second
    a, b, c = np.moveaxis(np.take_along_axis(corners, order[..., None], axis=1), 1, 0)
    middle = 0.5 * (a + b)
    return np.stack([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)], axis=1).reshape(-1, 3, 3)


def _welded(mesh: Mesh, parts: int) -> Mesh:
    """Return the mesh with equal vertices made one."""
    _, first, number = np.unique(np.round(mesh.vertices_m, 9), axis=0, return_index=True, return_inverse=True)
    return Mesh(mesh.vertices_m[first], number.reshape(-1)[mesh.triangles], mesh.albedo, mesh.part % parts)
