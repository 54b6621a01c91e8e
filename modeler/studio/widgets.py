"""Parts of pages that several steps have, and pictures of frames for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from nicegui import ui
from PIL import Image
from scipy.spatial.transform import Rotation

from modeler.sequences.survey import shaded_depth
from modeler.system.pictures import encoded
from modeler.types import BoolArray, Frame, InputError
from modeler.viz.entities import OUTLINE_RGB
from modeler.viz.images import outline

PRIORS: Final = {
    "auto": ("Not sure", "The images decide.", "M8 38h48M32 10v6M32 22a8 8 0 1 0-8-8M32 30v1"),
    "table": (
        "On a table",
        "Turned by hand; it keeps standing.",
        "M6 44h52M22 44V24h20v20M50 16a18 8 0 0 0-36 0m36 0-5-4m5 4 4-5",
    ),
    "turntable": (
        "Turntable",
        "The same step each time.",
        "M32 50a24 7 0 1 0 0-14 24 7 0 1 0 0 14M24 38V20h16v18M14 30a20 6 0 0 1 36 0",
    ),
    "general": (
        "In the hand",
        "Held freely, or laid down anew.",
        "M22 34 34 22 46 34 34 46ZM12 52c8-10 8-14 10-18M10 22a24 24 0 0 1 24-14",
    ),
    "held": (
        "Robot's hand",
        "Its poses are in robot.txt.",
        "M12 54V36l14-14 14 6M40 28v8h10v10M40 36h-2M26 22v-8",
    ),
}
"""Label, what it means, and the lines of a picture, of each motion prior."""


def div(classes: str = "", props: str = "") -> ui.element:
    """Return a block."""
    return ui.element("div").classes(classes).props(props)


def heading(words: str) -> ui.label:
    """Return a heading."""
    return ui.label(words).classes("text-h6")


def quiet(words: str = "") -> ui.label:
    """Return words that explain; lines stay lines."""
    return ui.label(words).classes("quiet").style("white-space: pre-line")


def main_button(words: str, act: Callable[..., Any]) -> ui.button:
    """Return a button as wide as its column, for what usually follows."""
    return ui.button(words, on_click=act).props("no-caps").classes("w-full q-mt-sm")


def plain_button(words: str, act: Callable[..., Any]) -> ui.button:
    """Return a button for what is needed now and then."""
    return ui.button(words, on_click=act).props("outline no-caps dense")


def command_line() -> ui.label:
    """Return where the command line that does the same is shown."""
    with ui.element("details").classes("card"):
        with ui.element("summary").classes("quiet"):
            ui.label("The same in a terminal").style("display: inline")
        return ui.label().classes("line").style("white-space: pre-line")


def embedded_viewer(address: str) -> None:
    """Embed Rerun's viewer."""
    frame = ui.element("iframe").props("title='The model in the Rerun viewer' allow=fullscreen")
    frame.props["src"] = address
    frame.style("height: calc(100vh - 130px); min-height: 380px")


def drawing(lines: str) -> ui.html:
    """Return a small picture of lines."""
    return ui.html(
        "<svg viewBox='0 0 64 60' aria-hidden='true'><path fill='none' stroke='#0b6b75' stroke-width='2.5' "
        f"stroke-linecap='round' stroke-linejoin='round' d='{lines}'/></svg>",
        sanitize=False,
    )


def mark(element: ui.element, name: str, *, on: bool) -> None:
    """Give an element a class, or take it away."""
    element.classes(add=name if on else "", remove="" if on else name)


def sentence(words: str) -> str:
    """Return words of the library as a sentence."""
    plain = words.strip().rstrip(".").replace("`", "")
    return f"{plain[:1].upper()}{plain[1:]}." if plain else ""


def complain(error: InputError | str) -> None:
    """Tell what went wrong."""
    words = str(error).replace("`", "")
    ui.notify(words, type="negative", timeout=12_000, close_button="OK", multi_line=True)


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
