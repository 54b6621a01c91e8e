"""Folders of the TUM RGB-D benchmark, and trajectories in its format."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.sequences.image_files import MASK_SUFFIXES, depth_size
from modeler.sequences.image_folders import (
    MASK_FOLDERS,
    OCCLUDER_FOLDERS,
    FrameFiles,
    ImageFolderSequence,
    images_within,
)
from modeler.sequences.input_files import is_there, listed, read_text
from modeler.sequences.intrinsics import CameraFacts, Overrides, find_intrinsics
from modeler.sequences.recording import paired
from modeler.types import Array, InputError

CALIBRATION = (525.0, 525.0, 319.5, 239.5)
"""Intrinsics recommended by the benchmark for its images of 640 x 480, which come without intrinsics."""


def open_tum(path: Path, overrides: Overrides) -> ImageFolderSequence:
    """Open a folder with `depth.txt`, and perhaps `rgb.txt`, `groundtruth.txt`, `mask/` and `mask_hand/`."""
    depth = _list(path / "depth.txt", 2)
    if not depth:
        raise InputError(f"{path / 'depth.txt'}: lists no depth image; write lines 'time path'.")
    colour = _list(path / "rgb.txt", 2) if is_there(path / "rgb.txt") else []
    masks, occluders = (images_within(path, names, MASK_SUFFIXES) for names in (MASK_FOLDERS, OCCLUDER_FOLDERS))
    pairs, remarks = paired(depth, colour)
    files: dict[int, FrameFiles] = {}
    for index, pair in pairs.items():
        image = listed(path / "depth.txt", pair.depth[0])
        colour_path = None if pair.colour is None else listed(path / "rgb.txt", pair.colour[0])
        mask, occluder = (
            some.get(image.stem) or (None if colour_path is None else some.get(colour_path.stem))
            for some in (masks, occluders)
        )
        files[index] = FrameFiles(pair.time_s, image, colour_path, mask, occluder)
    used = {path for one in files.values() for path in (one.mask, one.occluder)}
    for what, images in (("masks", masks), ("masks of hands", occluders)):
        strange = [image.name for image in images.values() if image not in used]
        if strange:
            remarks.append(
                f"{len(strange)} of {len(images)} {what} belong to no depth image and are left out ({strange[0]}; give "
                "each the name of its depth image)"
            )
    found, (width, height) = find_intrinsics(path, overrides), depth_size(files[0].depth)
    if found is None:
        if (width, height) != (640, 480):
            raise InputError(
                f"{path}: no intrinsics for images of {width} x {height}; write `fx fy cx cy` into calibration.txt "
                "there, or convert with `intrinsics` FX FY CX CY."
            )
        found = CameraFacts(CALIBRATION, "the benchmark")
        remarks.append("no intrinsics: the benchmark's default of 525 525 319.5 239.5 px is assumed")
    remarks += found.remarks((width, height))
    unit_mm, who = found.unit(overrides, (0.2, "the benchmark's, 5000 per m"))
    return ImageFolderSequence(
        path,
        files=files,
        camera=found,
        depth_scale_mm=unit_mm,
        what="TUM RGB-D folder",
        unit_source=who,
        read_truth=lambda: _tum_truth(path / "groundtruth.txt", [time for time, _ in depth]),
        remarks=tuple(remarks),
        calibrated=found.calibrated,
        kind="tof" if found.of_phone else None,
    )


def trajectory(path: Path) -> list[tuple[float, Array]]:
    """Return times in s and poses (4, 4) in m of a file with lines `time tx ty tz qx qy qz qw`."""
    poses = []
    for time_s, words in _list(path, 8):
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = [math.nan]
        bounded = all(abs(value) < 1e6 for value in values)  # not so of NaN
        if not bounded or abs(float(np.linalg.norm(values[3:])) - 1.0) > 1e-2:
            raise InputError(
                f"{path}: time {time_s:.6f} has no pose; write tx ty tz and a unit quaternion qx qy qz qw."
            )
        poses.append((time_s, se3.rigid(Rotation.from_quat(values[3:]).as_matrix(), np.array(values[:3]))))
    return poses


def _tum_truth(path: Path, times_s: Sequence[float]) -> dict[int, Array] | None:
    """Return camera_from_world by frame number, on the way between the two nearest poses in time."""
    if not is_there(path):
        return None
    known = trajectory(path)
    stamps = np.array([time for time, _ in known])
    found: dict[int, Array] = {}
    for index, time_s in enumerate(times_s):
        after = int(np.searchsorted(stamps, time_s))
        if after < len(stamps) and stamps[after] == time_s:
            found[index] = se3.inverse(known[after][1])
        elif 0 < after < len(stamps) and stamps[after] - stamps[after - 1] <= 0.2:  # s
            (before_s, before), (after_s, behind) = known[after - 1], known[after]
            share = (time_s - before_s) / (after_s - before_s)
            found[index] = se3.inverse(before @ se3.exp(share * se3.log(se3.inverse(before) @ behind)))
    return found or None


def _list(path: Path, words: int) -> list[tuple[float, list[str]]]:
    """Return the time and the other words of each line that is no comment."""
    lines: list[tuple[float, list[str]]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        time, *rest = line.replace(",", " ").split() if words > 2 else line.split(maxsplit=1)
        try:
            time_s = float(time)
        except ValueError:
            time_s = math.nan
        if len(rest) != words - 1 or not math.isfinite(time_s):
            raise InputError(f"{path}: line {number} is not a time and {words - 1} more; correct it there.")
        if lines and time_s <= lines[-1][0]:
            how = "is the same as" if time_s == lines[-1][0] else "comes before"
            raise InputError(f"{path}: line {number}: its time {how} that of the line above; sort, and remove doubles.")
        lines.append((time_s, rest))
    return lines
