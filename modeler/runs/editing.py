"""A finished run without some of its frames: optimised and fused again, without registering again."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from modeler import se3
from modeler.composition.compose import comes_back
from modeler.export import RunFolder, RunMeta
from modeler.graph import PoseGraph, solve
from modeler.runs.joining import Work, groups_of, sequences_of, write_run
from modeler.runs.reopening import Reopened, reopened
from modeler.types import InputError, Verdict


@dataclass(frozen=True, eq=False)
class Edited:
    """Result of an edit."""

    report: Mapping[str, Any]
    """As in report.json."""
    verdict: Verdict
    """Whether the model can be trusted."""
    unconnected: tuple[int, ...]
    """Frames that only those dropped joined to the others: they are left out, too."""


def edit(run: Path, dropped: Collection[int], out: Path, *, overwrite: bool) -> Edited:
    """Optimise and fuse a run anew without some of its frames.

    The camera keeps the focal length that the run found. Frames that are dropped are not in the new report, whose
    settings name them.

    Args:
        run: run folder.
        dropped: numbers of frames of its model.
        out: run folder to create; the run's own, to replace it.
        overwrite: whether another run there may be replaced.

    Raises:
        InputError: if the run cannot be read, has no such frame, or too few are left.
    """
    began_s = time.perf_counter()
    before = reopened(run)
    poses = before.solution.trajectory
    if unknown := sorted(set(dropped) - poses.keys()):
        raise InputError(
            f"{run}: frame {unknown[0]} is not in the model; its frames are {', '.join(map(str, sorted(poses)))}"
        )
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
    solution = solve(graph, {frame: first_from_object @ rest[frame] for frame in sorted(joined)})
    part = _without(before, {*dropped, *unconnected})
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
    found, verdict = write_run(out, work, meta, overwrite=overwrite and not same, resume=same, **_expected(before))
    return Edited(found, verdict, unconnected)


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
