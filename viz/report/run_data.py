"""Data of a run: its report as types of the package, and the clouds and images of its recording."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.export import RunFolder, edges_of, poses_of
from modeler.graph import PoseGraph, dead_reckoning
from modeler.system.regular_files import check_regular
from modeler.types import Array, Edge, InputError, PoseGaussian
from modeler.viz import entities
from modeler.viz.reader import READ, steps_of


@dataclass(frozen=True, eq=False)
class Result:
    """A finished or interrupted run, with the true motion where it is known."""

    path: Path
    """The run folder."""
    report: Mapping[str, Any]
    """`report.json`."""
    truth: Mapping[int, Array]
    """camera_from_model (4, 4) by frame number; empty where it is not known."""

    @classmethod
    def read(cls, path: Path, truth: Mapping[int, Array] | None = None) -> Result:
        """Read a run folder."""
        report = RunFolder(path).report()
        if not report["poses"]:
            raise InputError(f"{path}: no frame of this run was accepted; report.json says why")
        return cls(path, report, truth or {})

    @cached_property
    def edges(self) -> list[Edge]:
        """Every edge, in order."""
        return list(edges_of(self.report))

    @cached_property
    def poses(self) -> dict[int, PoseGaussian]:
        """object_from_camera after optimisation, by frame number."""
        return poses_of(self.report)

    @cached_property
    def chain(self) -> dict[int, PoseGaussian]:
        """object_from_camera of the pairwise chain alone, by frame number: `odometry.txt` with covariances."""
        reached = dead_reckoning(PoseGraph(tuple(self.edges), self.first))
        return {frame: reached[frame] for frame in self.poses if frame in reached}

    @property
    def first(self) -> int:
        """Number of the first accepted frame, in whose camera frame the object is."""
        return next(iter(self.poses))

    def true_pose(self, frame: int) -> Array | None:
        """Return the true object_from_camera (4, 4) of a frame; None if it is not known."""
        if frame not in self.truth or self.first not in self.truth:
            return None
        return self.truth[self.first] @ se3.inverse(self.truth[frame])

    def true_motion(self, edge: Edge) -> Array | None:
        """Return the true target_from_source (4, 4) of an edge; None if it is not known."""
        if edge.source not in self.truth or edge.target not in self.truth:
            return None
        return self.truth[edge.target] @ se3.inverse(self.truth[edge.source])


Row = Mapping[str, Any]  # values of an entity by component


def recorded(recording: Path) -> dict[str, dict[int, dict[str, Any]]]:
    """Return the rows of `READ` by frame; empty if nothing can be read.

    The frame is the newer view of a pair's caption, else that of the timeline, where a frame that was retried later
    appears at a later time. Of repeated attempts, the last one counts.
    """
    rows: dict[str, dict[int, dict[str, Any]]] = {path: {} for path in READ}
    if not os.path.lexists(recording):
        return rows
    check_regular(recording)
    if recording.stat().st_size > (4 << 30):  # 5,000 frames of 640×480; Rerun reads all into memory
        return rows
    steps = steps_of(recording)
    for _, step in sorted(steps.items()):
        found = {path: {name: value[0] for name, value in row.items()} for path, row in step.rows.items()}
        pair = registered(found.get(entities.PAIR_CAPTION, {}))
        for path, row in found.items():
            rows[path][step.frame if pair is None else pair[0]] = row
    return rows


def registered(caption: Row) -> tuple[int, int] | None:
    """Return the numbers of a pair's frames, the newer first, as its caption names them; None if there is none."""
    words = " ".join(map(str, caption["labels"].as_py())) if "labels" in caption else ""
    numbers = re.findall(r"frame (\d+)", words)
    return (int(numbers[0]), int(numbers[1])) if len(numbers) == 2 else None


def cloud(row: Row) -> tuple[Array, npt.NDArray[np.uint8]] | None:
    """Return points (n, 3) in m and colours (n, 3) of a row, without what damage made infinite; None if it has none."""
    if "positions" not in row or "colors" not in row:
        return None
    points = np.array(row["positions"].as_py(), dtype=np.float64).reshape(-1, 3)
    packed = np.array(row["colors"].as_py(), dtype=np.uint32)
    colours = np.stack([packed >> 24, packed >> 16, packed >> 8], axis=1).astype(np.uint8)
    known = np.isfinite(points).all(axis=1)
    return (points[known], np.broadcast_to(colours, points.shape)[known]) if known.any() else None


def surfaces(rows: Mapping[str, Mapping[int, Row]]) -> dict[int, Array]:
    """Return the surface points (n, 3) of frames that were registered, or registered to, in their cameras' frames."""
    found = {frame: cloud(row) for frame, row in rows[entities.PAIR_BEFORE].items()}
    for frame, caption in rows[entities.PAIR_CAPTION].items():
        pair, target = registered(caption), rows[entities.PAIR_TARGET].get(frame)
        if pair is not None and target is not None and found.get(pair[1]) is None:
            found[pair[1]] = cloud(target)
    return {frame: points_colours[0] for frame, points_colours in found.items() if points_colours is not None}
