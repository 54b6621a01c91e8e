"""Organised point clouds (PCD, PLY): a point a pixel, from which the depth image and its camera are taken back."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, final

import numpy as np
import numpy.typing as npt

from modeler.sequences.file_names import frame_numbers
from modeler.sequences.image_files import MAX_PIXELS
from modeler.sequences.input_files import input_errors, list_images
from modeler.sequences.intrinsics import Intrinsics, Overrides, sane
from modeler.sequences.recording import AbstractRecording
from modeler.system.regular_files import open_regular, unreadable
from modeler.types import Array, Camera, Frame, InputError

SUFFIXES = (".pcd", ".ply")
MAX_OFF_PX = 1.0
"""Points that lie farther (half of them) from their pixels were not seen by a pinhole camera."""
_HEADER_BYTES = 65536
_MOST_BYTES = 1000  # a point, as text with many fields
_LZF_RATIO = 20  # points a byte: its longest match is 264 bytes in 3, and a point has 6 at the least


@final
@dataclass(frozen=True)
class CloudSequence(AbstractRecording):
    """A cloud a frame, in camera coordinates."""

    clouds: Mapping[int, Path]
    """By frame number, ascending."""
    unit_mm: float
    """Millimetres per unit of the coordinates."""
    given: Intrinsics | None
    """Intrinsics that take precedence over fitted ones."""

    def __post_init__(self) -> None:
        """Check the first cloud's header and `sequence.json`.

        Raises:
            InputError: if they cannot be used.
        """
        _ = self.name, self.sensor(), self.motion, organised(self.clouds[self.indices[0]])

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers, ascending."""
        return tuple(self.clouds)

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`: each point falls into the pixel that sees it, the nearest counts."""
        path = self.clouds.get(index)
        if path is None:
            raise self.absent(index)
        points, colours = _points(path)
        camera, size = self._camera, (self._camera.height, self._camera.width)
        if points.shape[:2] != size:
            raise InputError(
                f"{path}: has {points.shape[1]} x {points.shape[0]} points where the first cloud has "
                f"{size[1]} x {size[0]}; all clouds of a sequence must have one size."
            )
        z_m = points[..., 2] * (self.unit_mm / 1000.0)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            columns = np.rint(points[..., 0] / points[..., 2] * camera.fx + camera.cx)
            rows = np.rint(points[..., 1] / points[..., 2] * camera.fy + camera.cy)
            seen = (z_m > 0.0) & (columns >= 0) & (columns < size[1]) & (rows >= 0) & (rows < size[0])
        where = rows[seen].astype(np.intp), columns[seen].astype(np.intp)
        depth_m = np.full(size, np.inf)
        np.minimum.at(depth_m, where, z_m[seen])
        colour = None
        if colours is not None:
            colour = np.zeros((*size, 3), np.uint8)
            colour[where] = colours[seen]
        depth = np.where(np.isinf(depth_m), np.nan, depth_m).astype(np.float32)
        return Frame(index, float(index), depth, camera, None, colour)

    def truth(self) -> dict[int, Array] | None:
        """Return None: clouds have no ground truth."""
        return None

    @property
    def layout(self) -> str:
        """Format of the sequence."""
        kinds = sorted({path.suffix.lower()[1:].upper() for path in self.clouds.values()})
        return f"organised clouds ({', '.join(kinds)})"

    @property
    def depth_unit(self) -> str:
        """Unit of the coordinates."""
        return "m (the coordinates)" if self.unit_mm == 1000.0 else f"{self.unit_mm:g} mm (--depth-scale-mm)"

    @property
    def notes(self) -> tuple[str, ...]:
        """Where the intrinsics come from."""
        return () if self.given is not None else ("intrinsics are fitted to the points of the first cloud",)

    @cached_property
    def _camera(self) -> Camera:
        path = self.clouds[self.indices[0]]
        points, _ = _points(path)
        intrinsics = fit_intrinsics(points, path) if self.given is None else self.given
        return Camera(points.shape[1], points.shape[0], *intrinsics)


def open_clouds(path: Path, overrides: Overrides) -> CloudSequence:
    """Open a folder of organised clouds, or one such file.

    Raises:
        InputError: if it is not readable as such.
    """
    found = list_images(path, SUFFIXES) if path.is_dir() else {path.stem: path}
    numbers = frame_numbers(list(found)) or {stem: place for place, stem in enumerate(found)}
    clouds = dict(sorted((numbers[stem], cloud) for stem, cloud in found.items()))
    unit_mm = 1000.0 if overrides.depth_scale_mm is None else overrides.depth_scale_mm
    return CloudSequence(path, clouds, unit_mm, overrides.intrinsics)


def organised(path: Path) -> tuple[int, int]:
    """Return the (width, height) of a cloud as its header says.

    Raises:
        InputError: if it is no cloud or is not organised as an image.
    """
    try:
        with open_regular(path) as file:
            head, size = file.read(_HEADER_BYTES), os.fstat(file.fileno()).st_size
    except OSError as error:
        raise unreadable(path, error) from None
    if path.suffix.lower() == ".pcd":
        end, width, height = r"(?m)^DATA\s+\w+", r"(?m)^WIDTH\s+(\d{1,9})\s*$", r"(?m)^HEIGHT\s+(\d{1,9})\s*$"
        count = r"(?m)^POINTS\s+(\d{1,12})\s*$"
    else:
        end, count = r"(?m)^end_header\s*$", r"(?m)^element\s+vertex\s+(\d{1,12})\s*$"
        width, height = (rf"(?m)^(?:obj_info|comment)\s+(?:{names})\s+(\d{{1,9}})\s*$" for names in _PLY_SIZES)
    text = head.decode("latin-1")
    stop = re.search(end, text)
    if stop is None:
        raise InputError(f"{path}: has no header of a {path.suffix[1:].upper()} file; save it again.")
    sizes = [re.search(pattern, text[: stop.end()]) for pattern in (width, height, count)]
    columns, rows, points = (int(found[1]) if found else 0 for found in sizes)
    if columns < 2 or rows < 2 or columns * rows != points:
        raise InputError(
            f"{path}: is not organised as an image of columns and rows; save the camera's cloud as it comes "
            "(PCD with WIDTH and HEIGHT, PLY with obj_info num_cols and num_rows), or its depth image."
        )
    if points > MAX_PIXELS:
        raise InputError(f"{path}: has more than {MAX_PIXELS // 1_000_000} million points; thin it out.")
    least = points // _LZF_RATIO if "binary_compressed" in stop[0] else 2 * points
    if size < stop.end() + least:
        raise InputError(f"{path}: is cut off, or has fewer points than its header says; save it again.")
    if size > stop.end() + _MOST_BYTES * points:
        raise InputError(f"{path}: is larger than the points of its header can be; save it again.")
    return columns, rows


_PLY_SIZES = ("num_cols|width|cols", "num_rows|height|rows")


def fit_intrinsics(points: npt.NDArray[np.float64], path: Path) -> Intrinsics:
    """Return the intrinsics of the camera that saw points (h, w, 3), by least squares over all of them.

    Raises:
        InputError: if no pinhole camera that looks along z saw them.
    """
    rows, columns = np.nonzero(np.isfinite(points).all(axis=2) & (points[..., 2] > 1e-9))
    if rows.size < 100:
        raise InputError(f"{path}: has only {rows.size} points before the camera; z must point forward, in m.")
    found, off_px = [], []
    for axis, pixels in ((0, columns), (1, rows)):
        slope = points[rows, columns, axis] / points[rows, columns, 2]
        design = np.stack([slope, np.ones(slope.size)], axis=1)
        line, *_ = np.linalg.lstsq(design, pixels.astype(np.float64), rcond=None)
        found.append(line)
        off_px.append(float(np.median(np.abs(design @ line - pixels))))
    (fx, cx), (fy, cy) = ((float(slope), float(start)) for slope, start in found)
    if max(off_px) > MAX_OFF_PX or not sane((fx, fy, cx, cy)):
        raise InputError(
            f"{path}: its points are not on the rays of a pinhole camera (off by {max(off_px):.1f} px); save them in "
            "camera coordinates (x right, y down, z forward), or give --intrinsics FX FY CX CY."
        )
    return fx, fy, cx, cy


def _points(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8] | None]:
    """Return the points (h, w, 3) of a cloud, NaN where there is none, and their colours (h, w, 3)."""
    width, height = organised(path)
    with input_errors(path, "cloud", "save it again"):
        with open_regular(path) as file:
            points, colours = (_read_pcd if path.suffix.lower() == ".pcd" else _read_ply)(file)
    if points.shape != (width * height, 3):
        raise InputError(f"{path}: is cut off or broken, {len(points)} points could be read; save it again.")
    points = np.where(np.isfinite(points) & (np.abs(points) < 1e9), points, np.nan).reshape(height, width, 3)
    if colours.shape[:1] != (width * height,) or colours.ndim != 2 or colours.shape[1] < 3:
        return points, None
    return points, colours[:, :3].astype(np.uint8).reshape(height, width, 3)


def _read_pcd(file: BinaryIO) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return points (n, 3) and colours (n, 3) from 0 to 255, or (0, 3), of a PCD file."""
    import open3d as o3d  # takes a second

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        open_file = Path(f"/dev/fd/{file.fileno()}")  # Open3D takes no open files
        cloud = o3d.io.read_point_cloud(open_file, format="pcd", remove_nan_points=False, remove_infinite_points=False)
    shares = np.nan_to_num(np.asarray(cloud.colors, dtype=np.float64)).clip(0.0, 1.0)
    return np.asarray(cloud.points, dtype=np.float64), np.rint(255.0 * shares)


def _read_ply(file: BinaryIO) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return points (n, 3) and colours (n, 3 or 4) from 0 to 255, or (0, 3), of a PLY file."""
    from trimesh.exchange.ply import load_ply

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read = load_ply(file)
    colours = np.asarray(read.get("vertex_colors", np.zeros((0, 3))), dtype=np.float64)
    return np.asarray(read["vertices"], dtype=np.float64), np.nan_to_num(colours).clip(0.0, 255.0)
