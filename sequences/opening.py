"""Selects the reader of a path by its contents."""

from __future__ import annotations

import contextlib
import difflib
from pathlib import Path

from modeler.sequences.base import AbstractSequence
from modeler.sequences.bop import BopSequence
from modeler.sequences.calibrated import AxialSequence
from modeler.sequences.clouds import SUFFIXES as CLOUD_SUFFIXES
from modeler.sequences.clouds import open_clouds
from modeler.sequences.hand_shapes import with_hand
from modeler.sequences.image_folders import (
    COLOUR_FOLDERS,
    DEPTH_FOLDERS,
    images_in_folders,
    images_in_one_folder,
    open_colour_depth,
)
from modeler.sequences.input_files import check_links, entries, first_folder, is_there
from modeler.sequences.intrinsics import Overrides
from modeler.sequences.live import LIBRARIES, open_camera
from modeler.sequences.phones import images_of_transforms, open_record3d
from modeler.sequences.tum import open_tum
from modeler.system.regular_files import check_regular
from modeler.types import InputError, checked

FORMATS = (
    "a folder with depth/ (BOP, TUM RGB-D, Open3D, BundleSDF, your own), organised clouds, a ROS bag, a RealSense "
    "recording, an Azure Kinect .mkv, or realsense:, orbbec:, oak: or azure: for a camera"
)
BAGS = (".bag", ".mcap", ".db3")


@checked
def open_sequence(path: str | Path, overrides: Overrides | None = None) -> AbstractSequence:
    """Open the sequence at a path in whichever supported format.

    Args:
        path: a folder or a file, or `realsense:`, `orbbec:`, `oak:` or `azure:` for a live camera.
        overrides: values that take precedence over the files.

    Raises:
        InputError: if it does not hold a readable sequence, or, on request, a link leads out of it.
    """
    path, overrides = Path(path), overrides or Overrides()
    if not _is_text(path):
        raise InputError(f"{path}: its name is not UTF-8; rename it.")
    maker, colon, serial = str(path).partition(":")
    if colon and maker in LIBRARIES and not path.exists():
        return open_camera(maker, serial, overrides)
    try:
        found = with_hand(_open(path, overrides))
        return AxialSequence(found) if overrides.along_ray else found
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions.") from None


def _suggestion(path: Path) -> str:
    """Return a suggestion of a similar name in the same folder, "" if there is none."""
    with contextlib.suppress(OSError):  # the error about the path itself follows
        siblings = [other.name for other in path.parent.iterdir()]
        if near := difflib.get_close_matches(path.name, siblings, n=1, cutoff=0.75):
            return f"did you mean {path.parent / near[0]}? Else "
    return ""


def _open(path: Path, overrides: Overrides) -> AbstractSequence:
    if not path.exists():
        raise InputError(f"{path}: no such folder or file; {_suggestion(path)}give {FORMATS}.")
    if not path.is_dir():
        check_regular(path)
    elif overrides.strict_paths:
        check_links(path)
    recorded = [entry for entry in entries(path) if entry.suffix.lower() in BAGS] if path.is_dir() else []
    if len(recorded) == 1 and not is_there(path / "metadata.yaml"):  # which a recorder that crashed does not write
        path = recorded[0]
    if path.suffix.lower() in BAGS or is_there(path / "metadata.yaml"):
        from modeler.sequences.ros.sequence import open_ros

        return open_ros(path, overrides)
    if is_there(path / "report.json"):
        raise InputError(f"{path}: is the folder of a run; give the sequence it was made from, or convert its poses.")
    if path.is_file() and path.suffix.lower() == ".mkv":
        from modeler.sequences.kinect import open_kinect

        return open_kinect(path, overrides)
    if path.is_file() and path.suffix.lower() == ".r3d":
        return open_record3d(path, overrides)
    if (path.is_file() and path.suffix.lower() in CLOUD_SUFFIXES) or _holds_clouds(path):
        return open_clouds(path, overrides)
    if not path.is_dir():
        raise InputError(f"{path}: a file of this kind holds no sequence; give {FORMATS}.")
    if is_there(path / "scene_camera.json"):
        return BopSequence(path, overrides)
    if is_there(path / "depth.txt"):
        return open_tum(path, overrides)
    if (path / "keyframes" / "depth").is_dir():  # Polycam's
        path = path / "keyframes"
    if (listed := images_of_transforms(path)) is not None:
        return open_colour_depth(path, listed, overrides)
    if first_folder(path, DEPTH_FOLDERS) is not None:
        return open_colour_depth(path, images_in_folders(path), overrides)
    if (found := images_in_one_folder(path)) is not None:
        return open_colour_depth(path, found, overrides)
    raise InputError(f"{path}: {_advice(path)}")


def _is_text(path: Path) -> bool:
    """Return whether a path can be written out: on Linux a name is any bytes."""
    try:
        return bool(str(path).encode())
    except UnicodeEncodeError:
        return False


def _holds_clouds(path: Path) -> bool:
    """Return whether a folder holds clouds and no depth images."""
    marks = ("scene_camera.json", "depth.txt", *DEPTH_FOLDERS)
    if not path.is_dir() or any((path / mark).exists() for mark in marks):
        return False
    clouds = any(entry.suffix.lower() in CLOUD_SUFFIXES for entry in entries(path))
    return clouds and images_in_one_folder(path) is None


def _folders(path: Path) -> list[str]:
    return [entry.name for entry in entries(path) if entry.is_dir()]


def _scenes(path: Path, names: list[str]) -> list[str]:
    """Return which of the folders of these names hold depth as sequences do."""
    return [name for name in names if any((path / name / mark).exists() for mark in ("depth", "depth.txt"))]


def _advice(path: Path) -> str:
    """Return the error for a folder without depth."""
    inner = _folders(path)
    scenes = _scenes(path, inner) or _scenes(
        path, [f"{name}/{deeper}" for name in inner for deeper in _folders(path / name)]
    )
    if scenes:
        more, one = ", ..." if len(scenes) > 3 else "", len(scenes) == 1
        held, which = ("a sequence", "it") if one else (f"{len(scenes)} sequences", "one of them")
        return f"holds {held}; give {which}: {', '.join(scenes[:3])}{more}."
    of_depth = [name for name in inner if "depth" in name.lower()]
    if len(of_depth) == 1:
        return f"holds no folder depth; if its depth images are those in {of_depth[0]}, rename that to depth."
    if any(name in COLOUR_FOLDERS for name in inner):
        return "holds colour but no depth images; only depth can be registered, put it into depth/."
    if path.absolute().name == "depth":
        return f"is the folder of the images alone; give the one it lies in, {path.absolute().parent}."
    if any(entry.suffix.lower() == ".png" for folder in ("", *inner) for entry in entries(path / folder)):
        return (
            "holds images but no folder depth; put the depth images into one, and camera.json or cam_K.txt next to it."
        )
    return f"holds no depth images where they are looked for; give {FORMATS}."
