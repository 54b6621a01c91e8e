"""Frames and poses to a mesh, by us and by Open3D with our voxels and band."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
import open3d as o3d

from modeler import se3
from modeler.fusion import Fuser
from modeler.types import Array, RayImage

Surface = tuple[Array, npt.NDArray[np.int64]]
Method = Callable[[Mapping[int, RayImage], Mapping[int, Array], float, float], Surface]
"""From views, object_from_camera (4, 4), voxel and half band in m to vertices and triangles."""


def ours(views: Mapping[int, RayImage], poses: Mapping[int, Array], voxel_m: float, tau_m: float) -> Surface:
    """Fuse as `modeler build` does, the poses exact: carved, coloured, with views and deviation of every vertex."""
    del tau_m  # it follows the data
    model = Fuser(voxel_m=voxel_m).fuse(views, poses)
    return model.vertices_m, model.triangles


def open3d_tsdf(views: Mapping[int, RayImage], poses: Mapping[int, Array], voxel_m: float, tau_m: float) -> Surface:
    """Integrate into a VoxelBlockGrid, which replaces ScalableTSDFVolume: that gives empty meshes in Open3D 0.20."""
    single, scalar = o3d.core.float32, o3d.core.SizeVector([1])
    volume = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (single, single), (scalar, scalar), voxel_m, 16, 1000, o3d.core.Device("CPU:0")
    )
    band = max(1.01, tau_m / voxel_m)
    for frame, view in views.items():
        camera, mask = view.frame.camera, view.frame.mask
        depth_m = np.nan_to_num(view.frame.depth_m)
        depth_m = depth_m if mask is None else np.where(mask, depth_m, 0.0)
        image = o3d.t.geometry.Image(o3d.core.Tensor.from_numpy(depth_m[..., None].astype(np.float32)))
        matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        lens = o3d.core.Tensor.from_numpy(matrix)
        pose = o3d.core.Tensor.from_numpy(np.ascontiguousarray(se3.inverse(poses[frame])))
        blocks = volume.compute_unique_block_coordinates(image, lens, pose, 1.0, 5.0, band)
        volume.integrate(blocks, image, lens, pose, 1.0, 5.0, band)
    mesh = volume.extract_triangle_mesh(weight_threshold=1.0)
    return mesh.vertex.positions.numpy().astype(np.float64), mesh.triangle.indices.numpy().astype(np.int64)


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


METHODS: dict[str, Method] = {"ours": ours, "Open3D TSDF": open3d_tsdf, "Open3D Poisson": open3d_poisson}
