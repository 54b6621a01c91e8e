"""Where captures are chosen or taken, and the gallery of what was scanned."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

from nicegui import run, ui

from modeler.export import RunFolder
from modeler.sequences.clouds import SUFFIXES
from modeler.sequences.opening import BAGS
from modeler.studio.capture import Capture
from modeler.studio.jobs import Job
from modeler.studio.scan import STATE, Choices
from modeler.studio.widgets import (
    PRIORS,
    command_line,
    complain,
    div,
    embedded_viewer,
    ghost_svg,
    heading,
    main_button,
    outline_svg,
    plain_button,
    quiet,
    ring_svg,
    sentence,
)
from modeler.types import InputError

if TYPE_CHECKING:
    from modeler.studio.page import Page


_FOLDER: Final = ""
_CAMERAS: Final = {
    "realsense:": "Intel RealSense",
    "orbbec:": "Orbbec Femto, Gemini, Astra",
    "oak:": "OAK-D",
    "azure:": "Azure Kinect",
}
"""Connected cameras, by the names under which sequences open them."""
_BEAT_S: Final = 5.0  # of the metronome, to begin with
_NOTES_HZ: Final = {"tick": 880, "placed": 660, "lost": 220}  # which can be distinguished
TONE: Final = """<script>
window.tone = (hertz) => {
  window.sound = window.sound || new AudioContext();
  const tone = sound.createOscillator(), quiet = sound.createGain();
  tone.frequency.value = hertz; quiet.gain.value = 0.1;
  tone.connect(quiet).connect(sound.destination); tone.start(); tone.stop(sound.currentTime + 0.12);
};
</script>"""
"""Script that plays a note."""


class CaptureStep:
    """Following a capture."""

    def __init__(self, page: Page, panel: ui.element) -> None:
        self.page, self.panel = page, panel
        self._shown = ""

    def draw(self) -> None:
        """Draw what a capture needs."""
        self.panel.clear()
        self._shown = ""
        with self.panel:
            with div("wide"):
                self.live = ui.interactive_image().classes("photo").props("role=img aria-label='The newest frame'")
                self.viewer = div("w-full q-mt-sm")
            with div("side first column gap-3"):
                with div("card"):
                    heading("Take a capture")
                    quiet(
                        "Start a connected camera, or have a program write depth images into a folder; turn the "
                        "object a little between two views, and watch the model grow."
                    )
                    self._choices()
                with div("card") as self.light:
                    self.come = heading("Nothing is watched.").props("role=status")
                    self.more = quiet()
                    self.ring = ui.html("", sanitize=False)
                self.line = command_line()

    def _choices(self) -> None:
        source = ui.select({_FOLDER: "A folder that is written", **_CAMERAS}, value=_FOLDER, label="From")
        source.classes("w-full").props("dense")
        folder = ui.input("Folder", value=str(self.page.files.place)).classes("w-full").props("dense outlined")
        folder.bind_visibility_from(source, "value", value=_FOLDER)
        moves = {name: label for name, (label, *_) in PRIORS.items() if name != "held"}
        prior = ui.select(moves, value="auto", label="How does it move?").classes("w-full").props("dense")
        with ui.row().classes("no-wrap items-center"):
            step = ui.number("Step, degrees", value=20, step=1).props("dense")
            beat = ui.number("Beat, seconds", value=_BEAT_S, min=1, step=1).props("dense")
        step.bind_visibility_from(prior, "value", value="turntable")
        ticks = ui.switch("Metronome", on_change=lambda event: _tick(bool(event.value), beat.value or _BEAT_S))
        ticks.props("aria-label='Metronome: a tick for each step'")
        beat.on_value_change(lambda: _tick(bool(ticks.value), beat.value or _BEAT_S))

        async def watch() -> None:
            chosen = None if prior.value == "auto" else prior.value
            given = (chosen, step.value if chosen == "turntable" else None)
            place = Path(folder.value or ".").expanduser()
            if source.value == _FOLDER:
                await self._start(lambda: self.page.studio.watch(place, *given))
            else:
                await self._start(lambda: self.page.studio.record(str(source.value), *given))

        main_button("Start", watch)
        self.taking = main_button("Take this view (T)", self.take)

    def take(self) -> None:
        """Take the view that the camera sees now."""
        if self.page.studio.recorder is not None:
            self.page.studio.recorder.take()

    async def _start(self, begin: Callable[[], list[Job]]) -> None:
        if self.page.busy():
            return
        try:
            await self.page.run(await run.io_bound(begin) or [])
        except InputError as error:
            complain(error)

    def follow(self) -> None:
        """Show what has come."""
        capture, recorder = self.page.studio.capture, self.page.studio.recorder
        self.taking.set_visibility(recorder is not None)
        if capture is None or self.page.step != "Capture":
            return
        placed, words = capture.said()
        self.come.text = _come(capture, placed, words)
        self.line.text = capture.job.line
        if recorder is not None:
            self.live.set_source(f"/capture/newest.jpg?v={recorder.shown}")
        lines = [*([] if recorder is None else [recorder.fault]), *capture.doubts(), *capture.facts(), capture.next()]
        self.more.text = "\n".join(filter(None, map(sentence, lines)))
        shown = f"{capture.count} {words} {capture.next()}"
        if shown == self._shown:
            return
        self._shown = shown
        self.light.classes(replace=f"card {'' if placed is None else 'good' if placed else 'bad'}")
        if capture.count and recorder is None:
            self.live.set_source(f"/capture/newest.jpg?v={capture.count}")
            self.live.set_content(outline_svg(capture.mask) + ghost_svg(capture.ghost()))
        if (report := capture.report()) is not None:
            self.ring.set_content(ring_svg(report))
        if placed is not None:
            ui.run_javascript(f"tone({_NOTES_HZ['placed' if placed else 'lost']})")
        if self.page.viewers.live and not list(self.viewer):
            with self.viewer:
                embedded_viewer(self.page.viewers.address(None))


def _tick(on: bool, beat_s: float) -> None:
    """Tick for each step of a turntable, or stop ticking."""
    beat = f"window.beat = setInterval(() => tone({_NOTES_HZ['tick']}), {1000.0 * max(beat_s, 0.5):.0f})" if on else ""
    ui.run_javascript(f"clearInterval(window.beat); {beat}")


def _come(capture: Capture, placed: bool | None, words: str) -> str:
    """Return in words whether the next view may come."""
    if not capture.job.running:
        return sentence(capture.job.failure or "the capture has ended")
    if placed is None:
        return (
            f"{capture.count} frames; the model begins with the first few." if capture.count else "Waiting for frames."
        )
    if placed:
        late = f" No new one for {capture.waits_s:.0f} s." if capture.waits_s > 15.0 else ""  # longer than a turn takes
        return f"{sentence(words)} Turn it: the next view may come.{late}"
    return f"{sentence(words)} Turn it back a little, and try again."


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
