"""`modeler join`: two runs of one object to one model."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from modeler.cli.console import say
from modeler.cli.options import SEED

if TYPE_CHECKING:
    from modeler.cli.inputs import Part, Reopened
    from modeler.export import RunFolder, RunMeta
    from modeler.graph import PoseGraph
    from modeler.types import RayImage, Solution, Step


@dataclass(frozen=True)
class Join:
    """Join two runs of the same object in different postures, so that the model has no hidden side.

    They are joined like the segments of a build before and after the object was laid down differently: the models are
    aligned from many initial rotations, pairs of their views registered, and the frames of both fused into one model in
    the object frame of RUN_A.
    """

    run_a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_A")]
    """Run folder of one posture (upright, say)."""
    run_b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_B")]
    """Run folder of the other (lying, say)."""
    out: Annotated[Path, tyro.conf.arg(metavar="RUN")]
    """Run folder to create. Frame numbers of RUN_B continue those of RUN_A."""
    overwrite: bool = False
    """Replace the results of an earlier run in the folder."""
    pairs: Annotated[int, tyro.conf.arg(metavar="N")] = 6
    """Number of pairs of views, one of each run, to register."""
    seed: Annotated[int, SEED] = 0
    """Same seed, same machine, same result, to the bit."""

    def run(self) -> int:
        """Join the runs; status 3 if the result cannot be trusted; report.json has the reasons.

        Raises:
            InputError: if a run cannot be read, or no pair of their views can be registered.
        """
        from modeler.cli.inputs import reopened
        from modeler.export import RunFolder, RunMeta, alone
        from modeler.graph import PoseGraph, solve
        from modeler.pipeline.joining import Joiner, Segment
        from modeler.pipeline.pairs import Registrations
        from modeler.registration import VisibilityRegistrar
        from modeler.types import InputError

        _check(self)
        began_s = time.perf_counter()
        first, second = reopened(self.run_a), reopened(self.run_b)
        offset = max(record["id"] for record in first.report["frames"]) + 1
        second = _shifted(second, offset)
        joiner = Joiner(Registrations(VisibilityRegistrar(), self.seed), pairs=self.pairs)
        parts = [Segment(run.views, run.solution, run.edges) for run in (first, second)]
        alignments = joiner.join(*parts)
        if not alignments:
            raise InputError("the models cannot be aligned; build both runs from more views")
        edges, ways = alignments[0].edges, len(alignments)
        count = alignments[0].accepted
        if not count:
            raise InputError(
                f"{self.run_a} and {self.run_b}: no alignment of the models fits their views; check "
                "that they show the same object and share enough surface"
            )
        say(f"models aligned: {100.0 * alignments[0].share:.3g} % likely" + (f", of {ways} ways" if ways > 1 else ""))
        graph = PoseGraph(edges=(*first.edges, *second.edges, *edges), first=min(first.solution.trajectory))
        guess = dict(first.solution.trajectory) | {
            frame: alignments[0].target_from_source @ pose for frame, pose in second.solution.trajectory.items()
        }
        meta = RunMeta(
            sequence=f"{first.report['sequence']} + {second.report['sequence']}",
            seed=self.seed,
            prior="none",
            settings={
                "joined": [str(self.run_a.absolute()), str(self.run_b.absolute())],
                "offset": offset,
                "pairs": self.pairs,
            },
            camera=_least_known([*first.parts, *second.parts]),
        )
        with alone(self.out):
            folder = RunFolder.open(self.out, overwrite=self.overwrite)
            report = _written(folder, (first, second), graph, solve(graph, guess), meta, began_s=began_s)
            folder.finish()
        say(f"{count} of {len(edges)} pairs registered, {len(report['poses'])} frames joined: {self.out}")
        if report["reasons"]:
            say(f"not to be trusted: {report['reasons'][0]}")
        return 0 if report["trustworthy"] else 3


def _check(options: Join) -> None:
    """Refuse options out of range, and a folder that holds something.

    Raises:
        InputError: if they are such, or another program is writing to the folder.
    """
    from modeler.cli.outputs import check_run_folder, run_inputs
    from modeler.export import alone
    from modeler.types import InputError

    if options.pairs < 1:
        raise InputError(f"--pairs {options.pairs} is out of range; give at least 1")
    if options.run_a.resolve() == options.run_b.resolve():
        raise InputError(f"RUN_A and RUN_B are both {options.run_a}; name two runs")
    check_run_folder(options.out, run_inputs([options.run_a, options.run_b]), overwrite=options.overwrite)
    if options.out.is_dir():
        with alone(options.out):  # asked now, not only when the work is done
            pass


def _least_known(parts: Sequence[Part]) -> dict[str, float | str] | None:
    """Return the estimate of the camera with the most uncertain depth scale; None if all are as given."""
    cameras = [camera for part in parts if (camera := part.report.get("camera")) is not None]
    return max(cameras, key=lambda camera: float(camera["depth_scale_sigma"]), default=None)


def _shifted(run: Reopened, offset: int) -> Reopened:
    """Return a run with frame numbers from `offset` on."""
    from modeler.cli.inputs import renumbered

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
    before = run.solution.relative_covariance
    solution = replace(
        run.solution,
        trajectory=trajectory,
        covariances=covariances,
        odometry=odometry,
        relative_covariance=lambda target, source: before(target - offset, source - offset),
    )
    views = {frame + offset: renumbered(view, offset) for frame, view in run.views.items()}
    report = dict(run.report) | {"frames": [r | {"id": r["id"] + offset} for r in run.report["frames"]]}
    return replace(run, report=report, views=views, edges=edges, solution=solution)


def _written(
    folder: RunFolder,
    parts: tuple[Reopened, Reopened],
    graph: PoseGraph,
    solution: Solution,
    meta: RunMeta,
    *,
    began_s: float,
) -> Mapping[str, Any]:
    """Fuse the frames of both parts, write the run folder with its recording and return its report."""
    import numpy as np

    from modeler.fusion import Fuser, conditional_covariances
    from modeler.types import FrameRecord, Solution
    from modeler.verdict import judged
    from modeler.viz.stream import open_stream

    views = dict(parts[0].views) | dict(parts[1].views)
    model = Fuser().fuse(views, solution.trajectory, conditional_covariances(solution, graph.edges))
    names = [field.name for field in fields(FrameRecord)]
    records = [
        FrameRecord(**{name: record[name] for name in names if name in record})
        for part in parts
        for record in part.report["frames"]
    ]
    depth_scale_sigma = 0.0 if meta.camera is None else float(meta.camera["depth_scale_sigma"])
    joining = tuple(edge for edge in graph.edges if edge.source in parts[1].views and edge.target in parts[0].views)
    best = max((edge.posterior for edge in joining if edge.accepted), key=lambda posterior: posterior.overlap)
    first, root = min(views), {min(views): np.eye(4)}
    begun = _step(views[first], solution=Solution(root, odometry=root), views={first: views[first]})
    step = replace(
        _step(views[best.source], solution=solution, views=views),
        posteriors=(best,),
        edges=joining,
        make_model=lambda: model,
        edges_so_far=graph.edges,
        frames_so_far=tuple(sorted(records, key=lambda record: record.id)),
        last=True,
    )
    step = replace(step, verdict=judged(step, depth_scale_sigma=depth_scale_sigma))
    facts = {"sequence": meta.sequence, "seed": meta.seed, **meta.settings}
    stream = open_stream(" + ".join(part.name for part in parts), save=folder.path / "recording.rrd", facts=facts)
    try:
        report = folder.write(step, replace(meta, seconds={"total": time.perf_counter() - began_s}))
        stream(begun)
        stream(step)
    finally:
        stream.close()
    return report


def _step(view: RayImage, *, solution: Solution, views: Mapping[int, RayImage]) -> Step:
    """Return a step of one view that is part of the model."""
    import numpy as np

    from modeler.types import Outcome, Segmentation, Step

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
