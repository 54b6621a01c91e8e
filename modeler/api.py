"""The main functions for scripts: two depth images to a posterior, a sequence to a model."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from modeler.composition import compose
from modeler.composition.compose import comes_back
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.export import RunFolder, RunMeta, locked
from modeler.pipeline import Modeler
from modeler.priors import AutoPrior
from modeler.registration import VisibilityLikelihood, VisibilityRegistrar
from modeler.runs.outputs import check_run_folder
from modeler.sequences import AbstractSequence
from modeler.sequences import open_sequence as opened
from modeler.types import AbstractPrior, Camera, Frame, InputError, ObjectModel, Posterior, Solution, Step, Verdict
from modeler.views import Sensor
from modeler.viz.stream import open_stream

Intrinsics = Camera | npt.ArrayLike
"""A camera, `(fx, fy, cx, cy)` in px, or the (3, 3) camera matrix."""


@final
@dataclass(frozen=True, eq=False)
class Result:
    """Result of a run."""

    model: ObjectModel | None
    """The fused object; None if no frame shows it."""
    solution: Solution
    """object_from_camera (4, 4) by frame number, with covariances."""
    verdict: Verdict
    """Whether the model can be trusted, why not, and the checks behind that."""
    report: Mapping[str, Any]
    """As in report.json: every frame, every edge, the verdict."""
    folder: Path
    """The run folder."""

    @property
    def trustworthy(self) -> bool:
        """Whether the model can be trusted; `verdict.reasons` says why not."""
        return self.verdict.trustworthy


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
    pictures = [_numbers("depth image", depth).astype(np.float32) for depth in (source_depth_m, target_depth_m)]
    if pictures[0].ndim != 2 or pictures[0].shape != pictures[1].shape or not pictures[0].size:
        shapes = " and ".join(str(picture.shape) for picture in pictures)
        raise InputError(f"the depth images have shapes {shapes}; give two arrays (h, w) of the same camera")
    for name, images in (("masks", masks), ("colours", colours)):
        if images is not None and len(images) != len(pictures):
            raise InputError(f"there are {len(images)} {name} for two depth images; give one for each")
    given = [None, None] if masks is None else [_numbers("mask", mask) for mask in masks]
    if any(mask is not None and (mask.shape != pictures[0].shape or np.isnan(mask).any()) for mask in given):
        raise InputError(f"the masks hold NaN, or have another shape than depth's {pictures[0].shape}; correct them")
    rgb = [None, None] if colours is None else [np.asarray(colour) for colour in colours]
    for colour in rgb:
        if colour is not None and (colour.shape != (*pictures[0].shape, 3) or colour.dtype != np.uint8):
            raise InputError(
                f"colours have shape {colour.shape} of {colour.dtype}; give 8-bit RGB of depth's {pictures[0].shape}"
            )
    camera = _camera(intrinsics, pictures[0].shape)
    frames = []
    for index, (depth_m, mask, colour) in enumerate(zip(pictures, given, rgb, strict=True)):
        depth_m[~(depth_m > 0.0) | np.isinf(depth_m)] = np.nan
        frames.append(
            Frame(index, float(index), depth_m, camera, mask=None if mask is None else mask != 0, colour=colour)
        )
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


def build(
    sequence: str | Path | AbstractSequence,
    out: str | Path,
    *,
    prior: AbstractPrior | str | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> Result:
    """Build the model of an object from a sequence into a run folder, as `modeler build` does.

    Args:
        sequence: a path in any format that `modeler build` reads, or an open sequence, with frames selected or not.
        out: the run folder to create: mesh, cloud, trajectory, graph, report and recording.
        prior: of the motion between frames, or its name in `modeler build`; None: that of the sequence, else `auto`.
        seed: of every random number; the same seed gives the same model.
        overwrite: replace the results of an earlier run in the folder.

    Raises:
        InputError: if the sequence cannot be read, or the folder cannot be used.
    """
    began_s = time.perf_counter()
    frames = sequence if isinstance(sequence, AbstractSequence) else opened(Path(sequence))
    named = () if isinstance(sequence, AbstractSequence) else (Path(sequence),)
    check_run_folder(Path(out), (*named, *frames.inputs), overwrite=overwrite)
    options = PriorOptions(prior=prior if isinstance(prior, str) else None)
    modeler = compose.modeler(frames, options, MethodOptions(seed=seed), ObjectOptions())
    if isinstance(prior, AbstractPrior):
        modeler = replace(modeler, prior=prior)
    meta = RunMeta(
        sequence=frames.name if isinstance(sequence, AbstractSequence) else str(sequence),
        seed=seed,
        prior=type(prior).__name__ if isinstance(prior, AbstractPrior) else compose.resolved_prior(options, frames)[0],
    )
    closure_expected = comes_back(frames, modeler.prior, modeler.closer.max_angle_deg)
    scene = compose.scene(modeler, frames)
    report: Mapping[str, Any] = {}
    last: Step | None = None
    with locked(Path(out)):
        folder = RunFolder.open(Path(out), overwrite=overwrite)
        facts = {"sequence": meta.sequence, "seed": seed, "prior": meta.prior}
        stream = open_stream(frames.name, save=folder.path / "recording.rrd", facts=facts)
        try:
            for event in modeler.run(frames, scene, closure_expected=closure_expected):
                if isinstance(event, Step):
                    seconds = {"total": time.perf_counter() - began_s}
                    report = folder.write(event, replace(meta, seconds=seconds))
                    stream(event)
                    last = event
        finally:
            stream.close()
        folder.finish()
    if last is None or last.verdict is None:
        raise InputError(f"{frames.name}: has no selected frame; select others")
    return Result(last.model, last.solution, last.verdict, report, folder.path)


def _numbers(name: str, image: npt.ArrayLike) -> np.ndarray:
    """Return an image as an array of its own.

    Raises:
        InputError: if it is none of real numbers.
    """
    try:
        array = np.array(image)
    except ValueError as error:  # rows of different lengths
        raise InputError(f"a {name} is no array ({error}); give one of numbers") from None
    if array.dtype.kind not in "fiub":
        raise InputError(f"a {name} is of {array.dtype}; give real numbers")
    return array


def _camera(intrinsics: Intrinsics, shape: tuple[int, ...]) -> Camera:
    """Return the camera of images of a shape (h, w).

    Raises:
        InputError: if the intrinsics are invalid.
    """
    height, width = shape
    if isinstance(intrinsics, Camera):
        return intrinsics
    numbers = _numbers("camera", intrinsics).astype(np.float64)
    if numbers.shape == (3, 3):
        numbers = numbers[[0, 1, 0, 1], [0, 1, 2, 2]]
    if numbers.shape != (4,) or not np.isfinite(numbers).all() or not (numbers[:2] > 0.0).all():
        raise InputError("the intrinsics are invalid; give (fx, fy, cx, cy) in px, or the (3, 3) camera matrix")
    return Camera(width, height, *(float(number) for number in numbers))
