"""Trials: an object sought or followed in frames by the tracker and the baselines, beside the truth."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, final

import numpy as np

import modeler
from modeler import se3
from modeler.baselines import IcpRegistrar
from modeler.composition import compose
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.export import RunFolder, poses_of
from modeler.pipeline.pairs import prepare
from modeler.runs.known_objects import known_object
from modeler.segmentation import Scene as Segmented
from modeler.sequences import open_sequence
from modeler.sequences.rendering import RenderedSequence
from modeler.tracking import Tracked, Tracker
from modeler.types import Array, Frame, ObjectModel, PoseGaussian, RayImage
from modeler.views import Sensor
from studies.calibration.specimens import SPECIMENS, Half, load_specimen
from studies.calibration.study import Condition, staged
from studies.tracking.baselines import ModelCloud, methods
from studies.tracking.clutter import VIEWS, exact_model, model_of, mssd_m, noise, scene

OURS: Final = "modeler track"
OURS_FROM_LAST: Final = f"{OURS} from the last pose"
DEG, M, MSSD = 5.0, 0.005, 0.1
"""Errors below which a pose is right: of rotation, place, and in diameters."""
HIDDEN: Final = 0.6
"""Largest share of the object that is hidden, on purpose."""
_SMALL_M = 0.35  # of shapes that fit on the table together
_AWAY_DEG, _AWAY_M = 15.0, 0.01  # of the last pose from the true one, where frames stand for themselves
_TURNS, _TURN_DEG = 28, 12.5  # frames of a shape of which half make a model, and its turn in each
_FOLLOWED, _STEP_DEG = 30, 6.0  # frames of an object that is followed, and its turn in each
Part = Literal["even", "odd"]
PARTS: Final[dict[Part, int]] = {"even": 0, "odd": 1}
"""Halves of a capture, by their first frame."""


@final
@dataclass(frozen=True)
class Trial:
    """An object sought in one frame."""

    group: str
    """Where."""
    name: str
    """Of object and frame."""
    method: str
    visible: float
    """Share (0..1) of the object that nothing hides, as far as it is known; 0: it is absent."""
    there: bool
    """Whether the method says that it is there."""
    usable: bool
    error_deg: float
    error_m: float
    mssd: float
    """In diameters."""
    nees: float
    """Of six degrees of freedom, over 6."""
    seconds: float
    """Of a processor."""

    @property
    def right(self) -> bool:
        """Whether the pose is right, or the object absent and said to be."""
        if self.visible == 0.0:
            return not self.there
        return self.there and self.error_deg < DEG and self.error_m < M


@final
@dataclass(frozen=True, eq=False)
class Sought:
    """A model that is sought."""

    model: ObjectModel
    tracker: Tracker

    @property
    def centre_m(self) -> Array:
        """Middle (3,) of the model."""
        return self.tracker.renderer.centre_m

    @property
    def diameter_m(self) -> float:
        """Diameter of the model."""
        return 2.0 * self.tracker.renderer.radius_m

    @property
    def thing(self) -> ModelCloud:
        """The model for the baselines."""
        return ModelCloud(self.model, self.diameter_m)


def shapes(half: Half, count: int) -> list[str]:
    """Return the names of shapes of a half that fit on the table."""
    names = [one.recipe for one in SPECIMENS if one.half == half and one.symmetry in ("asymmetric", "near-symmetric")]
    fitting = (name for name in names if np.ptp(model_of(name).vertices_m[:, :2], axis=0).max() < _SMALL_M)
    return [name for name, _ in zip(fitting, range(count), strict=False)]


def on_table(name: str, names: tuple[str, ...], scenes: range) -> list[Trial]:
    """Return trials on the cluttered table, with 0 to 60 % of the object hidden; every fourth is without it.

    Args:
        name: of the shape.
        names: of the shapes that may be around it.
        scenes: seeds.
    """
    found = list[Trial]()
    for seed in scenes:
        view, absent = VIEWS[seed // 4 % len(VIEWS)], seed % 4 == 3
        rng, sensor = np.random.default_rng(seed), Sensor(noise(view.distance_m, view))
        sought = Sought(model_of(name), Tracker(model_of(name), sensor, independent=True))
        thing = sought.thing
        others = tuple(str(one) for one in rng.choice([one for one in names if one != name], 3, replace=False))
        shown = scene(None if absent else name, others, seed, hidden=HIDDEN * float(rng.uniform()), view=view)
        where, truth = ("table", f"{name} {seed}"), shown.camera_from_model
        found.append(_trial(where, sought, shown.frame, truth, shown.visible))
        if truth is None:
            continue
        masked = replace(shown.frame, mask=shown.mask)
        if (seen := prepare(masked, Segmented(), sought.tracker.segmenter, sensor).view) is not None:
            last = _away(truth, sought, rng)
            found += _beside(where, (sought, thing), seen, truth, shown.visible)
            found += _beside(where, (sought, thing), seen, truth, shown.visible, last=last)
            found.append(_from_last(where, sought, masked, truth, shown.visible, last))
    return found


def turned(name: str, out: Path) -> list[Trial]:
    """Return trials of a turned shape: the model that its even frames make, sought in each odd one.

    The truth is the pose in which the model's surface fits the true one best.

    Args:
        name: of the shape.
        out: where the run is written.
    """
    sequence = RenderedSequence(staged(load_specimen(name), Condition(step_deg=_TURN_DEG), frames=_TURNS, seed=2))
    run, mesh, truth = out / f"turned-{name}", sequence.model(), sequence.truth()
    modeler.build(sequence.select(every=2), run, overwrite=True)
    first, thing = min(poses_of(RunFolder(run).result())), known_object(run)
    sensor, scale = Sensor(sequence.sensor()), 0.0 if thing.focal is None else thing.focal.depth_scale_sigma
    sought = Sought(thing.model, Tracker(thing.model, sensor, independent=True, depth_scale_sigma=scale))
    exact = ModelCloud(exact_model(mesh.vertices_m, mesh.triangles), sought.diameter_m)
    fit = IcpRegistrar().refine(sought.thing.cloud, exact.cloud, se3.inverse(truth[first]))
    if fit is None:
        return []
    where = "turned, model " + ("trusted" if RunFolder(run).result()["trustworthy"] else "not trusted")
    return [
        _trial((where, f"{name} {index}"), sought, thing.seen_by(sequence).frame(index),
               truth[index] @ fit.target_from_source, 1.0)
        for index in sequence.indices[1::2]
    ]  # fmt: skip


def followed(name: str) -> list[Trial]:
    """Return trials of a shape that is followed as it turns, each method from its own last pose; all start right."""
    sequence = RenderedSequence(staged(load_specimen(name), Condition(step_deg=_STEP_DEG), frames=_FOLLOWED, seed=1))
    mesh, truth = sequence.model(), sequence.truth()
    model = exact_model(mesh.vertices_m, mesh.triangles)
    sensor = Sensor(sequence.sensor())
    sought = Sought(model, Tracker(model, sensor))
    thing, found = sought.thing, list[Trial]()
    last = dict.fromkeys(methods(local=True), truth[sequence.indices[0]])
    for frame in sequence:
        where = "followed", f"{name} {frame.index}"
        found.append(_trial(where, sought, frame, truth[frame.index], 1.0))
        view = prepare(frame, Segmented(), sought.tracker.segmenter, sensor).view
        if view is None or frame.index == sequence.indices[0]:
            continue
        for method, run in methods(local=True).items():
            began_s = time.process_time()
            answer = run(thing, view, last[method])
            seconds = time.process_time() - began_s
            last[method] = last[method] if answer is None else answer.camera_from_model
            errors = _errors(sought, last[method], truth[frame.index])
            found.append(Trial(*where, method, 1.0, True, True, *errors, np.nan, seconds))
    return found


def built(path: Path, part: Part | Literal["whole"], out: Path) -> None:
    """Build the model of a capture or of half of it, unless it was."""
    sequence, run = open_sequence(path), run_of(path, part, out)
    if not (run / "model.ply").exists():
        if part != "whole":
            sequence = sequence.select(every=2, frames=slice(sequence.indices[PARTS[part]], None))
        modeler.build(sequence, run, overwrite=True)


def run_of(path: Path, part: str, out: Path) -> Path:
    """Return the run folder of a capture or half of it."""
    return out / f"{path.name}-{part}"


def in_capture(path: Path, part: Part, other: Path, out: Path, count: int) -> list[Trial]:
    """Return trials with the model of half of a capture: in the other half, or in another capture, where it is absent.

    Args:
        path: the capture that made the model.
        part: which half did.
        other: the capture it is sought in.
        out: where the runs are.
        count: largest number of frames of another capture.
    """
    run, whole = (run_of(path, one, out) for one in (part, "whole"))
    poses = {frame: pose.mean for frame, pose in poses_of(RunFolder(whole).result()).items()}
    first, thing = min(poses_of(RunFolder(run).result())), known_object(run)
    trusted = "trusted" if RunFolder(run).result()["trustworthy"] else "not trusted"
    seen, own = thing.seen_by(open_sequence(other)), other == path
    parts = compose.modeler(seen, PriorOptions(prior="general"), MethodOptions(), ObjectOptions())
    segmented = compose.scene(parts, seen)
    sensor = parts.sensor.measured(segmented.range_noise)
    tracker = Tracker(thing.model, sensor, independent=True, segmenter=parts.segmenter, scene=segmented)
    sought, rng, found = Sought(thing.model, tracker), np.random.default_rng(0), list[Trial]()
    cloud = sought.thing
    frames = seen.indices[1 - PARTS[part] :: 2] if own else seen.indices[:: max(len(seen.indices) // count, 1)][:count]
    for index in frames:
        if own and not {index, first} <= poses.keys():
            continue
        truth = se3.inverse(poses[index]) @ poses[first] if own else None
        where = f"captures, model {trusted}", f"{path.name} {part} in {other.name} {index}"
        visible = 1.0 if own else 0.0
        found.append(_trial(where, sought, seen.frame(index), truth, visible))
        view = prepare(seen.frame(index), segmented, parts.segmenter, sensor).view
        if view is not None:
            found += _beside(where, (sought, cloud), view, truth, visible)
            if truth is not None:
                last = _away(truth, sought, rng)
                found += _beside(where, (sought, cloud), view, truth, visible, last=last)
                found.append(_from_last(where, sought, seen.frame(index), truth, visible, last))
    return found


def _away(truth: Array, sought: Sought, rng: np.random.Generator) -> Array:
    """Return a pose as that of the frame before may be: turned and shifted about the object's centre."""
    turn, shift = (axis / np.linalg.norm(axis) for axis in rng.normal(size=(2, 3)))
    about = se3.translation(sought.centre_m)
    moved = se3.exp(np.concatenate([np.radians(_AWAY_DEG) * turn, _AWAY_M * shift]))
    return truth @ about @ moved @ se3.inverse(about)


def _from_last(
    where: tuple[str, str], sought: Sought, frame: Frame, truth: Array | None, visible: float, last: Array
) -> Trial:
    """Return what the tracker makes of a frame if it knows the pose before, `last`."""
    tracker = replace(sought.tracker, independent=False)
    tracker.newest.append(Tracked(-1, frame.time_s - 1.0, "found", PoseGaussian(last, np.eye(6)), usable=True))
    return _trial(where, replace(sought, tracker=tracker), frame, truth, visible, OURS_FROM_LAST)


def _trial(
    where: tuple[str, str], sought: Sought, frame: Frame, truth: Array | None, visible: float, method: str = OURS
) -> Trial:
    """Return what the tracker makes of a frame."""
    began_s = time.process_time()
    found = sought.tracker.update(frame)
    seconds = time.process_time() - began_s
    pose = None if found.pose is None or found.outcome == "unsure" else found.pose.mean
    return Trial(*where, method, visible, pose is not None, found.usable, *_errors(sought, pose, truth),
                 _nees(found, truth), seconds)  # fmt: skip


def _beside(
    where: tuple[str, str],
    thing: tuple[Sought, ModelCloud],
    view: RayImage,
    truth: Array | None,
    visible: float,
    *,
    last: Array | None = None,
) -> Iterator[Trial]:
    """Yield what the baselines make of a frame with its mask, those that start from the last pose if it is given."""
    for method, run in methods(local=last is not None).items():
        began_s = time.process_time()
        answer = run(thing[1], view, np.eye(4) if last is None else last)
        seconds = time.process_time() - began_s
        pose = answer.camera_from_model if answer is not None and answer.there else None
        errors = _errors(thing[0], pose, truth)
        yield Trial(*where, method, visible, pose is not None, pose is not None, *errors, np.nan, seconds)


def _errors(sought: Sought, pose: Array | None, truth: Array | None) -> tuple[float, float, float]:
    """Return the errors of camera_from_model: in degrees, of the centre in m, MSSD in diameters; NaN without a pose."""
    if pose is None or truth is None:
        return np.nan, np.nan, np.nan
    turns = [np.eye(4)]
    if se3.rotation_angle(se3.inverse(pose) @ truth) > np.radians(DEG):  # perhaps another turn of a symmetric model
        coloured = sought.tracker.symmetries.with_colour
        turns += list((coloured or sought.tracker.symmetries).discrete)
    angles = [float(se3.rotation_angle(se3.inverse(pose) @ truth @ turn)) for turn in turns]
    turned = truth @ turns[int(np.argmin(angles))]
    centre_m = sought.centre_m[None]
    off_m = float(np.linalg.norm(se3.transform(pose, centre_m) - se3.transform(turned, centre_m)))
    return float(np.degrees(min(angles))), off_m, mssd_m(sought.model, pose, turned) / sought.diameter_m


def _nees(found: Tracked, truth: Array | None) -> float:
    """Return the normalised estimation error squared over 6; NaN without a usable pose."""
    if found.pose is None or truth is None or not found.usable:
        return np.nan
    xi = se3.log(se3.inverse(found.pose.mean) @ truth)
    return float(xi @ np.linalg.solve(found.pose.covariance, xi)) / 6.0
