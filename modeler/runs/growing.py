"""A model that a new recording goes on with: its frames are placed on the model, and one graph has all."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from modeler import se3
from modeler.composition.options import ObjectOptions
from modeler.export import RunFolder, RunMeta
from modeler.graph import PoseGraph
from modeler.pipeline.joining import Joiner, Segment
from modeler.pipeline.pairs import Registrations
from modeler.registration import VisibilityRegistrar
from modeler.runs.joining import Work, groups_of, later_s, sequences_of, stated_tolerance, write_run
from modeler.runs.known_objects import known_object
from modeler.runs.reopening import Part, Reopened, reopened, solved
from modeler.sequences import AbstractSequence, Overrides
from modeler.sequences.calibrated import has_focal
from modeler.tracking import Tracked, Tracker
from modeler.types import (
    ACCEPTED,
    Array,
    Edge,
    InputError,
    ObjectModel,
    Outcome,
    RayImage,
    Solution,
    Stated,
    Verdict,
    explain,
)

_WHY: Final = Stated("it agrees with the place of the frame on the model")


@dataclass(frozen=True, eq=False)
class Grown:
    """Result of going on with a model."""

    verdict: Verdict
    """Whether the model can be trusted."""
    placed: int
    """Number of new frames that became part of it."""
    frames: int
    """Number of new frames."""


@dataclass(frozen=True)
class Growth:
    """Goes on building a model from a new recording."""

    where: ObjectOptions
    given: Overrides
    """What is given in place of the recording's own values."""
    seed: int = 0
    """Of every random number."""

    def run(self, run: Path, path: Path, frames: AbstractSequence, out: Path, *, overwrite: bool) -> Grown:
        """Place new frames on the model of a run, register them with its views, optimise and fuse all.

        Args:
            run: run folder, whose object frame is kept.
            path: the recording.
            frames: those selected of it, whose numbers continue those of the run.
            out: run folder to create.
            overwrite: whether the results of an earlier run in the folder are replaced.

        Raises:
            InputError: if the run cannot be read, or no frame of the recording can be placed on its model.
        """
        began_s = time.perf_counter()
        before, made = reopened(run), RunFolder(out)
        offset = max(record["id"] for record in before.report["frames"]) + 1
        settings = {name: value for name, value in vars(self.where).items() if value is not None}
        settings |= {name: value for name, value in vars(self.given).items() if value not in (None, ())}
        settings |= stated_tolerance(before)
        report = {"settings": settings, "frames": (), "camera": _camera(before, frames)}
        part = Part(out, report, frames, offset)
        times_s = [{"timestamp": frames.frame(k).time_s} for k in (frames.indices[0], frames.indices[-1])]
        part = replace(part, later_s=later_s(before, replace(before, report={"frames": times_s})))
        views = {k: part.view(k) for k in frames.indices}
        found = self._placed(known_object(run).model, part, [view for view in views.values() if view is not None])
        # How well a frame is placed, its edges say; only which pose of several it has, they do not.
        certain = [one for one in found if one.outcome in ("found", "followed") and not one.modes]
        placed = {one.frame: se3.inverse(one.pose.mean) for one in certain if one.pose is not None}
        new = {view.index: view for view in views.values() if view is not None and view.index in placed}
        edges = (*before.edges, *self._edges(before, new, placed))
        poses = before.solution.trajectory
        ends = (frame for edge in edges for frame in (edge.source, edge.target))
        kept = groups_of((*poses, *ends), edges)[min(poses)]
        if not kept & placed.keys():
            raise InputError(
                f"{path}: no frame can be placed on the model of {run}; check that both show the same object"
            )
        reasons = {edge.source: explain(edge.reason) for edge in edges} | {
            one.frame: one.reason for one in found if one.reason
        }
        edges = tuple(edge for edge in edges if {edge.source, edge.target} <= kept)
        records = [
            _record(part, k, view, "" if k + offset in kept else reasons.get(k + offset, "no object was found in it"))
            for k, view in views.items()
        ]
        views_kept = {k: view for k, view in new.items() if k in kept}
        second = replace(before, name=frames.name, report={"frames": records}, views=views_kept, parts=(part,))
        meta = RunMeta(
            sequence=" + ".join([*sequences_of(run, before, out), made.stored(path)]),
            seed=self.seed,
            prior="none",
            settings={"continues": made.stored(run), "offset": offset, "later_s": part.later_s,
                      "same_camera": report["camera"] is not None, **settings},
            camera=before.report.get("camera"),
        )  # fmt: skip
        graph = PoseGraph(edges=edges, first=min(poses))
        guess = {k: pose for k, pose in {**poses, **placed}.items() if k in kept}
        solution = solved(edges, guess, {**before.views, **views_kept}, meta.camera)
        shown = [edge for edge in edges if edge.source in views_kept and edge.target in before.views]
        work = Work((before, second), graph, solution, shown, began_s)
        _, verdict = write_run(out, work, meta, overwrite=overwrite)
        return Grown(verdict, len(views_kept), len(frames.indices))

    def _placed(self, model: ObjectModel, part: Part, views: Sequence[RayImage]) -> list[Tracked]:
        """Return the model in views of the recording, followed from each to the next."""
        modeler, scene = part.looking
        camera = part.report["camera"] or {}
        tracker = Tracker(
            model,
            part.sensor,
            depth_scale_sigma=float(camera.get("depth_scale_sigma", 0.0)),
            segmenter=modeler.segmenter,
            scene=scene,
            seed=self.seed,
        )
        return [replace(tracker.update(view.frame), view=None) for view in views]

    def _edges(self, before: Reopened, new: Mapping[int, RayImage], poses: Mapping[int, Array]) -> list[Edge]:
        """Return edges of new views with the model's views from nearly the same side, and with the new one before."""
        method, edges = VisibilityRegistrar(), list[Edge]()
        # So wide that each registration that is not ambiguous determines more than the pose about which it was made.
        joiner = Joiner(Registrations(method, self.seed), sigma_rad=2.0 * float(np.radians(method.max_sigma_deg)))
        old, added = (
            Segment(before.views, before.solution, before.edges),
            Segment(new, Solution(poses, odometry={}), ()),
        )
        for number, frame in enumerate(added.frames):
            near = _nearest(before, poses[frame], new[frame])
            found = joiner.between(old, added, [(k, frame) for k in near], np.eye(4))
            if number:
                found += joiner.between(added, added, [(added.frames[number - 1], frame)], np.eye(4))
            edges += [replace(edge, kind="closure", reason=_WHY if edge.accepted else edge.reason) for edge in found]
        return edges


def _nearest(before: Reopened, object_from_camera: Array, view: RayImage) -> list[int]:
    """Return the numbers of views of a run from nearly the same side as a new one, the nearest first."""
    centre_m = se3.transform(object_from_camera, view.centroid_m[None])[0]
    poses = before.solution.trajectory
    frames = sorted(frame for frame in before.views if frame in poses)
    rays = np.stack([object_from_camera[:3, 3], *(poses[frame][:3, 3] for frame in frames)]) - centre_m
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # Two that agree, and one that may fail.
    return [frames[k] for k in np.argsort(-(rays[1:] @ rays[0]), kind="stable")[:3]]


def _camera(before: Reopened, frames: AbstractSequence) -> Mapping[str, Any] | None:
    """Return what a run found out about its camera, if a recording is of the same; None otherwise."""
    camera = before.report.get("camera")
    if not camera or not camera.get("fx_px"):
        return None
    stated_px = camera["fx_px"] / camera["focal_factor"]
    return camera if has_focal(frames.frame(frames.indices[0]), stated_px) else None


def _record(part: Part, frame: int, view: RayImage | None, reason: str) -> dict[str, Any]:
    """Return the record of a frame of the recording as in report.json; a reason leaves it out."""
    time_s = part.sequence.frame(frame).time_s + part.later_s
    points = 0 if view is None else len(view.points_m)
    cause = Outcome.TOO_FEW_POINTS if view is None else Outcome.NO_OVERLAP
    left_out = {"outcome": reason, "cause": cause.label} if reason else {"outcome": ACCEPTED}
    return {"id": frame + part.offset, "timestamp": time_s, "points": points, **left_out}
