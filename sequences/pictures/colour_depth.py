"""Folders of colour and depth pictures with one camera: as Open3D's and BundleSDF's programs take them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from modeler import se3
from modeler.types import Array, InputError
from sequences.files.folders import entries, first_folder, frame_number, inside, pictures
from sequences.files.images import picture_size
from sequences.files.intrinsics import find_intrinsics
from sequences.files.json_input import read_text
from sequences.given import Given
from sequences.pictures.sequence import PictureSequence, Shot

COLOUR_FOLDERS = ("color", "rgb", "colour", "image")
MASK_FOLDERS = ("masks", "mask")
POSES = "annotated_poses"
FARTHEST_M = 1e6
"""No camera is farther away."""


def open_colour_depth(path: Path, given: Given) -> PictureSequence:
    """Open a folder with `depth/` and intrinsics, and where they are there `color/` or `rgb/`, and `masks/`.

    Depth is in mm unless the file of intrinsics or somebody says otherwise, as both programs have it.

    Raises:
        InputError: where it is not readable as such.
    """
    depth = pictures(path / "depth", (".png", ".tif", ".tiff"), path)
    if not depth:
        raise InputError(f"{path / 'depth'}: holds no depth image; put 16-bit PNG pictures there.")
    found = find_intrinsics(path, given)
    if found is None:
        raise InputError(
            f"{path}: no intrinsics; add camera.json with fx, fy, cx and cy in px, cam_K.txt (three rows of K), "
            "camera_intrinsic.json (Open3D's) or scene_camera.json (BOP's), or convert with --intrinsics FX FY CX CY."
        )
    numbers = told_numbers(list(depth)) or {stem: place for place, stem in enumerate(depth)}
    remarks = found.doubts(picture_size(next(iter(depth.values()))))
    colour = _partners(path, COLOUR_FOLDERS, (".png", ".jpg", ".jpeg"), depth)
    masks = _partners(path, MASK_FOLDERS, (".png",), depth)
    for what, partners in (("colour image", colour), ("mask", masks)):
        lacking = sum(stem not in partners for stem in depth)
        if partners and lacking:
            remarks.append(f"{lacking} of {len(depth)} depth images have no {what}")
    shots = {
        numbers[stem]: Shot(_time_s(stem, numbers[stem]), picture, colour.get(stem), masks.get(stem))
        for stem, picture in depth.items()
    }
    unit_mm, who = found.unit(given, (1.0, "nothing says otherwise"))
    return PictureSequence(
        path,
        shots=dict(sorted(shots.items())),
        intrinsics=found.intrinsics,
        depth_scale_mm=unit_mm,
        what=_layout(path),
        unit_source=who,
        read_truth=lambda: _truth(path, numbers),
        remarks=tuple(remarks),
    )


def _layout(path: Path) -> str:
    """Return whose layout a folder has, in words."""
    if (path / "cam_K.txt").exists() and first_folder(path, (*MASK_FOLDERS, POSES)) is not None:
        return "BundleSDF folder"
    return "Open3D folder" if (path / "camera_intrinsic.json").exists() else "folder of pictures"


def told_numbers(stems: list[str]) -> dict[str, int] | None:
    """Return the frame numbers that names are, begin with, or differ by alone; None where they do not tell."""
    for numbered in (stems, [re.split(r"[^0-9]", stem)[0] for stem in stems], _differences(stems)):
        numbers = [frame_number(stem) for stem in numbered]
        known = [number for number in numbers if number is not None]
        if len(set(known)) == len(stems):
            return dict(zip(stems, known, strict=True))
    return None


def _differences(stems: list[str]) -> list[str]:
    """Return the digits by which names such as `depth_9` and `depth_10` differ, where that is all; else nothing."""
    rows = [re.split(r"([0-9]+)", stem) for stem in stems]
    if len({len(row) for row in rows}) != 1:
        return []
    differ = [place for place, words in enumerate(zip(*rows, strict=True)) if len(set(words)) > 1]
    counted = len(differ) == 1 and differ[0] % 2 == 1 and rows[0][differ[0] - 1] != "."  # which begins a fraction
    return [row[differ[0]] for row in rows] if counted else []


def _time_s(stem: str, number: int) -> float:
    """Return the time that a long number in a name tells in ns; else the frame number."""
    return int(stem) * 1e-9 if stem.isascii() and stem.isdigit() and 16 <= len(stem) <= 19 else float(number)


def _partners(
    root: Path, names: tuple[str, ...], suffixes: tuple[str, ...], depth: Mapping[str, Path]
) -> dict[str, Path]:
    """Return the pictures of a folder by the name of the depth image to which they belong.

    Raises:
        InputError: where neither names nor numbers nor order tell.
    """
    folder = first_folder(root, names)
    if folder is None:
        return {}
    found = pictures(folder, suffixes, root)
    same = {stem: found[stem] for stem in depth if stem in found}
    ours, theirs = told_numbers(list(depth)) or {}, told_numbers(list(found)) or {}
    named = {number: stem for stem, number in theirs.items()}
    alike = {stem: found[named[number]] for stem, number in ours.items() if number in named}
    best = alike if len(alike) > len(same) else same
    if best or not found:
        return best
    if len(found) == len(depth):  # names are times of two clocks
        return dict(zip(depth, found.values(), strict=True))
    raise InputError(
        f"{folder}: its {len(found)} pictures cannot be told to belong to the {len(depth)} depth images; "
        "give those of one frame the same name."
    )


def _truth(root: Path, numbers: Mapping[str, int]) -> dict[int, Array] | None:
    """Return camera_from_model by frame number as BundleSDF's or Open3D's files tell it; None without."""
    posed = {path.stem: path for path in entries(root / POSES) if path.suffix == ".txt"}
    if posed:
        found = {number: _pose(inside(posed[stem], root)) for stem, number in numbers.items() if stem in posed}
        return dict(sorted(found.items())) or None
    log = next((path for path in (root / "trajectory.log", root / "scene" / "trajectory.log") if path.is_file()), None)
    if log is None:
        return None
    rows = [line.split() for line in read_text(inside(log, root)).splitlines() if line.strip()]
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
