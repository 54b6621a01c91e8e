"""What a run folder says, in the nouns of the package."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from modeler import se3
from modeler.export import RunFolder, edges_of, poses_of
from modeler.graph import PoseGraph, dead_reckoning
from modeler.types import Array, Edge, InputError, PoseGaussian


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
        """Read a run folder.

        Raises:
            InputError: where there is no run, or no frame of it was accepted.
        """
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
        """Return the true object_from_camera (4, 4) of a frame; None where it is not known."""
        if frame not in self.truth or self.first not in self.truth:
            return None
        return self.truth[self.first] @ se3.inverse(self.truth[frame])

    def true_motion(self, edge: Edge) -> Array | None:
        """Return the true target_from_source (4, 4) of an edge; None where it is not known."""
        if edge.source not in self.truth or edge.target not in self.truth:
            return None
        return self.truth[edge.target] @ se3.inverse(self.truth[edge.source])
