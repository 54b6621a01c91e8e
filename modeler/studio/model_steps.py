"""Where the motion is chosen and the model grows, where it is checked and improved, and where it is taken away."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from nicegui import run, ui

from modeler.export import RunFolder
from modeler.studio.object_step import frame_address
from modeler.studio.scan import MESHES, Scan
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
    plain_button,
    quiet,
    ring_svg,
    sentence,
)
from modeler.types import ACCEPTED, InputError

if TYPE_CHECKING:
    from modeler.studio.page import Page


_NONE: Final = "There is no model yet: build one."
_EXPORTS: Final = {
    "glb": "Browsers, phones, Blender",
    "obj": "Blender, MeshLab",
    "ply": "Point and mesh tools",
    "stl": "CAD (no colour)",
    "3mf": "Slicers",
    "print": "3-D printing: closed, flat bottom, mm",
    "foundationpose": "FoundationPose",
    "bop": "BOP: model and views",
    "mujoco": "MuJoCo",
    "urdf": "ROS, PyBullet (URDF)",
    "isaac": "Isaac Sim (OpenUSD)",
    "gazebo": "Gazebo (SDF)",
    "nerfstudio": "nerfstudio: images, masks, cameras",
    "colmap": "COLMAP: images, masks, cameras",
}
_OF_CHECK: Final = ("edit", "report", "calibrate-camera", "suggest")  # commands of the check
_CAMERA: Final = {
    "Calibrate the camera, build again": None,
    "The focal length is right": "focal-length",
    "The depth is right": "depth",
}
"""What `calibrate-camera` takes for known, by the words of its button."""


class CheckStep:
    """The verdict on the latest run."""

    def __init__(self, page: Page, panel: ui.element) -> None:
        self.page, self.panel = page, panel

    def draw(self, scan: Scan) -> None:
        """Draw a scan."""
        self.panel.clear()
        report, made = scan.report(), scan.run
        with self.panel:
            if report is None or made is None:
                ui.label(_NONE).classes("card")
                return
            with div("wide"):
                page = made / "report.html"
                if page.exists():
                    version = page.stat().st_mtime_ns
                    self._pictures(f"/runs/{quote(scan.name)}/{quote(made.name)}/report.html?v={version}", report)
                else:
                    quiet("The pictures are being drawn." if self.page.studio.queue.current else "No pictures yet.")
                self._frames(scan)
            with div("side first column gap-3"):
                _verdict(report)
                self._advice(scan, report)
                with div("card"):
                    ui.html(ring_svg(report), sanitize=False)
                    plain_button("What next? Suggest a turn", lambda: self.page.run([scan.suggest_job()]))
                    quiet(scan.suggested())
                lines = [line for command, line in self.page.lines.items() if command in _OF_CHECK]
                command_line().text = "\n".join(lines) or f"modeler report {made}"
                main_button("Next: take it away", lambda: self.page.go("Take away"))

    def _pictures(self, address: str, report: Mapping[str, Any]) -> None:
        """Embed the report of the run, at the worst pairs where it is not to be trusted."""
        with ui.row().classes("q-mb-xs"):
            for label, anchor in (("Verdict", ""), ("Worst pairs", "pairs"), ("Masks", "masks")):
                plain_button(label, lambda _, anchor=anchor: self._show(address, anchor))
        self.paper = ui.element("iframe").classes("paper")
        self.paper.props("title='The report of the run' sandbox=allow-scripts")
        self.paper.style("height: calc(100vh - 290px); min-height: 420px")
        self._show(address, "" if report["trustworthy"] else "pairs")

    def _show(self, address: str, anchor: str) -> None:
        self.paper.props["src"] = f"{address}&at={anchor}#{anchor}" if anchor else address
        self.paper.update()

    def _advice(self, scan: Scan, report: Mapping[str, Any]) -> None:
        remedies = [str(words) for words in report.get("remedies") or ()]
        if not remedies:
            return
        with div("card"):
            heading("What to do")
            for words in remedies:
                ui.label(sentence(words.partition(": modeler")[0]))
            if any("calibrate-camera" in words for words in remedies):
                quiet(
                    "Estimate the focal length of the camera from the loop, and build again with it. Where depth and "
                    "focal length disagree, say which is right."
                )
                for label, known in _CAMERA.items():
                    button = plain_button(label, lambda _, known=known: self._calibrate(scan, known))
                    button.classes("w-full q-mt-xs")

    async def _calibrate(self, scan: Scan, known: str | None) -> None:
        if self.page.busy():
            return
        try:
            calibration = scan.calibrate_job(known)
            await self.page.run([calibration, *(await run.io_bound(scan.build_jobs) or ())])
        except InputError as error:
            complain(error)
            return
        self.page.go("Build")

    def _frames(self, scan: Scan) -> None:
        """Draw the frames of the latest run; a click takes one out, or puts it back."""
        report = RunFolder(scan.runs()[-1]).report()
        quiet("A click takes a frame out of the model, another one puts it back.").classes("q-mt-sm")
        with div("strip", "aria-label='Frames of the model'"):
            for k in [frame["id"] for frame in report["frames"] if frame["outcome"] == ACCEPTED]:
                out = k in scan.choices.dropped
                with ui.element("button").props(f"aria-label='frame {k}' aria-pressed={str(out).lower()}") as button:
                    ui.element("img").props(f"loading=lazy alt='' src='{frame_address(scan, 'thumbnails', k)}'")
                    ui.label(str(k))
                mark(button, "out", on=out)
                button.on("click", lambda _, k=k: self._drop(scan, k))

    async def _drop(self, scan: Scan, frame: int) -> None:
        if not self.page.busy():
            await self.page.run(scan.edit_jobs(sorted({*scan.choices.dropped} ^ {frame})))
            self.draw(scan)


def _verdict(report: Mapping[str, Any]) -> None:
    """Draw whether the model can be trusted, and why not."""
    good = report["trustworthy"]
    with div(f"card {'good' if good else 'bad'}", "role=status"):
        heading("This model can be trusted" if good else "Do not trust this model")
        placed = sum(frame["outcome"] == ACCEPTED for frame in report["frames"])
        loop = "the loop is closed" if report["closed"] else "no loop is closed"
        ui.label(f"{placed} of {len(report['frames'])} frames placed, {loop}.")
        if good and report.get("trusted_to_m"):
            ui.label(f"Its surface is trusted to {1000.0 * report['trusted_to_m']:.1f} mm.")
        for reason in report["reasons"]:
            ui.label(sentence(reason))


class ExportStep:
    """What is taken away."""

    def __init__(self, page: Page, panel: ui.element) -> None:
        self.page, self.panel = page, panel

    def draw(self, scan: Scan) -> None:
        """Draw a scan."""
        self.panel.clear()
        with self.panel:
            if scan.run is None:
                ui.label(_NONE).classes("card")
                return
            with div("wide card"):
                heading("Take the model away")
                with div("priors q-my-sm"):
                    for what, words in _EXPORTS.items():
                        with ui.element("button").classes("prior") as button:
                            ui.html(f"<b>{what.upper() if what in MESHES else what}</b>{words}", sanitize=False)
                        button.on("click", lambda _, what=what: self._export(scan, what))
            with div("side column gap-3"):
                with div("card"):
                    heading("Download")
                    exports = scan.exports()
                    if not exports:
                        quiet("Choose a format: the file appears here.")
                    for path in exports:
                        name = f"{path.name}.zip" if path.is_dir() else path.name
                        link = ui.link(name, f"/take-away/{quote(scan.name)}/{quote(name)}").classes("block")
                        link.props["download"] = name
                    for words in scan.export_words():
                        quiet(sentence(words))
                shown = self.page.lines.get("export", f"modeler export {scan.run} --out {scan.name}.glb")
                self.line = command_line()
                self.line.text = shown

    async def _export(self, scan: Scan, what: str) -> None:
        coloured = scan.sequence.frame(scan.sequence.indices[0]).colour is not None
        await self.page.run([scan.export_job(what, texture=coloured)])
        self.line.text = self.page.lines["export"]


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
            step_deg, sigma_deg = (self.step_deg.value, self.sigma_deg.value) if turns else (None, None)
            scan.choose(prior=name, step_deg=step_deg, step_sigma_deg=sigma_deg)
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
