"""Pictures of frames for the page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.spatial.transform import Rotation

from modeler.sequences.survey import shaded_depth
from modeler.system.pictures import encoded
from modeler.types import BoolArray, Frame
from modeler.viz.entities import OUTLINE_RGB
from modeler.viz.images import outline

THUMBNAIL_PX: Final = 80  # height of a small picture


def picture(frame: Frame) -> npt.NDArray[np.uint8]:
    """Return a frame as a picture (h, w, 3): its colour, else its depth."""
    return shaded_depth(frame) if frame.colour is None else frame.colour


def jpeg(frame: Frame) -> bytes:
    """Return a frame as JPEG."""
    return encoded(picture(frame), "JPEG")


def thumbnail(frame: Frame, mask: BoolArray | None) -> bytes:
    """Return a small picture of a frame as JPEG, all but the mask (h, w) darkened."""
    pixels = picture(frame)
    if mask is not None:
        pixels = np.where(mask[..., None], pixels, pixels // 3)
    image = Image.fromarray(np.ascontiguousarray(pixels.astype(np.uint8)))
    image.thumbnail((4 * THUMBNAIL_PX, THUMBNAIL_PX))
    return encoded(np.asarray(image), "JPEG")


def outline_svg(mask: BoolArray | None) -> str:
    """Return the outline of a mask (h, w) as SVG in px of the image; nothing without a mask."""
    if mask is None:
        return ""
    steps = _lines(mask)
    red, green, blue = OUTLINE_RGB
    style = "fill='none' vector-effect='non-scaling-stroke'"
    return (
        f"<path d='{steps}' {style} stroke='black' stroke-width='4' opacity='0.5'/>"
        f"<path d='{steps}' {style} stroke='rgb({red},{green},{blue})' stroke-width='2'/>"
    )


def ghost_svg(mask: BoolArray | None) -> str:
    """Return the outline of where the object (h, w) should be next, as SVG; nothing without one."""
    if mask is None:
        return ""
    style = "fill='none' stroke='white' stroke-width='1.5' opacity='0.8' vector-effect='non-scaling-stroke'"
    return f"<path d='{_lines(mask)}' {style}><title>the next view</title></path>"


def _lines(mask: BoolArray) -> str:
    """Return the outline of a mask (h, w) as the lines of an SVG path."""
    return "".join(f"M{x0:g} {y0:g}L{x1:g} {y1:g}" for (x0, y0), (x1, y1) in outline(mask))


def stroke_svg(points: list[tuple[float, float]], radius_px: float, *, add: bool) -> str:
    """Return a stroke of the brush as SVG."""
    places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    colour = "#35c26b" if add else "#e4572e"
    return (
        f"<polyline points='{places} {places.rpartition(' ')[2]}' fill='none' stroke='{colour}' opacity='0.55' "
        f"stroke-width='{2.0 * radius_px:.1f}' stroke-linecap='round' stroke-linejoin='round'/>"
    )


def box_svg(corner: tuple[float, float], opposite: tuple[float, float]) -> str:
    """Return a box as SVG."""
    (x0, x1), (y0, y1) = (sorted((corner[axis], opposite[axis])) for axis in (0, 1))
    return (
        f"<rect x='{x0:.1f}' y='{y0:.1f}' width='{x1 - x0:.1f}' height='{y1 - y0:.1f}' fill='none' stroke='white' "
        "stroke-width='2' stroke-dasharray='6 4' vector-effect='non-scaling-stroke'/>"
    )


def turns_deg(report: Mapping[str, Any]) -> dict[int, float]:
    """Return how far the object had turned about the vertical in each view since the first, by frame number.

    That is the twist of its rotation about the support's normal; without a support, about the image's vertical.
    """
    up = np.asarray(report.get("up") or (0.0, -1.0, 0.0), dtype=np.float64)
    poses = {pose["id"]: np.reshape(pose["object_from_camera"], (4, 4))[:3, :3] for pose in report["poses"]}
    turns = {k: Rotation.from_matrix(pose).as_quat() for k, pose in poses.items()}
    return {k: float(np.degrees(2.0 * np.arctan2(turn[:3] @ up, turn[3]))) % 360.0 for k, turn in turns.items()}


def ring_svg(report: Mapping[str, Any]) -> str:
    """Return the views around the object, seen from above, as SVG: gaps in the ring are not seen yet."""
    dots = ""
    for k, turn_deg in turns_deg(report).items():
        x, y = 50.0 + 38.0 * np.sin(np.radians(turn_deg)), 50.0 + 38.0 * np.cos(np.radians(turn_deg))
        dots += f"<circle cx='{x:.1f}' cy='{y:.1f}' r='4' fill='#0b6b75'><title>frame {k}</title></circle>"
    return (
        "<svg viewBox='0 0 100 100' width='120' height='120' role='img' aria-label='Views around the object'>"
        "<circle cx='50' cy='50' r='38' fill='none' stroke='#b9c3cc' stroke-width='2' stroke-dasharray='3 3'/>"
        f"<rect x='42' y='42' width='16' height='16' rx='3' fill='#b9c3cc'/>{dots}</svg>"
    )
