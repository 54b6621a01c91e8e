"""Finished runs, opened again: their sequences, components, views, edges and poses."""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from modeler.composition import compose
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.export import RunFolder, edges_of, poses_of
from modeler.fusion import Fuser, FusionVolume, conditional_covariances
from modeler.graph import MovingGraph, PoseGraph, Smoother
from modeler.pipeline import Modeler
from modeler.pipeline.pairs import SEGMENTED
from modeler.pipeline.state import State
from modeler.segmentation import Scene, scene_frames
from modeler.sequences import (
    AbstractSequence,
    CalibratedSequence,
    Overrides,
    RefocusedSequence,
    open_sequence,
    read_focal_factor,
    read_noise,
)
from modeler.types import ACCEPTED, AbstractPrior, Array, BoolArray, Edge, InputError, ObjectModel, RayImage, Solution
from modeler.verdict.spreads import widened
from modeler.views import Sensor

_Options = TypeVar("_Options", PriorOptions, MethodOptions, ObjectOptions)
_ALIKE = 0.02  # largest relative change of an object's number of points between versions of a library


@dataclass(frozen=True, eq=False)
class Part:
    """A run and its sequence."""

    run: Path
    """Its folder, or that of the run which it is a part of."""
    report: Mapping[str, Any]
    """Its report, with its own frame numbers."""
    sequence: AbstractSequence
    offset: int = 0
    """Offset of its frame numbers in the joined run."""
    later_s: float = 0.0
    """By how much its frames are later in the joined run."""
    masks: Mapping[int, BoolArray] = field(default_factory=dict)
    """Masks (h, w), by its own frame numbers, of views whose masks are not those found in their frames alone."""

    @property
    def accepted(self) -> tuple[int, ...]:
        """Numbers, its own, of the frames that became part of the model."""
        return tuple(record["id"] for record in self.report["frames"] if record["outcome"] == ACCEPTED)

    def truth(self) -> dict[int, Array] | None:
        """Return the true camera_from_model (4, 4) by frame number of the joined run; None if it is not known."""
        truth = self.sequence.truth()
        return None if truth is None else {frame + self.offset: pose for frame, pose in truth.items()}

    def modeler(self) -> Modeler:
        """Return the loop with the components and the prior that the run was made with.

        Raises:
            InputError: if its settings cannot be used.
        """
        said: dict[str, Any] = {**self.report["settings"], **{name: self.report[name] for name in ("prior", "seed")}}
        settings: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in said.items()
        }

        def options(kind: type[_Options]) -> _Options:
            return kind(**{one.name: settings[one.name] for one in fields(kind) if one.name in settings})

        return compose.modeler(self.sequence, options(PriorOptions), options(MethodOptions), options(ObjectOptions))

    def views(self, frames: Sequence[int]) -> dict[int, RayImage]:
        """Return views, made again, by frame number of the joined run.

        Args:
            frames: numbers, its own, of accepted frames.

        Raises:
            InputError: if the sequence differs from that of the run.
        """
        views, points = {}, {record["id"]: record["points"] for record in self.report["frames"]}
        for frame in frames:
            view = self.view(frame)
            if view is None or abs(len(view.points_m) - points[frame]) > _ALIKE * points[frame]:
                raise InputError(
                    f"{self.sequence.name}: frame {frame} differs from the one that {self.run} was made "
                    "from, or another version segments it differently; give the original sequence with "
                    "`sequence`, or build the run again"
                )
            views[view.index] = view
        return views

    def view(self, frame: int) -> RayImage | None:
        """Return the view of a frame, its own number, as it is in the joined run; None if no object is found in it."""
        modeler, scene = self.looking
        images, known = self.sequence.frame(frame), self.masks.get(frame)
        found = modeler.segmenter.segment(images, scene)
        if known is not None and known.shape == images.depth_m.shape:
            plane = modeler.segmenter.with_surroundings(images, found, scene).plane
            view = self.sensor.ray_image(replace(images, mask=known), plane)
        elif found.outcome in SEGMENTED:
            view = self.sensor.ray_image(replace(images, mask=found.mask), found.plane)
        else:
            return None
        if not len(view.points_m):
            return None
        log_factor = math.log((self.report.get("camera") or {}).get("factor_in_run", 1.0))
        view = self.sensor.refocused(view, log_factor) if log_factor else view
        return renumbered(view, self.offset, self.later_s)

    @property
    def sensor(self) -> Sensor:
        """Noise of the camera that took the sequence."""
        modeler, scene = self.looking
        return modeler.sensor.measured(scene.range_noise)

    @cached_property
    def looking(self) -> tuple[Modeler, Scene]:
        """The components that find the object, and the scene learned from the sequence."""
        settings = self.report["settings"]
        roi = settings.get("roi")
        limits = ObjectOptions(roi=None if roi is None else tuple(roi), max_depth_m=settings.get("max_depth_m"))
        modeler = compose.modeler(self.sequence, PriorOptions(prior="general"), MethodOptions(), limits)
        learned_from = scene_frames(self.sequence.indices, self.report.get("scene_frames") or ())
        return modeler, compose.scene(modeler, self.sequence, learned_from)

    def check(self) -> None:
        """Look at the first and the last frame.

        Raises:
            InputError: if the sequence differs from that of the run.
        """
        self.views(sorted({*self.accepted[:1], *self.accepted[-1:]}))


def parts_of(run: Path, moved: Sequence[Path] = ()) -> tuple[Part, ...]:
    """Return the parts of a run: itself, the runs that it joins, or the run that it continues and its own recording.

    Args:
        run: run folder.
        moved: where the sequences are now, in order; none: where they were.

    Raises:
        InputError: if a folder holds no run, or a sequence cannot be found.
    """
    places = deque(moved) if moved else None
    found = _parts(run, places, ())
    if places:
        raise InputError(
            f"`sequence` is given {len(moved)} times where {run} was made from {len(found)}; give each once"
        )
    return found


def truth_of(parts: Sequence[Part]) -> dict[int, Array]:
    """Return the true camera_from_model (4, 4) by frame number of the joined run, where it is known."""
    return {frame: pose for part in parts for frame, pose in (part.truth() or {}).items()}


def _parts(run: Path, places: deque[Path] | None, within: tuple[Path, ...]) -> tuple[Part, ...]:
    """Return the parts of a run; `within` are the joined runs that contain it, from the outermost."""
    if run.resolve() in within:
        raise InputError(f"{run}: is part of itself; join its parts again")
    folder = RunFolder(run)
    report = folder.result()
    settings = report["settings"]
    if "joined" in settings:
        first, second = (_parts(folder.located(part), places, (*within, run.resolve())) for part in settings["joined"])
        offset, later_s = int(settings["offset"]), float(settings.get("later_s", 0.0))
        moved = (replace(part, offset=part.offset + offset, later_s=part.later_s + later_s) for part in second)
        return (*first, *moved)
    first: tuple[Part, ...] = ()
    if "continues" in settings:
        first = _parts(folder.located(settings["continues"]), places, (*within, run.resolve()))
        report = _of_recording(report)
    if places is not None and not places:
        raise InputError(f"`sequence` is given too few times; give that of {run}, too, in order")
    where = folder.located(report["sequence"]) if places is None else places.popleft()
    if not where.exists():
        raise InputError(f"{where}: the sequence of {run} does not exist; give its new place with `sequence`")
    sensor, camera = (folder.located(settings[name]) if name in settings else None for name in ("sensor", "camera"))
    sequence = calibrated(open_sequence(where, _overrides(settings)), sensor, camera)
    offset, later_s = int(settings.get("offset", 0)), float(settings.get("later_s", 0.0))
    masks = {frame - offset: mask for frame, mask in folder.masks().items()}
    return (*first, Part(run, report, sequence, offset, later_s, masks))


def _of_recording(report: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the part of a report about the recording with which a run continues another, by its own numbers."""
    offset, later_s = report["settings"]["offset"], report["settings"].get("later_s", 0.0)
    frames = [
        record | {"id": record["id"] - offset, "timestamp": record["timestamp"] - later_s}
        for record in report["frames"]
        if record["id"] >= offset
    ]
    camera = report["camera"] if report["settings"].get("same_camera") else None
    return dict(report) | {"frames": frames, "sequence": report["sequence"].split(" + ")[-1], "camera": camera}


def _overrides(settings: Mapping[str, Any]) -> Overrides:
    """Return what was given in place of the input's own values, of the settings of a run."""
    given: dict[str, Any] = {one.name: settings[one.name] for one in fields(Overrides) if one.name in settings}
    if "intrinsics" in given:
        given["intrinsics"] = tuple(given["intrinsics"])
    return Overrides(**given)


def calibrated(sequence: AbstractSequence, sensor: Path | None, camera: Path | None) -> AbstractSequence:
    """Return a sequence with the calibration of its camera, as files with its noise and focal length have it."""
    sequence = sequence if camera is None else RefocusedSequence(sequence, read_focal_factor(camera))
    return sequence if sensor is None else CalibratedSequence(sequence, read_noise(sensor))


def renumbered(view: RayImage, offset: int, later_s: float = 0.0) -> RayImage:
    """Return a view with another frame number and time."""
    frame = view.frame
    return replace(view, frame=replace(frame, index=frame.index + offset, time_s=frame.time_s + later_s))


@dataclass(frozen=True, eq=False)
class Reopened:
    """Views, edges and poses of a finished run."""

    name: str
    """Of the object or sequence."""
    report: Mapping[str, Any]
    sensor: Sensor
    """Noise of the camera."""
    views: Mapping[int, RayImage]
    """Accepted views by frame number."""
    edges: tuple[Edge, ...]
    """Every edge, accepted or not."""
    solution: Solution
    """The poses, solved again from the edges."""
    parts: tuple[Part, ...]
    """Its sequence, or for joined runs those of all parts."""

    def volume(self, fuser: Fuser) -> FusionVolume:
        """Return the views fused as `modeler build` fuses them."""
        return fuser.volume(self.views, self.solution.trajectory, conditional_covariances(self.solution, self.edges))

    def model(self, volume: FusionVolume, *, watertight: bool = False) -> ObjectModel:
        """Return the model of its volume, whose vertices are as uncertain as those of `modeler build`."""
        return widened(volume.model(watertight=watertight), self.solution)


def reopened(run: Path, moved: Sequence[Path] = (), announce: Callable[[str], None] = lambda words: None) -> Reopened:
    """Return a run with its views, made from the sequence again with the run's settings.

    Args:
        run: run folder.
        moved: where its sequence is now, of joined runs all of theirs in order; none: where they were.
        announce: receives in words what follows, once first and last frames are found to be those of the run.

    Raises:
        InputError: if the folder holds no finished run, or a sequence is not to be found or is another.
    """
    report, parts = RunFolder(run).result(), parts_of(run, moved)
    poses = {frame: pose.mean for frame, pose in poses_of(report).items()}
    if not poses:
        raise InputError(f"{run}: no frame was accepted; build the run again")
    for part in parts:
        part.check()
    total_s = (report.get("seconds") or {}).get("total")
    took = "" if total_s is None else f"; the build took {total_s:.0f} s"
    announce(f"preparing {len(poses)} frames again{took}")
    views = {frame: view for part in parts for frame, view in part.views(part.accepted).items()}
    if not poses.keys() <= views.keys():
        raise InputError(f"{run}: its parts have changed since they were joined; join them again")
    edges = edges_of(report)
    solution = solved(edges, poses, views, report.get("camera"), _prior_of(parts))
    solution = replace(solution, trajectory={frame: poses[frame] for frame in solution.trajectory if frame in poses})
    return Reopened(parts[0].sequence.name, report, parts[0].sensor, views, edges, solution, parts)


def _prior_of(parts: Sequence[Part]) -> AbstractPrior | None:
    """Return the prior of a run; None if it joins several, or was not made with one that options name."""
    with contextlib.suppress(InputError):
        return parts[0].modeler().prior if len(parts) == 1 else None
    return None


def solved(
    edges: tuple[Edge, ...],
    guess: Mapping[int, Array],
    views: Mapping[int, RayImage],
    camera: Mapping[str, Any] | None,
    prior: AbstractPrior | None = None,
) -> Solution:
    """Return the solution of the edges of finished runs, as certain as `modeler build` takes it.

    Args:
        edges: all of them.
        guess: object_from_camera (4, 4) by frame number; the first frame keeps its pose.
        views: by frame number.
        camera: its estimate by the runs, as in report.json, under which edges and views are; None: exact.
        prior: of the steps, if all are of one run.
    """
    graph = PoseGraph(edges=edges, first=min(guess))
    smoother = Smoother(solution=Solution(guess)).to(graph)
    spans = tuple(edge for edge in edges if edge.kind == "span")
    state = State(graph=graph, smoother=smoother, views=views, spans=spans)
    focal, sigma = None, float((camera or {}).get("focal_factor_sigma", 0.0))
    if sigma > 0.0 and len(smoother.solution.trajectory) > 1:
        focal = MovingGraph.of(graph, smoother.solution).estimate(sigma)
        focal = replace(focal, log_factor=0.0, sigma=sigma)  # loops determined it
    parts = {"common_noise": Modeler.common_noise, "common_distance": Modeler.common_distance}
    return state.with_shared_errors(prior, focal=focal, **parts).solution
