"""Point clouds (PCD, PLY) of a depth camera: the depth image and its camera are taken back from the points.

Organised clouds have a point a pixel. Of others the camera is known, or points lie on the rays of its pixels: then x/z
and y/z are whole numbers, but for a factor, the focal length, and an offset, the principal point.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Final, Literal

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.sequences.file_names import frame_numbers, said_of_angles
from modeler.sequences.image_files import LEAST_MM, MAX_PIXELS
from modeler.sequences.input_files import input_errors, list_images
from modeler.sequences.intrinsics import MAX_ASPECT, Intrinsics, Overrides, find_intrinsics, sane
from modeler.sequences.recording import AbstractRecording
from modeler.system.regular_files import PIECE_BYTES, open_regular
from modeler.types import Array, Camera, Frame, InputError

SUFFIXES = (".pcd", ".ply")
_MOST_BYTES = 1000  # a point, as text with many fields


@dataclass(frozen=True)
class CloudSequence(AbstractRecording):
    """A cloud a frame, in camera coordinates."""

    clouds: Mapping[int, Path]
    """By frame number, ascending."""
    unit_mm: float
    """Millimetres per unit of the coordinates."""
    unit_source: str
    camera: Camera
    axes: Axes = "camera"
    """Of the coordinates."""
    is_organised: bool = True
    """Whether each cloud has a point a pixel."""

    @property
    def indices(self) -> tuple[int, ...]:
        return tuple(self.clouds)

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`: each point falls into the pixel that sees it, the nearest counts."""
        path = self.clouds.get(index)
        if path is None:
            raise self.absent(index)
        cloud = _read(path)
        camera, size = self.camera, (self.camera.height, self.camera.width)
        if self.is_organised and cloud.size != (size[1], size[0]):
            raise InputError(
                f"{path}: has {cloud.size[0]} x {cloud.size[1]} points where the first cloud has "
                f"{size[1]} x {size[0]}; all clouds of a sequence must have one size."
            )
        points = cloud.points @ _CAMERA_FROM[self.axes].T
        z_m = points[:, 2] * (self.unit_mm / 1000.0)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            columns = np.rint(points[:, 0] / points[:, 2] * camera.fx + camera.cx)
            rows = np.rint(points[:, 1] / points[:, 2] * camera.fy + camera.cy)
            seen = (z_m > 0.0) & (columns >= 0) & (columns < size[1]) & (rows >= 0) & (rows < size[0])
        far_first = np.flatnonzero(seen)[np.argsort(-z_m[seen], kind="stable")]
        where = rows[far_first].astype(np.intp), columns[far_first].astype(np.intp)
        depth_m = np.full(size, np.nan, dtype=np.float32)
        depth_m[where] = z_m[far_first]
        colour = None
        if cloud.colours is not None:
            colour = np.zeros((*size, 3), np.uint8)
            colour[where] = cloud.colours[far_first]
        return Frame(index, float(index), depth_m, camera, None, colour)

    @property
    def layout(self) -> str:
        kinds = sorted({path.suffix.lower()[1:].upper() for path in self.clouds.values()})
        return f"{'organised clouds' if self.is_organised else 'clouds'} ({', '.join(kinds)})"

    @property
    def depth_unit(self) -> str:
        return f"{'m' if self.unit_mm == 1000.0 else f'{self.unit_mm:g} mm'} ({self.unit_source})"


Axes = Literal["camera", "viewer", "body"]
_CAMERA_FROM: Final[Mapping[Axes, Array]] = {
    "camera": np.eye(3),
    "viewer": se3.Y_UP,
    "body": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
}
"""Rotations (3, 3) into the camera frame: x right, y down, z forward."""
_SAID: Final[Mapping[Axes, tuple[str, ...]]] = {
    "camera": (),
    "viewer": ("y points up and z backward, as viewers have it: both are turned around",),
    "body": ("x points forward and z up, as body frames of ROS have it: turned to those of a camera",),
}


def open_clouds(path: Path, overrides: Overrides) -> CloudSequence:
    """Open a folder of clouds, or one such file."""
    found = list_images(path, SUFFIXES) if path.is_dir() else {path.stem: path}
    numbers = frame_numbers(list(found)) or {stem: place for place, stem in enumerate(found)}
    clouds = dict(sorted((numbers[stem], cloud) for stem, cloud in found.items()))
    first_path = next(iter(clouds.values()))
    first, refused = _read(first_path), list[InputError]()
    for axes in _plausible_axes(first.points):
        turned = replace(first, points=first.points @ _CAMERA_FROM[axes].T)
        try:
            (intrinsics, columns, rows), remarks = _intrinsics(path, clouds, turned, axes, overrides)
        except InputError as error:
            refused.append(error)
            continue
        camera, (unit_mm, who) = Camera(columns, rows, *intrinsics), _unit_mm(turned, overrides)
        said = (*_SAID[axes], *remarks, *said_of_angles(clouds))
        return CloudSequence(path, clouds, unit_mm, who, camera, axes, first.size[1] > 1, remarks=said)
    raise refused[0]


def _plausible_axes(points: npt.NDArray[np.float64]) -> list[Axes]:
    """Return the axes by which nearly all points (n, 3) lie before the camera, and those of a camera."""
    found = list[Axes]()
    for axes, rotation in _CAMERA_FROM.items():
        forward = points @ rotation[2]
        if np.count_nonzero(forward > _LEAST_Z) > 100 * max(np.count_nonzero(forward < -_LEAST_Z), 1):
            found.append(axes)
    return found if "camera" in found else [*found, "camera"]


def _intrinsics(
    path: Path, clouds: Mapping[int, Path], first: _Cloud, axes: Axes, overrides: Overrides
) -> tuple[tuple[Intrinsics, int, int], tuple[str, ...]]:
    """Return intrinsics, width and height of the camera that saw the clouds, and their source in words."""
    intrinsics, columns, rows = overrides.intrinsics, *first.size
    first_path = next(iter(clouds.values()))
    if rows > 1:
        if intrinsics is not None:
            return (intrinsics, columns, rows), ()
        fitted = fit_intrinsics(first.points.reshape(rows, columns, 3), first_path)
        return (fitted, columns, rows), ("intrinsics are fitted to the points of the first cloud",)
    known = find_intrinsics(path, overrides) if path.is_dir() else None
    intrinsics = known.intrinsics if intrinsics is None and known is not None else intrinsics
    pixels = _image_coordinates(first_path) if intrinsics is None else None
    whole, said = True, tuple[str, ...]()
    if pixels is not None:
        intrinsics = _fitted(first.points, pixels, first_path)
        said = ("intrinsics are fitted to the image coordinates (imX, imY) of the first cloud's points",)
    if intrinsics is None:
        intrinsics, whole = _on_a_grid(_slopes(first.points), first_path), False
        said = ("intrinsics are recovered: the points lie on the rays of a grid of pixels",)
    return _window(clouds, intrinsics, axes, whole=whole), said


_LEAST_Z = 1e-9  # in any unit: nearer is the camera itself


def _unit_mm(cloud: _Cloud, overrides: Overrides) -> tuple[float, str]:
    """Return the millimetres per unit of the coordinates, m or mm by their size, and its source."""
    if overrides.depth_scale_mm is not None:
        return overrides.depth_scale_mm, "`depth_scale_mm`"
    measured = np.abs(cloud.points[:, 2])
    measured = measured[measured > _LEAST_Z]
    in_mm = measured.size > 0 and float(np.median(measured)) > LEAST_MM
    return (1.0, "by the size of the coordinates") if in_mm else (1000.0, "the coordinates")


@dataclass(frozen=True, eq=False)
class _Cloud:
    """A cloud as stored."""

    points: npt.NDArray[np.float64]
    """(n, 3) in units of the file, NaN where there is none."""
    colours: npt.NDArray[np.uint8] | None
    """(n, 3)."""
    size: tuple[int, int]
    """Columns and rows; one row if it is not organised."""


def _slopes(points: npt.NDArray[np.float64]) -> Array:
    """Return x/z and y/z (n, 2) of the points (n, 3) before the camera."""
    points = points[points[:, 2] > _LEAST_Z]
    slopes = points[:, :2] / points[:, 2:]
    return slopes[(np.abs(slopes) < 1e3).all(axis=1)]  # no camera sees so far to the side


def _on_a_grid(slopes: Array, path: Path) -> Intrinsics:
    """Return the intrinsics of a grid of pixels whose rays points (n, 2) lie on, the principal point but for pixels."""
    (fx, cx), (fy, cy) = _steps(slopes[:, 0]), _steps(slopes[:, 1])
    if not sane((fx, fy, cx, cy)) or max(fx, fy) > MAX_ASPECT * min(fx, fy):
        raise InputError(
            f"{path}: is not organised as an image of columns and rows, nor do its points lie on the rays of a grid of "
            "pixels; save the camera's cloud or depth image as it comes, or give `intrinsics` FX FY CX CY."
        )
    return fx, fy, cx, cy


_FINEST_PX, _COARSEST_PX = 5000.0, 50.0  # focal lengths between which grids are looked for
_BINS = 1 << 18  # four to a pixel of the finest grid, over slopes of 13


def _steps(slopes: Array) -> tuple[float, float]:
    """Return the factor and the offset in 0..1 that make whole numbers of slopes (n,); 0, 0 if none do.

    The spectrum of the slopes' histogram has its first line at the factor, and multiples of it follow.
    """
    slopes = slopes[np.abs(slopes) < _BINS / (8.0 * _FINEST_PX)]
    values = np.unique(np.round(slopes, 7))
    if len(values) < 2:
        return 0.0, 0.0
    histogram = np.bincount(np.rint((slopes - values[0]) * 4.0 * _FINEST_PX).astype(np.intp), minlength=_BINS)
    power = np.abs(np.fft.rfft(histogram, _BINS)) / len(slopes)
    per_bin = 4.0 * _FINEST_PX / _BINS
    start, stop = round(_COARSEST_PX / per_bin), round(_FINEST_PX / per_bin)
    # Of the largest possible power; of points anywhere it is a few hundredths.
    high = np.flatnonzero(power[start:stop] > 0.7)
    if not high.size:
        return 0.0, 0.0
    width = max(1, round(0.5 / ((values[-1] - values[0]) * per_bin)))
    first = start + int(high[0])
    factor = (first + int(np.argmax(power[first : first + width + 1]))) * per_bin
    offset = 0.0
    for _ in range(4):
        turns = np.exp(2j * np.pi * slopes * factor).mean()
        offset = float(-np.angle(turns) / (2.0 * np.pi)) % 1.0
        whole = np.rint(slopes * factor + offset)
        (factor, offset), *_ = np.linalg.lstsq(np.stack([slopes, np.ones_like(slopes)], axis=1), whole, rcond=None)
    off_px = float(np.median(np.abs(slopes * factor + offset - np.rint(slopes * factor + offset))))
    return (float(factor), float(offset)) if off_px < 0.12 else (0.0, 0.0)  # 0.25 if they lie anywhere


def _window(
    clouds: Mapping[int, Path], intrinsics: Intrinsics, axes: Axes, *, whole: bool
) -> tuple[Intrinsics, int, int]:
    """Return intrinsics, width and height of an image that holds the points of all clouds."""
    fx, fy, cx, cy = intrinsics
    lows, highs = [], []
    for path in clouds.values():
        slopes = _slopes(_read(path).points @ _CAMERA_FROM[axes].T)
        if len(slopes):
            pixels = np.rint(slopes * (fx, fy) + (cx, cy))
            lows.append(pixels.min(axis=0))
            highs.append(pixels.max(axis=0))
    if not lows:
        raise InputError(f"{next(iter(clouds.values()))}: has no points before the camera; z must point forward, in m.")
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    if whole:
        low, high = np.zeros(2), np.maximum(high, np.rint((2.0 * cx, 2.0 * cy)) - 1)
    else:  # with the principal point in the middle
        middle = np.array([cx, cy])
        reach = np.maximum(high - middle, middle - low)
        low, high = np.floor(middle - reach), np.ceil(middle + reach)
    columns, rows = (int(size) for size in high - low + 1)
    if columns * rows > MAX_PIXELS:
        raise InputError(
            f"{next(iter(clouds.values()))}: its points spread over {columns} x {rows} pixels of a camera with fx "
            f"{fx:g} px; are these points in camera coordinates, and the intrinsics theirs?"
        )
    return (fx, fy, cx - float(low[0]), cy - float(low[1])), columns, rows


def organised(path: Path) -> tuple[int, int]:
    """Return the (width, height) of a cloud as its header says; one row if it is not organised as an image."""
    with input_errors(path, "cloud", "save it again"), open_regular(path) as file:
        head, size = file.read(PIECE_BYTES), os.fstat(file.fileno()).st_size
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
    if points > MAX_PIXELS:
        raise InputError(f"{path}: has more than {MAX_PIXELS // 1_000_000} million points; thin it out.")
    if points < 2 or (rows > 1 and columns * rows != points):
        raise InputError(
            f"{path}: is not organised as an image of columns and rows; save the camera's cloud as it comes "
            "(PCD with WIDTH and HEIGHT, PLY with obj_info num_cols and num_rows), or its depth image."
        )
    # LZF's longest match is 264 bytes in 3, and a point has 6 at the least.
    least = points // 20 if "binary_compressed" in stop[0] else 2 * points
    if size < stop.end() + least:
        raise InputError(f"{path}: is cut off, or has fewer points than its header says; save it again.")
    if size > stop.end() + _MOST_BYTES * points:
        raise InputError(f"{path}: is larger than the points of its header can be; save it again.")
    return (columns, rows) if columns > 1 and rows > 1 else (points, 1)


_PLY_SIZES = ("num_cols|width|cols", "num_rows|height|rows")


def fit_intrinsics(points: npt.NDArray[np.float64], path: Path) -> Intrinsics:
    """Return the intrinsics of the camera that saw points (h, w, 3), by least squares over all of them."""
    rows, columns = np.indices(points.shape[:2])
    return _fitted(points.reshape(-1, 3), np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64), path)


def _fitted(points: npt.NDArray[np.float64], pixels: npt.NDArray[np.float64], path: Path) -> Intrinsics:
    """Return the intrinsics of the camera that saw points (n, 3) at pixels (n, 2)."""
    seen = np.isfinite(points).all(axis=1) & (points[:, 2] > _LEAST_Z) & np.isfinite(pixels).all(axis=1)
    if np.count_nonzero(seen) < 100:
        raise InputError(
            f"{path}: has only {np.count_nonzero(seen)} points before the camera; z must point forward, in m."
        )
    found, off_px = [], []
    for axis in (0, 1):
        slope = points[seen, axis] / points[seen, 2]
        design = np.stack([slope, np.ones(slope.size)], axis=1)
        line, *_ = np.linalg.lstsq(design, pixels[seen, axis], rcond=None)
        found.append(line)
        off_px.append(float(np.median(np.abs(design @ line - pixels[seen, axis]))))
    (fx, cx), (fy, cy) = ((float(slope), float(start)) for slope, start in found)
    if max(off_px) > 1.0 or not sane((fx, fy, cx, cy)):  # no pinhole camera saw these points
        raise InputError(
            f"{path}: its points are not on the rays of a pinhole camera (off by {max(off_px):.1f} px); save them in "
            "camera coordinates (x right, y down, z forward), or give `intrinsics` FX FY CX CY."
        )
    return fx, fy, cx, cy


def _read(path: Path) -> _Cloud:
    """Return a cloud as stored."""
    width, height = organised(path)
    with input_errors(path, "cloud", "save it again"), open_regular(path) as file:
        points, colours = (_read_pcd if path.suffix.lower() == ".pcd" else _read_ply)(file)
    if points.shape != (width * height, 3):
        raise InputError(f"{path}: is cut off or broken, {len(points)} points could be read; save it again.")
    points = np.where(np.isfinite(points) & (np.abs(points) < 1e9), points, np.nan)
    if colours.shape[:1] != (width * height,) or colours.ndim != 2 or colours.shape[1] < 3:
        return _Cloud(points, None, (width, height))
    return _Cloud(points, colours[:, :3].astype(np.uint8), (width, height))


def _read_pcd(file: BinaryIO) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return points (n, 3) and colours (n, 3) from 0 to 255, or (0, 3), of a PCD file."""
    import open3d as o3d  # takes a second

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        open_file = Path(f"/dev/fd/{file.fileno()}")  # Open3D takes no open files
        cloud = o3d.io.read_point_cloud(open_file, format="pcd", remove_nan_points=False, remove_infinite_points=False)
    shares = np.nan_to_num(np.asarray(cloud.colors, dtype=np.float64)).clip(0.0, 1.0)
    return np.asarray(cloud.points, dtype=np.float64), np.rint(255.0 * shares)


def _image_coordinates(path: Path) -> npt.NDArray[np.float64] | None:
    """Return the pixels (n, 2) at which the points of a PCD were seen, where it has them, as Washington's."""
    if path.suffix.lower() != ".pcd":
        return None
    with input_errors(path, "cloud", "save it again"), open_regular(path) as file:
        if re.search(rb"(?m)^FIELDS\b.* imX imY\b", file.read(PIECE_BYTES)) is None:
            return None
        import open3d as o3d

        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            read = o3d.t.io.read_point_cloud(Path(f"/dev/fd/{file.fileno()}"), format="pcd")
        return np.hstack([read.point[name].numpy().astype(np.float64) for name in ("imX", "imY")])


def _read_ply(file: BinaryIO) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return points (n, 3) and colours (n, 3 or 4) from 0 to 255, or (0, 3), of a PLY file."""
    from trimesh.exchange.ply import load_ply

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read = load_ply(file)
        colours = np.asarray(read.get("vertex_colors", np.zeros((0, 3))), dtype=np.float64)
        return np.asarray(read["vertices"], dtype=np.float64), np.nan_to_num(colours).clip(0.0, 255.0)
