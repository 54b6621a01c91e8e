"""`modeler info`, `convert` and `render`: inputs described, and written as sequences; poses for other programs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from modeler.cli.console import as_options, say
from modeler.cli.options import FrameOptions, InputOptions
from modeler.composition.options import SEED, default

if TYPE_CHECKING:
    from modeler.sequences import AbstractSequence, Survey
    from modeler.types import Camera, SensorNoise


@dataclass(frozen=True)
class Convert:
    """Write any input as a BOP scene folder, the native layout; or the poses of a run for other programs.

    Of a run folder as INPUT, it writes the poses: as scene_gt.json (BOP) if OUT ends in .json, as a TUM trajectory if
    it ends in .txt.
    """

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """A sequence in any supported format, or a run folder."""
    out: Annotated[Path, tyro.conf.arg(metavar="OUT")]
    """BOP scene folder to create; scene_gt.json or poses.txt for a run."""
    overwrite: bool = False
    """Replace an existing file of poses; a folder is never replaced."""
    sensor: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("from INPUT")] = None
    """Noise of the depth camera, as `modeler calibrate-sensor` measured it, to write into sequence.json."""
    camera: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("from INPUT")] = None
    """Focal length of the depth camera, as `modeler calibrate-camera` estimated it."""
    selection: FrameOptions = field(default_factory=FrameOptions)
    given: InputOptions = field(default_factory=InputOptions)

    def run(self) -> int:
        """Write the input as a BOP scene folder, or the poses of a run."""
        from modeler.cli.reading import reading, while_it_lasts
        from modeler.runs.outputs import check_files, check_folder, run_inputs
        from modeler.runs.reopening import calibrated
        from modeler.sequences import finest_unit_mm, frame_range, open_sequence, scene_meta, survey, write_bop
        from modeler.sequences.live import REACH_M
        from modeler.system.regular_files import read_regular
        from modeler.types import InputError

        if (self.input / "report.json").is_file():
            if self.sensor or self.camera or self.selection != FrameOptions() or self.given != InputOptions():
                raise InputError(f"{self.input}: the poses of a run are written as they are; leave out other options")
            check_files([self.out], run_inputs([self.input]), overwrite=self.overwrite)
            return _poses(self.input, self.out)
        if self.out.suffix in (".json", ".txt"):
            raise InputError(f"{self.input}: is not a run folder with poses for {self.out}; give a run folder")
        check_folder(self.out, [path for path in (self.input, self.sensor, self.camera) if path is not None])
        whole = open_sequence(self.input, self.given.overrides())
        whole = calibrated(whole, self.sensor, self.camera)
        kept = frame_range(self.selection.frames)
        sequence = whole.select(self.selection.every, kept)
        if sequence.live and kept.stop is None:
            raise InputError(
                f"{self.input}: has no end; limit the number of frames to record, for instance --frames :30."
            )
        with reading() as watched:
            found = survey(watched(sequence.recorded(), "reading"))
            found.check(sequence.name, despite_doubts=self.given.despite_doubts)
            farthest_m = REACH_M if sequence.live else found.farthest_m
            unit_mm = finest_unit_mm(farthest_m)
            write_bop(
                self.out,
                while_it_lasts(sequence) if sequence.live else watched(sequence, "writing"),
                sequence.truth(),
                scene_meta(sequence),
                depth_scale_mm=unit_mm,
                files={
                    path.name: read_regular(path)
                    for path in (sequence.robot_path, sequence.model_path)
                    if path is not None
                },
            )
        say(f"{len(open_sequence(self.out))} frames ({sequence.layout}): {self.out}")
        for note in (*found.doubts, *sequence.notes):
            say(note)
        return 0


def _poses(run: Path, out: Path) -> int:
    """Write the poses of a run as BOP's scene_gt.json, with the object frame as model frame, or as TUM lines."""
    from modeler import se3
    from modeler.export import RunFolder, poses_of, tum_text, write_atomically
    from modeler.sequences.bop import pose_entry
    from modeler.system.regular_files import json_lines
    from modeler.types import InputError

    report = RunFolder(run).result()
    poses = {frame: pose.mean for frame, pose in poses_of(report).items()}
    if out.suffix == ".json":
        entries = {str(index): [pose_entry(se3.inverse(pose))] for index, pose in poses.items()}
        write_atomically(out, json_lines(entries))
    elif out.suffix == ".txt":
        write_atomically(out, tum_text(poses, {frame["id"]: frame["timestamp"] for frame in report["frames"]}))
    else:
        raise InputError(f"{out}: poses are written as scene_gt.json (BOP) or .txt (TUM); give --out such a name.")
    say(f"{len(poses)} poses: {out}")
    return 0


@dataclass(frozen=True)
class Render:
    """Render a synthetic sequence, with its ground truth, from a recipe."""

    recipe: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RECIPE")]
    """Recipe in JSON or TOML, or the name of a built-in one: box, flashlight, tube and more."""
    out: Annotated[Path, tyro.conf.arg(metavar="SEQUENCE")]
    """BOP scene folder to create."""
    seed: Annotated[int | None, SEED, default("the recipe's own")] = None
    """Seed of the camera's noise and of the object's motion."""

    def run(self) -> int:
        """Render the sequence."""
        from modeler.cli.reading import reading
        from modeler.runs.outputs import check_folder
        from modeler.sequences.rendering import render
        from modeler.sequences.rendering.recipe import load_recipe

        check_folder(self.out, [Path(self.recipe)])
        recipe = load_recipe(self.recipe)
        with reading() as watched:
            render(recipe if self.seed is None else replace(recipe, seed=self.seed), self.out, watched)
        return 0


@dataclass(frozen=True)
class Info:
    """Describe the input at a path: format, frames, resolution, depth, intrinsics, masks, colour, what is missing.

    Every frame is read once, so that the output covers the whole input.
    """

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """A sequence in any format that `modeler build` takes; the format is detected from the path."""
    json: bool = False
    """Print a JSON object instead of lines."""
    picture: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png"), default("none")] = None
    """Write a picture of the first and the middle frame: depth, its edges over colour, and the mask."""
    given: InputOptions = field(default_factory=InputOptions)

    def run(self) -> int:
        """Print what was found."""
        from modeler.cli.reading import reading
        from modeler.runs.outputs import check_files
        from modeler.sequences import open_sequence, survey
        from modeler.sequences.survey import write_picture

        if self.picture is not None:
            check_files([self.picture], [self.input], overwrite=True)
        sequence = open_sequence(self.input, self.given.overrides())
        with reading() as watched:
            found = survey(watched(sequence.recorded(), "reading"))
        doubts = [*found.doubts, *of_the_scene(sequence)]
        if self.picture is not None:
            middle = sequence.indices[len(sequence.indices) // 2]
            write_picture(self.picture, [sequence.frame(index) for index in (sequence.indices[0], middle)])
        if self.json:
            print(as_options(json.dumps(record(sequence, found, doubts), allow_nan=False)))
        else:
            print(as_options("\n".join(f"{what:14}{said}" for what, said in rows(sequence, found, doubts))))
        return 0


def of_the_scene(sequence: AbstractSequence) -> list[str]:
    """Return what may be wrong with how the object was captured, in words."""
    from modeler.composition import compose
    from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
    from modeler.segmentation import scene_frames
    from modeler.types import Outcome

    modeler = compose.modeler(sequence, PriorOptions(prior="general"), MethodOptions(), ObjectOptions())
    scene, frames = compose.scene(modeler, sequence), scene_frames(sequence.indices)
    outcomes = {index: modeler.segmenter.segment(sequence.frame(index), scene).outcome for index in frames}
    doubts = list(scene.doubts)
    for outcome, what in (
        (Outcome.CUT_OFF, "the image cuts off the object: keep it in view, with a margin"),
        (Outcome.TOO_FEW_POINTS, "no object is found: give masks, `roi` or `max_depth_m`"),
    ):
        some = [str(index) for index, each in outcomes.items() if each is outcome]
        if some:
            doubts.append(f"in {len(some)} of {len(frames)} frames looked at ({', '.join(some)}) {what}")
    return doubts


def record(sequence: AbstractSequence, found: Survey, doubts: Sequence[str]) -> dict[str, object]:
    """Return the results as JSON values."""
    camera, sensor, motion = found.cameras[0], sequence.sensor(), sequence.motion
    return {
        "name": sequence.name,
        "format": sequence.layout,
        "frames": list(found.indices),
        "seconds": found.times_s[-1] - found.times_s[0],
        "resolution": [camera.width, camera.height],
        "resolutions": [list(size) for size in _sizes(found.cameras)],
        "intrinsics": [[c.fx, c.fy, c.cx, c.cy] for c in found.cameras],
        "depth_unit": sequence.depth_unit,
        "depth_m": dict(zip(("1%", "50%", "99%"), found.range_m, strict=True)),
        "measured": found.measured,
        "masks": found.masks,
        "colour": found.colours,
        "ground_truth": found.truths,
        "sensor": None if sensor is None else sensor._asdict(),
        "motion": None if motion is None else dict(motion),
        "missing": list(found.missing),
        "notes": [*doubts, *sequence.notes],
    }


def rows(sequence: AbstractSequence, found: Survey, doubts: Sequence[str]) -> list[tuple[str, str]]:
    """Return the results as (name, words)."""
    from modeler.sequences.base import span

    total = len(found.indices)
    low, middle, high = found.range_m
    sensor, motion = sequence.sensor(), sequence.motion
    timed = (
        f", {found.times_s[-1] - found.times_s[0]:.3g} s" if found.times_s != tuple(map(float, found.indices)) else ""
    )
    lines = [
        ("sequence", sequence.name),
        ("format", sequence.layout),
        ("frames", span(found.indices) + timed),
        ("resolution", ", ".join(f"{width} x {height}" for width, height in _sizes(found.cameras)[:4])),
        ("intrinsics", _intrinsics(found.cameras)),
        ("focal length", _known(sensor)),
        ("depth unit", sequence.depth_unit),
        (
            "depth range",
            f"{low:.3f} to {high:.3f} m, median {middle:.3f} m; {found.measured:.0%} of the pixels measured",
        ),
        ("masks", f"{found.masks} of {total}"),
        ("colour", f"{found.colours} of {total}"),
        ("ground truth", f"{found.truths} of {total}"),
    ]
    if sensor is not None and sensor.sigma_r_m is not None:
        noise = f"{sensor.sigma_wh:.3g} across (w, h), {sensor.sigma_r_m * 1000.0:.3g} mm along the ray"
        lines.append(("sensor noise", noise))
    if sensor is not None and sensor.sigma_multipath > 0.0:
        words = f"{sensor.sigma_multipath:.0%} of the object's size (sd), by light from other surfaces: time of flight"
        lines.append(("smooth errors", words))
    if motion is not None:
        lines.append(("motion", ", ".join(f"{key} {value}" for key, value in motion.items())))
    lines += [("doubt", what) for what in doubts]
    lines += [("missing", what) for what in found.missing]
    lines += [("note", note) for note in sequence.notes]
    if doubts or sequence.notes:
        override = "--intrinsics, --depth-scale-mm, --along-ray and --despite-doubts, here as for build and convert"
        lines.append(("to override", override))
    return lines


def _sizes(cameras: tuple[Camera, ...]) -> list[tuple[int, int]]:
    """Return (width, height) of the images, each once."""
    return list(dict.fromkeys((camera.width, camera.height) for camera in cameras))


def _known(sensor: SensorNoise | None) -> str:
    """Return how well a focal length is known, and why."""
    from modeler.types import CALIBRATED_FOCAL, NOMINAL_FOCAL

    sigma_focal = NOMINAL_FOCAL if sensor is None else sensor.sigma_focal
    if sigma_focal == 0.0:
        return "exact"
    source = {NOMINAL_FOCAL: ", as nobody says more", CALIBRATED_FOCAL: ", by a calibration of this camera"}
    return f"known to {100.0 * sigma_focal:.2g} % (sd){source.get(sigma_focal, '')}"


def _intrinsics(cameras: tuple[Camera, ...]) -> str:
    first = cameras[0]
    words = f"fx {first.fx:.2f}, fy {first.fy:.2f}, cx {first.cx:.2f}, cy {first.cy:.2f} px"
    return words if len(cameras) == 1 else f"{words} in the first frame; {len(cameras)} different ones"
