"""Depth images on disk: whole numbers (PNG, TIFF, PGM) or fractions (EXR, NumPy, TIFF)."""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
import zipfile
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt

from modeler.sequences.image_files import MAX_PIXELS, EmbeddedImage, image_size, open_image, quiet
from modeler.sequences.input_files import entries, input_errors
from modeler.system.regular_files import open_regular, unreadable
from modeler.types import InputError

RawDepth = npt.NDArray[np.uint16] | npt.NDArray[np.float32]
"""Depth (h, w) as stored: whole numbers with a unit of their own, or fractions in m or mm; 0 = no measurement."""
SUFFIXES: Final = (".png", ".tif", ".tiff", ".pgm", ".exr", ".npy", ".npz")
FORMATS: Final = "16-bit PNG, TIFF and PGM, EXR and NumPy files"
NOTHING: Final = 65504.0
"""Largest number of 16 bits with fractions. Programs write it, the largest integer, more or infinity for nothing."""
LEAST_MM: Final = 50.0  # median depth: nothing is 50 m away, nor 50 mm
_KINDS: Final = {"L": "an 8-bit image", "P": "an 8-bit image", "RGB": "a colour image", "RGBA": "a colour image"}
_WANTED: Final = "depth must be a 16-bit greyscale PNG, TIFF or PGM image, or floating point (TIFF, EXR, NumPy)"


def read_depth(path: Path | EmbeddedImage) -> RawDepth:
    """Return a depth image (h, w) as stored."""
    suffix = path.suffix.lower() if isinstance(path, Path) else ""
    reader = {".pgm": _read_pgm, ".exr": _read_exr, ".npy": _read_npy, ".npz": _read_npz}.get(suffix)
    if reader is not None and isinstance(path, Path):
        with input_errors(path, f"{suffix[1:].upper()} file", "replace it"):
            try:
                file = open_regular(path)
            except OSError as error:
                raise unreadable(path, error) from None
            with file:
                return _as_depth(reader(file), path)
    image = open_image(path, ("PNG", "TIFF"))
    if image.mode not in ("I;16", "I;16B", "I", "F"):
        kind = _KINDS.get(image.mode, f"of mode {image.mode}")
        raise InputError(f"{path}: is {kind}; {_WANTED}.")
    return _as_depth(np.asarray(image), path)


def _as_depth(pixels: npt.NDArray[np.generic], path: Path | EmbeddedImage) -> RawDepth:
    """Return an array (h, w) or (h, w, 1) as depth."""
    pixels = pixels[..., 0] if pixels.ndim == 3 and pixels.shape[2] == 1 else pixels
    if pixels.ndim != 2 or not pixels.size or pixels.dtype.kind not in "iuf" or pixels.dtype == np.uint8:
        raise InputError(f"{path}: holds {pixels.dtype} values of shape {pixels.shape}; {_WANTED}.")
    if pixels.dtype.kind == "f":
        with np.errstate(over="ignore", invalid="ignore"):
            return pixels.astype(np.float32)
    if pixels.min() < 0 or pixels.max() > np.iinfo(np.uint16).max:
        raise InputError(f"{path}: holds values beyond 16 bits; {_WANTED}.")
    return pixels.astype(np.uint16)


def _check_size(width: int, height: int) -> None:
    if not 0 < width * height <= MAX_PIXELS:
        raise ValueError(f"{width} x {height} pixels")


def _read_pgm(file: BinaryIO) -> npt.NDArray[np.generic]:
    """Read a binary PGM, as it is: Pillow would scale its values to the full range."""
    head = file.read(1024)
    match = re.match(
        rb"P5\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(?:#[^\n]*\n\s*)*(\d{1,5})\s", head
    )
    if match is None:
        raise ValueError("it has no header of a binary PGM")
    width, height, largest = (int(number) for number in match.groups())
    _check_size(width, height)
    if largest < 256:
        return np.zeros((height, width), np.uint8)  # which is refused
    file.seek(match.end())
    data = file.read(2 * width * height)
    if len(data) < 2 * width * height:
        raise ValueError("it is cut off")
    return np.frombuffer(data, ">u2").reshape(height, width)


def _read_npy(file: BinaryIO) -> npt.NDArray[np.generic]:
    version = np.lib.format.read_magic(file)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = header(file)
    _check_size(*(shape if len(shape) == 2 else (int(np.prod(shape, dtype=np.float64).clip(0, 1e12)), 1)))
    if dtype.kind not in "iuf":
        raise ValueError(f"it holds {dtype}")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def _read_npz(file: BinaryIO) -> npt.NDArray[np.generic]:
    """Read the array `depth` of an archive, or its only one."""
    with zipfile.ZipFile(file) as archive:
        named = archive.namelist()
        name = next((name for name in named if name in ("depth.npy", "depth_m.npy", "arr_0.npy")), None)
        if name is None and len(named) != 1:
            raise ValueError(f"it holds {', '.join(named[:4]) or 'nothing'}, none of which is depth")
        entry = archive.getinfo(name or named[0])
        if entry.file_size > 8 * MAX_PIXELS:
            raise ValueError("it would unpack to more than the largest image")
        with archive.open(entry) as inner:
            return _read_npy(io.BytesIO(inner.read(8 * MAX_PIXELS)))


def _read_exr(file: BinaryIO) -> npt.NDArray[np.generic]:
    """Read the channel of depth of an OpenEXR image: Z, depth or Y, or the first of R, G and B."""
    import OpenEXR

    name = f"/dev/fd/{file.fileno()}"  # the library takes no open files
    with tempfile.TemporaryFile() as said:  # where it reports pixels that it could not read, and goes on
        with quiet(said), contextlib.redirect_stdout(io.StringIO()):  # where it warns of what it then raises
            with OpenEXR.File(name, header_only=True) as header:
                (left, top), (right, bottom) = (corner.tolist() for corner in header.header()["dataWindow"])
                _check_size(right - left + 1, bottom - top + 1)
            with OpenEXR.File(name, separate_channels=True) as image:
                found = {channel.lower(): np.array(value.pixels) for channel, value in image.channels().items()}
        said.seek(0)
        if report := said.read(1000).decode("utf-8", "replace"):
            raise ValueError(report.splitlines()[0].partition("EXR_ERR_")[2].rstrip(") ") or "its pixels are damaged")
    order = ("z", "depth", "depth.v", "depth.z", "y", "v", "r")
    best = next((found[channel] for channel in order if channel in found), None)
    if best is None and len(found) == 1:
        (best,) = found.values()
    if best is None:
        raise ValueError(f"none of its channels {', '.join(found)} is depth")
    return best


def depth_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of a depth image."""
    if path.suffix.lower() in (".png", ".tif", ".tiff"):
        return image_size(path)
    height, width = read_depth(path).shape
    return width, height


_SMOOTHER: Final = 4.0  # times rougher: bytes in the right order never are


def is_swapped(raw: RawDepth) -> bool:
    """Return whether whole numbers have their two bytes exchanged: neighbours are much more alike once they are not."""
    if raw.dtype != np.uint16:
        return False

    def roughness(values: npt.NDArray[Any]) -> float:
        left, right = values[:, :-1].astype(np.int64), values[:, 1:].astype(np.int64)
        both = (left > 0) & (right > 0)
        return float(np.abs(left - right)[both].mean()) if both.any() else 0.0

    return roughness(raw) > _SMOOTHER * roughness(raw.byteswap()) > 0.0


def float_unit_mm(raw: RawDepth) -> float | None:
    """Return the millimetres per unit of fractional depth, m or mm by its median; None of whole numbers."""
    if raw.dtype == np.uint16:
        return None
    measured = raw[np.isfinite(raw) & (raw > 0.0) & (raw < NOTHING)]
    return 1.0 if measured.size and float(np.median(measured)) > LEAST_MM else 1000.0


def metres(raw: RawDepth, scale_mm: float) -> npt.NDArray[np.float32]:
    """Return depth (h, w) in m of stored depth; NaN where it is 0, or stands for nothing."""
    if raw.dtype == np.uint16:
        nothing = (raw == 0) | (raw == np.iinfo(np.uint16).max)
        return np.where(nothing, np.float32(np.nan), (raw * (scale_mm / 1000.0)).astype(np.float32))
    with np.errstate(invalid="ignore", over="ignore"):
        seen = np.isfinite(raw) & (raw > 0.0) & (raw < NOTHING)
        return np.where(seen, raw * np.float32(scale_mm / 1000.0), np.float32(np.nan))


def no_depth(folder: Path, wanted: str, formats: str = FORMATS) -> InputError:
    """Return the error for a folder without depth images that can be read: what should be there, and what is read."""
    others = sorted({path.suffix.lower() for path in entries(folder) if path.suffix and not path.name.startswith(".")})
    if others:
        return InputError(
            f"{folder}: holds no depth image that can be read, but files {', '.join(others[:3])}; {formats} are read, "
            "convert them."
        )
    return InputError(f"{folder}: holds no depth image; put {wanted} there.")


def check_same_size(path: Path, size: tuple[int, ...], alike: Path, said: str) -> None:
    """Refuse a depth image of another size than one with the same intrinsics."""
    width, height = depth_size(alike)
    if size != (height, width):
        raise InputError(f"{path}: is {size[1]} x {size[0]} pixels where {alike.name} is {width} x {height}, {said}.")
