"""`modeler join`: two runs of one object to one model."""

from __future__ import annotations

import math
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
    from modeler.fusion import Match
    from modeler.graph import PoseGraph
    from modeler.types import Array, Edge, Posterior, RayImage, Solution, Step

_SIGMA_RAD, _SIGMA_M = 0.12, 0.01  # error of the models' alignment
_LEAST = 0.15  # score of models that fit each other at all
_RIVAL = 0.97  # of the best match's score: one that is as good and lies elsewhere leaves the choice open
_FARTHEST_RAD = 0.5  # a posterior farther from the match than this is another place


@dataclass(frozen=True)
class Join:
    """Join two runs of the same object in different postures, so that the model has what each of them hides.

    The models are aligned from every side, pairs of their views registered as in a build, and the frames of
    both fused into one model in the object frame of RUN_A.
    """

    run_a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_A")]
    """Run folder of one posture (upright, say)."""
    run_b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_B")]
    """Run folder of the other (lying, say)."""
    out: Annotated[Path, tyro.conf.arg(metavar="RUN")]
    """Run folder to make. Frames of RUN_B are numbered on from those of RUN_A."""
    overwrite: bool = False
    """Replace the results of an earlier run in the folder."""
    pairs: Annotated[int, tyro.conf.arg(metavar="N")] = 6
    """Pairs of views, one of each run, that are registered."""
    seed: Annotated[int, SEED] = 0
    """Same seed, same machine, same result, to the bit."""

    def run(self) -> int:
        """Join the runs; status 3 where the result is not to be trusted, as report.json then says.

        Raises:
            InputError: where a run cannot be read, or no pair of their views can be registered.
        """
        from modeler.cli.inputs import reopened
        from modeler.export import RunFolder, RunMeta, alone
        from modeler.graph import PoseGraph, solve
        from modeler.types import InputError

        _check(self)
        began_s = time.perf_counter()
        first, second = reopened(self.run_a), reopened(self.run_b)
        offset = max(record["id"] for record in first.report["frames"]) + 1
        second = _shifted(second, offset)
        matches = _matches(first, second)
        if matches[0].score < _LEAST:
            raise InputError(
                f"{self.run_a} and {self.run_b}: no alignment of the models fits; are they of "
                "the same object, and do they share enough surface?"
            )
        say(f"models aligned: {100.0 * matches[0].score:.0f} % of the surface agrees")
        edges = _edges(first, second, matches[0], self)
        count = sum(edge.accepted for edge in edges)
        if not count:
            raise InputError(
                f"{self.run_a} and {self.run_b}: none of {len(edges)} pairs of views could be registered; are they "
                "of the same object, and do they share enough surface? Try more --pairs"
            )
        graph = PoseGraph(edges=(*first.edges, *second.edges, *edges), first=min(first.solution.trajectory))
        guess = dict(first.solution.trajectory) | {
            frame: matches[0].target_from_source @ pose for frame, pose in second.solution.trajectory.items()
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
            doubts=_doubts(matches),
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
        InputError: where they are such, or another program is writing to the folder.
    """
    from modeler.cli.outputs import check_run_folder, run_inputs
    from modeler.export import alone
    from modeler.types import InputError

    if options.pairs < 1:
        raise InputError(f"--pairs {options.pairs} leaves nothing to join by; give at least 1")
    if options.run_a.resolve() == options.run_b.resolve():
        raise InputError(f"RUN_A and RUN_B are both {options.run_a}; name two runs")
    check_run_folder(options.out, run_inputs([options.run_a, options.run_b]), overwrite=options.overwrite)
    if options.out.is_dir():
        with alone(options.out):  # asked now, not only when the work is done
            pass


def _matches(first: Reopened, second: Reopened) -> list[Match]:
    """Return alignments of the second model with the first, best first.

    Raises:
        InputError: where there is none.
    """
    from modeler.fusion import Fuser, Matcher
    from modeler.types import InputError

    volumes = first.volume(Fuser()), second.volume(Fuser())
    models = volumes[0].model(), volumes[1].model()
    found = Matcher().matches(*volumes, models) if all(len(model.points_m) for model in models) else []
    if not found:
        raise InputError("the models cannot be aligned; build both runs from more views")
    return found


def _doubts(matches: list[Match]) -> list[str]:
    """Return in words why the way the models lie on each other is open; empty where it is not."""
    from modeler import se3

    rivals = [match for match in matches[1:] if match.score > _RIVAL * matches[0].score]
    if not rivals:
        return []
    angle = float(se3.rotation_angle(se3.inverse(matches[0].target_from_source) @ rivals[0].target_from_source))
    return [
        f"another alignment of the models fits as well, turned by {math.degrees(angle):.0f}°: the object "
        "looks the same from several sides"
    ]


def _least_known(parts: Sequence[Part]) -> dict[str, float | str] | None:
    """Return what was estimated of the camera whose depth scale is known least; None where all are as stated."""
    from modeler.cli.inputs import estimated_camera

    files = (part.report["settings"].get("camera") for part in parts)
    cameras = [camera for file in files if file is not None and (camera := estimated_camera(Path(file))) is not None]
    return max(cameras, key=lambda camera: float(camera["depth_scale_sigma"]), default=None)


def _edges(first: Reopened, second: Reopened, match: Match, options: Join) -> tuple[Edge, ...]:
    """Register views of the second run against views of the first that look from nearly the same side."""
    import numpy as np

    from modeler import se3
    from modeler.pipeline import register
    from modeler.priors.mixtures import KernelMixture
    from modeler.registration import VisibilityRegistrar

    edges = []
    for target, source in _facing(first, second, match.target_from_source, options.pairs):
        views = second.views[source], first.views[target]
        poses = second.solution.trajectory[source], first.solution.trajectory[target]
        guess = se3.inverse(poses[1]) @ match.target_from_source @ poses[0]
        density = KernelMixture(
            guess[None],
            np.ones(1),
            centre_m=views[0].centroid_m,
            sigma_rad=_SIGMA_RAD,
            sigma_m=_SIGMA_M,
            evidence=False,
        )
        edges.append(_judged(register(VisibilityRegistrar(), *views, density, seed=options.seed), guess))
    return tuple(edges)


def _judged(posterior: Posterior, guess: Array) -> Edge:
    """Return the posterior as an edge that takes part where it is usable and in the place that was looked at."""
    import numpy as np

    from modeler import se3
    from modeler.types import Edge, Failed, Stated

    off = se3.inverse(guess) @ posterior.pose.mean
    away = float(se3.rotation_angle(off)) > _FARTHEST_RAD
    lasting = replace(posterior, samples=np.zeros((0, 4, 4)), weights=np.zeros(0))
    if not posterior.usable:
        return Edge(lasting, "closure", False, Failed(posterior.outcome))
    if away:
        return Edge(lasting, "closure", False, Stated("contradicts the alignment of the models"))
    return Edge(lasting, "closure", True, Stated("joins the runs"))


def _facing(first: Reopened, second: Reopened, target_from_source: Array, count: int) -> list[tuple[int, int]]:
    """Return pairs of views, target and source, that look at the object from the nearest sides, no view twice."""
    import numpy as np

    centre = np.mean([first.solution.trajectory[k] @ np.append(v.centroid_m, 1.0) for k, v in first.views.items()], 0)
    sides = []
    for run, motion in ((first, np.eye(4)), (second, target_from_source)):
        frames = [frame for frame in run.solution.trajectory if frame in run.views]
        rays = np.stack([(motion @ run.solution.trajectory[frame])[:3, 3] - centre[:3] for frame in frames])
        sides.append((frames, rays / np.linalg.norm(rays, axis=1, keepdims=True)))
    cosines = sides[0][1] @ sides[1][1].T
    pairs = []
    for flat in np.argsort(-cosines, axis=None, kind="stable"):
        row, column = np.unravel_index(flat, cosines.shape)
        target, source = sides[0][0][int(row)], sides[1][0][int(column)]
        if len(pairs) < count and all(target != pair[0] and source != pair[1] for pair in pairs):
            pairs.append((target, source))
    return pairs


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
    from modeler.types import Solution
    from modeler.verdict import FrameRecord
    from viz.stream import open_stream

    views = dict(parts[0].views) | dict(parts[1].views)
    model = Fuser().fuse(views, solution.trajectory, conditional_covariances(solution, graph.edges))
    names = [field.name for field in fields(FrameRecord)]
    for record in (record for part in parts for record in part.report["frames"]):
        folder.frames[record["id"]] = FrameRecord(**{name: record[name] for name in names if name in record})
    joining = tuple(edge for edge in graph.edges if edge.source in parts[1].views and edge.target in parts[0].views)
    best = max((edge.posterior for edge in joining if edge.accepted), key=lambda posterior: posterior.overlap)
    first, root = min(views), {min(views): np.eye(4)}
    begun = _step(views[first], solution=Solution(root, odometry=root), views={first: views[first]})
    step = replace(
        _step(views[best.source], solution=solution, views=views),
        posteriors=(best,),
        edges=joining,
        model=model,
        edges_so_far=graph.edges,
        last=True,
    )
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
        model=None,
        views=views,
    )
