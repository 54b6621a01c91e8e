"""Trajectories in the format of the TUM RGB-D benchmark."""

from __future__ import annotations

from collections.abc import Mapping

from scipy.spatial.transform import Rotation

from modeler.types import Array


def pose_text(pose: Array) -> str:
    """Return `tx ty tz qx qy qz qw` of a pose (4, 4), in m, with every digit that it has and qw not negative."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    return " ".join(repr(float(value)) for value in (*pose[:3, 3], *quaternion))


def tum_text(trajectory: Mapping[int, Array], times_s: Mapping[int, float]) -> str:
    """Return one line `timestamp tx ty tz qx qy qz qw` per pose, in order of time.

    Args:
        trajectory: object_from_camera (4, 4) by frame number.
        times_s: time of capture in s by frame number.
    """
    frames = sorted(trajectory, key=lambda frame: (times_s[frame], frame))
    return "".join(f"{float(times_s[frame])!r} {pose_text(trajectory[frame])}\n" for frame in frames)
