"""Rays against meshes: the only module of the renderer that knows Open3D."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.types import Array, BoolArray
from sequences.rendering.mesh import Mesh

if TYPE_CHECKING:
    import open3d as o3d

_SHORT = 1.0 - 2e-3
"""Light is followed up to just in front of the surface it should reach, which would else block itself."""


@final
@dataclass(frozen=True, eq=False)
class Hits:
    """What a bundle of rays met first."""

    depth_m: Array
    """(h, w) distance along the optical axis; NaN where nothing was met."""
    incidence_rad: Array
    """(h, w) angle between ray and normal; NaN where nothing was met."""
    points_m: Array
    """(h, w, 3) camera coordinates of what was met; NaN where nothing was."""
    albedo: npt.NDArray[np.uint8]
    """(h, w, 3) RGB of what was met."""

    def over(self, other: Hits, first: BoolArray) -> Hits:
        """Return these hits where `first` (h, w) holds, the others elsewhere."""
        wide = first[..., None]
        return Hits(
            np.where(first, self.depth_m, other.depth_m),
            np.where(first, self.incidence_rad, other.incidence_rad),
            np.where(wide, self.points_m, other.points_m),
            np.where(wide, self.albedo, other.albedo),
        )


@final
@dataclass(frozen=True, eq=False)
class Caster:
    """A mesh made ready for rays; one without triangles is met by no ray."""

    mesh: Mesh
    """What the rays are to meet."""

    @cached_property
    def _scene(self) -> o3d.t.geometry.RaycastingScene:
        return _scene(self.mesh)

    def cast(self, rays: Array, camera_from_mesh: Array) -> Hits:
        """Follow rays (h, w, 3) of unit depth from the camera's centre."""
        shape = rays.shape[:2]
        if not len(self.mesh.triangles):
            missed = np.full(shape, np.nan)
            return Hits(missed, missed, np.full((*shape, 3), np.nan), np.zeros((*shape, 3), np.uint8))
        mesh_from_camera = se3.inverse(camera_from_mesh)
        turned = rays @ mesh_from_camera[:3, :3].T
        origins = np.broadcast_to(mesh_from_camera[:3, 3], turned.shape)
        found = self._scene.cast_rays(_tensor(np.concatenate([origins, turned], axis=-1)))
        depth_m = found["t_hit"].numpy().astype(np.float64)
        met = np.isfinite(depth_m)
        depth_m = np.where(met, depth_m, np.nan)
        facing = np.abs(np.sum(found["primitive_normals"].numpy() * turned, axis=-1)) / np.linalg.norm(turned, axis=-1)
        incidence_rad = np.where(met, np.arccos(np.clip(facing, 0.0, 1.0)), np.nan)
        triangle = np.where(met, found["primitive_ids"].numpy(), 0)
        return Hits(depth_m, incidence_rad, rays * depth_m[..., None], self.mesh.albedo[triangle])

    def blocks(self, lamp_m: Array, points_m: Array, camera_from_mesh: Array) -> BoolArray:
        """Return where (h, w) the mesh stands between a lamp (3,) and points (h, w, 3), all in camera coordinates."""
        if not len(self.mesh.triangles):
            return np.zeros(points_m.shape[:2], bool)
        mesh_from_camera = se3.inverse(camera_from_mesh)
        lamp = se3.transform(mesh_from_camera, lamp_m)
        away = (np.nan_to_num(points_m) - lamp_m) @ mesh_from_camera[:3, :3].T
        rays = np.concatenate([np.broadcast_to(lamp, away.shape), away], axis=-1)
        return self._scene.test_occlusions(_tensor(rays), tnear=0.0, tfar=_SHORT).numpy()


def inside(mesh: Mesh, points_m: Array) -> BoolArray:
    """Return which points (n, 3) lie inside one closed part."""
    return _scene(mesh).compute_occupancy(_tensor(points_m), nsamples=3).numpy() > 0.5


def _scene(mesh: Mesh) -> o3d.t.geometry.RaycastingScene:
    import open3d as o3d  # takes a second to import

    scene = o3d.t.geometry.RaycastingScene()
    if len(mesh.triangles):
        scene.add_triangles(_tensor(mesh.vertices_m), o3d.core.Tensor.from_numpy(mesh.triangles.astype(np.uint32)))
    return scene


def _tensor(values: Array) -> o3d.core.Tensor:
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
