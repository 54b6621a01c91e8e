"""Where the motion is chosen, and the model grows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from nicegui import run, ui

from modeler.studio.scan import Scan
from modeler.studio.widgets import (
    PRIORS,
    command_line,
    complain,
    div,
    drawing,
    embedded_viewer,
    heading,
    main_button,
    mark,
)
from modeler.types import InputError

if TYPE_CHECKING:
    from modeler.studio.page import Page

_STEP_DEG, _STEP_SIGMA_DEG = 20.0, 3.0  # where nothing is known: a usual step, and how well marks are met by hand
_QUESTION: Final = "How did it move?"


class BuildStep:
    """The choice of the prior, and the embedded viewer."""

    def __init__(self, page: Page, panel: ui.element) -> None:
        self.page, self.panel = page, panel
        self._shown = ""

    def draw(self, scan: Scan) -> None:
        """Draw a scan."""
        self.panel.clear()
        self._shown = ""
        with self.panel:
            with div("wide"):
                self.viewer = div("w-full")
            with div("side column gap-3"):
                with div("card"):
                    heading(_QUESTION)
                    self._choices(scan)
                    main_button("Build the model", self.build)
                    self.resuming = main_button("Go on with the interrupted run", lambda: self.build(resume=True))
                    self.resuming.props("outline")
                self.line = command_line()
        self.update(scan)

    def _choices(self, scan: Scan) -> None:
        self.priors: dict[str, ui.element] = {}
        with div("priors q-my-sm", f"role=radiogroup aria-label='{_QUESTION}'"):
            for name, (label, words, lines) in PRIORS.items():
                with ui.element("button").classes("prior").props("role=radio") as button:
                    drawing(lines)
                    ui.html(f"<b>{label}</b>{words}", sanitize=False)
                button.on("click", lambda _, name=name: self._choose(name))
                if name == "held" and scan.sequence.robot_path is None:
                    button.props("disabled")
                self.priors[name] = button
        motion: dict[str, Any] = {**(scan.sequence.motion or {})}
        step = scan.choices.step_deg or motion.get("step_deg") or _STEP_DEG
        sigma = scan.choices.step_sigma_deg or motion.get("sigma_deg") or _STEP_SIGMA_DEG
        with ui.row().classes("no-wrap") as self.steps:
            self.step_deg = ui.number("Step, degrees", value=step, step=1, on_change=self._rechoose)
            self.sigma_deg = ui.number("give or take", value=sigma, min=0.1, step=0.5, on_change=self._rechoose)

    def update(self, scan: Scan) -> None:
        """Bring the choice and the command line up to date."""
        chosen = scan.choices.prior or scan.usual_prior
        for name, button in self.priors.items():
            mark(button, "on", on=name == chosen)
            button.props(f"aria-checked={str(name == chosen).lower()}")
        self.steps.set_visibility(chosen == "turntable")
        self.line.text = scan.line()
        report = None if scan.choices.dropped or self.page.studio.queue.current is not None else scan.report()
        self.resuming.set_visibility(report is not None and report.get("complete") is not True)

    def _choose(self, name: str) -> None:
        if (scan := self.page.scan) is not None:
            turns = name == "turntable"
            scan.choose_prior(name, self.step_deg.value if turns else None, self.sigma_deg.value if turns else None)
            self.update(scan)

    def _rechoose(self) -> None:
        scan = self.page.scan
        if scan is not None and (scan.choices.prior or scan.usual_prior) == "turntable":
            self._choose("turntable")

    async def build(self, *, resume: bool = False) -> None:
        """Start a build."""
        scan = self.page.scan
        if scan is None or self.page.busy():
            return
        try:
            await self.page.run(await run.io_bound(lambda: scan.build_jobs(resume=resume)) or [])
        except InputError as error:
            complain(error)
            return
        self.page.go("Build")

    def embed(self) -> None:
        """Show the viewer: of the build that runs, or of the latest run."""
        scan, job = self.page.scan, self.page.studio.queue.current
        if scan is None or (scan.run is None and (job is None or not self.page.viewers.live)):
            return
        address = self.page.viewers.address(scan)
        if address != self._shown:
            self._shown = address
            self.viewer.clear()
            with self.viewer:
                embedded_viewer(address)
