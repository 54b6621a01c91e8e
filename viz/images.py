"""What the camera saw: colour, depth and the object mask, compressed."""

from __future__ import annotations

import io
import math
from typing import Final

import numpy as np
import numpy.typing as npt
import rerun as rr
from PIL import Image

from modeler.types import BoolArray, Frame, Step
from viz import entities
from viz.drawings import Drawing

_PIXELS: Final = 500_000  # larger images are shown at a whole fraction of their size
_DEPTH_PIXELS: Final = 100_000
_JPEG_QUALITY: Final = 80
_DEPTH_UNITS_PER_M: Final = 1000.0  # finer units make the picture no better and the file several times larger
_RUN_LENGTHS: Final = 3  # zlib's strategy; for filtered depth the quickest, and small
_DIMMED: Final = 0.65  # how dark what is not the object becomes


def statics() -> Drawing:
    """Yield what is said once: the mask leaves the object as it is and dims the rest."""
    background = rr.AnnotationInfo(id=0, label="background", color=(0, 0, 0))
    yield entities.MASK, rr.AnnotationContext([background, rr.AnnotationInfo(1, "object", (0, 0, 0, 0))])


def drawing(step: Step) -> Drawing:
    """Yield the colour image, the depth image and the mask of the step's frame."""
    stride, coarse = stride_px(step.frame), depth_stride_px(step.frame)
    mask = step.segmentation.mask
    if step.frame.colour is None:
        yield entities.COLOUR, rr.Clear(recursive=False)
    else:
        yield entities.COLOUR, _jpeg(step.frame.colour[::stride, ::stride])
    yield entities.DEPTH, _depth_png(step.frame.depth_m[::coarse, ::coarse], mask[::coarse, ::coarse])
    shown = mask[::stride, ::stride].astype(np.uint8)
    yield entities.MASK, rr.SegmentationImage(shown, opacity=_DIMMED, draw_order=1.0)


def stride_px(frame: Frame) -> int:
    """Return how many pixels of the frame one pixel of its pictures stands for, along either axis."""
    return math.ceil(math.sqrt(frame.depth_m.size / _PIXELS))


def depth_stride_px(frame: Frame) -> int:
    """Return the same for pictures made of depth, which are costly to pack and show no more when they are finer."""
    return math.ceil(math.sqrt(frame.depth_m.size / _DEPTH_PIXELS))


def _jpeg(colour: npt.NDArray[np.uint8]) -> rr.EncodedImage:
    """Return an RGB image (h, w, 3) as JPEG."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(colour)).save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return rr.EncodedImage(contents=buffer.getvalue(), media_type="image/jpeg", draw_order=0.0)


def _depth_png(depth_m: npt.NDArray[np.float32], mask: BoolArray) -> rr.EncodedDepthImage:
    """Return a depth image (h, w) in m as 16-bit PNG, its colours spread over the object and a little around it."""
    units = np.nan_to_num(depth_m * _DEPTH_UNITS_PER_M, nan=0.0, posinf=0.0, neginf=0.0)
    buffer = io.BytesIO()
    pixels = np.clip(np.rint(units), 0, np.iinfo(np.uint16).max).astype(np.uint16)
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=1, compress_type=_RUN_LENGTHS)
    return rr.EncodedDepthImage(
        blob=buffer.getvalue(),
        media_type="image/png",
        meter=_DEPTH_UNITS_PER_M,
        depth_range=_depth_range(pixels, mask),
        draw_order=0.0,
    )


def _depth_range(pixels: npt.NDArray[np.uint16], mask: BoolArray) -> tuple[float, float]:
    """Return the depths, in units of the image, that the ends of the colour scale stand for."""
    chosen = pixels[mask & (pixels > 0)][::4]
    if chosen.size == 0:
        chosen = pixels[pixels > 0]
    if chosen.size == 0:
        return 0.0, 1.0
    near, far = np.percentile(chosen, (1, 99))
    margin = max(0.5 * (far - near), 1.0)
    return float(near - margin), float(far + margin)
