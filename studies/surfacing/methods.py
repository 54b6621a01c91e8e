"""Frames and poses to a mesh, by us and by Open3D with our voxels and band."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
import open3d as o3d

from modeler import se3
from modeler.fusion import Fuser
from modeler.types import Array, RayImage
from studies.bench.reference import tsdf

Surface = tuple[Array, npt.NDArray[np.int64]]
Method = Callable[[Mapping[int, RayImage], Mapping[int, Array], float, float], Surface]
"""From views, object_from_camera (4, 4), voxel and half band in m to vertices and triangles."""


def ours(views: Mapping[int, RayImage], poses: Mapping[int, Array], voxel_m: float, tau_m: float) -> Surface:
    """Fuse as `modeler build` does, the poses exact: carved, coloured, with views and deviation of every vertex."""
    del tau_m  # it follows the data
    model = Fuser(voxel_m=voxel_m).fuse(views, poses)
    return model.vertices_m, model.triangles


def open3d_tsdf(
    views: Mapping[int, RayImage], poses: Mapping[int, Array], voxel_m: float, tau_m: float, *, above: float = 1.0
) -> Surface:
    """Integrate with Open3D; surface is where the weight is `above` that number."""
    frames = [view.frame for view in views.values()]
    mesh = tsdf(frames, [poses[frame] for frame in views], voxel_m, tau_m, above=above)
    return mesh.vertex.positions.numpy().astype(np.float64), mesh.triangle.indices.numpy().astype(np.int64)


def open3d_smoothed(views: Mapping[int, RayImage], poses: Mapping[int, Array], voxel_m: float, tau_m: float) -> Surface:
    """Integrate with Open3D, and smooth by ten steps of the filter of Taubin (1995), which does not shrink."""
    vertices_m, triangles = open3d_tsdf(views, poses, voxel_m, tau_m)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices_m), o3d.utility.Vector3iVector(triangles.astype(np.int32))
    )
    mesh = mesh.filter_smooth_taubin(number_of_iterations=10)
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)


def open3d_poisson(views: Mapping[int, RayImage], poses: Mapping[int, Array], voxel_m: float, tau_m: float) -> Surface:
    """Reconstruct the merged cloud (Kazhdan and Hoppe 2013), without the 5 % of vertices that it invents the most."""
    del tau_m
    points = np.concatenate([se3.transform(poses[frame], view.points_m) for frame, view in views.items()])
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    normals = np.concatenate([view.normals @ poses[frame][:3, :3].T for frame, view in views.items()])
    cloud.normals = o3d.utility.Vector3dVector(normals)
    cloud = cloud.voxel_down_sample(voxel_m)
    mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=8, n_threads=1)
    mesh.remove_vertices_by_mask(np.asarray(density) < np.quantile(np.asarray(density), 0.05))
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)


METHODS: dict[str, Method] = {
    "ours": ours,
    "Open3D TSDF": open3d_tsdf,
    "the same, smoothed": open3d_smoothed,
    "Open3D Poisson": open3d_poisson,
}
