"""Where the frames of a robot are, as far as a bag says that they are fixed to each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.types import Array
from sequences.ros.bag import Bag

STATIC = "tf2_msgs/msg/TFMessage"
FARTHEST_M = 1e4
"""No robot is larger."""
MOST = 1000
"""Messages of fixed transforms that are read; drivers send one or a few."""


def fixed(bag: Bag, target: str, source: str) -> Array | None:
    """Return target_from_source (4, 4), in m, between two frames; None where no fixed transforms lead there.

    Args:
        bag: with a topic `tf_static`.
        target: `frame_id` of one image.
        source: `frame_id` of another.
    """
    if not target or not source:
        return None
    steps: dict[str, list[tuple[str, Array]]] = {}
    for topic in (name for name, kind in bag.types.items() if kind == STATIC and name.endswith("tf_static")):
        for _, message in bag.messages(topic, most=MOST):
            for stamped in message.transforms:
                parent, child = _name(stamped.header.frame_id), _name(stamped.child_frame_id)
                parent_from_child = pose(stamped.transform)
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


def pose(transform: Any) -> Array | None:
    """Return the motion (4, 4), in m, that a `geometry_msgs/Transform` is; None where it is none."""
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
