"""Points recognised by the shape about them, and the motions that matches of such points fix."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from modeler.types import Array

_FEWEST = 9  # matches that are left; three fix a motion


def fpfh(points_m: Array, normals: Array, radius_m: float) -> Array:
    """Return the Fast Point Feature Histogram (n, 33) of each point (Rusu, Blodow and Beetz 2009).

    Args:
        points_m: (n, 3).
        normals: (n, 3) unit.
        radius_m: of the neighbourhood that it describes, by at most 100 points.
    """
    import open3d as o3d  # slow to load, and only needed here

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    search = o3d.geometry.KDTreeSearchParamHybrid(radius_m, 100)
    features = o3d.pipelines.registration.compute_fpfh_feature(cloud, search)  # pyright: ignore[reportCallIssue]
    return np.ascontiguousarray(np.asarray(features.data).T)


def mutual_matches(source: Array, target: Array) -> npt.NDArray[np.int64]:
    """Return pairs (m, 2) of rows that are each other's nearest; of all nearest targets where those are too few.

    Args:
        source: (n, k) features.
        target: (m, k) features.
    """
    a, b = source.astype(np.float32), target.astype(np.float32)
    squares = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2.0 * a @ b.T
    forth, back = np.argmin(squares, axis=1), np.argmin(squares, axis=0)
    pairs = np.column_stack([np.arange(len(a)), forth])
    mutual = pairs[back[forth] == pairs[:, 0]]
    return mutual if len(mutual) >= _FEWEST else pairs


def kabsch(source_m: Array, target_m: Array) -> Array:
    """Return the motions (n, 4, 4) that best carry point sets (n, k, 3) onto their partners (n, k, 3) (Kabsch 1976)."""
    source_mean, target_mean = source_m.mean(axis=1), target_m.mean(axis=1)
    spread = np.swapaxes(source_m - source_mean[:, None], 1, 2) @ (target_m - target_mean[:, None])
    left, _, right = np.linalg.svd(spread)
    handed = np.sign(np.linalg.det(left @ right))
    left[:, :, 2] *= handed[:, None]
    poses = np.broadcast_to(np.eye(4), (len(source_m), 4, 4)).copy()
    poses[:, :3, :3] = np.swapaxes(left @ right, 1, 2)
    poses[:, :3, 3] = target_mean - (poses[:, :3, :3] @ source_mean[:, :, None])[:, :, 0]
    return poses
