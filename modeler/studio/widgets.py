"""Parts of pages that several steps have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from nicegui import ui

from modeler.types import InputError

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
