"""Two runs of one object to one model."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from modeler.export import RunFolder, RunMeta, locked
from modeler.fusion import Fuser, conditional_covariances, widened
from modeler.graph import PoseGraph, solve
from modeler.pipeline.joining import Alignment, Joiner, Segment
from modeler.pipeline.pairs import Registrations
from modeler.registration import VisibilityRegistrar
from modeler.runs.reopening import Part, Reopened, renumbered, reopened
from modeler.types import Edge, FrameRecord, InputError, Outcome, RayImage, Segmentation, Solution, Step, Verdict
from modeler.verdict import judged
from modeler.viz.stream import open_stream


@dataclass(frozen=True, eq=False)
class Joined:
    """Result of joining two runs."""

    alignments: Sequence[Alignment]
    """Of their models, the likeliest first; that one was used."""
    report: Mapping[str, Any]
    """As in report.json."""
    verdict: Verdict
    """Whether the model can be trusted."""


def join(run_a: Path, run_b: Path, out: Path, *, pairs: int, seed: int, overwrite: bool) -> Joined:
    """Join two runs of the same object in different postures into one run folder.

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
    made = RunFolder(out)
    sequences = [
        made.stored(RunFolder(run).located(part))
        for run, opened in ((run_a, first), (run_b, second))
        for part in opened.report["sequence"].split(" + ")
    ]
    meta = RunMeta(
        sequence=" + ".join(sequences),
        seed=seed,
        prior="none",
        settings={
            "joined": [made.stored(run) for run in (run_a, run_b)],
            "offset": offset,
            "later_s": delay_s,
            "pairs": pairs,
        },
        camera=_least_known([*first.parts, *second.parts]),
    )
    with locked(out):
        folder = RunFolder.open(out, overwrite=overwrite)
        sigma = 0.0 if meta.camera is None else float(meta.camera["depth_scale_sigma"])
        judge = partial(judged, depth_scale_sigma=sigma)
        shown = [edge for edge in graph.edges if edge.source in second.views and edge.target in first.views]
        report, verdict = write_run(
            folder, (first, second), graph, solve(graph, guess), meta, shown=shown, judge=judge, began_s=began_s
        )
        folder.finish()
    return Joined(alignments, report, verdict)


def _least_known(parts: Sequence[Part]) -> dict[str, float | str] | None:
    """Return the estimate of the camera with the most uncertain depth scale; None if all are as given."""
    cameras = [camera for part in parts if (camera := part.report.get("camera")) is not None]
    return max(cameras, key=lambda camera: float(camera["depth_scale_sigma"]), default=None)


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


def write_run(
    folder: RunFolder,
    parts: Sequence[Reopened],
    graph: PoseGraph,
    solution: Solution,
    meta: RunMeta,
    *,
    shown: Sequence[Edge],
    judge: Callable[[Step], Verdict],
    began_s: float,
) -> tuple[Mapping[str, Any], Verdict]:
    """Fuse the frames of finished runs anew, write a run folder with its recording, and return report and verdict.

    Args:
        folder: to write to.
        parts: the runs, whose frames have different numbers.
        graph: of all their frames.
        solution: its poses.
        meta: contents of the report besides the results.
        shown: edges whose best is drawn as the newest pair.
        judge: returns the verdict on the last step.
        began_s: when the work began, by `time.perf_counter`.
    """
    views = {frame: view for part in parts for frame, view in part.views.items()}
    model = Fuser(voxel_m=meta.settings.get("voxel_m")).fuse(
        views, solution.trajectory, conditional_covariances(solution, graph.edges)
    )
    model = widened(model, solution)
    names = [field.name for field in fields(FrameRecord)]
    records = [
        FrameRecord(**{name: record[name] for name in names if name in record})
        for part in parts
        for record in part.report["frames"]
    ]
    best = max((edge.posterior for edge in shown if edge.accepted), key=lambda posterior: posterior.overlap)
    first, root = min(views), {min(views): np.eye(4)}
    begun = _step(views[first], solution=Solution(root, odometry=root), views={first: views[first]})
    step = replace(
        _step(views[best.source], solution=solution, views=views),
        posteriors=(best,),
        edges=tuple(shown),
        make_model=lambda: model,
        edges_so_far=graph.edges,
        frames_so_far=tuple(sorted(records, key=lambda record: record.id)),
        last=True,
    )
    verdict = judge(step)
    step = replace(step, verdict=verdict)
    facts = {"sequence": meta.sequence, "seed": meta.seed, **meta.settings}
    stream = open_stream(" + ".join(part.name for part in parts), save=folder.path / "recording.rrd", facts=facts)
    try:
        report = folder.write(step, replace(meta, seconds={"total": time.perf_counter() - began_s}))
        stream(begun)
        stream(step)
    finally:
        stream.close()
    return report, verdict


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
