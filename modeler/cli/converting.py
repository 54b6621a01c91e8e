"""What `modeler convert` does once it is understood."""

from __future__ import annotations

import json
from pathlib import Path

from modeler import se3
from modeler.cli.convert import Convert
from modeler.cli.input_options import InputOptions
from modeler.cli.options import FrameOptions
from modeler.cli.reading import reading, while_it_lasts
from modeler.cli.saying import say
from modeler.export import RunFolder, poses_of
from modeler.export.files import write_atomically
from modeler.export.tum import tum_text
from modeler.types import InputError
from sequences import AbstractSequence, SensedSequence, frame_range, open_sequence, read_noise, survey, write_bop
from sequences.bop.entries import pose_entry

UNITS_MM = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 10.0)
"""Depth is written in the finest of these in which it fits into 16 bits."""

LIVE_REACH_M = 16.0
"""What lies farther away of what a live camera sees is an error of its."""


def convert(options: Convert) -> int:
    """Write an input as a BOP scene folder, or the poses of a run.

    Raises:
        InputError: where the input cannot be used or the output cannot be written.
    """
    if (options.input / "report.json").is_file():
        if options.sensor is not None or options.selection != FrameOptions() or options.given != InputOptions():
            raise InputError(f"{options.input}: the poses of a run are written as they are; leave out other options")
        return _poses(options.input, options.out)
    if options.out.suffix in (".json", ".txt"):
        raise InputError(f"{options.input}: is no folder of a run, whose poses {options.out} could hold; give one")
    whole = open_sequence(options.input, options.given.stated())
    whole = whole if options.sensor is None else SensedSequence(whole, read_noise(options.sensor))
    kept = frame_range(options.selection.frames)
    sequence = whole.select(options.selection.every, kept)
    if sequence.live and kept.stop is None:
        raise InputError(f"{options.input}: has no end; say how many frames to record, for instance --frames :30.")
    with reading() as watched:
        found = survey(watched(sequence.recorded(), "reading"))
        farthest_m = LIVE_REACH_M if sequence.live else found.farthest_m
        unit_mm = next((unit for unit in UNITS_MM if farthest_m * 1000.0 < 65535.0 * unit), UNITS_MM[-1])
        write_bop(
            options.out,
            while_it_lasts(sequence) if sequence.live else watched(sequence, "writing"),
            sequence.truth(),
            _meta(sequence),
            depth_scale_mm=unit_mm,
            files={
                path.name: path.read_bytes() for path in (sequence.robot_path, sequence.model_path) if path is not None
            },
        )
    say(f"{len(open_sequence(options.out))} frames ({sequence.layout}): {options.out}")
    for note in (*found.doubts, *sequence.notes):
        say(note)
    return 0


def _meta(sequence: AbstractSequence) -> dict[str, object]:
    """Return the entries of `sequence.json`."""
    meta: dict[str, object] = {"name": sequence.name}
    noise, motion = sequence.sensor(), sequence.motion
    if noise is not None:
        meta["sensor"] = {"sigma_wh": noise[0], "sigma_r_m": noise[1]}
    if motion is not None:
        meta["motion"] = dict(motion)
    return meta


def _poses(run: Path, out: Path) -> int:
    """Write the poses of a run as BOP's scene_gt.json, with the object frame as model frame, or as TUM lines.

    Raises:
        InputError: where the report cannot be read or the file's ending says neither.
    """
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
