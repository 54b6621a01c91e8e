"""`modeler convert` and `modeler render`: any input or a recipe as a sequence, and results for other programs."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.console import say
from modeler.cli.options import FrameOptions, InputOptions
from modeler.composition.options import SEED, default


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
    from modeler.types import InputError

    report = RunFolder(run).result()
    poses = {frame: pose.mean for frame, pose in poses_of(report).items()}
    if out.suffix == ".json":
        lines = (f' "{index}": {json.dumps([pose_entry(se3.inverse(pose))])}' for index, pose in poses.items())
        write_atomically(out, "{\n" + ",\n".join(lines) + "\n}\n")
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
        from modeler.sequences.rendering.recipe import load_recipe
        from modeler.sequences.rendering.renderer import render

        check_folder(self.out, [Path(self.recipe)])
        recipe = load_recipe(self.recipe)
        with reading() as watched:
            render(recipe if self.seed is None else replace(recipe, seed=self.seed), self.out, watched)
        return 0
