"""A picture of some frames of an input: depth, colour with the edges of depth over it, and the mask."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from modeler.sequences.colour_alignment import depth_edges
from modeler.sequences.survey import measured_pixels
from modeler.types import Frame, InputError

_EDGE = (255, 0, 0)
_NEAR, _FAR = np.array([255.0, 220.0, 120.0]), np.array([30.0, 40.0, 110.0])
_GAP = 4


def write_picture(path: Path, frames: Sequence[Frame]) -> None:
    """Write a PNG with a row a frame: depth from near (light) to far (dark), colour or depth with edges, the mask.

    Raises:
        InputError: if it cannot be written.
    """
    rows = [np.concatenate([np.pad(image, _PAD) for image in _images(frame)], axis=1) for frame in frames]
    width = max(row.shape[1] for row in rows)
    whole = np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])
    try:
        Image.fromarray(whole).save(path, "PNG")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from None


_PAD = ((0, _GAP), (0, _GAP), (0, 0))


def _images(frame: Frame) -> list[npt.NDArray[np.uint8]]:
    """Return the images (h, w, 3) of a row."""
    depth = _shaded(frame)
    over = (depth if frame.colour is None else frame.colour).copy()
    over[depth_edges(frame.depth_m)] = _EDGE
    if frame.mask is None:
        return [depth, over]
    return [depth, over, np.where(frame.mask[..., None], depth, depth // 4).astype(np.uint8)]


def _shaded(frame: Frame) -> npt.NDArray[np.uint8]:
    """Return depth as an image (h, w, 3), black where nothing was measured."""
    measured = measured_pixels(frame)
    image = np.zeros((*frame.depth_m.shape, 3), np.uint8)
    if measured.any():
        near, far = np.percentile(frame.depth_m[measured], (1.0, 99.0))
        share = np.clip((frame.depth_m[measured] - near) / max(far - near, 1e-6), 0.0, 1.0)[:, None]
        image[measured] = (_NEAR + share * (_FAR - _NEAR)).astype(np.uint8)
    return image
