"""The page in a real browser: from a capture to an exported model."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from studio_server import EXECUTABLE, FLAGS, Server, end, needs_browser, served

from modeler.export import RunFolder
from modeler.sequences import write_bop
from studies.formats.image_folders import small_frames

pytest.importorskip("nicegui", reason="needs the extra studio")
sync_api = pytest.importorskip("playwright.sync_api", reason="needs Playwright")
pytestmark = needs_browser
CAPTURES = Path(__file__).parents[1].parent / "shared" / "data"
PATIENCE_MS = 90_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=str(EXECUTABLE), args=[*FLAGS])
        yield running
        running.close()


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of five small frames of the bundled box."""
    folder = tmp_path_factory.mktemp("capture") / "box"
    write_bop(folder, small_frames(5), depth_scale_mm=1.0)
    return folder


class Window:
    """A browser window on a server; it notes errors, and what was asked of whom."""

    def __init__(
        self, browser: Any, server: Server, size: tuple[int, int] = (1280, 800), *, drawn: bool = False
    ) -> None:
        self.page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        self.page.set_default_timeout(PATIENCE_MS)
        self.faults: list[str] = []
        self.hosts: set[str] = set()
        self.clicks = 0
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("console", self._note)
        self.page.on("request", self._asked)
        if not drawn:  # which takes a core here, without a graphics card
            ours = f"http://127.0.0.1:{server.port}/"
            self.page.route(lambda url: not url.startswith((ours, "blob:", "data:")), lambda route: route.abort())
        self.page.goto(server.address)

    def _note(self, message: Any) -> None:
        ours = message.location.get("url", "").split("?")[0]
        if message.type == "error" and "re_viewer" not in ours and self.page.url.split("?")[0] in ours:
            self.faults.append(message.text)

    def _asked(self, request: Any) -> None:
        if request.frame == self.page.main_frame:
            self.hosts.add(request.url.partition("://")[2].partition("/")[0])

    def click(self, role: str, name: str) -> None:
        """Click on what a person would."""
        self.clicks += 1
        self.page.get_by_role(role, name=name, exact=True).click()

    def sees(self, words: str) -> None:
        """Return once words are seen."""
        self.page.get_by_text(words).first.wait_for()

    def drag(self, *places: tuple[float, float]) -> None:
        """Drag across the frame, along places in px of the image."""
        image = self.page.locator(".photo img")
        self.page.wait_for_function("document.querySelector('.photo img').naturalWidth > 0")
        box, natural = image.bounding_box(), image.evaluate("image => [image.naturalWidth, image.naturalHeight]")
        points = [
            (box["x"] + x * box["width"] / natural[0], box["y"] + y * box["height"] / natural[1]) for x, y in places
        ]
        self.clicks += 1
        self.page.mouse.move(*points[0])
        self.page.mouse.down()
        for point in points[1:]:
            self.page.mouse.move(*point, steps=6)
        self.page.mouse.up()

    def fits(self) -> bool:
        """Whether nothing sticks out at the side."""
        return bool(self.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"))


def test_a_capture_becomes_an_exported_model_while_the_page_answers(
    browser: Any, capture: Path, tmp_path: Path
) -> None:
    with served(capture, tmp_path / "studio") as server:
        window, other = Window(browser, server), Window(browser, server, (390, 844))
        window.sees("5 frames.")
        assert window.page.locator(".strip img").count() >= 5
        assert window.fits()
        assert other.fits()
        window.click("button", "Next: build")
        window.click("button", "Build the model")
        times_ms = []
        while (
            window.page.get_by_text("This model can be trusted").or_(window.page.get_by_text("Do not trust")).count()
            == 0
        ):
            times_ms.append(answered_ms(window.page))
            time.sleep(0.2)
            assert len(times_ms) < 1000
        assert statistics.median(times_ms) < 100.0
        other.click("tab", "Check")
        other.sees("frames placed")
        window.page.get_by_role("button", name="Stop").wait_for(state="hidden")
        window.click("tab", "Take away")
        window.page.get_by_role("button", name="STL").click()
        with window.page.expect_download() as download:
            window.page.get_by_role("link", name="box.stl", exact=True).click()
        size = download.value.path().stat().st_size
        assert size == (tmp_path / "studio" / "box" / "take-away" / "box.stl").stat().st_size > 1000
        report = RunFolder(tmp_path / "studio" / "box" / "run-1").report()
        assert len(report["poses"]) == 5
        assert (window.faults, other.faults) == ([], [])
        assert window.hosts == other.hosts == {f"127.0.0.1:{server.port}"}


def answered_ms(page: Any) -> float:
    """Return how long the page takes to answer a click on another step, as a person sees it."""
    asked = "document.querySelector('[role=status]') && fetch('/thumbnails/box/0.jpg').then(() => performance.now())"
    return float(
        page.evaluate(f"(async () => {{ const before = performance.now(); return await ({asked}) - before }})()")
    )


@pytest.mark.slow
def test_what_was_painted_and_chosen_survives_a_server_that_is_killed(
    browser: Any, capture: Path, tmp_path: Path
) -> None:
    out = tmp_path / "studio"
    with served(capture, out) as server:
        window = Window(browser, server)
        window.sees("5 frames.")
        window.page.keyboard.press("ArrowRight")
        window.click("button", "Add")
        window.drag((10.0, 10.0), (40.0, 12.0))
        window.sees("Corrected by hand: 1;")
        window.click("button", "Next: build")
        window.page.get_by_role("radio", name="On a table").click()
        window.click("button", "Build the model")
        window.sees("Building the model")
        server.kill()
        window.page.close()
    running = json.loads((out / "jobs.json").read_text())
    try:
        with served(capture, out) as server:
            window = Window(browser, server)
            window.sees("frames placed")
            window.click("tab", "Object")
            window.sees("Corrected by hand: 1;")
            report = RunFolder(out / "box" / "run-1").report()
            assert report["prior"] == "table"
            assert report["complete"]
            assert Path(report["sequence"]).name == "masked-1"
    finally:
        for record in running:
            end(record["pid"])


@pytest.mark.slow
@pytest.mark.skipif(not (CAPTURES / "cap").exists(), reason="the captures are not here")
def test_a_wrong_mask_of_the_cap_is_mended_by_one_box(browser: Any, tmp_path: Path) -> None:
    with served(CAPTURES / "cap", tmp_path / "studio") as server:
        window = Window(browser, server)
        window.sees("19 frames.")
        window.drag((20.0, 20.0), (120.0, 140.0))  # a wrong one: the wall
        window.sees("Look at frames")
        began_s, window.clicks = time.monotonic(), 0
        window.drag((200.0, 120.0), (460.0, 400.0))
        window.page.get_by_text("19 frames.").first.wait_for()
        window.click("button", "Next: build")
        window.click("button", "Build the model")
        window.sees("frames placed")
        window.click("button", "Next: take it away")
        window.page.get_by_role("button", name="GLB").click()
        window.page.get_by_role("link", name="cap.glb", exact=True).click()
        print(f"cap: {window.clicks + 2} clicks, {time.monotonic() - began_s:.0f} s")
        report = RunFolder(tmp_path / "studio" / "cap" / "run-1").report()
        assert len(report["poses"]) == 19
        assert report["trustworthy"], report["reasons"]
        turned = np.degrees(
            np.arccos(
                np.clip((np.trace(np.reshape(report["poses"][9]["object_from_camera"], (4, 4))[:3, :3]) - 1) / 2, -1, 1)
            )
        )
        assert turned > 90.0
        assert window.faults == []
