"""What cameras see of meshes, by casting rays: no graphics card is needed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import open3d as o3d

from modeler.types import Array, BoolArray, Camera


@dataclass(frozen=True, eq=False)
class Drawn:
    """What a camera sees of a mesh, (h, w) each."""

    depth_m: Array
    """Along the optical axis; inf where the mesh is not hit."""
    triangle: npt.NDArray[np.int64]
    """-1 where it is not hit."""
    shares: Array
    """(h, w, 3) of the triangle's corners."""

    @property
    def hit(self) -> BoolArray:
        """Where the mesh is."""
        return self.triangle >= 0


@dataclass(frozen=True, eq=False)
class Scene:
    """A mesh that rays are cast at."""

    vertices_m: Array
    """(v, 3)."""
    triangles: npt.NDArray[np.int64]
    """(t, 3)."""

    @cached_property
    def _scene(self) -> o3d.t.geometry.RaycastingScene:
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(self.vertices_m.astype(np.float32)),
            o3d.core.Tensor.from_numpy(self.triangles.astype(np.uint32)),
        )
        return scene

    def seen(self, camera: Camera, object_from_camera: Array) -> Drawn:
        """Return what a camera sees."""
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(rows.shape)], -1)
        ahead = rays @ object_from_camera[:3, :3].T
        start = np.broadcast_to(object_from_camera[:3, 3], ahead.shape)
        answer = self._scene.cast_rays(
            o3d.core.Tensor.from_numpy(np.concatenate([start, ahead], axis=-1).astype(np.float32)), nthreads=1
        )
        second, third = np.moveaxis(answer["primitive_uvs"].numpy().astype(np.float64), -1, 0)
        number = answer["primitive_ids"].numpy()
        return Drawn(
            answer["t_hit"].numpy().astype(np.float64),
            np.where(number == o3d.t.geometry.RaycastingScene.INVALID_ID, -1, number.astype(np.int64)),
            np.stack([1.0 - second - third, second, third], axis=-1),
        )

    def nearest_normals(self, points_m: Array) -> Array:
        """Return the unit normals (n, 3) of the mesh at the places nearest to points (n, 3)."""
        found = self._scene.compute_closest_points(o3d.core.Tensor.from_numpy(points_m.astype(np.float32)), nthreads=1)
        return found["primitive_normals"].numpy().astype(np.float64)

    def of(self, drawn: Drawn, values: Array) -> Array:
        """Return values (v, c) of vertices where the mesh is hit, (n, c)."""
        corners = self.triangles[drawn.triangle[drawn.hit]]
        return np.einsum("nk,nkc->nc", drawn.shares[drawn.hit], values[corners])
