"""Colour and mask images on disk, and the decoding of images."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import re
import threading
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from modeler.system.regular_files import open_regular, unreadable
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
                with quiet() if image.format == "TIFF" else contextlib.nullcontext():
                    image.load()
                return image
    except InputError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise InputError(f"{path}: has more than {MAX_PIXELS // 1_000_000} million pixels; scale it down.") from None
    except Exception as error:  # a broken image can make the library raise anything
        why = re.sub(r" file <_io\.[^>]*>| file '[^']*'", "", " ".join(str(error).split())) or type(error).__name__
        raise InputError(f"{path}: is not a readable {wanted} image ({why}); replace it.") from None


@contextlib.contextmanager
def _stream(path: Path | EmbeddedImage) -> Iterator[IO[bytes]]:
    """Open an image for reading."""
    if isinstance(path, EmbeddedImage):
        yield io.BytesIO(path.content)
        return
    try:
        stream = open_regular(path)
    except OSError as error:
        raise unreadable(path, error) from None
    with stream:
        yield stream


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


@contextlib.contextmanager
def quiet(into: IO[bytes] | None = None) -> Iterator[None]:
    """Keep a library from writing to stderr, which is one for all threads: into a file, or nowhere."""
    with _STDERR:
        stderr, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere if into is None else into.fileno(), 2)
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            os.close(nowhere)


_STDERR = threading.Lock()


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


def object_and_occluder(
    labels: npt.NDArray[np.uint8], occluder: BoolArray | None
) -> tuple[BoolArray, BoolArray | None]:
    """Return the masks (h, w) of an object and of its occluder; None if not given."""
    marked = labels == OCCLUDED
    if not marked.any():
        return labels != 0, occluder
    return (labels != 0) & ~marked, marked if occluder is None else marked | occluder


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
