"""What `modeler build` does once it is understood."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from modeler import se3
from modeler.cli import compose, nonvisual
from modeler.cli.build import Build
from modeler.cli.console import Console
from modeler.cli.interrupt import Interrupt
from modeler.cli.reading import while_it_lasts
from modeler.cli.remembered import Remembered
from modeler.cli.saying import say
from modeler.cli.watching import watched
from modeler.export import RunFolder, RunMeta, alone
from modeler.pipeline import Modeler
from modeler.priors import TurntablePrior
from modeler.segmentation import Scene
from modeler.types import ACCEPTED, AbstractPrior, InputError, Outcome
from sequences import AbstractSequence, SensedSequence, frame_range, open_sequence, read_noise, survey
from viz.ending import ends_whole
from viz.stream import open_stream
from viz.viewer import reachable

_SURE_STEPS: Final = 3  # pairs that tell a step
_FAR_SDS: Final = 3.0  # of the told step, from which on another one is meant


def build(options: Build) -> int:
    """Run the loop into a run folder and return the exit status: 3 where the result is not to be trusted.

    Raises:
        InputError: where the input or the folder cannot be used.
    """
    began_s = time.perf_counter()
    _check(options)
    whole, frames = _opened(options)
    modeler = compose.modeler(whole, options.prior, options.method, options.where)
    modeler = replace(modeler, fuser=replace(modeler.fuser, voxel_m=options.voxel_m))
    prior, remark = nonvisual.told(options.prior, whole)
    meta = RunMeta(
        sequence=str(options.sequence),
        seed=options.method.seed,
        prior=prior,
        settings=options.settings(),
        closure_expected=comes_back(frames, options.prior.step_deg, modeler.closer.max_angle_deg),
    )
    if options.resume and RunFolder(options.out).finished(meta):
        say("the run had come to its end; --overwrite makes it anew")
        return _told(RunFolder(options.out).report(), options, modeler.prior)
    scene = compose.scene(modeler, whole)
    with alone(options.out):
        before = RunFolder(options.out).changed_versions(meta) if options.resume else ()
        folder = RunFolder.open(options.out, overwrite=options.overwrite, resume=options.resume)
        glance = None if modeler.glance is None else Remembered(modeler.glance, folder.pairs, meta.versions)
        registrar = Remembered(modeler.registrar, folder.pairs, meta.versions)
        modeler = replace(modeler, registrar=registrar, glance=glance)
        if before:
            say(f"was begun with {', '.join(before)}: pairs are registered anew")
        if remark:
            say(remark)
        report = _run(options, modeler, (frames, scene), folder, meta, began_s=began_s)
        folder.finish()
    recording = folder.path / "recording.rrd"
    if not ends_whole(recording):
        say(f"{recording}: is cut off (is the disk full?); the rest is whole")
    return _told(report, options, modeler.prior)


def _check(options: Build) -> None:
    """Refuse options that contradict each other or nobody can mean.

    Raises:
        InputError: where they do.
    """
    if options.resume and options.overwrite:
        raise InputError("--resume keeps what --overwrite deletes; give one of them")
    if options.voxel_m is not None and not 0.0 < options.voxel_m < 1.0:
        raise InputError(f"--voxel-m {options.voxel_m:g} is out of range; give a length in m between 0 and 1")
    if options.connect is not None:
        reachable(options.connect)  # refuses what is no address; whether somebody listens is asked when there is news


def _opened(options: Build) -> tuple[AbstractSequence, AbstractSequence]:
    """Return the sequence and what was selected of it; what cannot be read is found before anything is made.

    Raises:
        InputError: where something cannot be read.
    """
    path = options.sequence
    whole = watched(path, options.idle_s) if options.watch else open_sequence(path)
    whole = whole if options.sensor is None else SensedSequence(whole, read_noise(options.sensor))
    frames = whole.select(every=options.selection.every, frames=frame_range(options.selection.frames))
    if not frames.live:
        for doubt in survey(frames, truth=False).doubts:
            say(doubt)
    return whole, frames


def _run(
    options: Build,
    modeler: Modeler,
    seen: tuple[AbstractSequence, Scene],
    folder: RunFolder,
    meta: RunMeta,
    *,
    began_s: float,
) -> Mapping[str, Any]:
    """Show and write every step, and return the last report.

    Raises:
        InputError: where a frame cannot be read or a file cannot be written.
        KeyboardInterrupt: where somebody asked for an end before the first frame.
    """
    frames, scene = seen
    stream = open_stream(
        frames.name,
        save=folder.path / "recording.rrd",
        spawn=options.view,
        web=options.web,
        connect=options.connect,
        facts={"sequence": meta.sequence, "seed": meta.seed, "prior": meta.prior, **meta.settings},
    )
    seconds = {"scene": time.perf_counter() - began_s, "registration": 0.0, "total": 0.0}
    report: Mapping[str, Any] = {}
    try:
        with Interrupt() as interrupt, Console(len(frames), stream.address) as console:
            wanted = frames.until(lambda: interrupt.asked)
            coming = interrupt.until(while_it_lasts(wanted) if frames.live and not options.watch else wanted)
            steps = modeler.run(
                coming,
                scene,
                hurry=lambda: interrupt.asked,
                ending=console.ending,
                seeking=console.seeking,
            )
            for step in steps:
                seconds["registration"] += sum(posterior.seconds for posterior in step.posteriors)
                seconds["total"] = time.perf_counter() - began_s
                meta = replace(meta, seconds=dict(seconds), interrupted=interrupt.ended_early)
                report = folder.write(step, meta)
                stream(step)
                console(step)
    finally:
        stream.close()
    if not report:
        raise KeyboardInterrupt
    return report


def comes_back(frames: AbstractSequence, given_deg: float | None, reach_deg: float) -> bool:
    """Return whether the object is said to turn as far as its first view, or nearly.

    Args:
        frames: the sequence, which may tell the turn from frame to frame.
        given_deg: that turn where a person tells it, who counts more.
        reach_deg: how near to a view another must look for them to be registered.
    """
    step_deg = (frames.motion or {}).get("step_deg") if given_deg is None else given_deg
    if not isinstance(step_deg, int | float):
        return False
    return abs(step_deg) * (frames.indices[-1] - frames.indices[0]) >= 360.0 - reach_deg


def sense_in_doubt(reasons: Sequence[str], prior: AbstractPrior) -> bool:
    """Return whether views overlap so little that a table may turn the other way round than its prior takes for known.

    Args:
        reasons: not to trust the model, as the report has them.
        prior: of the run.
    """
    little = any(words in reason for reason in reasons for words in ("no overlap", "little surface"))
    return little and isinstance(prior, TurntablePrior) and prior.step_sign == "known"


def other_step(edges: Sequence[Mapping[str, Any]], prior: AbstractPrior) -> str:
    """Return in words by what step the views turned where that is not the one that the prior was told, else "".

    Args:
        edges: of the report.
        prior: of the run.
    """
    odometry = [edge for edge in edges if edge["accepted"] and edge["kind"] == "odometry"]
    gaps = [abs(edge["source"] - edge["target"]) for edge in odometry]  # frames tried again lie before their targets
    gap = min(gaps, default=1)
    turns = [
        np.degrees(se3.rotation_angle(np.reshape(edge["target_from_source"], (4, 4)))) / gap
        for edge, apart in zip(odometry, gaps, strict=True)
        if apart == gap
    ]
    if not isinstance(prior, TurntablePrior) or len(turns) < _SURE_STEPS:
        return ""
    found_deg, told_deg = float(np.median(turns)), abs(prior.step_deg)
    if abs(found_deg - told_deg) <= _FAR_SDS * prior.step_sigma_deg:
        return ""
    return (
        f"the views turned by {found_deg:.1f}° from one frame number to the next, not by the {told_deg:g}° ± "
        f"{prior.step_sigma_deg:g}° that was told; is --step-deg {np.copysign(found_deg, prior.step_deg):.1f} meant?"
    )


def ends_without(frames: Sequence[Mapping[str, Any]]) -> str:
    """Return in words which frames show the object, where the first or the last ones do not, else "".

    Args:
        frames: of the report.
    """
    ids = sorted(frame["id"] for frame in frames)
    seen = sorted(frame["id"] for frame in frames if not frame["outcome"].startswith(Outcome.TOO_FEW_POINTS.label))
    if len(seen) < 2 or (seen[0], seen[-1]) == (ids[0], ids[-1]):
        return ""
    late, early = seen[0] > ids[0], seen[-1] < ids[-1]
    when = [f"from frame {seen[0]} on"] * late + [f"up to frame {seen[-1]}"] * early
    only = f"{seen[0] if late else ''}:{seen[-1] + 1 if early else ''}"
    return f"the object is seen {', '.join(when)}; --frames {only} takes those frames alone"


def _told(report: Mapping[str, Any], options: Build, prior: AbstractPrior) -> int:
    """Say on stderr what came out, and return the exit status."""
    accepted = sum(frame["outcome"] == ACCEPTED for frame in report["frames"])
    loop = "loop closed" if report["closed"] else "no loop closed"
    took = f"{report['seconds'].get('total', 0.0):.0f} s"
    frames = "1 frame" if len(report["frames"]) == 1 else f"{len(report['frames'])} frames"
    say(f"{accepted} of {frames}, {loop}, {took}: {options.out}")
    if report["reasons"]:
        first, *others = sorted(report["reasons"], key=lambda reason: "left out" in reason)  # those were told above
        more = f" (and {len(others)} more in {options.out / 'report.json'})" if others else ""
        say(f"not to be trusted: {first}{more}")
        if sense_in_doubt(report["reasons"], prior):
            say("that the table turns the way round that was told is taken for granted; else give --step-sign unknown")
    for remark in (other_step(report["edges"], prior), ends_without(report["frames"])):
        if remark:
            say(remark)
    return 0 if report["trustworthy"] else 3
