"""Writers of images and cameras as other programs have them: formats of depth, names, files of intrinsics, a lens."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy import ndimage

from modeler.types import Camera
from studies.formats.image_folders import save


def exr(path: Path, depth_m: np.ndarray, channel: str = "Z") -> None:
    openexr = importlib.import_module("OpenEXR")
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with openexr.File(header, {channel: depth_m}) as file:
        file.write(str(path))


def pgm(path: Path, units: np.ndarray) -> None:
    head = f"P5\n# a comment\n{units.shape[1]} {units.shape[0]}\n4000\n".encode()
    path.write_bytes(head + units.astype(">u2").tobytes())


def write_npz(path: Path, depth_m: np.ndarray) -> None:
    np.savez_compressed(path, depth=depth_m)


DEPTHS: dict[str, tuple[Callable[[Path, np.ndarray], object], float]] = {
    "exr": (exr, 1.0),
    "npy": (np.save, 1.0),
    "npz": (write_npz, 1.0),
    "tiff": (save, 1.0),
    "npy in mm": (np.save, 1000.0),
    "pgm": (lambda path, units: pgm(path, np.rint(units)), 1000.0),
}
NAMES: dict[str, tuple[str, str | None, str | None]] = {
    "suffixes": ("{0}_depth.png", "{0}.jpg", "{0}_mask.jpg"),
    "7-Scenes": ("frame-{0:06d}.depth.png", "frame-{0:06d}.color.png", None),
    "Washington": ("cup_1_1_{0}_depth.png", "cup_1_1_{0}.png", None),
    "ticks": ("DepthImage_{1}_{0}.png", None, None),
    "in front": ("frame_{0}_depth.png", "frame_{0}_rgb.bmp", "frame_{0}_mask.png"),
    "aligned": ("aligned_depth_to_color/{0}.png", "color/{0}.png", "masks/{0}.jpg"),
    "bitmaps": ("depth/{0}.png", "rgb/{0}.bmp", "mask/{0}.bmp"),
}
LENS = (-0.28, 0.09, 0.001, -0.002, 0.01)
"""Brown's k1, k2, p1, p2 and k3."""


def _facts(camera: Camera) -> dict[str, float]:
    return {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}


def write_camera(folder: Path, camera: Camera, **more: object) -> None:
    (folder / "camera.json").write_text(json.dumps(_facts(camera) | more))


def realsense(camera: Camera, lens: Sequence[float]) -> str:
    return json.dumps(_facts(camera) | {"model": "brown_conrady", "coeffs": list(lens)})


def by_name(camera: Camera, lens: Sequence[float]) -> str:
    return json.dumps(_facts(camera) | dict(zip(("k1", "k2", "p1", "p2", "k3"), lens, strict=True)))


def opencv(camera: Camera, lens: Sequence[float]) -> str:
    data = f"[{camera.fx}, 0., {camera.cx}, 0., {camera.fy}, {camera.cy}, 0., 0., 1.]"
    return (
        f"%YAML:1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\n"
        f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: {data}\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: {list(lens)}\n"
    )


def ros(camera: Camera, lens: Sequence[float]) -> str:
    data = f"[{camera.fx}, 0, {camera.cx}, 0, {camera.fy}, {camera.cy}, 0, 0, 1]"
    size = f"width: {camera.width}\nheight: {camera.height}\n"
    return f"{size}distortion_model: plumb_bob\nD: {list(lens)}\nK: {data}\n"


def orb_slam(camera: Camera, lens: Sequence[float]) -> str:
    values = _facts(camera) | dict(zip(("k1", "k2", "p1", "p2", "k3"), lens, strict=True))
    lines = [f"Camera.{name}: {value}" for name, value in values.items()]
    return "\n".join(["%YAML:1.0", *lines, "DepthMapFactor: 1000.0", ""])


def kalibr(camera: Camera, lens: Sequence[float]) -> str:
    pixels = [camera.fx, camera.fy, camera.cx, camera.cy]
    return (
        f"cam0:\n  camera_model: pinhole\n  intrinsics: {pixels}\n  distortion_model: radtan\n"
        f"  distortion_coeffs: {list(lens)}\n  resolution: [{camera.width}, {camera.height}]\n"
    )


def line(camera: Camera, lens: Sequence[float]) -> str:
    return " ".join(map(str, (*_facts(camera).values(), *lens)))


CAMERAS: dict[str, tuple[str, Callable[[Camera, Sequence[float]], str]]] = {
    "RealSense": ("camera.json", realsense),
    "by name": ("camera.json", by_name),
    "OpenCV": ("calib.yml", opencv),
    "ROS": ("camera_info.yaml", ros),
    "ORB-SLAM": ("TUM1.yaml", orb_slam),
    "Kalibr": ("camchain.yaml", kalibr),
    "line": ("calibration.txt", line),
}


def distorted(image: np.ndarray, camera: Camera, lens: Sequence[float] = LENS, *, order: int = 0) -> np.ndarray:
    """Return an image as a lens shows it: each of its pixels looks up the ray that reaches it, found by iteration."""
    k1, k2, p1, p2, k3 = lens
    rays = [np.array(each) for each in camera.rays()]
    w, h = rays
    for _ in range(40):
        s = w**2 + h**2
        radial = 1.0 + s * (k1 + s * (k2 + s * k3))
        w, h = (
            (rays[0] - 2.0 * p1 * w * h - p2 * (s + 2.0 * w**2)) / radial,
            (rays[1] - p1 * (s + 2.0 * h**2) - 2.0 * p2 * w * h) / radial,
        )
    return ndimage.map_coordinates(image, [h * camera.fy + camera.cy, w * camera.fx + camera.cx], order=order)
