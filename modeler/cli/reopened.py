"""A run taken up again: the views it was made of, and its poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from modeler.cli import compose
from modeler.cli.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.export import RunFolder, edges_of, poses_of
from modeler.fusion import Fuser, Scan, own_covariances
from modeler.graph import PoseGraph, solve
from modeler.pipeline import ACCEPTED
from modeler.rays import Sensor
from modeler.types import Array, Edge, InputError, RayImage, Solution
from sequences import AbstractSequence, SensedSequence, read_noise


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
    recorded: AbstractSequence | None
    """What it was made of; None where that are two runs."""

    def scan(self, fuser: Fuser) -> Scan:
        """Return the views laid together as `modeler build` lays them."""
        return fuser.scanned(self.views, self.solution.trajectory, own_covariances(self.solution, self.edges))


def reopened(run: Path, sequence: Path | None = None) -> Reopened:
    """Return a run with its views, made from the sequence again with the run's settings.

    Args:
        run: run folder.
        sequence: where the sequence is now; None: where it was. Not for joined runs, which name two.

    Raises:
        InputError: where the folder holds no finished run, or the sequence is not to be found.
    """
    report = RunFolder(run).report()
    if not report["poses"]:
        raise InputError(f"{run}: no frame was accepted; build the run again")
    if "joined" in report["settings"]:
        return _joined(run, report)
    settings, where = report["settings"], Path(report["sequence"]) if sequence is None else sequence
    if not where.exists():
        raise InputError(f"{where}: the sequence of {run} is not there; say where it is with --sequence")
    whole = compose.open_sequence(where)
    whole = SensedSequence(whole, read_noise(Path(settings["sensor"]))) if "sensor" in settings else whole
    roi = settings.get("roi")
    limits = ObjectOptions(roi=None if roi is None else tuple(roi), max_depth_m=settings.get("max_depth_m"))
    noise = whole.sensor()
    modeler = compose.modeler(whole, PriorOptions(prior="general"), MethodOptions(), limits)
    scene = compose.scene(modeler, whole)
    views = {}
    for record in report["frames"]:
        if record["outcome"] != ACCEPTED:
            continue
        _, view = modeler.view(whole.frame(record["id"]), scene)
        if view is None:
            raise InputError(f"{where}: frame {record['id']} is not as it was for {run}; build the run again")
        views[record["id"]] = view
    edges = edges_of(report)
    sensor = Sensor() if noise is None else Sensor(*noise)
    return Reopened(whole.name, report, sensor, views, edges, solved(edges, _means(report)), whole)


def solved(edges: tuple[Edge, ...], poses: Mapping[int, Array]) -> Solution:
    """Return the solution of edges, its poses where they were before."""
    solution = solve(PoseGraph(edges=edges, first=min(poses)), poses)
    return replace(solution, trajectory={frame: poses[frame] for frame in solution.trajectory if frame in poses})


def renumbered(view: RayImage, offset: int) -> RayImage:
    """Return a view with another frame number."""
    return replace(view, frame=replace(view.frame, index=view.frame.index + offset))


def _means(report: Mapping[str, Any]) -> dict[int, Array]:
    """Return object_from_camera (4, 4) by frame number."""
    return {frame: pose.mean for frame, pose in poses_of(report).items()}


def _joined(run: Path, report: Mapping[str, Any]) -> Reopened:
    """Return a joined run, made of its two parts."""
    first, second = (reopened(Path(part)) for part in report["settings"]["joined"])
    offset = int(report["settings"]["offset"])
    views = dict(first.views) | {frame + offset: renumbered(view, offset) for frame, view in second.views.items()}
    edges, poses = edges_of(report), _means(report)
    if not poses.keys() <= views.keys():
        raise InputError(f"{run}: its parts have changed since they were joined; join them again")
    return Reopened(first.name, report, first.sensor, views, edges, solved(edges, poses), None)
