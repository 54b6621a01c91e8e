"""Depth, colour and mask images on disk, and the decoding of images."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import tempfile
import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt
from PIL import Image

from modeler.sequences.input_files import entries, input_errors
from modeler.system.processes import diverted
from modeler.system.regular_files import open_regular
from modeler.types import BoolArray, InputError

MAX_PIXELS = 50_000_000
"""Larger images are refused before they are decoded: no depth camera makes them, decompression bombs do."""

COLOUR_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm")
MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "PPM")


@dataclass(frozen=True)
class EmbeddedImage:
    """An image that is stored within another file."""

    content: bytes
    where: str
    """The file and the place in it, for error messages."""

    def __str__(self) -> str:
        return self.where


def open_image(path: Path | EmbeddedImage, formats: tuple[str, ...]) -> Image.Image:
    """Return an image fully decoded."""
    wanted = " or ".join(formats)
    try:
        with _stream(path) as stream, warnings.catch_warnings(), _unlogged():
            warnings.simplefilter("ignore")  # what is wrong is reported below, in one line
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(stream, formats=formats) as image:
                if image.width * image.height > MAX_PIXELS:
                    raise Image.DecompressionBombError
                with diverted(2) if image.format == "TIFF" else contextlib.nullcontext():
                    image.load()
                return image
    except InputError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise InputError(f"{path}: has more than {MAX_PIXELS // 1_000_000} million pixels; scale it down.") from None
    except Exception as error:  # a broken image can make the library raise anything
        why = re.sub(r" file <_io\.[^>]*>| file '[^']*'", "", " ".join(str(error).split())) or type(error).__name__
        raise InputError(f"{path}: is not a readable {wanted} image ({why}); replace it.") from None


def _stream(path: Path | EmbeddedImage) -> BinaryIO:
    """Open an image for reading."""
    return io.BytesIO(path.content) if isinstance(path, EmbeddedImage) else open_regular(path)


@contextlib.contextmanager
def _unlogged() -> Iterator[None]:
    """Keep Pillow from logging."""
    logger = logging.getLogger("PIL")
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(before)


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of an image from its header."""
    try:
        with _stream(path) as stream, warnings.catch_warnings(), _unlogged():
            warnings.simplefilter("ignore")
            with Image.open(stream, formats=_FORMATS) as image:
                return image.size
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: is not a readable image ({type(error).__name__}); replace it.") from None


def read_mask(path: Path) -> BoolArray:
    """Return a mask (h, w), True where the image is not black. Of `read_labels`, occluders count too."""
    return read_labels(path) != 0


OCCLUDED = 128  # value of a mask's pixels that show a hand or a gripper


def read_labels(path: Path) -> npt.NDArray[np.uint8]:
    """Return the values of a mask (h, w): 0 or `OCCLUDED` of 8-bit images of those values, else 255.

    In images of few values, labels, all but 0 are object; of the many between black and white that soft edges, veils
    and JPEG make, those from the middle of the range on.
    """
    pixels, is_grey = _mask_pixels(path)
    soft, few = is_soft(pixels), len(_values(pixels)) <= _FEW_LABELS
    own = pixels >= np.ceil(pixels.max() / 2) if soft else pixels != 0
    occluded = (pixels == OCCLUDED) & (is_grey and (few or not soft))  # a palette numbers things
    return np.where(occluded, OCCLUDED, np.where(own, 255, 0)).astype(np.uint8)


def _mask_pixels(path: Path) -> tuple[npt.NDArray[Any], bool]:
    """Return the values of a mask (h, w), of colour the brightest channel, and whether it is stored as 8-bit grey."""
    image = open_image(path, _FORMATS)
    if image.mode in ("LA", "RGBA", "PA"):
        alpha = np.asarray(image.getchannel("A"))
        if alpha.min() < 255:  # the object is cut out
            return alpha, False
    if image.mode in ("1", "L", "P", "I;16", "I"):
        return np.asarray(image if image.mode != "P" else image.convert("L")), image.mode == "L"
    return np.asarray(image.convert("RGB")).max(axis=2), False


_WHITE, _VEIL, _FEW_LABELS = 192, 16, 8  # a mask is white somewhere; grades begin near black, and are many


def is_soft(pixels: npt.NDArray[Any]) -> bool:
    """Return whether a mask (h, w) is graded between black and white, instead of a few labels."""
    if pixels.dtype != np.uint8 or pixels.max(initial=0) < _WHITE:
        return False
    values = _values(pixels)
    between = values[(values > 0) & (values < values[-1]) & (values != OCCLUDED)]
    return len(between) > _FEW_LABELS or values[0] > 0 or bool(between.size and between[0] <= _VEIL)


def _values(pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the values that occur, ascending."""
    return np.flatnonzero(np.bincount(pixels.ravel())) if pixels.dtype == np.uint8 else np.unique(pixels)


def graded(path: Path) -> bool:
    """Return whether the mask in a file is graded between black and white."""
    return is_soft(_mask_pixels(path)[0])


def read_masks(
    mask: Path | None, occluder: Path | None, depth: tuple[int, ...]
) -> tuple[BoolArray | None, BoolArray | None]:
    """Return the masks (h, w) of an object and of its occluder, of which the object's may show some; None without.

    `depth` (h, w) is the size of their depth image.
    """
    hidden = None if occluder is None else read_mask(occluder)
    labels = None if mask is None else read_labels(mask)
    for path, image in ((mask, labels), (occluder, hidden)):
        if path is not None and image is not None:
            check_size(path, image.shape, depth)
    if labels is None:
        return None, hidden
    marked = labels == OCCLUDED
    if not marked.any():
        return labels != 0, hidden
    return (labels != 0) & ~marked, marked if hidden is None else marked | hidden


def read_colour(path: Path | EmbeddedImage) -> npt.NDArray[np.uint8]:
    """Return an image, in colour or grey, as RGB (h, w, 3)."""
    image = open_image(path, _FORMATS)
    if image.mode.startswith("I"):  # 16-bit grey, which Pillow would clip rather than scale
        grey = (np.asarray(image).astype(np.uint32) >> 8).astype(np.uint8)
        return np.repeat(grey[:, :, None], 3, axis=2)
    return np.array(image.convert("RGB"))


def write_image(path: Path, pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> None:
    """Write pixels in the format of the suffix: PNG with best compression, or JPEG at quality 85."""
    image = Image.fromarray(np.ascontiguousarray(pixels))
    if path.suffix == ".jpg":
        image.save(path, quality=85, optimize=True)
    else:
        image.save(path, compress_level=9, optimize=True)


def check_size(path: Path, found: tuple[int, ...], depth: tuple[int, ...]) -> None:
    """Refuse a mask or colour of another size than its depth image, each (h, w)."""
    if found != depth:
        raise InputError(
            f"{path}: is {found[1]} x {found[0]} pixels where its depth image is {depth[1]} x {depth[0]}; "
            "colour and masks must be aligned to depth; align them, or move colour away to do without."
        )


def resize_to_depth(path: Path, colour: npt.NDArray[np.uint8], depth: tuple[int, ...]) -> npt.NDArray[np.uint8]:
    """Return colour (h, w, 3) in the size of its depth image, shrunk where it is finer and of the same shape."""
    height, width = depth
    if is_finer(colour.shape[1::-1], (width, height)):
        return np.array(Image.fromarray(colour).resize((width, height), Image.Resampling.BOX))
    check_size(path, colour.shape[:2], depth)
    return colour


def is_finer(colour: tuple[int, ...], depth: tuple[int, ...]) -> bool:
    """Return whether colour has more pixels than depth, each (width, height), and the same shape to the pixel."""
    return colour[0] > depth[0] and abs(colour[0] * depth[1] / depth[0] - colour[1]) < 1.0


RawDepth = npt.NDArray[np.uint16] | npt.NDArray[np.float32]
"""Depth (h, w) as stored: whole numbers with a unit of their own, or fractions in m or mm; 0 = no measurement."""
DEPTH_SUFFIXES: Final = (".png", ".tif", ".tiff", ".pgm", ".exr", ".npy", ".npz")
DEPTH_FORMATS: Final = "16-bit PNG, TIFF and PGM, EXR and NumPy files"
NOTHING: Final = 65504.0
"""Largest number of 16 bits with fractions. Programs write it, the largest integer, more or infinity for nothing."""
LEAST_MM: Final = 50.0  # median depth: nothing is 50 m away, nor 50 mm
_DEPTH_KINDS: Final = {"L": "an 8-bit image", "P": "an 8-bit image", "RGB": "a colour image", "RGBA": "a colour image"}
_WANTED: Final = "depth must be a 16-bit greyscale PNG, TIFF or PGM image, or floating point (TIFF, EXR, NumPy)"


def read_depth(path: Path | EmbeddedImage) -> RawDepth:
    """Return a depth image (h, w) as stored."""
    suffix = path.suffix.lower() if isinstance(path, Path) else ""
    reader = {".pgm": _read_pgm, ".exr": _read_exr, ".npy": _read_npy, ".npz": _read_npz}.get(suffix)
    if reader is not None and isinstance(path, Path):
        with input_errors(path, f"{suffix[1:].upper()} file", "replace it"), open_regular(path) as file:
            return _as_depth(reader(file), path)
    image = open_image(path, ("PNG", "TIFF"))
    if image.mode not in ("I;16", "I;16B", "I", "F"):
        kind = _DEPTH_KINDS.get(image.mode, f"of mode {image.mode}")
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


def _check_pixels(width: int, height: int) -> None:
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
    _check_pixels(width, height)
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
    _check_pixels(*(shape if len(shape) == 2 else (int(np.prod(shape, dtype=np.float64).clip(0, 1e12)), 1)))
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
        with diverted(2, said), contextlib.redirect_stdout(io.StringIO()):  # where it warns of what it then raises
            with OpenEXR.File(name, header_only=True) as header:
                (left, top), (right, bottom) = (corner.tolist() for corner in header.header()["dataWindow"])
                _check_pixels(right - left + 1, bottom - top + 1)
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


def is_swapped(raw: RawDepth) -> bool:
    """Return whether whole numbers have their two bytes exchanged: neighbours are much more alike once they are not."""
    if raw.dtype != np.uint16:
        return False

    def roughness(values: npt.NDArray[Any]) -> float:
        left, right = values[:, :-1].astype(np.int64), values[:, 1:].astype(np.int64)
        both = (left > 0) & (right > 0)
        return float(np.abs(left - right)[both].mean()) if both.any() else 0.0

    return roughness(raw) > 4.0 * roughness(raw.byteswap()) > 0.0  # times rougher: bytes in the right order never are


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


def no_depth(folder: Path, wanted: str, formats: str = DEPTH_FORMATS) -> InputError:
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
