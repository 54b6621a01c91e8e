"""What RealSense's own recorder writes into bags besides images: units of depth, its cameras, and where they are.

It has recorded bags of ROS 1, with messages, and since version 2.58 of ROS 2, with texts `key=value;key=value`.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from modeler import se3
from modeler.types import Array, Camera, InputError
from sequences.given import sane
from sequences.lens import Lens, known
from sequences.ros import frames
from sequences.ros.bag import Bag

FARTHEST_M = 10.0
"""No two cameras of one device are so far apart."""
TEXT = "std_msgs/msg/String"
_STREAM = r"(/device_\d+/sensor_\d+)/\w+"


def unit_mm(bag: Bag, topic: str) -> tuple[float, str] | None:
    """Return the millimetres in one unit of depth and the topic that says so; None where nothing does."""
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


def lens(bag: Bag, topic: str) -> Lens | None:
    """Return the camera of a topic where a text tells it, as versions 2.58 write it; None where none does.

    Raises:
        InputError: where the text tells no camera.
    """
    stream = re.match(_STREAM, topic)
    name = None if stream is None else f"{stream[0]}/camera_info"
    if name is None or bag.types.get(name) != TEXT:
        return None
    for _, message in bag.messages(name, most=1):
        said = _said(message)
        width, height, *pixels = (_number(said.get(key, "")) for key in ("width", "height", "fx", "fy", "ppx", "ppy"))
        bend = _numbers(said.get("coeffs", ""), 5)
        sound = sane((pixels[0], pixels[1], pixels[2], pixels[3])) and bool(np.isfinite(bend).all())
        if not sound or not (1.0 <= width <= 1e5 and 1.0 <= height <= 1e5):
            raise InputError(f"{bag.path}: {name}: tells no camera; record it anew, or convert with --intrinsics.")
        camera = Camera(int(width), int(height), pixels[0], pixels[1], pixels[2], pixels[3])
        return known(camera, bend.tolist(), said.get("model", ""), f"{bag.path}: {name}")
    return None


def colour_from_depth(bag: Bag, colour_topic: str, depth_topic: str) -> Array | None:
    """Return the motion (4, 4), in m, from the depth to the colour camera; None where nothing tells it.

    Raises:
        InputError: where what tells it is no motion.
    """
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
        found = frames.pose(message)
        pose = np.full((4, 4), np.nan) if found is None else found
    else:
        said = _said(message)
        # Matrices of the camera's library stand column by column.
        pose = se3.translation(_numbers(said.get("translation", ""), 3))
        pose[:3, :3] = _numbers(said.get("rotation", ""), 9).reshape(3, 3).T
    if not se3.is_rigid(pose, tolerance=1e-3, farthest_m=FARTHEST_M):
        raise InputError(f"{where}: is no rigid motion; record it anew.")
    return pose


def _said(message: Any) -> dict[str, str]:
    """Return what a text message `key=value;key=value` says."""
    return dict(part.split("=", 1) for part in str(getattr(message, "data", "")).split(";") if "=" in part)


def _numbers(text: str, count: int) -> Array:
    found = [_number(word) for word in text.split(",")]
    return np.array(found) if len(found) == count else np.full(count, np.nan)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")
