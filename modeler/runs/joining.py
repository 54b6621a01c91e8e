"""Runs made of finished ones: without some frames, or of two in which the object lies differently."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from modeler import se3
from modeler.composition.compose import comes_back
from modeler.export import RunFolder, RunMeta, locked
from modeler.fusion import Fuser, conditional_covariances
from modeler.graph import PoseGraph
from modeler.pipeline.joining import Alignment, Joiner, Segment
from modeler.pipeline.pairs import Registrations
from modeler.registration import VisibilityRegistrar
from modeler.runs.reopening import Reopened, renumbered, reopened, solved
from modeler.types import Edge, FrameRecord, InputError, Outcome, RayImage, Segmentation, Solution, Step, Verdict
from modeler.verdict import judged
from modeler.verdict.spreads import widened
from modeler.viz.stream import open_stream


def join(
    run_a: Path, run_b: Path, out: Path, *, pairs: int, seed: int, overwrite: bool
) -> tuple[Sequence[Alignment], Mapping[str, Any], Verdict]:
    """Join two runs of the same object in different postures into one run folder.

    Returns alignments of their models, the likeliest, which was used, first; report and verdict.

    Args:
        run_a: run folder whose object frame is kept.
        run_b: run folder, whose frame numbers continue those of the other.
        out: run folder to create.
        pairs: number of pairs of views, one of each run, to register.
        seed: of every random number.
        overwrite: whether the results of an earlier run in the folder are replaced.

    Raises:
        InputError: if a run cannot be read, or no pair of their views can be registered.
    """
    began_s = time.perf_counter()
    first, second = reopened(run_a), reopened(run_b)
    offset = max(record["id"] for record in first.report["frames"]) + 1
    delay_s = later_s(first, second)
    second = _shifted(second, offset, delay_s)
    joiner = Joiner(Registrations(VisibilityRegistrar(), seed), pairs=pairs)
    parts = [Segment(run.views, run.solution, run.edges) for run in (first, second)]
    alignments = joiner.join(*parts)
    if not alignments:
        raise InputError("the models cannot be aligned; build both runs from more views")
    if not alignments[0].accepted:
        raise InputError(
            f"{run_a} and {run_b}: no alignment of the models fits their views; check "
            "that they show the same object and share enough surface"
        )
    edges = (*first.edges, *second.edges, *alignments[0].edges)
    graph = PoseGraph(edges=edges, first=min(first.solution.trajectory))
    guess = dict(first.solution.trajectory) | {
        frame: alignments[0].target_from_source @ pose for frame, pose in second.solution.trajectory.items()
    }
    parts = (*first.parts, *second.parts)
    cameras = [camera for part in parts if (camera := part.report.get("camera")) is not None]
    made = RunFolder(out)
    meta = RunMeta(
        sequence=" + ".join([*sequences_of(run_a, first, out), *sequences_of(run_b, second, out)]),
        seed=seed,
        prior="none",
        settings={
            "joined": [made.stored(run) for run in (run_a, run_b)],
            "offset": offset,
            "later_s": delay_s,
            "pairs": pairs,
            **stated_tolerance(first, second),
        },
        # The one whose depth scale is the most uncertain; none if all are as given.
        camera=max(cameras, key=lambda camera: float(camera["depth_scale_sigma"]), default=None),
    )
    shown = [edge for edge in graph.edges if edge.source in second.views and edge.target in first.views]
    views = {**first.views, **second.views}
    work = Work((first, second), graph, solved(edges, guess, views, meta.camera), shown, began_s)
    return alignments, *write_run(out, work, meta, overwrite=overwrite)


def sequences_of(run: Path, opened: Reopened, out: Path) -> list[str]:
    """Return the sequences of a run as the report of another one has them."""
    parts = opened.report["sequence"].split(" + ")
    return [RunFolder(out).stored(RunFolder(run).located(part)) for part in parts]


def stated_tolerance(*runs: Reopened) -> dict[str, float]:
    """Return the settings for the least tolerance stated for one of some runs; none if there is none."""
    stated = [run.report["settings"].get("tolerance_mm") for run in runs]
    known = [tolerance_mm for tolerance_mm in stated if tolerance_mm is not None]
    return {"tolerance_mm": min(known)} if known else {}


def later_s(first: Reopened, second: Reopened) -> float:
    """Return by how much a run must be later than it was for its times to follow another's: 0 where none is shared."""
    times_s = [sorted(frame["timestamp"] for frame in run.report["frames"]) for run in (first, second)]
    (begin_s, *_, end_s), (start_s, *_, stop_s) = ([times[0], times[-1]] for times in times_s)
    if stop_s < begin_s or end_s < start_s:
        return 0.0
    step_s = float(np.median(np.diff(times_s[0]))) if len(times_s[0]) > 1 else 1.0
    return end_s + step_s - start_s


def _shifted(run: Reopened, offset: int, later_s: float) -> Reopened:
    """Return a run with frame numbers from `offset` on, and later."""
    edges = tuple(
        replace(
            edge,
            posterior=replace(edge.posterior, source=edge.source + offset, target=edge.target + offset),
        )
        for edge in run.edges
    )
    trajectory, covariances, odometry = (
        {frame + offset: value for frame, value in mapping.items()}
        for mapping in (run.solution.trajectory, run.solution.covariances, run.solution.odometry)
    )
    before, deforming = run.solution.relative_covariance, run.solution.deforming_covariance
    solution = replace(
        run.solution,
        trajectory=trajectory,
        covariances=covariances,
        odometry=odometry,
        relative_covariance=lambda target, source: before(target - offset, source - offset),
        deforming_covariance=lambda target, source: deforming(target - offset, source - offset),
    )
    views = {frame + offset: renumbered(view, offset, later_s) for frame, view in run.views.items()}
    frames = [r | {"id": r["id"] + offset, "timestamp": r["timestamp"] + later_s} for r in run.report["frames"]]
    report = dict(run.report) | {"frames": frames}
    return replace(run, report=report, views=views, edges=edges, solution=solution)


@dataclass(frozen=True, eq=False)
class Work:
    """A graph of finished runs that was solved anew."""

    parts: Sequence[Reopened]
    """The runs, whose frames have different numbers."""
    graph: PoseGraph
    """Of all their frames."""
    solution: Solution
    shown: Sequence[Edge]
    """Edges whose best is drawn as the newest pair."""
    began_s: float
    """When the work began, by `time.perf_counter`."""


def groups_of(frames: Iterable[int], edges: Iterable[Edge]) -> dict[int, set[int]]:
    """Return by frame number the frames that accepted edges join with it, itself included."""
    groups = {frame: {frame} for frame in frames}
    for edge in edges:
        if edge.accepted and edge.source in groups and edge.target in groups:
            both = groups[edge.source] | groups[edge.target]
            groups |= dict.fromkeys(both, both)
    return groups


def write_run(
    out: Path, work: Work, meta: RunMeta, *, overwrite: bool = False, resume: bool = False, **expected: Any
) -> tuple[Mapping[str, Any], Verdict]:
    """Fuse frames anew, write a run folder with its recording, and return report and verdict.

    Args:
        out: where.
        work: what is fused.
        meta: contents of the report besides the results.
        overwrite: replace another run there.
        resume: replace the files of the run there one by one.
        expected: arguments of `judged` besides the step, the uncertainty of the depth scale and the tolerance.
    """
    with locked(out):
        folder = RunFolder.open(out, overwrite=overwrite, resume=resume)
        step = _last_step(work, meta.settings.get("voxel_m"))
        sigma = 0.0 if meta.camera is None else float(meta.camera["depth_scale_sigma"])
        tolerance_mm = meta.settings.get("tolerance_mm")
        tolerance_m = None if tolerance_mm is None else 1e-3 * tolerance_mm
        verdict = judged(step, depth_scale_sigma=sigma, tolerance_m=tolerance_m, **expected)
        step = replace(step, verdict=verdict)
        facts = {"sequence": meta.sequence, "seed": meta.seed, **meta.settings}
        name = " + ".join(part.name for part in work.parts)
        with closing(open_stream(name, save=out / "recording.rrd", facts=facts)) as stream:
            report = folder.write(step, replace(meta, seconds={"total": time.perf_counter() - work.began_s}))
            first = min(step.views)
            root = {first: np.eye(4)}
            view = step.views[first]
            stream(_step(view, solution=Solution(root, odometry=root), views={first: view}))
            stream(step)
        folder.finish()
    return report, verdict


def _last_step(work: Work, voxel_m: float | None) -> Step:
    """Return the last step of a run that would have given a graph."""
    solution, edges = work.solution, work.graph.edges
    views = {frame: view for part in work.parts for frame, view in part.views.items()}
    model = Fuser(voxel_m=voxel_m).fuse(views, solution.trajectory, conditional_covariances(solution, edges))
    model = widened(model, solution)
    names = [field.name for field in fields(FrameRecord)]
    records = [
        FrameRecord(**{name: record[name] for name in names if name in record})
        for part in work.parts
        for record in part.report["frames"]
    ]
    best = max((edge.posterior for edge in work.shown if edge.accepted), key=lambda posterior: posterior.overlap)
    return replace(
        _step(views[best.source], solution=solution, views=views),
        posteriors=(best,),
        edges=tuple(work.shown),
        make_model=lambda: model,
        edges_so_far=edges,
        frames_so_far=tuple(sorted(records, key=lambda record: record.id)),
        last=True,
        remasked={k + part.offset for one in work.parts for part in one.parts for k in part.masks} & views.keys(),
    )


def _step(view: RayImage, *, solution: Solution, views: Mapping[int, RayImage]) -> Step:
    """Return a step of one view that is part of the model."""
    mask = view.frame.mask if view.frame.mask is not None else np.isfinite(view.frame.depth_m)
    return Step(
        frame=view.frame,
        segmentation=Segmentation(mask, view.plane, Outcome.CONVERGED),
        view=view,
        posteriors=(),
        edges=(),
        left_out=None,
        solution=solution,
        views=views,
    )


def edit(
    run: Path, dropped: Collection[int], out: Path, *, overwrite: bool
) -> tuple[Mapping[str, Any], Verdict, tuple[int, ...]]:
    """Optimise and fuse a run anew without some of its frames; return report, verdict, and which are left out, too.

    Those are the frames that only the dropped ones joined to the others.

    The camera keeps the focal length that the run found. Frames that are dropped are not in the new report, whose
    settings name them.

    Args:
        run: run folder.
        dropped: numbers of frames, of its model or left out.
        out: run folder to create; the run's own, to replace it.
        overwrite: whether another run there may be replaced.

    Raises:
        InputError: if the run cannot be read, has no such frame, or too few are left.
    """
    began_s = time.perf_counter()
    before = reopened(run)
    poses = before.solution.trajectory
    frames = sorted(record["id"] for record in before.report["frames"])
    if unknown := sorted({*dropped} - {*frames}):
        raise InputError(f"{run}: frame {unknown[0]} is not in the run; its frames are {', '.join(map(str, frames))}")
    rest = {frame: pose for frame, pose in poses.items() if frame not in dropped}
    if len(rest) < 2:
        raise InputError(f"{run}: of its {len(poses)} frames {len(rest)} would be left; keep at least 2")
    joined = max(groups_of(rest, before.edges).values(), key=lambda some: (len(some), -min(some)))
    if len(joined) < 2:
        raise InputError(f"{run}: no two frames are joined without those dropped; drop others")
    unconnected = tuple(sorted(rest.keys() - joined))
    edges = tuple(edge for edge in before.edges if {edge.source, edge.target} <= joined)
    first = min(joined)
    graph, first_from_object = PoseGraph(edges, first), se3.inverse(rest[first])  # the first camera's is the object's
    guess = {frame: first_from_object @ rest[frame] for frame in sorted(joined)}
    part, expected = _without(before, {*dropped, *unconnected}), _expected(before)
    solution = solved(edges, guess, part.views, before.report.get("camera"), expected.get("prior"))
    report, settings = before.report, dict(before.report["settings"])
    made = RunFolder(out)
    for name in {"sensor", "camera", "continues"} & settings.keys():
        settings[name] = made.stored(RunFolder(run).located(settings[name]))
    if "joined" in settings:
        settings["joined"] = [made.stored(RunFolder(run).located(part)) for part in settings["joined"]]
    settings["dropped"] = sorted({*settings.get("dropped", ()), *dropped, *unconnected})
    sequence = " + ".join(sequences_of(run, before, out))
    meta = RunMeta(sequence, report["seed"], report["prior"], settings, report.get("camera"))
    same, work = out.resolve() == run.resolve(), Work((part,), graph, solution, edges, began_s)
    done = write_run(out, work, meta, overwrite=overwrite and not same, resume=same, **expected)
    return *done, unconnected


def _without(run: Reopened, frames: Collection[int]) -> Reopened:
    """Return a run without some frames."""
    report = dict(run.report) | {"frames": [one for one in run.report["frames"] if one["id"] not in frames]}
    return replace(run, report=report, views={k: view for k, view in run.views.items() if k not in frames})


def _expected(run: Reopened) -> dict[str, Any]:
    """Return what the verdict on a run depends on besides its last step, its camera and the stated tolerance."""
    part, *others = run.parts
    if others:
        return {}
    parts = part.modeler()
    return {
        "prior": parts.prior,
        "closure_expected": comes_back(part.sequence, parts.prior, parts.closer.max_angle_deg),
        "colour": parts.colour,
    }
