"""What the renderer does with meshes: ray casting, the outer surface, PLY."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.sequences.meshes import IntArray, Mesh
from modeler.system.pictures import raycaster, tensor
from modeler.types import Array, BoolArray

if TYPE_CHECKING:
    import open3d as o3d


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
