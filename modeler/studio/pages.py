"""The page: one for each browser window, all showing the same scan."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final
from urllib.parse import quote

from nicegui import events, run, ui

from modeler.export import RunFolder
from modeler.sequences.clouds import SUFFIXES
from modeler.sequences.opening import BAGS
from modeler.studio.capture import Capture
from modeler.studio.jobs import Job
from modeler.studio.pictures import box_svg, outline_svg, ring_svg, stroke_svg
from modeler.studio.scan import MESHES, Choices, Scan, Studio
from modeler.types import ACCEPTED, InputError

if TYPE_CHECKING:
    from modeler.studio.server import Viewers

STEPS: Final = ("Files", "Capture", "Object", "Build", "Check", "Take away", "Scans")
_POLL_S: Final = 0.3
_LATE_S: Final = 15.0  # without a frame: longer than a person takes to turn an object by hand
_TONE: Final = """<script>
window.tone = (hertz) => {
  window.sound = window.sound || new AudioContext();
  const tone = sound.createOscillator(), quiet = sound.createGain();
  tone.frequency.value = hertz; quiet.gain.value = 0.1;
  tone.connect(quiet).connect(sound.destination); tone.start(); tone.stop(sound.currentTime + 0.12);
};
</script>"""
_DRAW_S: Final = 0.05  # between redrawings of a stroke, so that the connection keeps up
_CLICK_PX: Final = 4.0  # a pointer that moves less has been clicked
_RECORDINGS: Final = (*BAGS, *SUFFIXES, ".mkv", ".r3d")
_FOLDERS_SHOWN: Final = 200
_THUMBNAILS: Final = 300  # frames shown small; of longer captures every so many-th
_PRIORS: Final = {
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
    "held": ("Robot's hand", "Its poses are in robot.txt.", "M12 54V36l14-14 14 6M40 28v8h10v10M40 36h-2M26 22v-8"),
}
"""Label, what it means, and the lines of a picture, of each motion prior."""
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
_STYLE: Final = Path(__file__).with_name("style.css")


@final
class Page:
    """What one browser window shows."""

    def __init__(self, studio: Studio, viewers: Viewers) -> None:
        """Prepare a page of a studio."""
        self.studio, self.viewers = studio, viewers
        self.step, self.frame, self.tool, self.brush_px = STEPS[0], 0, "Box", 8.0
        self.place = Path.cwd() if studio.place is None else studio.place
        self._points: list[tuple[float, float]] = []
        self._drawn_s = 0.0
        self._seen: tuple[int, int] = (-1, -1)
        self._job: Job | None = None
        self._ended: Job | None = studio.queue.last
        self._shown_iframe = ""

    @property
    def scan(self) -> Scan | None:
        """The scan that is shown."""
        return self.studio.current

    def show(self) -> None:
        """Build the page."""
        ui.add_css(_STYLE.read_text())
        ui.add_head_html(_TONE)
        ui.colors(primary="#0b6b75")
        with ui.header().classes("items-center no-wrap").style("background: #10343b; padding: 0 12px"):
            self.title = ui.label("modeler studio").classes("title text-subtitle1 q-mr-md")
            self.tabs = ui.tabs(on_change=lambda event: self.go(str(event.value))).props(
                "dense no-caps outside-arrows mobile-arrows aria-label='Steps'"
            )
            with self.tabs:
                for step in STEPS:
                    ui.tab(step)
        self.panels = {step: ui.element("div").classes("panel") for step in STEPS}
        with ui.footer().classes("items-center no-wrap").style("background: #10343b; padding: 6px 12px") as self.footer:
            self.doing = ui.label().classes("text-body2 col-8").props("role=status")
            self.bar = ui.linear_progress(0.0, show_value=False).props("dark color=white aria-label='Progress'")
            self.stopper = ui.button("Stop", on_click=self.stop).props("outline color=white dense no-caps")
        ui.keyboard(self._key)
        self._start()
        ui.timer(_POLL_S, self._poll)

    def _start(self) -> None:
        """Draw everything of the scan that is shown."""
        scan = self.scan
        for panel in self.panels.values():
            panel.clear()
        self._shown_iframe = ""
        self._seen = (self.studio.version, -1 if scan is None else scan.version)
        self._files()
        self._capture()
        self._scans()
        if scan is not None:
            self.title.text = scan.name
            if self.frame not in scan.sequence.indices:
                self.frame = scan.sequence.indices[0]
            self._object(scan)
            self._build(scan)
            self._check(scan)
            self._take_away(scan)
        if scan is None:
            self.go("Files")
        elif self.studio.queue.current is not None:
            self.go("Build")
        else:
            self.go("Object" if scan.run is None else "Check")

    def go(self, step: str) -> None:
        """Show a step."""
        if step not in STEPS or (self.scan is None and step not in ("Files", "Capture", "Scans")):
            if step in STEPS:
                ui.notify("Open a capture first.")
            step = "Files"
        self.step, self.tabs.value = step, step
        for name, panel in self.panels.items():
            panel.set_visibility(name == step)
        if step == "Build":
            self._embed()
        if step == "Scans":
            self._scans()

    # Files

    def _files(self) -> None:
        panel = self.panels["Files"]
        panel.clear()
        with panel, ui.element("div").classes("wide"), ui.element("div").classes("card"):
            ui.label("Open a capture").classes("text-h6")
            ui.label("A folder of depth images, a recording of a depth camera, a ROS bag, organised clouds.").classes(
                "quiet"
            )
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
        if path == self.place.absolute().parent:
            self.place = path
            self._files()
            return
        try:
            await run.io_bound(self.studio.open, path)
        except InputError as error:
            if path.is_dir() and _entries(path) and path != self.place:
                self.place = path
                self._files()
            else:
                _complain(error)
            return
        self._start()

    # Capture

    def _capture(self) -> None:
        panel = self.panels["Capture"]
        panel.clear()
        self._watched = ""
        with panel:
            with ui.element("div").classes("wide"):
                self.live = ui.interactive_image().classes("photo").props("role=img aria-label='The newest frame'")
                self.live_viewer = ui.element("div").classes("w-full q-mt-sm")
            with ui.element("div").classes("side first column gap-3"):
                with ui.element("div").classes("card"):
                    ui.label("Take a capture").classes("text-h6")
                    ui.label(
                        "Have a camera program write depth images into a folder, turn the object a little between two "
                        "frames, and watch the model grow."
                    ).classes("quiet")
                    folder = ui.input("Folder", value=str(self.place)).classes("w-full").props("dense outlined")
                    moves = {name: label for name, (label, *_) in _PRIORS.items() if name != "held"}
                    prior = ui.select(moves, value="auto", label="How does it move?").classes("w-full").props("dense")
                    with ui.row().classes("no-wrap items-center"):
                        step = ui.number("Step, degrees", value=20, step=1).props("dense")
                        pause = ui.number("Beat, seconds", value=5, min=1, step=1).props("dense")
                    step.bind_visibility_from(prior, "value", value="turntable")
                    ticks = ui.switch(
                        "Metronome", on_change=lambda event: self._tick(bool(event.value), pause.value or 5.0)
                    )
                    ticks.props("aria-label='Metronome: a tick for each step'")
                    pause.on_value_change(lambda: self._tick(bool(ticks.value), pause.value or 5.0))
                    ui.button(
                        "Watch the folder",
                        on_click=lambda: self._watch(
                            Path(folder.value or "."),
                            None if prior.value == "auto" else prior.value,
                            step.value if prior.value == "turntable" else None,
                        ),
                    ).props("no-caps").classes("w-full q-mt-sm")
                with ui.element("div").classes("card") as self.light:
                    self.come = ui.label("Nothing is watched.").classes("text-h6").props("role=status")
                    self.come_more = ui.label().classes("quiet").style("white-space: pre-line")
                    self.ring = ui.html("", sanitize=False)
                self.capture_line = _line()

    async def _watch(self, folder: Path, prior: str | None, step_deg: float | None) -> None:
        """Follow a folder that is being written."""
        if self.studio.queue.current is not None:
            ui.notify("Something is running; stop it first, or wait.")
            return
        try:
            jobs = await run.io_bound(self.studio.watch, folder.expanduser(), prior, step_deg) or []
            await run.io_bound(self._show_live, jobs)
        except InputError as error:
            _complain(error)
            return
        self._run(jobs)

    def _tick(self, on: bool, pause_s: float) -> None:
        """Tick for each step of a turntable, or stop ticking."""
        beat = f"window.beat = setInterval(() => tone(880), {1000.0 * max(pause_s, 0.5):.0f})" if on else ""
        ui.run_javascript(f"clearInterval(window.beat); {beat}")

    def _follow(self) -> None:
        """Show what has come into the folder."""
        capture = self.studio.capture
        if capture is None or self.step != "Capture":
            return
        placed, words = capture.said()
        told = f"{capture.count} {words} {capture.next()}"
        self.come.text = _come(capture, placed, words)
        self.capture_line.text = capture.job.line
        lines = [*capture.doubts(), *capture.facts(), capture.next()]
        self.come_more.text = "\n".join(f"{line[:1].upper()}{line[1:]}." for line in lines if line)
        if told == self._watched:
            return
        self._watched = told
        self.light.classes(replace=f"card {'' if placed is None else 'good' if placed else 'bad'}")
        if capture.count:
            self.live.set_source(f"/capture/newest.jpg?v={capture.count}")
            self.live.set_content(outline_svg(capture.mask))
        if (report := capture.report()) is not None:
            self.ring.set_content(ring_svg(report))
        if placed is not None:
            ui.run_javascript(f"tone({660 if placed else 220})")
        if self.viewers.live == capture.job.line and not list(self.live_viewer):
            with self.live_viewer:
                _viewer(self.viewers.address(None))

    # Object

    def _object(self, scan: Scan) -> None:
        panel = self.panels["Object"]
        panel.clear()
        with panel:
            with ui.element("div").classes("wide"):
                self.photo = (
                    ui.interactive_image(
                        self._address("frames"),
                        on_mouse=self._pointer,
                        events=["pointerdown", "pointermove", "pointerup", "pointerleave"],
                        sanitize=False,
                    )
                    .classes("photo")
                    .props("role=img aria-label='The frame with the outline of the object'")
                )
                self.strip = ui.element("div").classes("strip").props("aria-label='Frames'")
            with ui.element("div").classes("side column gap-3"):
                with ui.element("div").classes("card"):
                    ui.label("What is the object?").classes("text-h6")
                    ui.label(
                        "The outline should follow it in every frame. If not: click on the object or drag a box "
                        "around it, for all frames; or paint, to correct this frame."
                    ).classes("quiet")
                    tools = (
                        ui.toggle(["Box", "Add", "Erase"], value=self.tool)
                        .props("no-caps spread")
                        .classes("w-full q-my-sm")
                    )
                    tools.bind_value(self, "tool")
                    with ui.row().classes("items-center w-full no-wrap"):
                        ui.label("Brush")
                        ui.slider(min=2, max=40, step=1).bind_value(self, "brush_px").props(
                            "aria-label='Brush radius in pixels'"
                        )
                    with ui.row():
                        ui.button("Whole image", on_click=lambda: self._act(scan.whole_image)).props(
                            "outline no-caps dense"
                        )
                        ui.button("Undo painting", on_click=lambda: self._act(scan.unpaint, self.frame)).props(
                            "outline no-caps dense"
                        )
                with ui.element("div").classes("card"):
                    self.told = ui.label().classes("text-body2").props("role=status")
                    ui.button("Next: build", on_click=lambda: self.go("Build")).props("no-caps").classes(
                        "q-mt-sm w-full"
                    )
                self.object_line = _line()
        self._draw_strip(scan)
        self._outline(scan)

    def _address(self, kind: str, frame: int | None = None, version: int = 0) -> str:
        name = "" if self.scan is None else quote(self.scan.name)
        return f"/{kind}/{name}/{self.frame if frame is None else frame}.jpg?v={version}"

    def _draw_strip(self, scan: Scan) -> None:
        """Draw the small frames, each a button."""
        self.strip.clear()
        self.small: dict[int, ui.element] = {}
        stride = math.ceil(len(scan.sequence.indices) / _THUMBNAILS)
        with self.strip:
            for k in scan.sequence.indices[::stride]:
                with ui.element("button").on("click", lambda _, k=k: self._turn_to(k)) as button:
                    self.small[k] = ui.element("img").props(f"loading=lazy alt='frame {k}'")
                    ui.label(str(k))
                button.props(f"aria-label='frame {k}'")

    def _outline(self, scan: Scan) -> None:
        """Bring outline, small pictures and words up to date."""
        self.photo.set_content(outline_svg(scan.mask(self.frame)))
        doubts = scan.doubts()
        for k, image in self.small.items():
            state = f"{k in scan.found}-{scan.looked}-{scan.strokes.get(k, 0)}"
            address = self._address("thumbnails", k).replace("v=0", f"v={state}")
            if image.props.get("src") != address:
                image.props["src"] = address
                image.update()
            button = image.parent_slot.parent if image.parent_slot else None
            if button is not None:
                button.classes(add="on" if k == self.frame else "", remove="" if k == self.frame else "on")
                button.classes(add="doubt" if k in doubts else "", remove="" if k in doubts else "doubt")
        self.told.text = _told(scan, doubts)
        self.object_line.text = scan.line()

    def _turn_to(self, frame: int) -> None:
        if self.scan is not None:
            self.frame = frame
            self.photo.set_source(self._address("frames"))
            self._outline(self.scan)

    async def _pointer(self, event: events.MouseEventArguments) -> None:
        """Draw a box or a stroke, and act when the pointer is lifted."""
        scan, at = self.scan, (event.image_x, event.image_y)
        if scan is None:
            return
        if event.type == "pointerdown":
            self._points = [at]
        elif event.type == "pointermove" and self._points:
            self._points.append(at)
            if time.monotonic() - self._drawn_s > _DRAW_S:
                self._drawn_s = time.monotonic()
                shown = (
                    box_svg(self._points[0], at)
                    if self.tool == "Box"
                    else stroke_svg(self._points, self.brush_px, add=self.tool == "Add")
                )
                self.photo.set_content(outline_svg(scan.mask(self.frame)) + shown)
        elif self._points:
            points, self._points = self._points, []
            if event.type == "pointerup":
                points.append(at)
            if self.tool != "Box":
                await self._act(lambda: scan.paint(self.frame, points, self.brush_px, add=self.tool == "Add"))
            elif math.dist(points[0], points[-1]) > _CLICK_PX:
                await self._act(scan.box, points[0], points[-1])
            else:
                await self._act(scan.point_at, self.frame, *points[0])

    async def _act(self, act: Callable[..., object], *given: Any) -> None:
        """Do something that takes a moment, and show it."""
        try:
            await run.io_bound(act, *given)
        except InputError as error:
            _complain(error)
        if self.scan is not None:
            self._outline(self.scan)

    # Build

    def _build(self, scan: Scan) -> None:
        panel = self.panels["Build"]
        panel.clear()
        with panel:
            with ui.element("div").classes("wide"):
                self.viewer = ui.element("div").classes("w-full")
            with ui.element("div").classes("side column gap-3"):
                with ui.element("div").classes("card"):
                    ui.label("How did it move?").classes("text-h6")
                    self.priors = {}
                    with (
                        ui.element("div")
                        .classes("priors q-my-sm")
                        .props("role=radiogroup aria-label='How did it move?'")
                    ):
                        for name, (label, words, lines) in _PRIORS.items():
                            with ui.element("button").classes("prior").props("role=radio") as button:
                                ui.html(_drawing(lines), sanitize=False)
                                ui.html(f"<b>{label}</b>{words}", sanitize=False)
                            button.on("click", lambda _, name=name: self._choose(name))
                            if name == "held" and scan.sequence.robot_path is None:
                                button.props("disabled")
                            self.priors[name] = button
                    motion: dict[str, Any] = {**(scan.sequence.motion or {})}
                    step = scan.choices.step_deg or motion.get("step_deg") or 20.0
                    sigma = scan.choices.step_sigma_deg or motion.get("sigma_deg") or 3.0
                    with ui.row().classes("no-wrap") as self.steps:
                        self.step_deg = ui.number("Step, degrees", value=step, step=1, on_change=self._rechoose)
                        self.sigma_deg = ui.number(
                            "give or take", value=sigma, min=0.1, step=0.5, on_change=self._rechoose
                        )
                    self.building = (
                        ui.button("Build the model", on_click=self.build).props("no-caps").classes("w-full q-mt-sm")
                    )
                    self.resuming = ui.button(
                        "Go on with the interrupted run", on_click=lambda: self.build(resume=True)
                    )
                    self.resuming.props("no-caps outline").classes("w-full q-mt-sm")
                self.build_line = _line()
        self._mark_prior(scan)

    def _mark_prior(self, scan: Scan) -> None:
        chosen = scan.choices.prior or scan.usual_prior
        for name, button in self.priors.items():
            on = name == chosen
            button.classes(add="on" if on else "", remove="" if on else "on").props(f"aria-checked={str(on).lower()}")
        self.steps.set_visibility(chosen == "turntable")
        self.build_line.text = scan.line()
        report = None if self.studio.queue.current is not None else scan.report()
        self.resuming.set_visibility(
            report is not None and not scan.choices.dropped and report.get("complete") is not True
        )

    def _choose(self, name: str) -> None:
        if self.scan is not None:
            turns = name == "turntable"
            self.scan.choose_prior(
                name, self.step_deg.value if turns else None, self.sigma_deg.value if turns else None
            )
            self._mark_prior(self.scan)

    def _rechoose(self) -> None:
        if self.scan is not None and (self.scan.choices.prior or self.scan.usual_prior) == "turntable":
            self._choose("turntable")

    async def build(self, *, resume: bool = False) -> None:
        """Start a build."""
        scan = self.scan
        if scan is None or self.studio.queue.current is not None:
            ui.notify("Something is running; stop it first, or wait.")
            return
        try:
            jobs = await run.io_bound(lambda: scan.build_jobs(resume=resume)) or []
            await run.io_bound(lambda: self._show_live(jobs))
        except InputError as error:
            _complain(error)
            return
        self.studio.queue.add(jobs)
        self.go("Build")

    def _show_live(self, jobs: list[Job]) -> None:
        """Have the builds among jobs send what they do to the viewer."""
        for job in jobs:
            if job.words[0] == "build":
                job.unshown = ("--connect", self.viewers.sink(job.line))

    def _embed(self) -> None:
        """Show the viewer: of the build that runs, or of the latest run."""
        scan, queue = self.scan, self.studio.queue
        if scan is None or (scan.run is None and queue.current is None):
            return
        if self.viewers.live and queue.current is None and queue.last is not None and scan.run is None:
            return
        key = f"{self.viewers.live}|{'' if self.viewers.live else scan.run}"
        if key == self._shown_iframe:
            return
        self._shown_iframe = key
        address = self.viewers.address(scan)
        self.viewer.clear()
        with self.viewer:
            _viewer(address)

    def stop(self) -> None:
        """Stop what runs; of a build, what is there is kept."""
        self.studio.queue.stop()

    # Check

    def _check(self, scan: Scan) -> None:
        panel = self.panels["Check"]
        panel.clear()
        report, current = scan.report(), scan.run
        with panel:
            if report is None or current is None:
                ui.label("There is no model yet: build one.").classes("card")
                return
            with ui.element("div").classes("wide"):
                page = current / "report.html"
                if page.exists():
                    address = f"/runs/{quote(scan.name)}/{quote(current.name)}/report.html?v={page.stat().st_mtime_ns}"
                    with ui.row().classes("q-mb-xs"):
                        for label, anchor in (("Verdict", ""), ("Worst pairs", "pairs"), ("Masks", "masks")):
                            ui.button(label, on_click=lambda _, anchor=anchor: self._page(address, anchor)).props(
                                "outline no-caps dense"
                            )
                    self.paper = (
                        ui.element("iframe")
                        .classes("paper")
                        .props("title='The report of the run' sandbox=allow-scripts")
                    )
                    self.paper.style("height: calc(100vh - 290px); min-height: 420px")
                    self._page(address, "" if report["trustworthy"] else "pairs")
                else:
                    ui.label(
                        "The pictures are being drawn." if self.studio.queue.current else "No pictures yet."
                    ).classes("quiet")
                self._kept_frames(scan)
            with ui.element("div").classes("side first column gap-3"):
                self._verdict(scan, report)

    def _page(self, address: str, anchor: str) -> None:
        self.paper.props["src"] = f"{address}&at={anchor}#{anchor}" if anchor else address
        self.paper.update()

    def _verdict(self, scan: Scan, report: Any) -> None:
        good = report["trustworthy"]
        with ui.element("div").classes(f"card {'good' if good else 'bad'}").props("role=status"):
            ui.label("This model can be trusted" if good else "Do not trust this model").classes("text-h6")
            placed = sum(frame["outcome"] == ACCEPTED for frame in report["frames"])
            loop = "the loop is closed" if report["closed"] else "no loop is closed"
            ui.label(f"{placed} of {len(report['frames'])} frames placed, {loop}.")
            if good and report.get("trusted_to_m"):
                ui.label(f"Its surface is right to {1000.0 * report['trusted_to_m']:.1f} mm.")
            for reason in report["reasons"]:
                ui.label(f"{reason[:1].upper()}{reason[1:]}.")
        remedies = [words.partition(": modeler")[0] for words in report.get("remedies") or ()]
        camera = any("calibrate-camera" in words for words in report.get("remedies") or ())
        if remedies or camera:
            with ui.element("div").classes("card"):
                ui.label("What to do").classes("text-h6")
                for words in remedies:
                    ui.label(f"{words[:1].upper()}{words[1:]}.")
                if camera:
                    self._calibrations(scan)
        with ui.element("div").classes("card"):
            ui.html(ring_svg(report), sanitize=False)
            ui.button("What next? Suggest a turn", on_click=lambda: self._run([scan.suggest_job()])).props(
                "no-caps outline"
            )
            self.advice = ui.label().classes("quiet").style("white-space: pre-line")
            self.advice.text = scan.suggested()
        _line().text = f"modeler report {scan.run}"
        ui.button("Next: take it away", on_click=lambda: self.go("Take away")).props("no-caps").classes("w-full")

    def _calibrations(self, scan: Scan) -> None:
        ui.label(
            "Estimate the focal length of the camera from the loop, and build again with it. Where depth and focal "
            "length disagree, say which is right."
        ).classes("quiet")
        for label, known in (
            ("Calibrate the camera, build again", None),
            ("The focal length is right", "focal-length"),
            ("The depth is right", "depth"),
        ):
            button = ui.button(label, on_click=lambda _, known=known: self._calibrate(scan, known))
            button.props(f"no-caps {'outline' if known else ''} dense").classes("w-full q-mt-xs")

    async def _calibrate(self, scan: Scan, known: str | None) -> None:
        if self.studio.queue.current is not None:
            ui.notify("Something is running; wait for it, or stop it.")
            return
        calibration = scan.calibrate_job(known)
        jobs = [calibration, *(await run.io_bound(scan.build_jobs) or ())]
        await run.io_bound(lambda: self._show_live(jobs))
        self._run(jobs)
        self.go("Build")

    def _kept_frames(self, scan: Scan) -> None:
        """Draw the frames of the latest run; a click takes one out, or puts it back."""
        report = RunFolder(scan.runs()[-1]).report()
        placed = [frame["id"] for frame in report["frames"] if frame["outcome"] == ACCEPTED]
        ui.label("A click takes a frame out of the model, another one puts it back.").classes("quiet q-mt-sm")
        with ui.element("div").classes("strip").props("aria-label='Frames of the model'"):
            for k in placed:
                out = k in scan.choices.dropped
                with (
                    ui.element("button")
                    .classes("out" if out else "")
                    .props(f"aria-pressed={str(out).lower()}") as button
                ):
                    ui.element("img").props(f"loading=lazy alt='' src='{self._address('thumbnails', k)}'")
                    ui.label(str(k))
                button.props(f"aria-label='frame {k}'").on("click", lambda _, k=k: self._drop(scan, k))

    def _drop(self, scan: Scan, frame: int) -> None:
        if self.studio.queue.current is not None:
            ui.notify("Something is running; wait a moment.")
            return
        self._run(scan.edit_jobs(sorted({*scan.choices.dropped} ^ {frame})))
        self._check(scan)

    def _run(self, jobs: list[Job]) -> None:
        self.studio.queue.add(jobs)

    # Take away

    def _take_away(self, scan: Scan) -> None:
        panel = self.panels["Take away"]
        panel.clear()
        with panel:
            if scan.run is None:
                ui.label("There is no model yet: build one.").classes("card")
                return
            with ui.element("div").classes("wide card"):
                ui.label("Take the model away").classes("text-h6")
                with ui.element("div").classes("priors q-my-sm"):
                    for what, words in _EXPORTS.items():
                        with ui.element("button").classes("prior") as button:
                            ui.html(f"<b>{what.upper() if what in MESHES else what}</b>{words}", sanitize=False)
                        button.on("click", lambda _, what=what: self._export(scan, what))
            with ui.element("div").classes("side column gap-3"):
                with ui.element("div").classes("card"):
                    ui.label("Download").classes("text-h6")
                    exports = scan.exports()
                    if not exports:
                        ui.label("Choose a format: the file appears here.").classes("quiet")
                    for path in exports:
                        name = f"{path.name}.zip" if path.is_dir() else path.name
                        ui.link(name, f"/take-away/{quote(scan.name)}/{quote(name)}").props(
                            f"download='{name}'"
                        ).classes("block")
                    for words in scan.export_words():
                        ui.label(words).classes("quiet")
                line = _line()
                line.text = f"modeler export {scan.run} --out {scan.name}.glb"

    def _export(self, scan: Scan, what: str) -> None:
        coloured = scan.sequence.frame(scan.sequence.indices[0]).colour is not None
        self._run([scan.export_job(what, texture=coloured)])

    # Scans

    def _scans(self) -> None:
        panel = self.panels["Scans"]
        panel.clear()
        with panel, ui.element("div").classes("wide"):
            folders = self.studio.folders()
            if not folders:
                ui.label(f"Nothing scanned yet in {self.studio.out}.").classes("card")
            with ui.element("div").classes("gallery"):
                for folder in folders:
                    self._shelf(folder)

    def _shelf(self, folder: Path) -> None:
        runs = sorted(folder.glob("run-*/report.json"), key=lambda path: path.stat().st_mtime)
        with ui.element("div").classes("card"):
            words = "not built yet"
            if runs:
                run_folder = runs[-1].parent
                ui.element("img").props(
                    f"loading=lazy alt='' src='/models/{quote(folder.name)}/{quote(run_folder.name)}.jpg'"
                )
                try:
                    trusted = RunFolder(run_folder).report()["trustworthy"]
                    words = "can be trusted" if trusted else "not to be trusted"
                except (InputError, KeyError):
                    words = "interrupted"
            ui.label(folder.name).classes("text-subtitle1")
            ui.label(words).classes("quiet")
            ui.button("Open", on_click=lambda: self._reopen(folder)).props("no-caps dense outline")

    async def _reopen(self, folder: Path) -> None:
        try:
            await run.io_bound(lambda: self.studio.open(Path(Choices.read(folder / "scan.json").sequence)))
        except InputError as error:
            _complain(error)
            return
        self._start()

    # What goes on

    def _poll(self) -> None:
        """Follow the scan and the running command."""
        scan, queue = self.scan, self.studio.queue
        if self._seen[0] != self.studio.version:
            self._start()
            return
        if scan is not None and self._seen[1] != scan.version:
            self._seen = (self.studio.version, scan.version)
            self._outline(scan)
            self._mark_prior(scan)
        self._follow()
        job = queue.current
        self.footer.set_visibility(job is not None)
        if job is not None:
            now = job.progress()
            left = "" if now.left_s is None else f", about {max(1, round(now.left_s))} s left"
            self.doing.text = f"{job.title}: {now.words}{left}"
            self.bar.props["indeterminate"] = now.share is None
            self.bar.value = now.share or 0.0
            self.bar.update()
        if job is not self._job and job is not None and scan is not None and job.words[0] == "build":
            self._embed()
        if queue.last is not self._ended:
            self._ended = queue.last
            capture = self.studio.capture
            if capture is not None and not capture.job.running and job is None:
                self._captured(capture)
            elif scan is not None:
                self._after(scan, queue.last)
        self._job = job

    def _after(self, scan: Scan, job: Job | None) -> None:
        """Show the result of a command that has ended."""
        if job is None:
            return
        if job.failure is not None:
            ui.notify(f"{job.title}: {job.failure}", type="negative", timeout=0, close_button="OK", multi_line=True)
        self._mark_prior(scan)
        self._check(scan)
        self._take_away(scan)
        self._embed_if_shown()
        if job.words[0] == "report" and self.step == "Build" and job.failure is None:
            self.go("Check")

    def _captured(self, capture: Capture) -> None:
        """Go on with a capture whose model has been made."""
        capture.stop()
        self.studio.capture = None
        if capture.job.failure is not None:
            ui.notify(capture.job.failure, type="negative", timeout=0, close_button="OK", multi_line=True)
            return
        try:
            self.studio.open(capture.folder)
        except InputError as error:
            _complain(error)

    def _embed_if_shown(self) -> None:
        if self.step == "Build":
            self._embed()

    async def _key(self, event: events.KeyEventArguments) -> None:
        """Turn frames with the arrow keys, and choose steps with the digits."""
        scan = self.scan
        if not event.action.keydown or event.modifiers.ctrl or event.modifiers.alt or event.modifiers.meta:
            return
        name = str(event.key)
        if name.isdecimal() and 1 <= int(name) <= len(STEPS):
            self.go(STEPS[int(name) - 1])
        elif scan is not None and self.step == "Object":
            frames = scan.sequence.indices
            at = frames.index(self.frame)
            if name == "ArrowRight":
                self._turn_to(frames[min(at + 1, len(frames) - 1)])
            elif name == "ArrowLeft":
                self._turn_to(frames[max(at - 1, 0)])
        if name == "b" and scan is not None and self.step == "Build":
            await self.build()


def _viewer(address: str) -> None:
    """Embed the viewer."""
    frame = ui.element("iframe").props("title='The model in the Rerun viewer' allow=fullscreen")
    frame.props["src"] = address
    frame.style("height: calc(100vh - 130px); min-height: 380px")


def _come(capture: Capture, placed: bool | None, words: str) -> str:
    """Return in words whether the next view may come."""
    if not capture.job.running:
        return capture.job.failure or "The capture has ended."
    if placed is None:
        return (
            f"{capture.count} frames; the model begins with the first few." if capture.count else "Waiting for frames."
        )
    if placed:
        late = f" No new one for {capture.waits_s:.0f} s." if capture.waits_s > _LATE_S else ""
        return f"{words[:1].upper()}{words[1:]}. Turn it: the next view may come.{late}"
    return f"{words[:1].upper()}{words[1:]}. Turn it back a little, and try again."


def _entries(folder: Path) -> list[Path]:
    """Return what may be opened in a folder: folders and recordings."""
    try:
        found = [path for path in folder.iterdir() if not path.name.startswith(".")]
        found = [path for path in found if path.is_dir() or path.suffix.lower() in _RECORDINGS]
    except OSError:
        return []
    return sorted(found, key=lambda path: (not path.is_dir(), path.name))[:_FOLDERS_SHOWN]


def _complain(error: InputError) -> None:
    ui.notify(str(error).replace("`", ""), type="negative", timeout=8000, close_button="OK", multi_line=True)


def _told(scan: Scan, doubts: dict[int, str]) -> str:
    """Return what is known of the masks in words."""
    if scan.fault:
        return scan.fault
    count, total = len(scan.found), len(scan.sequence.indices)
    if scan.looking:
        return f"Looking for the object: {count} of {total} frames."
    words = f"{total} frames. "
    if doubts:
        named = ", ".join(map(str, sorted(doubts)[:12])) + (" …" if len(doubts) > 12 else "")
        words += (
            f"Look at {'frame' if len(doubts) == 1 else 'frames'} {named}: {', '.join(sorted(set(doubts.values())))}. "
        )
    if scan.painted:
        named = ", ".join(map(str, sorted(scan.painted)))
        words += f"Corrected by hand: {named}; the build reads all masks from a folder of its own."
    return words


def _line() -> ui.label:
    """Return where the command line that does the same is shown."""
    with ui.element("details").classes("card"):
        with ui.element("summary").classes("quiet"):
            ui.label("The same in a terminal").style("display: inline")
        return ui.label().classes("line")


def _drawing(lines: str) -> str:
    return (
        "<svg viewBox='0 0 64 60' aria-hidden='true'><path fill='none' stroke='#0b6b75' stroke-width='2.5' "
        f"stroke-linecap='round' stroke-linejoin='round' d='{lines}'/></svg>"
    )
