"""A run taken up again: the views it was made of, and its poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from modeler.cli.parts import Part, parts_of
from modeler.export import RunFolder, edges_of, poses_of
from modeler.fusion import Fuser, FusionVolume, own_covariances
from modeler.graph import PoseGraph, solve
from modeler.rays import Sensor
from modeler.types import Array, Edge, InputError, RayImage, Solution


@dataclass(frozen=True, eq=False)
class Reopened:
    """Views, edges and poses of a finished run."""

    name: str
    """Of the object or sequence."""
    report: Mapping[str, Any]
    """What the run said of itself."""
    sensor: Sensor
    """Noise of the camera."""
    views: Mapping[int, RayImage]
    """Accepted views by frame number."""
    edges: tuple[Edge, ...]
    """Every edge, as it was judged."""
    solution: Solution
    """The poses, solved again from the edges."""
    parts: tuple[Part, ...]
    """What it was made of: one sequence, or of joined runs all of theirs."""

    def volume(self, fuser: Fuser) -> FusionVolume:
        """Return the views laid together as `modeler build` lays them."""
        return fuser.volume(self.views, self.solution.trajectory, own_covariances(self.solution, self.edges))


def reopened(run: Path, sequences: Sequence[Path] = ()) -> Reopened:
    """Return a run with its views, made from the sequence again with the run's settings.

    Args:
        run: run folder.
        sequences: where its sequence is now, of joined runs all of theirs in order; none: where they were.

    Raises:
        InputError: where the folder holds no finished run, or a sequence is not to be found or is another.
    """
    report, parts = RunFolder(run).result(), parts_of(run, sequences)
    poses = {frame: pose.mean for frame, pose in poses_of(report).items()}
    if not poses:
        raise InputError(f"{run}: no frame was accepted; build the run again")
    views = {frame: view for part in parts for frame, view in part.views(part.accepted).items()}
    if not poses.keys() <= views.keys():
        raise InputError(f"{run}: its parts have changed since they were joined; join them again")
    edges, noise = edges_of(report), parts[0].sequence.sensor()
    sensor = Sensor() if noise is None else Sensor(*noise)
    return Reopened(parts[0].sequence.name, report, sensor, views, edges, solved(edges, poses), parts)


def solved(edges: tuple[Edge, ...], poses: Mapping[int, Array]) -> Solution:
    """Return the solution of edges, its poses where they were before."""
    solution = solve(PoseGraph(edges=edges, first=min(poses)), poses)
    return replace(solution, trajectory={frame: poses[frame] for frame in solution.trajectory if frame in poses})
