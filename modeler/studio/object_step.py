"""Where a person says what the object is."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from nicegui import events, run, ui

from modeler.studio.scan import Scan
from modeler.studio.widgets import (
    box_svg,
    command_line,
    complain,
    div,
    heading,
    main_button,
    mark,
    outline_svg,
    plain_button,
    quiet,
    stroke_svg,
)
from modeler.types import InputError

if TYPE_CHECKING:
    from modeler.studio.page import Page

_BRUSH_PX: Final = (2, 8, 40)  # least, usual and greatest radius
_NAMED: Final = 12  # doubtful frames


class ObjectStep:
    """The frames with the outline of the object, and what corrects it."""

    def __init__(self, page: Page, panel: ui.element) -> None:
        self.page, self.panel = page, panel
        self.frame, self.tool, self.brush_px = 0, "Box", float(_BRUSH_PX[1])
        self._points: list[tuple[float, float]] = []
        self._drawn_s = 0.0

    def draw(self, scan: Scan) -> None:
        """Draw a scan."""
        if self.frame not in scan.sequence.indices:
            self.frame = scan.sequence.indices[0]
        self.panel.clear()
        with self.panel:
            with div("wide"):
                self.photo = ui.interactive_image(
                    frame_address(scan, "frames", self.frame),
                    on_mouse=self._pointer,
                    events=["pointerdown", "pointermove", "pointerup", "pointerleave"],
                    sanitize=False,
                ).classes("photo")
                self.photo.props("role=img aria-label='The frame with the outline of the object'")
                self.strip = div("strip", "aria-label='Frames'")
            with div("side column gap-3"):
                with div("card"):
                    heading("What is the object?")
                    quiet(
                        "The outline should follow it in every frame. If not: click on the object or drag a box around "
                        "it, for all frames; or paint, to correct this frame."
                    )
                    self._tools(scan)
                with div("card"):
                    self.status = ui.label().classes("text-body2").props("role=status")
                    main_button("Next: build", lambda: self.page.go("Build"))
                self.line = command_line()
        self._draw_strip(scan)
        self.update(scan)

    def _tools(self, scan: Scan) -> None:
        tools = ui.toggle(["Box", "Add", "Erase"]).props("no-caps spread").classes("w-full q-my-sm")
        tools.bind_value(self, "tool")
        with ui.row().classes("items-center w-full no-wrap"):
            ui.label("Brush")
            brush = ui.slider(min=_BRUSH_PX[0], max=_BRUSH_PX[2], step=1).bind_value(self, "brush_px")
            brush.props("aria-label='Brush radius in pixels'")
        with ui.row():
            plain_button("Whole image", lambda: self._act(scan.whole_image))
            plain_button("Undo painting", lambda: self._act(scan.unpaint, self.frame))

    def _draw_strip(self, scan: Scan) -> None:
        """Draw the small frames, each a button."""
        self.small: dict[int, tuple[ui.element, ui.element]] = {}
        stride = math.ceil(len(scan.sequence.indices) / 300)  # of longer captures every so many-th
        with self.strip:
            for k in scan.sequence.indices[::stride]:
                with ui.element("button").props(f"aria-label='frame {k}'") as button:
                    self.small[k] = button, ui.element("img").props("loading=lazy alt=''")
                    ui.label(str(k))
                button.on("click", lambda _, k=k: self._turn_to(k))

    def update(self, scan: Scan) -> None:
        """Bring outline, small pictures and words up to date."""
        self.photo.set_content(outline_svg(scan.mask(self.frame)))
        doubts = scan.doubts()
        for k, (button, image) in self.small.items():
            address = frame_address(scan, "thumbnails", k)
            if image.props.get("src") != address:
                image.props["src"] = address
                image.update()
            mark(button, "on", on=k == self.frame)
            mark(button, "doubt", on=k in doubts)
        self.status.text = _status(scan, doubts)
        self.line.text = scan.line()

    def turn(self, by: int) -> None:
        """Show another frame, so many on."""
        if (scan := self.page.scan) is not None:
            frames = scan.sequence.indices
            self._turn_to(frames[min(max(frames.index(self.frame) + by, 0), len(frames) - 1)])

    def _turn_to(self, frame: int) -> None:
        if (scan := self.page.scan) is not None:
            self.frame = frame
            self.photo.set_source(frame_address(scan, "frames", frame))
            self.update(scan)

    async def _pointer(self, event: events.MouseEventArguments) -> None:
        """Draw a box or a stroke, and act when the pointer is lifted."""
        scan, at = self.page.scan, (event.image_x, event.image_y)
        if scan is None:
            return
        if event.type == "pointerdown":
            self._points = [at]
        elif event.type == "pointermove" and self._points:
            self._points.append(at)
            self._preview(scan)
        elif self._points:
            points, self._points = self._points, []
            if event.type == "pointerup":
                points.append(at)
            if self.tool != "Box":
                await self._act(lambda: scan.paint(self.frame, points, self.brush_px, add=self.tool == "Add"))
            elif math.dist(points[0], points[-1]) > 4.0:  # else it was a click
                await self._act(scan.box, points[0], points[-1])
            else:
                await self._act(scan.point_at, self.frame, *points[0])

    def _preview(self, scan: Scan) -> None:
        """Draw the box or the stroke so far."""
        if time.monotonic() - self._drawn_s < 0.05:  # so that the connection keeps up
            return
        self._drawn_s = time.monotonic()
        if self.tool == "Box":
            shown = box_svg(self._points[0], self._points[-1])
        else:
            shown = stroke_svg(self._points, self.brush_px, add=self.tool == "Add")
        self.photo.set_content(outline_svg(scan.mask(self.frame)) + shown)

    async def _act(self, act: Callable[..., object], *given: Any) -> None:
        """Do something that takes a moment, and show it."""
        try:
            await run.io_bound(act, *given)
        except InputError as error:
            complain(error)
        if (scan := self.page.scan) is not None:
            self.update(scan)


def frame_address(scan: Scan, kind: str, frame: int) -> str:
    """Return the address of a picture of a frame, another one once its mask changes."""
    state = f"{scan.looked}-{scan.strokes.get(frame, 0)}-{int(frame in scan.found)}" if kind == "thumbnails" else "0"
    return f"/{kind}/{quote(scan.name)}/{frame}.jpg?v={state}"


def _status(scan: Scan, doubts: dict[int, str]) -> str:
    """Return what is known of the masks in words."""
    count, total = len(scan.found), len(scan.sequence.indices)
    if scan.fault:
        return scan.fault
    if scan.looking:
        return f"Looking for the object: {count} of {total} frames."
    words = [f"{total} frames."]
    if doubts:
        named = ", ".join(map(str, sorted(doubts)[:_NAMED])) + (" …" if len(doubts) > _NAMED else "")
        what = "frame" if len(doubts) == 1 else "frames"
        words.append(f"Look at {what} {named}: {', '.join(sorted(set(doubts.values())))}.")
    if scan.painted:
        named = ", ".join(map(str, sorted(scan.painted)))
        words.append(f"Corrected by hand: {named}; the build reads all masks from a folder of its own.")
    return " ".join(words)
