"""Folders of depth and colour images: TUM RGB-D, Open3D, BundleSDF and similar layouts."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.sequences.image_files import (
    check_same_size,
    check_size,
    image_size,
    is_finer,
    metres,
    no_depth,
    object_and_occluder,
    read_colour,
    read_depth,
    read_labels,
    read_mask,
    resize_to_depth,
)
from modeler.sequences.input_files import (
    check_link,
    entries,
    first_folder,
    frame_number,
    is_there,
    list_images,
    read_text,
)
from modeler.sequences.intrinsics import CameraFacts, Intrinsics, Overrides, find_intrinsics
from modeler.sequences.recording import AbstractRecording, paired
from modeler.types import Array, Camera, Frame, InputError


@final
@dataclass(frozen=True)
class FrameFiles:
    """Files of one frame."""

    time_s: float
    """Time of capture in s."""
    depth: Path
    """16-bit image."""
    colour: Path | None = None
    """Colour aligned to depth, in its size or finer."""
    mask: Path | None = None
    """Non-zero = object, `OCCLUDED` = something before it."""
    occluder: Path | None = None
    """Non-zero = something before the object."""


@final
@dataclass(frozen=True)
class ImageFolderSequence(AbstractRecording):
    """Image files of one camera."""

    files: Mapping[int, FrameFiles]
    """By frame number, ascending."""
    intrinsics: Intrinsics
    """fx, fy, cx, cy in px."""
    depth_scale_mm: float
    """Millimetres per unit of depth."""
    what: str
    """Storage format, for people."""
    unit_source: str
    """Source of the unit."""
    read_truth: Callable[[], dict[int, Array] | None] = lambda: None
    """Reads the true camera_from_model (4, 4) in m by frame number, when it is asked for."""
    remarks: tuple[str, ...] = ()
    """Assumptions and omissions of the reader."""

    def __post_init__(self) -> None:
        """Check `sequence.json`.

        Raises:
            InputError: if it cannot be used.
        """
        _ = self.name, self.sensor(), self.motion

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers, ascending."""
        return tuple(self.files)

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`, depth in m and NaN where nothing was measured."""
        files = self.files.get(index)
        if files is None:
            raise self.absent(index)
        raw = read_depth(files.depth)
        first = self.files[self.indices[0]].depth
        check_same_size(files.depth, raw.shape, first, "and one camera took them all; convert each size by itself")
        labels = None if files.mask is None else read_labels(files.mask)
        occluder = None if files.occluder is None else read_mask(files.occluder)
        colour = None if files.colour is None else read_colour(files.colour)
        for path, image in ((files.mask, labels), (files.occluder, occluder)):
            if path is not None and image is not None:
                check_size(path, image.shape, raw.shape)
        if files.colour is not None and colour is not None:
            colour = resize_to_depth(files.colour, colour, raw.shape)
        camera = Camera(raw.shape[1], raw.shape[0], *self.intrinsics)
        mask, occluder = (None, occluder) if labels is None else object_and_occluder(labels, occluder)
        return Frame(index, files.time_s, metres(raw, self.depth_scale_mm), camera, mask, colour, occluder)

    def truth(self) -> dict[int, Array] | None:
        """Return the true camera_from_model (4, 4), in m, by frame number; None if it is not known."""
        return self.read_truth()

    @property
    def layout(self) -> str:
        """Format of the sequence."""
        return self.what

    @property
    def depth_unit(self) -> str:
        """Unit of stored depth."""
        return f"{self.depth_scale_mm:g} mm ({self.unit_source})"

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions and omissions of the reader."""
        coloured = next((files for files in self.files.values() if files.colour is not None), None)
        if coloured is None or coloured.colour is None:
            return self.remarks
        colour, depth = image_size(coloured.colour), image_size(coloured.depth)
        if not is_finer(colour, depth):
            return self.remarks
        sizes = f"{colour[0]} x {colour[1]} where depth is {depth[0]} x {depth[1]}"
        return (*self.remarks, f"colour is {sizes}: it is shrunk, and taken for the depth camera's view")


UNIT_MM = 0.2
"""The benchmark stores 5000 units per metre."""
CALIBRATION = (525.0, 525.0, 319.5, 239.5)
"""Intrinsics recommended by the benchmark for its images of 640 x 480, which come without intrinsics."""
FARTHEST_M = 1e6
"""Largest plausible coordinate of a camera in m."""
MAX_GAP_S = 0.2
"""Ground truth is not interpolated over longer gaps."""


def open_tum(path: Path, overrides: Overrides) -> ImageFolderSequence:
    """Open a folder with `depth.txt` and, where they are there, `rgb.txt`, `groundtruth.txt`, `mask/` and `mask_hand/`.

    Raises:
        InputError: if it is not readable as such.
    """
    depth = _list(path / "depth.txt", 2)
    if not depth:
        raise InputError(f"{path / 'depth.txt'}: lists no depth image; write lines 'time path'.")
    colour = _list(path / "rgb.txt", 2) if is_there(path / "rgb.txt") else []
    folder = first_folder(path, ("mask", "masks"))
    masks = {} if folder is None else list_images(folder, (".png",))
    occluding = first_folder(path, OCCLUDER_FOLDERS)
    occluders = {} if occluding is None else list_images(occluding, (".png",))
    pairs, remarks = paired(depth, colour)
    files: dict[int, FrameFiles] = {}
    for index, pair in pairs.items():
        image = _listed(path, "depth.txt", pair.depth[0])
        colour_path = None if pair.colour is None else _listed(path, "rgb.txt", pair.colour[0])
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
    found, (width, height) = find_intrinsics(path, overrides), image_size(files[0].depth)
    if found is None:
        if (width, height) != (640, 480):
            raise InputError(
                f"{path}: no intrinsics for images of {width} x {height}; write `fx fy cx cy` into calibration.txt "
                "there, or convert with --intrinsics FX FY CX CY."
            )
        found = CameraFacts(CALIBRATION, "the benchmark")
        remarks.append("no intrinsics: the benchmark's default of 525 525 319.5 239.5 px is assumed")
    remarks += found.doubts((width, height))
    unit_mm, who = found.unit(overrides, (UNIT_MM, "the benchmark's, 5000 per m"))
    return ImageFolderSequence(
        path,
        files=files,
        intrinsics=found.intrinsics,
        depth_scale_mm=unit_mm,
        what="TUM RGB-D folder",
        unit_source=who,
        read_truth=lambda: _tum_truth(path / "groundtruth.txt", [time for time, _ in depth]),
        remarks=tuple(remarks),
    )


def trajectory(path: Path) -> list[tuple[float, Array]]:
    """Return times in s and poses (4, 4) in m of a file with lines `time tx ty tz qx qy qz qw`.

    Raises:
        InputError: if a line says something else, or times do not grow.
    """
    poses = []
    for time_s, words in _list(path, 8):
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = [math.nan]
        bounded = all(abs(value) < FARTHEST_M for value in values)  # not so of NaN
        if not bounded or abs(float(np.linalg.norm(values[3:])) - 1.0) > 1e-2:
            raise InputError(
                f"{path}: time {time_s:.6f} has no pose; write tx ty tz and a unit quaternion qx qy qz qw."
            )
        pose = se3.translation(np.array(values[:3]))
        pose[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
        poses.append((time_s, pose))
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
        elif 0 < after < len(stamps) and stamps[after] - stamps[after - 1] <= MAX_GAP_S:
            (before_s, before), (after_s, behind) = known[after - 1], known[after]
            share = (time_s - before_s) / (after_s - before_s)
            found[index] = se3.inverse(before @ se3.exp(share * se3.log(se3.inverse(before) @ behind)))
    return found or None


def _list(path: Path, words: int) -> list[tuple[float, list[str]]]:
    """Return the time and the other words of each line that is no comment.

    Raises:
        InputError: if a line has too few words or no time, or times do not grow.
    """
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


def _listed(root: Path, by: str, name: str) -> Path:
    """Return an image file named in a list.

    Raises:
        InputError: if there is none, or its name leads out of the sequence.
    """
    name = name.strip()
    if not name.isprintable():
        raise InputError(f"{root / by}: names an image with control characters; correct it there.")
    path = root / name
    if Path(name).is_absolute() or ".." in Path(name).parts:
        check_link(path, root)
    if not is_there(path):
        raise InputError(f"{root / by}: names {name}, which is not there; add the image or remove the line.")
    return path


COLOUR_FOLDERS = ("color", "rgb", "colour", "image")
MASK_FOLDERS = ("masks", "mask")
OCCLUDER_FOLDERS = ("mask_hand", "masks_hand")
POSES = "annotated_poses"


def open_colour_depth(path: Path, overrides: Overrides) -> ImageFolderSequence:
    """Open a folder with `depth/` and intrinsics, and where they are there, colour, masks and masks of hands.

    Depth is in mm unless the file of intrinsics or the user gives another unit, as in both programs.

    Raises:
        InputError: if it is not readable as such.
    """
    depth = list_images(path / "depth", (".png", ".tif", ".tiff"))
    if not depth:
        raise no_depth(path / "depth", "16-bit PNG or TIFF images")
    found = find_intrinsics(path, overrides)
    if found is None:
        raise InputError(
            f"{path}: no intrinsics; add camera.json with fx, fy, cx and cy in px, cam_K.txt (three rows of K), "
            "camera_intrinsic.json (Open3D's) or scene_camera.json (BOP's), or convert with --intrinsics FX FY CX CY."
        )
    numbers = frame_numbers(list(depth)) or {stem: place for place, stem in enumerate(depth)}
    remarks = found.doubts(image_size(next(iter(depth.values()))))
    colour, left = _partners(path, COLOUR_FOLDERS, (".png", ".jpg", ".jpeg"), depth)
    masks, left_masks = _partners(path, MASK_FOLDERS, (".png",), depth)
    occluders, left_occluders = _partners(path, OCCLUDER_FOLDERS, (".png",), depth)
    for what, partners in (("colour image", colour), ("mask", masks)):  # not every frame has a hand
        lacking = sum(stem not in partners for stem in depth)
        if partners and lacking:
            remarks.append(f"{lacking} of {len(depth)} depth images have no {what}")
    for what, others in (("colour images", left), ("masks", left_masks), ("masks of hands", left_occluders)):
        if others:
            remarks.append(f"{len(others)} {what} belong to no depth image and are left out ({others[0]})")
    files = {
        numbers[stem]: FrameFiles(
            _time_s(stem, numbers[stem]), image, colour.get(stem), masks.get(stem), occluders.get(stem)
        )
        for stem, image in depth.items()
    }
    unit_mm, who = found.unit(overrides, (1.0, "the default"))
    return ImageFolderSequence(
        path,
        files=dict(sorted(files.items())),
        intrinsics=found.intrinsics,
        depth_scale_mm=unit_mm,
        what=_layout(path),
        unit_source=who,
        read_truth=lambda: _posed_truth(path, numbers),
        remarks=tuple(remarks),
    )


def _layout(path: Path) -> str:
    """Return the name of a folder's layout."""
    if (path / "cam_K.txt").exists() and first_folder(path, (*MASK_FOLDERS, POSES)) is not None:
        return "BundleSDF folder"
    return "Open3D folder" if (path / "camera_intrinsic.json").exists() else "folder of pictures"


def frame_numbers(stems: list[str]) -> dict[str, int] | None:
    """Parse frame numbers: whole names, leading digits, or the only digits that differ; None if ambiguous."""
    for numbered in (stems, [re.split(r"[^0-9]", stem)[0] for stem in stems], _differences(stems)):
        numbers = [frame_number(stem) for stem in numbered]
        known = [number for number in numbers if number is not None]
        if len(set(known)) == len(stems):
            return dict(zip(stems, known, strict=True))
    return None


def _differences(stems: list[str]) -> list[str]:
    """Return the digits in which names such as `depth_9` and `depth_10` differ, if nothing else does."""
    rows = [re.split(r"([0-9]+)", stem) for stem in stems]
    if len({len(row) for row in rows}) != 1:
        return []
    differ = [place for place, words in enumerate(zip(*rows, strict=True)) if len(set(words)) > 1]
    counted = len(differ) == 1 and differ[0] % 2 == 1 and rows[0][differ[0] - 1] != "."  # which begins a fraction
    return [row[differ[0]] for row in rows] if counted else []


def _time_s(stem: str, number: int) -> float:
    """Return the time in s of a name that is a time stamp in ns; else the frame number."""
    return int(stem) * 1e-9 if stem.isascii() and stem.isdigit() and 16 <= len(stem) <= 19 else float(number)


def _partners(
    root: Path, names: tuple[str, ...], suffixes: tuple[str, ...], depth: Mapping[str, Path]
) -> tuple[dict[str, Path], list[str]]:
    """Return the images of a folder by the name of the depth image to which they belong, and the names of the others.

    Raises:
        InputError: if neither names nor numbers nor order match them.
    """
    folder = first_folder(root, names)
    if folder is None:
        return {}, []
    found = list_images(folder, suffixes)
    same = {stem: found[stem] for stem in depth if stem in found}
    ours, theirs = frame_numbers(list(depth)) or {}, frame_numbers(list(found)) or {}
    named = {number: stem for stem, number in theirs.items()}
    alike = {stem: found[named[number]] for stem, number in ours.items() if number in named}
    best = alike if len(alike) > len(same) else same
    if best or not found:
        used = set(best.values())
        return best, [path.name for path in found.values() if path not in used]
    if len(found) == len(depth):  # names are times of two clocks
        return dict(zip(depth, found.values(), strict=True)), []
    raise InputError(
        f"{folder}: its {len(found)} images cannot be matched with the {len(depth)} depth images; "
        "give those of one frame the same name."
    )


def _posed_truth(root: Path, numbers: Mapping[str, int]) -> dict[int, Array] | None:
    """Return camera_from_model by frame number from BundleSDF's or Open3D's pose files; None without."""
    posed = {path.stem: path for path in entries(root / POSES) if path.suffix == ".txt"}
    if posed:
        found = {number: _pose(posed[stem]) for stem, number in numbers.items() if stem in posed}
        return dict(sorted(found.items())) or None
    log = next((path for path in (root / "trajectory.log", root / "scene" / "trajectory.log") if is_there(path)), None)
    if log is None:
        return None
    rows = [line.split() for line in read_text(log).splitlines() if line.strip()]
    heads, places = rows[::5], sorted(numbers.values())
    if len(rows) % 5 or not all(len(head) == 3 and frame_number(head[0]) is not None for head in heads):
        raise InputError(f"{log}: is no trajectory; each pose is a line 'i i n' and four rows of its matrix.")
    poses: dict[int, Array] = {}
    for place, head in enumerate(heads):
        if int(head[0]) < len(places):
            poses[places[int(head[0])]] = se3.inverse(_rigid(rows[5 * place + 1 : 5 * place + 5], log))
    return dict(sorted(poses.items())) or None


def _pose(path: Path) -> Array:
    return _rigid([line.split() for line in read_text(path).splitlines() if line.strip()], path)


def _rigid(rows: list[list[str]], path: Path) -> Array:
    """Return the rigid motion (4, 4) that four rows of text are."""
    try:
        matrix = np.array(rows, dtype=np.float64)
    except ValueError:
        matrix = np.zeros(0)
    if matrix.shape == (4, 4) and se3.is_rigid(matrix, tolerance=1e-2, farthest_m=FARTHEST_M):
        return matrix
    raise InputError(f"{path}: is no rigid motion; write four rows of four numbers, the last 0 0 0 1.")
