"""Cameras and poses as BOP's JSON files write them."""

import numpy as np

from modeler import se3
from modeler.types import Array
from sequences.files.intrinsics import of_matrix
from sequences.files.json_input import Node
from sequences.given import Intrinsics


def intrinsics(node: Node) -> Intrinsics:
    """Return (fx, fy, cx, cy) in px of one entry of `scene_camera.json`.

    Raises:
        InputError: where `cam_K` is missing or is not the matrix of a pinhole camera.
    """
    entry = node.need("cam_K")
    found = of_matrix(entry.numbers(9).reshape(3, 3))
    if found is None:
        raise entry.fault("[fx, 0, cx, 0, fy, cy, 0, 0, 1] in px with fx and fy of at least 1")
    return found


def depth_scale_mm(node: Node) -> float:
    """Return the millimetres per unit of depth of one entry of `scene_camera.json`.

    Raises:
        InputError: where it is missing or absurd; 1000 would be units per metre mistaken for it.
    """
    return node.need("depth_scale").number(1e-6, 100.0)


def camera_from_model(node: Node) -> Array:
    """Return the pose (4, 4), in m, of one object of `scene_gt.json`.

    Raises:
        InputError: where rotation or translation is missing or the rotation is none.
    """
    entry = node.need("cam_R_m2c")
    written = entry.numbers(9).reshape(3, 3)
    if np.abs(written).max() > 2.0:
        raise entry.fault("a rotation matrix, row by row")
    left, stretch, right = np.linalg.svd(written)
    if np.abs(stretch - 1.0).max() > 1e-2 or np.linalg.det(written) < 0.0:
        raise entry.fault("a rotation matrix, row by row")
    pose = se3.translation(node.need("cam_t_m2c").numbers(3) / 1000.0)
    pose[:3, :3] = left @ right  # the rotation nearest to the rounded digits
    return pose


def camera_entry(matrix: Array, scale_mm: float) -> dict[str, object]:
    """Return the entry of `scene_camera.json` for intrinsics (3, 3) in px."""
    return {"cam_K": [float(value) for value in matrix.ravel()], "depth_scale": scale_mm}


def pose_entry(pose: Array) -> dict[str, object]:
    """Return the entry of `scene_gt.json` for camera_from_model (4, 4) in m."""
    rotation, shift = pose[:3, :3].ravel(), pose[:3, 3] * 1000.0
    return {"cam_R_m2c": [float(v) for v in rotation], "cam_t_m2c": [float(v) for v in shift], "obj_id": 1}
