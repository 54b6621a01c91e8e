"""Find objects with their models: rendered on a cluttered table, and in captures whose even frames made the model.

    python -m studies tracking                                        # rendered shapes, half an hour
    python -m studies tracking --captures ../shared/data/* --record   # and captures, an hour

Each frame stands for itself: any rotation, anywhere in view. On the rendered table no mask is given, and every fourth
scene is without the object. Of a capture, the model is built from the even frames and sought in the odd ones, where the
poses of the whole run are the reference, and in frames of the other captures, where it is absent. A pose is right below
5° and 5 mm, or below a tenth of the diameter in BOP's MSSD; turns of a symmetric model are allowed in both. The
baseline is FPFH with RANSAC and ICP of the model's cloud; it is given the mask, on the table the true one.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, final

import numpy as np
from scipy import stats

import modeler
from modeler import se3
from modeler.baselines import FpfhIcpRegistrar
from modeler.baselines.clouds import Cloud
from modeler.composition import compose
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.export import RunFolder, poses_of
from modeler.fusion.paint import SurfacePoints
from modeler.pipeline.pairs import prepare
from modeler.runs.known_objects import known_object
from modeler.segmentation import Scene as Segmented
from modeler.sequences import AbstractSequence, open_sequence
from modeler.tracking import Tracked, Tracker
from modeler.types import Array, Frame, ObjectModel, RayImage
from modeler.views import Sensor
from studies.calibration.specimens import SPECIMENS, Half
from studies.results.tables import FOLDER, record
from studies.results_file import earlier_results
from studies.tracking.clutter import VIEW, model_of, mssd_m, noise, scene

_DEG, _M, _MSSD = 5.0, 0.005, 0.1
_FITNESS: Final = (
    0.8  # of the baseline's inliers, above which it says that the object is there: the best of a few tried
)
_POINTS = 20_000  # of the model's cloud
_SMALL_M = 0.35  # of shapes that fit on the table together


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
        return self.there and self.error_deg < _DEG and self.error_m < _M


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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; the status is 1 if nothing is found: then the study is broken."""
    parser = argparse.ArgumentParser(
        prog="python -m studies tracking", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--captures", nargs="*", type=Path, default=(), metavar="SEQUENCE", help="recordings")
    parser.add_argument("--half", choices=("tuning", "held-out"), default="tuning", help="which shapes")
    parser.add_argument("--shapes", type=int, default=8, metavar="N", help="rendered shapes, in all")
    parser.add_argument("--scenes", type=int, default=5, metavar="N", help="scenes of each")
    parser.add_argument("--out", type=Path, default=Path("runs/tracking"), metavar="DIR", help="runs and results")
    parser.add_argument("--record", action="store_true", help="put the figures into their file")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "trials.jsonl"
    trials = [Trial(**json.loads(line)) for line in earlier_results(path)]
    done = {(trial.group, trial.name) for trial in trials}
    with path.open("a") as file:
        for trial in itertools.chain(
            rendered(options.half, options.shapes, options.scenes, done), captured(options.captures, options.out, done)
        ):
            trials.append(trial)
            file.write(json.dumps(asdict(trial)) + "\n")
            file.flush()
            print(
                f"{trial.group}, {trial.name}, {trial.method}: {'right' if trial.right else 'wrong'}", file=sys.stderr
            )
    rows = table(trials)
    for row in rows:
        print(" | ".join(map(str, row)))
    if options.record:
        record(FOLDER / "tracking.json", rows)
    return 0 if any(trial.there and trial.right for trial in trials) else 1


def rendered(half: Half, shapes: int, scenes: int, done: set[tuple[str, str]]) -> Iterator[Trial]:
    """Yield trials on the cluttered table."""
    names = [one.recipe for one in SPECIMENS if one.half == half and one.symmetry in ("asymmetric", "near-symmetric")]
    names = [name for name in names[: 2 * shapes] if np.ptp(model_of(name).vertices_m[:, :2], axis=0).max() < _SMALL_M]
    for number, name in enumerate(names[:shapes]):
        sensor = Sensor(noise(VIEW.distance_m, VIEW))
        sought = Sought(model_of(name), Tracker(model_of(name), sensor, independent=True))
        for seed in range(1000 * number, 1000 * number + scenes):
            if ("table", f"{name} {seed}") in done:
                continue
            rng, absent = np.random.default_rng(seed), seed % 4 == 3
            others = tuple(str(one) for one in rng.choice([one for one in names if one != name], 3, replace=False))
            shown = scene(None if absent else name, others, seed, hidden=seed % 2 == 1)
            yield _trial("table", f"{name} {seed}", sought, shown.frame, shown.camera_from_model, shown.visible)
            if not absent:
                view = prepare(
                    replace(shown.frame, mask=shown.mask), Segmented(), sought.tracker.segmenter, sensor
                ).view
                if view is not None:
                    where = "table", f"{name} {seed}"
                    yield _baseline(*where, sought, view, shown.camera_from_model, shown.visible)


def captured(sequences: Sequence[Path], out: Path, done: set[tuple[str, str]]) -> Iterator[Trial]:
    """Yield trials in captures: the model of the even frames in the odd ones, and in frames of other captures."""
    opened = {path.name: open_sequence(path) for path in sequences}
    for name, whole in opened.items():
        even, all_frames = (_built(whole.select(every=step), out / f"{name}-{step}") for step in (2, 1))
        poses = {frame: pose.mean for frame, pose in poses_of(RunFolder(all_frames).result()).items()}
        first = min(poses_of(RunFolder(even).result()))
        for other, sequence in opened.items():
            thing = known_object(even)
            seen = thing.seen_by(sequence)
            parts = compose.modeler(seen, PriorOptions(prior="general"), MethodOptions(), ObjectOptions())
            segmented = compose.scene(parts, seen)
            sensor = parts.sensor.measured(segmented.range_noise)
            tracker = Tracker(thing.model, sensor, independent=True, segmenter=parts.segmenter, scene=segmented)
            sought = Sought(thing.model, tracker)
            own = other == name
            frames = sequence.indices[1::2] if own else sequence.indices[len(sequence.indices) // 2 :][:1]
            for index in frames:
                group, what = (
                    ("captures", f"{name} {index}") if own else ("other captures", f"{name} in {other} {index}")
                )
                if (group, what) in done or (own and not {index, first} <= poses.keys()):
                    continue
                truth = se3.inverse(poses[index]) @ poses[first] if own else None
                yield _trial(group, what, sought, seen.frame(index), truth, 1.0 if own else 0.0)
                view = prepare(seen.frame(index), segmented, parts.segmenter, sensor).view
                if view is not None:
                    yield _baseline(group, what, sought, view, truth, 1.0 if own else 0.0)


def _built(frames: AbstractSequence, run: Path) -> Path:
    """Return the run folder of a sequence, built unless it was."""
    if not (run / "model.ply").exists():
        modeler.build(frames, run, overwrite=True)
    return run


def _trial(group: str, name: str, sought: Sought, frame: Frame, truth: Array | None, visible: float) -> Trial:
    """Return what the tracker makes of a frame."""
    began_s = time.process_time()
    found = sought.tracker.update(frame)
    seconds = time.process_time() - began_s
    pose = None if found.pose is None else found.pose.mean
    nees = _nees(found, truth)
    return Trial(group, name, "modeler track", visible, pose is not None, found.usable,
                 *_errors(sought, pose, truth), nees, seconds)  # fmt: skip


def _baseline(group: str, name: str, sought: Sought, view: RayImage, truth: Array | None, visible: float) -> Trial:
    """Return what FPFH with RANSAC and ICP makes of a frame with its mask."""
    rng = np.random.default_rng(0)
    model = sought.model
    seen = np.ones(len(model.vertices_m), bool) if model.vertex_sigmas_m is None else np.isfinite(model.vertex_sigmas_m)
    drawn = SurfacePoints.draw(model.vertices_m, model.triangles[seen[model.triangles].all(axis=1)], _POINTS, rng)
    one, two, three = np.moveaxis(model.vertices_m[drawn.corners], 1, 0)
    normals = np.cross(two - one, three - one)
    cloud = Cloud(drawn.of(model.vertices_m), normals / np.linalg.norm(normals, axis=1, keepdims=True))
    began_s = time.process_time()
    method, clouds = FpfhIcpRegistrar(), (Cloud.of(view), cloud)
    coarse = method.fpfh.search(*clouds, np.eye(4), rng)
    fit = None if coarse is None else method.icp.refine(*clouds, coarse.target_from_source)
    seconds = time.process_time() - began_s
    there = fit is not None and fit.fitness > _FITNESS
    pose = se3.inverse(fit.target_from_source) if fit is not None and there else None
    return Trial(group, name, "fpfh-icp", visible, there, there, *_errors(sought, pose, truth), np.nan, seconds)


def _errors(sought: Sought, pose: Array | None, truth: Array | None) -> tuple[float, float, float]:
    """Return the errors of camera_from_model: in degrees, of the centre in m, MSSD in diameters; NaN without a pose."""
    if pose is None or truth is None:
        return np.nan, np.nan, np.nan
    turns = [np.eye(4)]
    if se3.rotation_angle(se3.inverse(pose) @ truth) > np.radians(_DEG):  # perhaps another turn of a symmetric model
        coloured = sought.tracker.symmetries.with_colour
        turns += list((coloured or sought.tracker.symmetries).discrete)
    angles = [float(se3.rotation_angle(se3.inverse(pose) @ truth @ turn)) for turn in turns]
    turned = truth @ turns[int(np.argmin(angles))]
    centre_m = sought.centre_m[None]
    off_m = float(np.linalg.norm(se3.transform(pose, centre_m) - se3.transform(turned, centre_m)))
    diameter_m = 2.0 * sought.tracker.renderer.radius_m
    return float(np.degrees(min(angles))), off_m, mssd_m(sought.model, pose, turned) / diameter_m


def _nees(found: Tracked, truth: Array | None) -> float:
    """Return the normalised estimation error squared over 6; NaN without a usable pose."""
    if found.pose is None or truth is None or not found.usable:
        return np.nan
    xi = se3.log(se3.inverse(found.pose.mean) @ truth)
    return float(xi @ np.linalg.solve(found.pose.covariance, xi)) / 6.0


def table(trials: Sequence[Trial]) -> list[list[str | float]]:
    """Return a row for each cell and method."""
    cells = {
        "table, at least 70 % visible": [t for t in trials if t.group == "table" and t.visible >= 0.7],
        "table, 40 to 70 % visible": [t for t in trials if t.group == "table" and 0.4 <= t.visible < 0.7],
        "table, absent": [t for t in trials if t.group == "table" and t.visible == 0.0],
        "captures, odd frames": [t for t in trials if t.group == "captures"],
        "captures, absent": [t for t in trials if t.group == "other captures"],
    }
    rows: list[list[str | float]] = []
    for name, cell in cells.items():
        for method in ("modeler track", "fpfh-icp"):
            mine = [trial for trial in cell if trial.method == method]
            if mine:
                rows.append([f"{name}, `{method}`", *_figures(mine)])
    return rows


def _figures(trials: Sequence[Trial]) -> list[str | float]:
    """Return the figures of a row."""
    seconds = f"{np.median([trial.seconds for trial in trials]):.1f}"
    if trials[0].visible == 0.0:
        said = sum(trial.there for trial in trials)
        return [len(trials), "", "", "", "", "", f"{said}", seconds]
    count, right = len(trials), [trial for trial in trials if trial.right]
    usable, nees = [t for t in trials if t.usable], [t.nees for t in trials if np.isfinite(t.nees)]
    inside = np.mean([6.0 * one < stats.chi2.ppf(0.95, 6) for one in nees]) if nees else np.nan
    return [
        count,
        f"{100.0 * len(right) / count:.0f} %",
        f"{100.0 * np.mean([trial.there and trial.mssd < _MSSD for trial in trials]):.0f} %",
        f"{np.median([t.error_deg for t in right]):.2f}°, {1000.0 * np.median([t.error_m for t in right]):.1f} mm"
        if right
        else "",
        f"{np.mean(nees):.2f}, {100.0 * inside:.0f} %" if nees else "",
        f"{sum(trial.right for trial in usable)} of {len(usable)}",
        f"{sum(not trial.there for trial in trials)}",
        seconds,
    ]


if __name__ == "__main__":
    sys.exit(main())
