"""Open3D's own recipes, as its tutorials put them together: what registration is measured against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d

from modeler import se3
from modeler.types import Array, Frame

_registration = o3d.pipelines.registration

PYRAMID_M = (0.008, 0.004, 0.002)  # the tutorial's 4, 2, 1 cm for a room, at the size of an object
PYRAMID_ITERATIONS = (50, 30, 14)
FEATURE_VOXEL_M = 0.005  # the tutorial's 5 cm for a room, likewise


@dataclass(frozen=True, eq=False)
class IcpView:
    """The object's cloud at each level of the pyramid, with normals."""

    levels: tuple[o3d.geometry.PointCloud, ...]
    centroid_m: Array


@dataclass(frozen=True, eq=False)
class FeatureView:
    """The object's cloud with normals, thinned, and the features of the thinned one."""

    whole: o3d.geometry.PointCloud
    thinned: o3d.geometry.PointCloud
    features: o3d.pipelines.registration.Feature


def cloud(frame: Frame) -> o3d.geometry.PointCloud:
    """Return the cloud of a frame's object pixels."""
    camera = frame.camera
    depth_m = np.nan_to_num(frame.depth_m, nan=0.0).astype(np.float32)
    if frame.mask is not None:
        depth_m[~frame.mask] = 0.0
    intrinsics = o3d.camera.PinholeCameraIntrinsic(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    )
    return o3d.geometry.PointCloud.create_from_depth_image(
        o3d.geometry.Image(depth_m),  # pyright: ignore[reportCallIssue, reportArgumentType]
        intrinsics,
        depth_scale=1.0,
        depth_trunc=10.0,
    )


def icp_view(frame: Frame) -> IcpView:
    """Make a frame ready for multi-scale ICP."""
    whole = cloud(frame)
    return IcpView(tuple(_thinned(whole, voxel_m) for voxel_m in PYRAMID_M), np.asarray(whole.get_center()))


def icp(source: IcpView, target: IcpView) -> Array:
    """Return target_from_source (4, 4) by multi-scale point-to-plane ICP from centroid on centroid."""
    pose = se3.translation(target.centroid_m - source.centroid_m)
    levels = zip(source.levels, target.levels, PYRAMID_M, PYRAMID_ITERATIONS, strict=True)
    for of_source, of_target, voxel_m, iterations in levels:
        pose = _refined(of_source, of_target, pose, reach_m=2.0 * voxel_m, iterations=iterations)
    return pose


def feature_view(frame: Frame) -> FeatureView:
    """Make a frame ready for global registration."""
    whole = cloud(frame)
    whole.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2.0 * FEATURE_VOXEL_M, max_nn=30))
    whole.orient_normals_towards_camera_location(np.zeros(3))
    thinned = _thinned(whole, FEATURE_VOXEL_M)
    search = o3d.geometry.KDTreeSearchParamHybrid(radius=5.0 * FEATURE_VOXEL_M, max_nn=100)
    features = _registration.compute_fpfh_feature(thinned, search)  # pyright: ignore[reportCallIssue]
    return FeatureView(whole, thinned, features)


def fpfh_icp(source: FeatureView, target: FeatureView) -> Array:
    """Return target_from_source (4, 4) by FPFH, RANSAC and a last ICP."""
    reach_m = 1.5 * FEATURE_VOXEL_M
    found = _registration.registration_ransac_based_on_feature_matching(
        source.thinned,
        target.thinned,
        source.features,
        target.features,
        True,
        reach_m,
        _registration.TransformationEstimationPointToPoint(False),
        3,
        [
            _registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            _registration.CorrespondenceCheckerBasedOnDistance(reach_m),
        ],
        _registration.RANSACConvergenceCriteria(100_000, 0.999),
    )
    return _refined(source.whole, target.whole, found.transformation, reach_m=0.4 * FEATURE_VOXEL_M, iterations=30)


def tsdf(
    frames: Sequence[Frame], poses: Sequence[Array], voxel_m: float, tau_m: float, *, above: float = 1.0
) -> o3d.t.geometry.TriangleMesh:
    """Return the mesh of object pixels, object_from_camera (4, 4) given.

    Surface is where the weight is `above` that number: at 1, the recipe's, what a single frame sees is left out.
    By VoxelBlockGrid, which replaces ScalableTSDFVolume: that gives empty meshes in Open3D 0.20.
    """
    single, scalar = o3d.core.float32, o3d.core.SizeVector([1])
    volume = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (single, single), (scalar, scalar), voxel_m, 16, 1000, o3d.core.Device("CPU:0")
    )
    band = max(1.01, tau_m / voxel_m)
    for frame, object_from_camera in zip(frames, poses, strict=True):
        camera, depth_m = frame.camera, np.nan_to_num(frame.depth_m)
        depth_m = depth_m if frame.mask is None else np.where(frame.mask, depth_m, 0.0)
        image = o3d.t.geometry.Image(o3d.core.Tensor.from_numpy(depth_m[..., None].astype(np.float32)))
        matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        lens = o3d.core.Tensor.from_numpy(matrix)
        pose = o3d.core.Tensor.from_numpy(np.ascontiguousarray(se3.inverse(object_from_camera)))
        blocks = volume.compute_unique_block_coordinates(image, lens, pose, 1.0, 5.0, band)
        volume.integrate(blocks, image, lens, pose, 1.0, 5.0, band)
    return volume.extract_triangle_mesh(weight_threshold=above)


def _thinned(whole: o3d.geometry.PointCloud, voxel_m: float) -> o3d.geometry.PointCloud:
    thinned = whole.voxel_down_sample(voxel_m)
    thinned.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2.0 * voxel_m, max_nn=30))
    thinned.orient_normals_towards_camera_location(np.zeros(3))
    return thinned


def _refined(
    source: o3d.geometry.PointCloud,
    target: o3d.geometry.PointCloud,
    pose: Array,
    *,
    reach_m: float,
    iterations: int,
) -> Array:
    result = _registration.registration_icp(
        source,
        target,
        reach_m,
        pose,
        _registration.TransformationEstimationPointToPlane(),
        _registration.ICPConvergenceCriteria(relative_fitness=1e-6, relative_rmse=1e-6, max_iteration=iterations),
    )
    return result.transformation
