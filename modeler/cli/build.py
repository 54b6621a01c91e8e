"""`modeler build`: a sequence to a model."""

from __future__ import annotations

import itertools
import math
import shlex
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from modeler.cli.console import Console, Interrupt, as_options, say, trusted_status
from modeler.cli.options import AbstractBuild, WatchOptions, check_voxel, given_options
from modeler.composition.options import MethodOptions, PriorOptions, default
from modeler.runs.compiling import compile_kernels

if TYPE_CHECKING:
    from modeler.export import RunFolder, RunMeta
    from modeler.pipeline import Modeler, Run
    from modeler.segmentation import Scene
    from modeler.sequences import AbstractSequence
    from modeler.types import AbstractPrior, Event, Frame

DRAWING_SHARE = 0.15
"""Of the time of a live run. Drawing a step takes about as long as registering one; so it delays steps by a fifth."""
_SHOWN_REASONS = 3  # not to trust a model; the report has all


@dataclass(frozen=True)
class Build(AbstractBuild):
    """Build the model of an object from a sequence: register its frames, close loops, fuse.

    Ctrl-C ends the run with the frames so far, and makes the model from them.
    """

    sequence: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SEQUENCE")]
    """Folder of images (BOP, TUM RGB-D, Open3D, BundleSDF, your own) or of organised clouds (PCD, PLY).
    ROS bag, MCAP, RealSense or Azure Kinect recording; realsense:, orbbec:, oak: or azure: for a connected one."""
    out: Annotated[Path, tyro.conf.arg(metavar="RUN")]
    """Run folder to create: model.ply, cloud.ply, trajectory.txt, graph.g2o, report.json, recording.rrd and more."""
    known: Annotated[Path | None, tyro.conf.arg(name="model", metavar="RUN0"), default("none")] = None
    """Go on with the model of this run: frames are placed on it, and one graph has those of both recordings."""
    overwrite: bool = False
    """Replace the results of an earlier run in the folder."""
    resume: bool = False
    """Continue a run that was interrupted, or whose frames have changed, with the same options: only pairs that are
    new are registered."""
    connect: Annotated[str | None, tyro.conf.arg(metavar="URL"), default("none")] = None
    """Watch in a Rerun viewer that is already open: rerun+http://HOST:PORT/proxy."""
    watching: WatchOptions = field(default_factory=WatchOptions)

    def run(self) -> int:
        """Run the loop into a run folder; status 3 if the model cannot be trusted; report.json has the reasons."""
        from modeler.composition import compose
        from modeler.export import PairCache, RunFolder, RunMeta, locked
        from modeler.runs.outputs import check_run_folder, run_inputs
        from modeler.segmentation import scene_frames
        from modeler.sequences import read_focal_factor
        from modeler.system.processes import in_parallel
        from modeler.viz.stream import load

        began_s = time.perf_counter()
        _check(self)
        inputs = [path for path in (self.sequence, self.model.sensor, self.model.camera) if path is not None]
        inputs += [] if self.known is None else run_inputs([self.known])
        check_run_folder(self.out, inputs, overwrite=self.overwrite, resume=self.resume)
        whole, frames, digests = _opened(self)
        if self.known is not None:
            return _go_on(self, self.known, frames)
        modeler = compose.modeler(whole, self.prior, self.method, self.where)
        tolerance_m = None if self.model.tolerance_mm is None else 1e-3 * self.model.tolerance_mm
        modeler = replace(modeler, fuser=replace(modeler.fuser, voxel_m=self.model.voxel_m), tolerance_m=tolerance_m)
        prior, remark = compose.resolved_prior(self.prior, whole)
        meta = RunMeta(
            sequence=RunFolder(self.out).stored(self.sequence),
            seed=self.method.seed,
            prior=prior,
            settings=self.settings(),
            camera=None if self.model.camera is None else read_focal_factor(self.model.camera).values(),
            digests=digests,
            advice=partial(self.advice, modeler.prior),
        )
        if self.resume and RunFolder(self.out).finished(meta):
            say("the run is already complete; give --overwrite to build it again")
            return _summarise(RunFolder(self.out).report(), self, modeler.prior)
        if self.resume and (changes := RunFolder(self.out).changed_frames(meta)):
            say(f"{', '.join(changes)} since the run: what the others gave is kept")
        compile_kernels(say)
        learned_from = scene_frames(whole.indices, RunFolder(self.out).scene_frames() if self.resume else ())
        meta = replace(meta, scene_frames=learned_from)
        scene, _ = in_parallel(partial(compose.scene, modeler, whole, learned_from), load)
        for doubt in scene.doubts:
            say(doubt)
        with locked(self.out):
            before = RunFolder(self.out).changed_versions(meta) if self.resume else ()
            folder = RunFolder.open(self.out, overwrite=self.overwrite, resume=self.resume)
            modeler = replace(modeler, cache=PairCache(folder.pairs, meta.versions))
            if before:
                say(f"the run was begun with {', '.join(before)}: its pairs are registered again")
            if remark:
                say(remark)
            report = _run(self, modeler, (frames, scene), folder, meta, began_s=began_s)
            folder.finish()
        return _summarise(report, self, modeler.prior)

    def settings(self) -> dict[str, object]:
        """Return the settings besides sequence, seed and the prior's name, as recorded in report.json."""
        from modeler.export import RunFolder

        parts = asdict(self.prior) | asdict(self.method) | asdict(self.selection) | asdict(self.where)
        parts |= {name: getattr(self.model, name) for name in ("voxel_m", "tolerance_mm")}
        files = {"sensor": self.model.sensor, "camera": self.model.camera}
        folder = RunFolder(self.out)
        parts |= {name: None if path is None else folder.stored(path) for name, path in files.items()}
        parts |= self.given.settings()
        return {
            name: value for name, value in parts.items() if name not in ("prior", "seed") and value not in (None, ())
        }

    def advice(self, prior: AbstractPrior, report: Mapping[str, Any]) -> list[str]:
        """Return in words, with commands, what to do about a model that cannot be trusted."""
        from modeler.verdict.advice import remedies

        found = []
        for remedy in remedies(report, prior):
            commands = [remedy.first.format(run=shlex.quote(str(self.out)))] if remedy.first else []
            commands += [self.command(remedy.parameters)] if remedy.parameters else []
            found.append(as_options(f"{remedy.words}: {' && '.join(commands)}"))
        return found

    def command(self, changes: Mapping[str, str]) -> str:
        """Return the command line that replaces the run by one with other parameters."""
        same = changes.get("prior", self.prior.prior) == self.prior.prior  # else its parameters are of another prior
        groups = (
            self.prior if same else PriorOptions(),
            self.selection,
            self.where,
            self.model,
            self.given,
            self.method,
        )
        words = {name: shlex.join(map(str, values)) for name, values in given_options(*groups).items()}
        words |= {f"--{name.replace('_', '-')}": value for name, value in changes.items()}
        options = " ".join(f"{name} {value}".rstrip() for name, value in words.items())
        return (
            f"modeler build {shlex.quote(str(self.sequence))} --out {shlex.quote(str(self.out))} --overwrite {options}"
        )


def _go_on(options: Build, known: Path, frames: AbstractSequence) -> int:
    """Go on with the model of a run, and return the exit status."""
    from modeler.runs.growing import Growth

    compile_kernels(say)
    growth = Growth(options.where, options.given.overrides(), options.method.seed)
    done = growth.run(known, options.sequence, frames, options.out, overwrite=options.overwrite)
    say(f"{done.placed} of {done.frames} frames placed on the model of {known}: {options.out}")
    return trusted_status(done.verdict)


def _check(options: Build) -> None:
    """Reject options that contradict each other or are out of range."""
    from modeler.types import InputError
    from modeler.viz.viewer import reachable

    if options.resume and options.overwrite:
        raise InputError("--resume keeps what --overwrite deletes; give one of them")
    if options.known is not None:
        method, model = (
            replace(options.method, seed=MethodOptions.seed),
            replace(options.model, sensor=None, camera=None),
        )
        unused = [f"--{name}" for name in ("resume", "connect") if getattr(options, name)]
        unused += given_options(replace(options.watching, idle_s=WatchOptions.idle_s), options.prior, method, model)
        if unused:
            raise InputError(f"--model places frames on a finished model; leave out {', '.join(unused)}")
    check_voxel(options.model.voxel_m)
    tolerance_mm = options.model.tolerance_mm
    if tolerance_mm is not None and not 0.0 < tolerance_mm < math.inf:
        raise InputError(f"--tolerance-mm {tolerance_mm:g} is out of range; give a positive length in mm")
    if options.connect is not None:
        reachable(options.connect)  # rejects invalid addresses; the connection is made with the first data


def _opened(options: Build) -> tuple[AbstractSequence, AbstractSequence, Mapping[int, str]]:
    """Return the sequence, the selected frames and their digests; what is unreadable is found before all else."""
    from modeler.cli.reading import opened, selected
    from modeler.runs.reopening import calibrated
    from modeler.types import InputError

    path = options.sequence
    whole = opened(path, options.given, options.watching)
    whole = calibrated(whole, options.model.sensor, options.model.camera)
    frames, found = selected(whole, options.selection, options.given)
    if found is not None and options.method.method == "coloured-icp" and found.colours == 0:
        raise InputError(f"{path}: has no colour, which coloured ICP compares; give another --method")
    return whole, frames, {} if found is None else found.digests


def _run(
    options: Build,
    modeler: Modeler,
    seen: tuple[AbstractSequence, Scene],
    folder: RunFolder,
    meta: RunMeta,
    *,
    began_s: float,
) -> Mapping[str, Any]:
    """Show and write every step, and return the last report."""
    from modeler.cli.reading import while_it_lasts
    from modeler.composition.compose import comes_back
    from modeler.runs.live_advice import advising
    from modeler.system.processes import in_background
    from modeler.types import Step
    from modeler.viz.stream import open_stream

    frames, scene = seen
    stream = open_stream(
        frames.name,
        save=folder.path / "recording.rrd",
        spawn=options.watching.view,
        web=options.watching.web,
        connect=options.connect,
        facts={"sequence": meta.sequence, "seed": meta.seed, "prior": meta.prior, **meta.settings},
        advised=frames.live,
    )
    run = modeler.start(
        scene,
        closure_expected=comes_back(frames, modeler.prior, modeler.closer.max_angle_deg),
        depth_scale_sigma=0.0 if meta.camera is None else float(meta.camera["depth_scale_sigma"]),
    )
    seconds = {"scene": time.perf_counter() - began_s, "registration": 0.0, "total": 0.0}
    report: Mapping[str, Any] = {}
    try:
        with (
            # A live run does not wait for the drawing; the last step draws all poses and the model.
            in_background(
                stream, lambda event: frames.live and not (isinstance(event, Step) and event.last), share=DRAWING_SHARE
            ) as draw,
            Interrupt() as interrupt,
            Console(None if frames.live else len(frames), stream.address, modeler.prior) as console,
            advising(run.modeler, console.advise, stream.advise) as advise,
        ):
            followed = frames.live and (console.watched or stream.shown is not None)
            wanted = frames.until(lambda: interrupt.asked)
            coming = interrupt.until(while_it_lasts(wanted) if frames.live else wanted)
            for event in _events(run, coming, interrupt, live=frames.live):
                console(event)
                if isinstance(event, Step):
                    seconds["registration"] += sum(posterior.seconds for posterior in event.posteriors)
                    seconds["total"] = time.perf_counter() - began_s
                    meta = replace(meta, seconds=dict(seconds))
                    report = folder.write(event, meta)
                    draw(event)
                    # Frames that were skipped are added once it is too late for advice.
                    if followed and not event.last and event.frame.index >= max(event.views, default=0):
                        advise(event)
    finally:
        stream.close()
    if not report:
        raise KeyboardInterrupt
    return report


def _events(run: Run, frames: Iterable[Frame], interrupt: Interrupt, *, live: bool) -> Iterator[Event]:
    """Yield the events of a run; Ctrl-C skips the stages after its frames, a second one the skipped frames, if any."""
    if live:
        from modeler.pipeline import NewestFrames

        newest = NewestFrames(frames)
        yield from run.track(newest, live=True)
        if newest.skipped:
            say(f"adding {len(newest.skipped)} frames that were skipped or came late; Ctrl-C leaves them out")
        yield from run.fill(interrupt.until_next(sorted(newest.skipped, key=lambda frame: frame.index)))
    else:
        yield from run.track(frames)
    yield from run.revisit()
    for event in itertools.chain(run.rejoin(), run.refine(), run.correct()):
        yield event
        if interrupt.asked:
            break
    yield from run.finish(interrupted=interrupt.ended_early)


def _summarise(report: Mapping[str, Any], options: Build, prior: AbstractPrior) -> int:
    """Write a summary of the run to stderr, and return the exit status."""
    from modeler.types import ACCEPTED
    from modeler.verdict.advice import (
        estimated_focal_length,
        measured_step,
        sign_is_ambiguous,
        unchecked_focal_length,
        visible_frames,
    )

    accepted = sum(frame["outcome"] == ACCEPTED for frame in report["frames"])
    loop = "loop closed" if report["closed"] else "no loop closed"
    took = f"{report['seconds'].get('total', 0.0):.0f} s"
    frames = "1 frame" if len(report["frames"]) == 1 else f"{len(report['frames'])} frames"
    say(f"{accepted} of {frames}, {loop}, {took}: {options.out}")
    if error := report.get("loop"):
        say(
            f"loop closure error before optimisation: {error['opening_deg']:.1f}° and "
            f"{1000.0 * error['opening_m']:.1f} mm, "
            f"{error['sigmas']:.1f} standard deviations of {error['edges']} edges and the closure"
        )
    if (camera := report.get("camera")) and (words := estimated_focal_length(camera)):
        say(words)
    if trusted_to_m := report.get("trusted_to_m"):
        say(f"the model can be trusted to {1000.0 * trusted_to_m:.1f} mm")
    if report["reasons"]:
        coded = list(zip(report.get("reason_codes") or report["reasons"], report["reasons"], strict=False))
        # Frames left out were reported above.
        reasons = [words for _, words in sorted(coded, key=lambda reason: reason[0] == "left_out")]
        for words in reasons[:_SHOWN_REASONS]:
            say(f"not to be trusted: {words}")
        if len(reasons) > _SHOWN_REASONS:
            say(f"for {len(reasons) - _SHOWN_REASONS} more, see {options.out / 'report.json'}")
        if sign_is_ambiguous(report, prior):
            say("the given direction of rotation is assumed; if it may be the opposite, give --step-sign unknown")
    for remark in (
        measured_step(report["edges"], prior),
        visible_frames(report["frames"]),
        unchecked_focal_length(report),
    ):
        if remark:
            say(remark)
    for words in report.get("remedies", ()):
        say(words)
    return 0 if report["trustworthy"] else 3
