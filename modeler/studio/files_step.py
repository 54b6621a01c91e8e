"""Where captures are chosen, and the gallery of what was scanned."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

from nicegui import run, ui

from modeler.export import RunFolder
from modeler.sequences.clouds import SUFFIXES
from modeler.sequences.opening import BAGS
from modeler.studio.scan import STATE, Choices
from modeler.studio.widgets import complain, div, heading, plain_button, quiet
from modeler.types import InputError

if TYPE_CHECKING:
    from modeler.studio.page import Page

_RECORDINGS: Final = (*BAGS, *SUFFIXES, ".mkv", ".r3d")
_SHOWN: Final = 200  # entries of a folder


class FilesStep:
    """Choosing a capture."""

    def __init__(self, page: Page, panel: ui.element) -> None:
        self.page, self.panel = page, panel
        self.place = Path.cwd() if page.studio.place is None else page.studio.place

    def draw(self) -> None:
        """Draw the folder."""
        self.panel.clear()
        with self.panel, div("wide"), div("card"):
            heading("Open a capture")
            quiet("A folder of depth images, a recording of a depth camera, a ROS bag, organised clouds.")
            with ui.row().classes("items-center w-full no-wrap"):
                path = ui.input("Path", value=str(self.place)).classes("col").props("dense outlined")
                path.on("keydown.enter", lambda: self._open(Path(path.value or ".")))
                ui.button("Open", on_click=lambda: self._open(Path(path.value or "."))).props("no-caps")
            with ui.column().classes("w-full gap-0"):
                if self.place.parent != self.place:
                    self._entry("..", "arrow_upward", self.place.parent)
                for entry in _entries(self.place):
                    self._entry(entry.name, "folder" if entry.is_dir() else "movie", entry)

    def _entry(self, name: str, icon: str, path: Path) -> None:
        button = ui.button(name, icon=icon, on_click=lambda: self._open(path))
        button.props("flat no-caps align=left dense").classes("w-full")

    async def _open(self, path: Path) -> None:
        """Open a capture, or look into a folder that is none."""
        path = path.expanduser().absolute()
        try:
            if path == self.place.absolute().parent:  # upwards, even if it could be read as a capture
                raise InputError("")
            await run.io_bound(self.page.studio.open, path)
        except InputError as error:
            if not (path.is_dir() and _entries(path) and path != self.place):
                complain(error)
                return
            self.place = path
            self.draw()
            return
        self.page.start()


class ScansStep:
    """The gallery."""

    def __init__(self, page: Page, panel: ui.element) -> None:
        self.page, self.panel = page, panel

    def draw(self) -> None:
        """Draw what was scanned, the newest first."""
        self.panel.clear()
        folders = self.page.studio.folders()
        with self.panel, div("wide"):
            if not folders:
                ui.label(f"Nothing scanned yet in {self.page.studio.out}.").classes("card")
            with div("gallery"):
                for folder in folders:
                    self._entry(folder)

    def _entry(self, folder: Path) -> None:
        runs = sorted(folder.glob("run-*/report.json"), key=lambda path: path.stat().st_mtime)
        words = "not built yet"
        with div("card"):
            if runs:
                made = runs[-1].parent
                ui.element("img").props(
                    f"loading=lazy alt='' src='/models/{quote(folder.name)}/{quote(made.name)}.jpg'"
                )
                try:
                    words = "can be trusted" if RunFolder(made).report()["trustworthy"] else "not to be trusted"
                except (InputError, KeyError):
                    words = "interrupted"
            ui.label(folder.name).classes("text-subtitle1")
            quiet(words)
            plain_button("Open", lambda: self._reopen(folder)).props(f"aria-label='Open {folder.name}'")

    async def _reopen(self, folder: Path) -> None:
        try:
            await run.io_bound(lambda: self.page.studio.open(Path(Choices.read(folder / STATE).sequence)))
        except InputError as error:
            complain(error)
            return
        self.page.start()


def _entries(folder: Path) -> list[Path]:
    """Return what may be opened in a folder: folders and recordings."""
    try:
        found = [path for path in folder.iterdir() if not path.name.startswith(".")]
        found = [path for path in found if path.is_dir() or path.suffix.lower() in _RECORDINGS]
    except OSError:
        return []
    return sorted(found, key=lambda path: (not path.is_dir(), path.name))[:_SHOWN]
