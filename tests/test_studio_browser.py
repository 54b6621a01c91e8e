"""The page in a real browser: from a capture to an exported model."""

import json
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from chromium import needs_chromium, started
from studio_server import Server, end, served

from modeler.export import RunFolder
from modeler.sequences import write_bop
from studies.formats.image_folders import small_frames

pytest.importorskip("nicegui", reason="needs the extra studio")
pytestmark = [needs_chromium, pytest.mark.slow]
CAPTURES = Path(__file__).parents[1].parent / "shared" / "data"
PATIENCE_MS = 90_000
STEPS = ("Files", "Capture", "Object", "Build", "Check", "Take away", "Scans")
_FAINT = """() => {
  const channels = (colour) => (colour.match(/[\\d.]+/g) || [0, 0, 0, 0]).map(Number);
  const linear = (c) => (c <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
  const light = ([r, g, b]) => 0.2126 * linear(r / 255) + 0.7152 * linear(g / 255) + 0.0722 * linear(b / 255);
  const behind = (element) => {
    for (let at = element; at; at = at.parentElement) {
      const rgba = channels(getComputedStyle(at).backgroundColor);
      if (rgba.length < 4 || rgba[3] > 0.5) return rgba;
    }
    return [255, 255, 255];
  };
  const faint = (element) => {
    const lights = [channels(getComputedStyle(element).color), behind(element)].map(light);
    return (Math.max(...lights) + 0.05) / (Math.min(...lights) + 0.05) < 4.5;
  };
  const says = (element) => [...element.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
  return [...document.querySelectorAll('body *')]
    .filter((element) => element.checkVisibility() && !element.closest(':disabled') && says(element) && faint(element))
    .map((element) => element.innerText);
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with started() as running:
        yield running


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of three small frames of the bundled box."""
    folder = tmp_path_factory.mktemp("capture") / "box"
    write_bop(folder, small_frames(3), depth_scale_mm=1.0)
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
        image = self.page.get_by_label("The frame with the outline of the object").locator("img")
        while not (natural := image.evaluate("image => [image.naturalWidth, image.naturalHeight]"))[0]:
            time.sleep(0.05)
        box = image.bounding_box()
        points = [
            (box["x"] + x * box["width"] / natural[0], box["y"] + y * box["height"] / natural[1]) for x, y in places
        ]
        self.clicks += 1
        self.page.mouse.move(*points[0])
        self.page.mouse.down()
        for point in points[1:]:
            self.page.mouse.move(*point, steps=6)
        self.page.mouse.up()

    def faint(self) -> list[str]:
        """Return visible words of which the contrast is below 4.5 to 1, the least that WCAG 2 asks of text."""
        return self.page.evaluate(_FAINT)

    def fits(self) -> bool:
        """Whether nothing sticks out at the side."""
        return bool(self.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"))


def test_a_capture_becomes_an_exported_model_which_a_second_page_shows_too(
    browser: Any, capture: Path, tmp_path: Path
) -> None:
    with served(capture, tmp_path / "studio") as server:
        window, other = Window(browser, server), Window(browser, server, (390, 844))
        window.sees("3 frames.")
        assert window.page.locator(".strip img").count() >= 3
        assert window.fits()
        assert other.fits()
        window.click("button", "Next: build")
        window.click("button", "Build the model")
        window.sees("frames placed")
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
        assert len(report["poses"]) == 3
        for number, step in enumerate(STEPS, start=1):
            window.page.keyboard.press(str(number))
            window.page.locator("[role=tab][aria-selected=true]", has_text=step).wait_for()
            assert window.faint() == []
            assert window.fits()
            other.click("tab", step)
            assert other.fits()
        assert (window.faults, other.faults) == ([], [])
        assert window.hosts == other.hosts == {f"127.0.0.1:{server.port}"}


def answered_ms(page: Any) -> float:
    """Return how long a click on another step and one back take until the step is shown, the longer of both."""
    script = """async (names) => {
      let longest = 0;
      for (const [name, number] of names) {
        const panel = document.querySelectorAll('.panel')[number], before = performance.now();
        [...document.querySelectorAll('[role=tab]')].find((tab) => tab.innerText.trim() === name).click();
        while (panel.classList.contains('hidden')) await new Promise((done) => setTimeout(done, 1));
        longest = Math.max(longest, performance.now() - before);
      }
      return longest;
    }"""
    return float(page.evaluate(script, [["Files", 0], ["Build", 3]]))


def test_what_was_painted_and_chosen_survives_a_server_that_is_killed(
    browser: Any, capture: Path, tmp_path: Path
) -> None:
    out = tmp_path / "studio"
    with served(capture, out) as server:
        window = Window(browser, server)
        window.sees("3 frames.")
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


@pytest.mark.timeout(900)
@pytest.mark.skipif(not (CAPTURES / "cap").exists(), reason="the captures are not here")
def test_a_wrong_mask_of_the_cap_is_mended_by_one_box_and_frames_are_dropped_and_put_back(
    browser: Any, tmp_path: Path
) -> None:
    folder = tmp_path / "studio" / "cap"
    with served(CAPTURES / "cap", tmp_path / "studio") as server:
        window = Window(browser, server)
        window.page.set_default_timeout(300_000)
        window.sees("19 frames.")
        window.drag((20.0, 20.0), (120.0, 140.0))  # a wrong one: the room behind
        window.sees("Look at frames")
        began_s, window.clicks = time.monotonic(), 0
        window.drag((180.0, 120.0), (460.0, 400.0))
        window.page.get_by_text("19 frames.", exact=True).wait_for()
        window.click("button", "Next: build")
        window.click("button", "Build the model")
        verdict, times_ms = window.page.get_by_text("frames placed"), list[float]()
        while not verdict.count():
            times_ms.append(answered_ms(window.page))
            time.sleep(0.2)
        print(f"answers in {statistics.median(times_ms):.0f} ms, at most {max(times_ms):.0f} ms")
        window.sees("frames placed")
        window.click("button", "Next: take it away")
        window.clicks += 2
        window.page.get_by_role("button", name="STL").click()
        window.page.get_by_role("link", name="cap.stl", exact=True).click()
        assert window.clicks <= 8
        print(f"cap: {window.clicks} clicks, {time.monotonic() - began_s:.0f} s")
        report = RunFolder(folder / "run-1").report()
        assert report["trustworthy"], report["reasons"]
        assert len(report["poses"]) == 19
        assert report["settings"]["roi"] == [180, 120, 461, 401]
        window.click("tab", "Check")
        began_s = time.monotonic()
        strip = window.page.get_by_label("Frames of the model")
        strip.get_by_label("frame 7", exact=True).click()
        window.sees("18 of 18 frames placed")
        print(f"re-optimised in {time.monotonic() - began_s:.1f} s")
        assert len(RunFolder(folder / "run-1-edited").report()["poses"]) == 18
        window.page.get_by_role("button", name="Stop").wait_for(state="hidden")
        strip.get_by_label("frame 7", exact=True).click()
        window.sees("19 of 19 frames placed")
        assert len(RunFolder(folder / "run-1").report()["poses"]) == 19
        assert window.faults == []
