"""A small rendered sequence, and the writers that other programs have for theirs."""

from __future__ import annotations

import copy
import json
import struct
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.sequences import bundled, open_sequence
from modeler.types import Camera, Frame

_Value = TypeVar("_Value", Camera, Frame)
STEP = 4  # every fourth pixel of the bundled images


def unchecked(value: _Value, **changes: object) -> _Value:
    """Return a frame or a camera that none can be made with, as a file may hold it."""
    changed = copy.copy(value)
    for name, wrong in changes.items():
        object.__setattr__(changed, name, wrong)
    return changed


def small_frames(count: int = 4) -> list[Frame]:
    """Return frames of the bundled box at 160 x 120, in whole millimetres: the same whenever asked for."""
    return [_small_frame(index) for index in range(count)]


@cache
def _small_frame(index: int) -> Frame:
    frame = open_sequence(bundled("box")).frame(index)
    camera, mask, colour = frame.camera, frame.mask, frame.colour
    small = Camera(160, 120, camera.fx / STEP, camera.fy / STEP, camera.cx / STEP, camera.cy / STEP)
    depth_m = (np.rint(frame.depth_m[::STEP, ::STEP] * 1000.0) * np.float32(0.001)).astype(np.float32)
    assert mask is not None
    assert colour is not None
    return Frame(index, frame.time_s, depth_m, small, mask[::STEP, ::STEP], colour[::STEP, ::STEP])


def small_truth(count: int = 4) -> dict[int, np.ndarray]:
    """Return camera_from_model (4, 4) in m of those frames."""
    truth = open_sequence(bundled("box")).truth()
    assert truth is not None
    return {index: pose for index, pose in truth.items() if index < count}


def raw_depth(frame: Frame, unit_mm: float) -> np.ndarray:
    """Return depth in units, 0 = none, as 16-bit images have it."""
    return np.rint(np.nan_to_num(frame.depth_m) * (1000.0 / unit_mm)).astype(np.uint16)


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def png_claiming(width: int, height: int) -> bytes:
    """Return a small 16-bit picture that says it is as large as that."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0" * 1000)) + chunk(b"IEND", b"")


def matrix(camera: Camera) -> np.ndarray:
    """Return K (3, 3)."""
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def write_tum(folder: Path, frames: list[Frame], truth: dict[int, np.ndarray] | None = None) -> None:
    """Write a folder as the benchmark has it: colour 5 ms late, poses of the camera in the world at twice the rate."""
    rgb, depth = ["# color images", "# timestamp filename"], ["# depth maps", "# timestamp filename"]
    for frame in frames:
        time_s = 1305031102.0 + frame.time_s
        save(folder / "depth" / f"{time_s:.6f}.png", raw_depth(frame, 0.2))
        depth.append(f"{time_s:.6f} depth/{time_s:.6f}.png")
        if frame.colour is not None:
            save(folder / "rgb" / f"{time_s + 0.005:.6f}.png", frame.colour)
            rgb.append(f"{time_s + 0.005:.6f} rgb/{time_s + 0.005:.6f}.png")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    camera = frames[0].camera
    (folder / "calibration.txt").write_text(f"{camera.fx!r} {camera.fy!r} {camera.cx!r} {camera.cy!r}\n")
    if truth is not None:
        lines = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
        for index, pose in truth.items():
            world_from_camera, time_s = se3.inverse(pose), 1305031102.0 + frames[index].time_s
            for ahead_s in (-0.003, 0.003):  # a constant turn about the exact pose
                moved = world_from_camera @ se3.exp(ahead_s * np.array([0.3, 0.2, -0.1, 0.05, 0.0, 0.1]))
                values = (*moved[:3, 3], *Rotation.from_matrix(moved[:3, :3]).as_quat())
                lines.append(f"{time_s + ahead_s:.4f} " + " ".join(f"{value:.9f}" for value in values))
        (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")


def write_open3d(folder: Path, frames: list[Frame], truth: dict[int, np.ndarray] | None = None) -> None:
    """Write a folder as Open3D's reconstruction system takes it: JPEG colour, K by columns, trajectory.log."""
    camera = frames[0].camera
    for frame in frames:
        save(folder / "depth" / f"{frame.index:06d}.png", raw_depth(frame, 1.0))
        if frame.colour is not None:
            save(folder / "color" / f"{frame.index:06d}.jpg", frame.colour)
    content = {"width": camera.width, "height": camera.height, "intrinsic_matrix": matrix(camera).T.ravel().tolist()}
    (folder / "camera_intrinsic.json").write_text(json.dumps(content))
    if truth is not None:
        blocks = []
        for index, pose in truth.items():
            rows = "\n".join(" ".join(f"{value:.12f}" for value in row) for row in se3.inverse(pose))
            blocks.append(f"{index} {index} {index + 1}\n{rows}\n")
        (folder / "trajectory.log").write_text("".join(blocks))


def write_bundlesdf(folder: Path, frames: list[Frame], truth: dict[int, np.ndarray] | None = None) -> None:
    """Write a folder as BundleSDF takes it: pictures named by the time in ns, cam_K.txt, masks."""
    for frame in frames:
        stem = str(1581120424100262102 + round(frame.time_s * 1e9))
        save(folder / "depth" / f"{stem}.png", raw_depth(frame, 1.0))
        if frame.colour is not None:
            save(folder / "rgb" / f"{stem}.png", frame.colour)
        if frame.mask is not None:
            save(folder / "masks" / f"{stem}.png", frame.mask.astype(np.uint8) * 255)
        if truth is not None and frame.index in truth:
            (folder / "annotated_poses").mkdir(exist_ok=True)
            np.savetxt(folder / "annotated_poses" / f"{stem}.txt", truth[frame.index])
    np.savetxt(folder / "cam_K.txt", matrix(frames[0].camera))


Writer = Callable[[Path, list[Frame], dict[int, np.ndarray] | None], None]
WRITERS: dict[str, Writer] = {"TUM RGB-D": write_tum, "Open3D": write_open3d, "BundleSDF": write_bundlesdf}
