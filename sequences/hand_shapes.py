"""The shape of a robot's hand, drawn at its poses to mask it in every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modeler import se3
from modeler.sequences.base import AbstractDerived, AbstractSequence
from modeler.sequences.input_files import Node
from modeler.sequences.recording import AbstractRecording
from modeler.sequences.tum import trajectory
from modeler.types import Array, BoolArray, Frame, HandPoses, InputError

_MOST = 100  # capsules: 10 s a run of 100 frames


@dataclass(frozen=True, eq=False)
class HandShape:
    """A hand as capsules: all points within a radius of a line segment."""

    ends_m: Array
    """(k, 2, 3) both ends of each segment, in the frame of the hand's poses."""
    radii_m: Array
    """(k,) of the capsules."""
    margin_m: float
    """Widening of the capsules, for errors of the poses and of the shape."""

    def __post_init__(self) -> None:
        assert self.ends_m.shape == (len(self.radii_m), 2, 3)

    def marked(self, frame: Frame, camera_from_hand: Array) -> BoolArray:
        """Return where a frame shows the hand (h, w): points within it, and rays through it that measured nothing.

        Measurements in front of or behind it are not part of the hand.
        """
        w, h = frame.camera.rays()
        rays = np.stack([w, h, np.ones_like(w)], axis=-1)
        measured = np.isfinite(frame.depth_m)
        points_m = rays[measured] * frame.depth_m[measured, None]
        blind = rays[~measured] / np.linalg.norm(rays[~measured], axis=1, keepdims=True)
        seen, hidden = np.zeros(len(points_m), dtype=bool), np.zeros(len(blind), dtype=bool)
        ends_m = se3.transform(camera_from_hand, self.ends_m.reshape(-1, 3)).reshape(-1, 2, 3)
        for (start_m, end_m), radius_m in zip(ends_m, self.radii_m + self.margin_m, strict=True):
            seen |= _distances(points_m - start_m, end_m - start_m) <= radius_m
            hidden |= _ray_distances(blind, start_m, end_m) <= radius_m
        marks = np.zeros(frame.depth_m.shape, dtype=bool)
        marks[measured], marks[~measured] = seen, hidden
        return marks


def _distances(offsets_m: Array, along_m: Array) -> Array:
    """Return the distances (n,) of points from a segment, given from its start (n, 3), and (3,) to its end."""
    share = np.clip(offsets_m @ along_m / max(float(along_m @ along_m), 1e-18), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offsets_m - share[:, None] * along_m, axis=1), dtype=np.float64)


def _ray_distances(rays: Array, start_m: Array, end_m: Array) -> Array:
    """Return the distances (n,) of lines through the camera, unit (n, 3), from a segment; inf behind the camera."""
    along_m = end_m - start_m
    across_start = start_m - (rays @ start_m)[:, None] * rays
    across_along = along_m - (rays @ along_m)[:, None] * rays
    square = np.maximum(np.sum(across_along**2, axis=1), 1e-18)
    share = np.clip(-np.sum(across_start * across_along, axis=1) / square, 0.0, 1.0)
    nearest_m = start_m + share[:, None] * along_m
    distances_m = np.linalg.norm(across_start + share[:, None] * across_along, axis=1)
    return np.where(np.sum(nearest_m * rays, axis=1) > 0.0, distances_m, np.inf)


@dataclass(frozen=True)
class HandMarkedSequence(AbstractDerived):
    """Another sequence whose frames have a robot's hand masked, in addition to their own masks."""

    shape: HandShape
    poses: HandPoses

    def frame(self, index: int) -> Frame:
        """Return a frame with the hand marked.

        Raises:
            InputError: if the hand's pose is not known, too.
        """
        frame = self.whole.frame(index)
        marks = self.shape.marked(frame, self.poses.at(frame)[0])
        return replace(frame, occluder=marks if frame.occluder is None else marks | frame.occluder)


def with_hand(sequence: AbstractSequence) -> AbstractSequence:
    """Return a sequence with the hand of its `sequence.json` masked; without one, the sequence itself."""
    node = sequence.facts.get("hand") if isinstance(sequence, AbstractRecording) else None
    if node is None:
        return sequence
    shape = _shape(node)
    if sequence.robot_path is None:
        raise InputError(
            f"{node.path}: describes a hand, but there is no robot.txt; write lines `time tx ty tz qx qy qz qw` of "
            "camera_from_hand into the same folder, or remove the hand."
        )
    return HandMarkedSequence(sequence, shape, hand_poses(sequence.robot_path))


def hand_poses(path: Path) -> HandPoses:
    """Read the poses of a hand from its robot.txt."""
    poses = trajectory(path)
    if not poses:
        raise InputError(f"{path}: holds no pose; write lines `time tx ty tz qx qy qz qw`.")
    times_s, hands = np.array([time_s for time_s, _ in poses]), np.array([pose for _, pose in poses])
    return HandPoses(times_s, hands, name=str(path))


def _shape(node: Node) -> HandShape:
    """Return the entry `hand` of `sequence.json` after a check of everything in it."""
    _check_keys(node, ("capsules", "margin_m"))
    capsules: Sequence[Node] = node.need("capsules").elements()
    if not 0 < len(capsules) <= _MOST:
        raise node.need("capsules").fault(f"a list of 1 to {_MOST} capsules")
    for capsule in capsules:
        _check_keys(capsule, ("from_m", "to_m", "radius_m"))
    ends_m = np.array([[capsule.need(key).numbers(3) for key in ("from_m", "to_m")] for capsule in capsules])
    radii_m = np.array([capsule.need("radius_m").number(1e-4, 1.0) for capsule in capsules])
    return HandShape(ends_m, radii_m, node.need("margin_m").number(0.0, 0.1))


def _check_keys(node: Node, known: tuple[str, ...]) -> None:
    for key, entry in node.items().items():
        if key not in known:
            raise entry.unknown(known)
