"""The page: one for each browser window, all showing the same scan."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from nicegui import events, run, ui

from modeler.studio.capture_steps import TONE, CaptureStep, FilesStep, ScansStep
from modeler.studio.jobs import POLL_S, Job
from modeler.studio.model_steps import BuildStep, CheckStep, ExportStep
from modeler.studio.object_step import ObjectStep
from modeler.studio.scan import Scan
from modeler.studio.state import Studio
from modeler.studio.widgets import complain
from modeler.types import InputError

if TYPE_CHECKING:
    from modeler.studio.server import Viewers

STEPS: Final = ("Files", "Capture", "Object", "Build", "Check", "Take away", "Scans")
_WITHOUT_SCAN: Final = ("Files", "Capture", "Scans")
_STYLE: Final = Path(__file__).with_name("style.css")
_DARK: Final = "background: #10343b"


class Page:
    """What one browser window shows."""

    def __init__(self, studio: Studio, viewers: Viewers) -> None:
        self.studio, self.viewers = studio, viewers
        self.step = STEPS[0]
        self._seen = (-1, -1)
        self._job: Job | None = None
        self.lines: dict[str, str] = {}  # that do the same as what was clicked, by command
        self._ended = studio.queue.last

    @property
    def scan(self) -> Scan | None:
        """The scan that is shown."""
        return self.studio.current

    def show(self) -> None:
        """Build the page."""
        ui.add_css(_STYLE.read_text())
        ui.add_head_html(TONE)
        ui.colors(primary="#0b6b75")
        with ui.header().classes("items-center no-wrap").style(f"{_DARK}; padding: 0 12px"):
            self.title = ui.label("modeler studio").classes("title text-subtitle1 q-mr-md")
            self.tabs = ui.tabs(on_change=lambda event: self.go(str(event.value)))
            self.tabs.props("dense no-caps outside-arrows mobile-arrows aria-label='Steps'")
            with self.tabs:
                for step in STEPS:
                    ui.tab(step)
        self.panels = {step: ui.element("div").classes("panel") for step in STEPS}
        with ui.footer().classes("items-center no-wrap").style(f"{_DARK}; padding: 6px 12px") as self.footer:
            self.doing = ui.label().classes("text-body2 col-8").props("role=status")
            self.bar = ui.linear_progress(0.0, show_value=False).props("dark color=white aria-label='Progress'")
            stop = ui.button("Stop", on_click=self.studio.queue.stop)  # of a build, what is there is kept
            stop.props("outline color=white dense no-caps")
        self.files = FilesStep(self, self.panels["Files"])
        self.capturing = CaptureStep(self, self.panels["Capture"])
        self.object = ObjectStep(self, self.panels["Object"])
        self.building = BuildStep(self, self.panels["Build"])
        self.check = CheckStep(self, self.panels["Check"])
        self.exports = ExportStep(self, self.panels["Take away"])
        self.scans = ScansStep(self, self.panels["Scans"])
        ui.keyboard(self._key, ignore=["input", "select", "textarea"])
        self.start()
        ui.timer(POLL_S, self._poll)

    def start(self) -> None:
        """Draw everything of the scan that is shown, and go to the step that follows."""
        scan = self.scan
        self._seen = (self.studio.version, -1 if scan is None else scan.version)
        self.files.draw()
        self.capturing.draw()
        if scan is None:
            self.go("Files" if self.studio.capture is None else "Capture")
            return
        self.title.text = scan.name
        for step in (self.object, self.building, self.check, self.exports):
            step.draw(scan)
        if self.studio.queue.current is not None:
            self.go("Build")
        else:
            self.go("Object" if scan.run is None else "Check")

    def go(self, step: str) -> None:
        """Show a step."""
        if step not in STEPS:
            return
        if self.scan is None and step not in _WITHOUT_SCAN:
            ui.notify("Open a capture first.")
            step = "Files"
        self.step, self.tabs.value = step, step
        for name, panel in self.panels.items():
            panel.set_visibility(name == step)
        if step == "Build":
            self.building.embed()
        if step == "Scans":
            self.scans.draw()

    def busy(self) -> bool:
        """Return whether a command runs, and say so."""
        if self.studio.queue.current is not None:
            ui.notify("Something is running; stop it first, or wait.")
        return self.studio.queue.current is not None

    async def run(self, jobs: Sequence[Job]) -> None:
        """Have commands run, one after another, builds among them seen in the viewer."""
        for job in jobs:
            if job.words[0] == "build":
                sink = await run.io_bound(self.viewers.sink, job.words[job.words.index("--out") + 1])
                job.unshown = () if sink is None else ("--connect", sink)
        self.lines |= {job.words[0]: job.line for job in jobs}
        self.studio.queue.add(jobs)

    def _poll(self) -> None:
        """Follow the scan and the running command."""
        scan, job = self.scan, self.studio.queue.current
        if self._seen[0] != self.studio.version:
            self.start()
        elif scan is not None and self._seen[1] != scan.version:
            self._seen = (self.studio.version, scan.version)
            self.object.update(scan)
            self.building.update(scan)
        self.capturing.follow()
        self.footer.set_visibility(job is not None)
        if job is not None:
            now = job.progress()
            left = "" if now.left_s is None else f", about {max(1, round(now.left_s))} s left"
            self.doing.text = f"{job.title}: {now.words}{left}"
            self.bar.props["indeterminate"] = now.share is None
            self.bar.value = now.share or 0.0
            self.bar.update()
        begun, self._job = job is not None and job is not self._job, job
        if begun and self.step == "Build":
            self.building.embed()
        if self.studio.queue.last is not self._ended:
            self._ended = self.studio.queue.last
            self._after(self._ended)

    def _after(self, job: Job | None) -> None:
        """Show the result of a command that has ended."""
        capture, scan = self.studio.capture, self.scan
        if job is not None and job.failure is not None:
            complain(f"{job.title}: {job.failure}")
        if capture is not None and not capture.job.running and self.studio.queue.current is None:
            self.studio.release()
            try:
                self.studio.open(capture.folder)  # of which the model has been made
            except InputError as error:
                complain(error)
        elif scan is not None and job is not None:
            self.building.update(scan)
            self.check.draw(scan)
            self.exports.draw(scan)
            if self.step == "Build":
                self.building.embed()
                if job.words[0] == "report" and job.failure is None:
                    self.go("Check")

    async def _key(self, event: events.KeyEventArguments) -> None:
        """Turn frames with the arrow keys, choose steps with the digits, build with B, take views with T."""
        held = event.modifiers
        if not event.action.keydown or held.ctrl or held.alt or held.meta:
            return
        name = str(event.key)
        if name in map(str, range(1, len(STEPS) + 1)):
            self.go(STEPS[int(name) - 1])
        elif self.step == "Object" and name in ("ArrowLeft", "ArrowRight"):
            self.object.turn(1 if name == "ArrowRight" else -1)
        elif self.step == "Build" and name == "b":
            await self.building.build()
        elif self.step == "Capture" and name == "t":
            self.capturing.take()
