"""Writer of BOP scene folders."""

import glob
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from modeler.types import Array, Frame, InputError
from sequences.bop.entries import camera_entry, pose_entry
from sequences.files.images import write_picture


def write_bop(
    folder: Path,
    frames: Iterable[Frame],
    truth: Mapping[int, Array] | None = None,
    meta: Mapping[str, object] | None = None,
    *,
    depth_scale_mm: float = 0.1,
    colour_suffix: str = ".png",
    files: Mapping[str, bytes] | None = None,
) -> None:
    """Write frames as a BOP scene folder; it appears complete or not at all.

    Args:
        folder: where to write; it may exist if it is empty.
        frames: what to write, each taken once.
        truth: camera_from_model (4, 4), in m, by frame number.
        meta: entries of `sequence.json`; the frames' times are added.
        depth_scale_mm: millimetres per unit of depth; with 0.1 depth reaches to 6.55 m.
        colour_suffix: `.png`, or `.jpg` for small files.
        files: more files by name, such as `model.ply` and `robot.txt`.

    Raises:
        InputError: where the folder is not empty or cannot be written, or depth does not fit into 16 bits.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: exists already; remove it or give another --out.")
    partial = folder.parent / f".{folder.name}.{os.getpid()}.partial"
    try:
        _tidy(folder)
        partial.mkdir(parents=True)
        _fill(partial, frames, truth, meta or {}, depth_scale_mm=depth_scale_mm, colour_suffix=colour_suffix)
        for name, content in (files or {}).items():
            (partial / name).write_bytes(content)
        os.replace(partial, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); check space and permissions.") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _tidy(folder: Path) -> None:
    """Remove what programs that were killed have left of the folder beside it."""
    for left in folder.parent.glob(f".{glob.escape(folder.name)}.*.partial"):
        process = left.name.split(".")[-2]
        try:
            os.kill(int(process), 0)
        except (ProcessLookupError, OverflowError):
            shutil.rmtree(left, ignore_errors=True)
        except (ValueError, PermissionError):
            pass  # not ours, or still at it


def _fill(
    folder: Path,
    frames: Iterable[Frame],
    truth: Mapping[int, Array] | None,
    meta: Mapping[str, object],
    *,
    depth_scale_mm: float,
    colour_suffix: str,
) -> None:
    cameras: dict[str, object] = {}
    times_s: dict[str, float] = {}
    for frame in frames:
        camera, stem = frame.camera, f"{frame.index:06d}"
        matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        cameras[str(frame.index)] = camera_entry(matrix, depth_scale_mm)
        times_s[str(frame.index)] = frame.time_s
        _picture(folder / "depth" / f"{stem}.png", _raw_depth(frame, depth_scale_mm))
        if frame.mask is not None:
            _picture(folder / "mask_visib" / f"{stem}_000000.png", frame.mask.astype(np.uint8) * np.uint8(255))
        if frame.colour is not None:
            _picture(folder / "rgb" / f"{stem}{colour_suffix}", frame.colour)
    _json(folder / "scene_camera.json", cameras)
    if truth is not None:
        _json(folder / "scene_gt.json", {str(index): [pose_entry(pose)] for index, pose in truth.items()})
    _json(folder / "sequence.json", {**meta, "timestamps_s": times_s}, indent=1)


def _raw_depth(frame: Frame, depth_scale_mm: float) -> npt.NDArray[np.uint16]:
    """Return depth in units of the file; 0 where nothing was measured."""
    measured = np.isfinite(frame.depth_m)
    units = np.rint(np.where(measured, frame.depth_m, 0.0) * (1000.0 / depth_scale_mm))
    if units.max(initial=0.0) > np.iinfo(np.uint16).max or units.min(initial=0.0) < 0.0:
        raise InputError(
            f"frame {frame.index}: depth up to {units.max() * depth_scale_mm / 1000.0:.2f} m does not fit into 16 bits "
            f"of {depth_scale_mm:g} mm; use a coarser unit or a shorter range."
        )
    return np.where(measured, np.maximum(units, 1.0), 0.0).astype(np.uint16)


def _picture(path: Path, pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> None:
    path.parent.mkdir(exist_ok=True)
    write_picture(path, pixels)


def _json(path: Path, content: Mapping[str, object], indent: int | None = None) -> None:
    if indent is None:  # one line a frame keeps the file both small and readable
        lines = ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
        text = f"{{\n{lines}\n}}\n"
    else:
        text = json.dumps(content, indent=indent) + "\n"
    path.write_text(text, encoding="utf-8")
