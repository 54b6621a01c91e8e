"""Metadata of bags: static transforms, and further data of the RealSense recorder."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.sequences.intrinsics import sane
from modeler.sequences.lens import Lens, lens_of_model
from modeler.sequences.ros.bag import Bag
from modeler.types import Array, Camera, InputError

STATIC = "tf2_msgs/msg/TFMessage"
FARTHEST_M = 1e4
"""No robot is larger."""
MOST = 1000
"""Messages of fixed transforms that are read; drivers send one or a few."""


def static_transform(bag: Bag, target: str, source: str) -> Array | None:
    """Return target_from_source (4, 4), in m, between two frames; None if no fixed transforms lead there."""
    if not target or not source:
        return None
    steps: dict[str, list[tuple[str, Array]]] = {}
    for topic in (name for name, kind in bag.types.items() if kind == STATIC and name.endswith("tf_static")):
        for _, message in bag.messages(topic, most=MOST):
            for stamped in message.transforms:
                parent, child = _name(stamped.header.frame_id), _name(stamped.child_frame_id)
                parent_from_child = transform_pose(stamped.transform)
                if parent_from_child is not None:
                    steps.setdefault(child, []).append((parent, parent_from_child))
                    steps.setdefault(parent, []).append((child, se3.inverse(parent_from_child)))
    found, front = {_name(source): np.eye(4)}, [_name(source)]
    while front:
        here = front.pop(0)
        for there, there_from_here in steps.get(here, []):
            if there not in found:
                found[there] = there_from_here @ found[here]
                front.append(there)
    return found.get(_name(target))


def transform_pose(transform: Any) -> Array | None:
    """Return the motion (4, 4), in m, of a `geometry_msgs/Transform`; None if it is not rigid."""
    turn, shift = transform.rotation, transform.translation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w], dtype=np.float64)
    offset_m = np.array([shift.x, shift.y, shift.z], dtype=np.float64)
    small = bool((np.abs(quaternion) < 2.0).all() and (np.abs(offset_m) < FARTHEST_M).all())  # not so of NaN
    if not small or not 0.9 < float(np.linalg.norm(quaternion)) < 1.1:
        return None
    motion = se3.translation(offset_m)
    motion[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    return motion


def _name(frame_id: str) -> str:
    return str(frame_id).removeprefix("/")


FARTHEST_CAMERA_M = 10.0
"""Largest distance of two cameras of one device."""
TEXT = "std_msgs/msg/String"
_STREAM = r"(/device_\d+/sensor_\d+)/\w+"


def realsense_unit_mm(bag: Bag, topic: str) -> tuple[float, str] | None:
    """Return the millimetres in one unit of depth and the topic that says so; None if nothing does."""
    sensor = re.match(_STREAM, topic)
    if sensor is None:
        return None
    for name in bag.types:
        if name.replace(" ", "_") == f"{sensor[1]}/option/Depth_Units/value":
            for _, message in bag.messages(name, most=1):
                found = _number(str(message.data)) * 1000.0
                if 1e-6 <= found <= 1e3:
                    return found, name
    return None


def realsense_lens(bag: Bag, topic: str) -> Lens | None:
    """Return the camera of a topic from a text message, as version 2.58 writes it; None without."""
    stream = re.match(_STREAM, topic)
    name = None if stream is None else f"{stream[0]}/camera_info"
    if name is None or bag.types.get(name) != TEXT:
        return None
    for _, message in bag.messages(name, most=1):
        entries = _entries(message)
        names = ("width", "height", "fx", "fy", "ppx", "ppy")
        width, height, *pixels = (_number(entries.get(key, "")) for key in names)
        distortion = _numbers(entries.get("coeffs", ""), 5)
        sound = sane((pixels[0], pixels[1], pixels[2], pixels[3])) and bool(np.isfinite(distortion).all())
        if not sound or not (1.0 <= width <= 1e5 and 1.0 <= height <= 1e5):
            raise InputError(f"{bag.path}: {name}: describes no camera; record it again, or convert with `intrinsics`.")
        camera = Camera(int(width), int(height), pixels[0], pixels[1], pixels[2], pixels[3])
        return lens_of_model(camera, distortion.tolist(), entries.get("model", ""), f"{bag.path}: {name}")
    return None


def realsense_colour_from_depth(bag: Bag, colour_topic: str, depth_topic: str) -> Array | None:
    """Return the motion (4, 4), in m, from the depth to the colour camera; None if unknown."""
    poses = [_from_reference(bag, topic) for topic in (colour_topic, depth_topic)]
    colour, depth = poses
    return None if colour is None or depth is None else colour @ se3.inverse(depth)


def _from_reference(bag: Bag, topic: str) -> Array | None:
    """Return camera_from_reference (4, 4) of the camera of a topic."""
    stream = re.match(_STREAM, topic)
    if stream is None:
        return None
    for name in bag.types:
        if re.fullmatch(re.escape(stream[0]) + r"/tf/\w+", name):
            for _, message in bag.messages(name, most=1):
                return _pose(message, f"{bag.path}: {name}")
    return None


def _pose(message: Any, where: str) -> Array:
    if message.__msgtype__ == "geometry_msgs/msg/Transform":
        found = transform_pose(message)
        pose = np.full((4, 4), np.nan) if found is None else found
    else:
        entries = _entries(message)
        # Matrices of the camera's library stand column by column.
        pose = se3.translation(_numbers(entries.get("translation", ""), 3))
        pose[:3, :3] = _numbers(entries.get("rotation", ""), 9).reshape(3, 3).T
    if not se3.is_rigid(pose, tolerance=1e-3, farthest_m=FARTHEST_CAMERA_M):
        raise InputError(f"{where}: is no rigid motion; record it again.")
    return pose


def _entries(message: Any) -> dict[str, str]:
    """Return the values of a text message `key=value;key=value`."""
    return dict(part.split("=", 1) for part in str(getattr(message, "data", "")).split(";") if "=" in part)


def _numbers(text: str, count: int) -> Array:
    found = [_number(word) for word in text.split(",")]
    return np.array(found) if len(found) == count else np.full(count, np.nan)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")
