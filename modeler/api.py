"""The main functions for scripts: two depth images to a posterior, a sequence to a model."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from modeler.composition import compose
from modeler.composition.compose import comes_back
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.export import RunFolder, RunMeta, locked, report_of
from modeler.graph import PoseGraph
from modeler.pipeline import Modeler
from modeler.priors import AutoPrior
from modeler.registration import VisibilityLikelihood, VisibilityRegistrar
from modeler.runs.outputs import check_run_folder
from modeler.segmentation import Segmenter, scene_frames
from modeler.sequences import AbstractSequence, GivenSequence, KeptSequence, open_sequence
from modeler.types import (
    AbstractPrior,
    AbstractRegistrar,
    Event,
    Frame,
    InputError,
    Intrinsics,
    ObjectModel,
    Posterior,
    Solution,
    Step,
    Verdict,
    checked,
)
from modeler.verdict.advice import remedies
from modeler.views import Sensor
from modeler.viz.stream import open_stream

Sink = Callable[[Event], object]  # consumes the events of a run: a `Step` for each frame, and others in between


@dataclass(frozen=True, eq=False)
class Result:
    """Result of a run."""

    model: ObjectModel | None
    """The fused object; None if no frame shows it."""
    graph: PoseGraph
    """Every edge, accepted or not."""
    solution: Solution
    """object_from_camera (4, 4) by frame number, with covariances."""
    verdict: Verdict
    """Whether the model can be trusted, why not, and the checks behind that."""
    report: Mapping[str, Any]
    """As in report.json: every frame, every edge, the verdict."""
    folder: Path | None
    """The run folder, if one was made."""

    @property
    def trustworthy(self) -> bool:
        """Whether the model can be trusted; `verdict.reasons` says why not."""
        return self.verdict.trustworthy


@checked
def register(
    source_depth_m: npt.ArrayLike,
    target_depth_m: npt.ArrayLike,
    intrinsics: Intrinsics,
    *,
    prior: AbstractPrior | str | None = None,
    masks: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
    colours: tuple[np.ndarray, np.ndarray] | None = None,
    sensor: Sensor | None = None,
    seed: int = 0,
) -> Posterior:
    """Return the posterior of target_from_source, the motion of the object between two depth images.

    Args:
        source_depth_m: (h, w) depth in m; 0 or NaN where nothing was measured.
        target_depth_m: (h, w), of the same camera.
        intrinsics: a `Camera`, `(fx, fy, cx, cy)` in px, or the (3, 3) camera matrix.
        prior: of the motion, or its name as in `--prior`; None: `AutoPrior`, free motion or motion on the table if one
            is seen, with rotations up to 50° and shifts of up to 4 cm, then any if none of these matches or the images
            contradict the match.
        masks: (h, w) of source and target, true on the object; None: the object is segmented.
        colours: (h, w, 3) 8-bit RGB of source and target, aligned to depth; None: only depth is compared.
        sensor: noise of the camera; None: the first Kinect's.
        seed: of the samples; the same seed gives the same posterior.

    Raises:
        InputError: if an image cannot be used, shows no object, or lacks what the prior needs.
    """
    for name, images in (("masks", masks), ("colours", colours)):
        if images is not None and len(images) != 2:
            raise InputError(f"there are {len(images)} {name} for two depth images; give one for each")
    depths_m, none = (source_depth_m, target_depth_m), (None, None)
    arrays = zip(depths_m, none if masks is None else masks, none if colours is None else colours, strict=True)
    frames = [
        Frame.of(depth_m, intrinsics, index, mask=mask, colour=colour)
        for index, (depth_m, mask, colour) in enumerate(arrays)
    ]
    shapes = [frame.depth_m.shape for frame in frames]
    if shapes[0] != shapes[1]:
        raise InputError(f"the depth images have shapes {shapes[0]} and {shapes[1]}; give two of the same camera")
    registrar = VisibilityRegistrar(VisibilityLikelihood(colour=colours is not None))
    modeler = Modeler(sensor=sensor or Sensor(), prior=AutoPrior(), registrar=registrar, seed=seed)
    scene = modeler.segmenter.scene(frames)
    views = []
    for name, frame in zip(("source", "target"), frames, strict=True):
        prepared = modeler.prepare(frame, scene)
        if prepared.view is None:
            raise InputError(f"the {name} image has {prepared.failure.label}: {prepared.failure.advice}")
        views.append(prepared.view)
    known = compose.chosen_prior(PriorOptions(prior=prior), None) if isinstance(prior, str) else prior
    return modeler.register(*views, prior=known)


@checked
def build(
    sequence: str | Path | Iterable[Frame],
    out: str | Path | None = None,
    *,
    prior: AbstractPrior | str | None = None,
    sensor: Sensor | None = None,
    segmenter: Segmenter | None = None,
    registrar: AbstractRegistrar | None = None,
    sinks: Sequence[Sink] = (),
    live: bool = False,
    seed: int = 0,
    overwrite: bool = False,
) -> Result:
    """Build the model of an object, into a run folder if one is given, as `modeler build` does.

    Args:
        sequence: a path in any format that `modeler build` reads, an open sequence, with frames selected or not, or any
            iterable of frames, such as a generator of `Frame.of(depth_m, intrinsics, number)`.
        out: the run folder to create: mesh, cloud, trajectory, graph, report and recording; None: none.
        prior: of the motion between frames, or its name in `modeler build`; None: that of the sequence, else `auto`.
        sensor: noise of the camera; None: that of the sequence, else the first Kinect's.
        segmenter: finds the object in frames without masks; None: the usual one.
        registrar: registers two views; None: the usual method.
        sinks: called with every event of the run, such as one of `open_stream`, which shows the run in Rerun, or a
            function of your own.
        live: whether the frames of an iterable are still being taken: each is processed before the next one is asked
            for, and the scene is learned from the first three. Otherwise all are read first, and kept in memory.
        seed: of every random number; the same seed gives the same model.
        overwrite: replace the results of an earlier run in the folder.

    Raises:
        InputError: if the sequence cannot be read, or the folder cannot be used.
    """
    began_s, folder = time.perf_counter(), None if out is None else Path(out)
    inputs: tuple[Path, ...] = ()
    if isinstance(sequence, str | Path):
        inputs = (Path(sequence),)
    elif isinstance(sequence, AbstractSequence):
        inputs = sequence.inputs
    if folder is not None:
        check_run_folder(folder, inputs, overwrite=overwrite)
    frames = _opened(sequence, live=live)
    options = compose.options_of(prior) if isinstance(prior, AbstractPrior) else PriorOptions(prior=prior)
    named = PriorOptions() if isinstance(prior, AbstractPrior) else options
    modeler = compose.modeler(frames, named, MethodOptions(seed=seed), ObjectOptions())
    modeler = replace(
        modeler,
        prior=prior if isinstance(prior, AbstractPrior) else modeler.prior,
        sensor=sensor or modeler.sensor,
        segmenter=segmenter or modeler.segmenter,
        registrar=registrar or modeler.registrar,
    )
    settings = {"prior_args": options.prior_args, "roi": modeler.segmenter.roi}
    settings |= {"max_depth_m": modeler.segmenter.max_depth_m}
    meta = RunMeta(
        sequence=_named(inputs, folder) or frames.name,
        seed=seed,
        prior=compose.resolved_prior(options, frames)[0],
        settings={name: value for name, value in settings.items() if value not in (None, ())},
        advice=partial(_advice, modeler.prior),
    )
    closure_expected = comes_back(frames, modeler.prior, modeler.closer.max_angle_deg)
    meta = replace(meta, scene_frames=scene_frames(frames.indices))
    scene = compose.scene(modeler, frames, meta.scene_frames)
    last: Step | None = None
    with nullcontext() if folder is None else _recorded(folder, meta, frames.name, began_s, overwrite) as record:
        for event in modeler.run(frames, scene, closure_expected=closure_expected, live=frames.live):
            if isinstance(event, Step):
                event.solution.covariances.values()  # in every run: the first request decides the last digits of others
                last = event
            for sink in (*([record] if record else []), *sinks):
                sink(event)
    if last is None or last.verdict is None:
        raise InputError(f"{frames.name}: has no selected frame; select others")
    report = report_of(last, meta) if folder is None else RunFolder(folder).report()
    return Result(last.model, PoseGraph(last.edges_so_far), last.solution, last.verdict, report, folder)


def _advice(prior: AbstractPrior, report: Mapping[str, Any]) -> list[str]:
    """Return in words what to do about a model that cannot be trusted."""
    return [
        f"{each.words}: {', '.join(f'{name} {value}' for name, value in each.parameters.items()) or each.first}"
        for each in remedies(report, prior)
    ]


def _opened(sequence: str | Path | Iterable[Frame], *, live: bool) -> AbstractSequence:
    """Return what frames are read from."""
    if isinstance(sequence, str | Path):
        return KeptSequence(open_sequence(Path(sequence)))
    return sequence if isinstance(sequence, AbstractSequence) else GivenSequence.of(sequence, live=live)


def _named(inputs: tuple[Path, ...], folder: Path | None) -> str:
    """Return the name of what is read; nothing for frames in memory."""
    if not inputs:
        return ""
    return str(inputs[0]) if folder is None else RunFolder(folder).stored(inputs[0])


@contextmanager
def _recorded(out: Path, meta: RunMeta, name: str, began_s: float, overwrite: bool) -> Iterator[Sink]:
    """Make a run folder with a recording, and yield the sink that fills it."""
    with locked(out):
        folder = RunFolder.open(out, overwrite=overwrite)
        facts = {"sequence": meta.sequence, "seed": meta.seed, "prior": meta.prior, **meta.settings}
        with closing(open_stream(name, save=out / "recording.rrd", facts=facts)) as stream:

            def record(event: Event) -> None:
                if isinstance(event, Step):
                    folder.write(event, replace(meta, seconds={"total": time.perf_counter() - began_s}))
                    stream(event)

            yield record
        folder.finish()
