"""Pages in headless Chromium: what they draw, and what they complain of."""

import io
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

EXECUTABLE = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_chromium = pytest.mark.skipif(EXECUTABLE is None, reason="Chromium is not installed")
_PATIENCE_S = 60.0
_FLAGS = (
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--enable-unsafe-swiftshader",  # draws WebGL without a graphics card
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--ignore-gpu-blocklist",
)


@contextmanager
def started() -> Iterator[Any]:
    """Start a browser, as Playwright has it, until the end of the block."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs Playwright")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=EXECUTABLE, args=[*_FLAGS])
        yield browser
        browser.close()


class Page:
    """One page of a browser."""

    def __init__(self, browser: Any, width: int, height: int) -> None:
        self.complaints: list[str] = []
        """Errors that the page wrote to the console or did not catch, and requests that failed."""
        self.requested: list[str] = []
        """Addresses that the page asked for."""
        self._page = browser.new_page(viewport={"width": width, "height": height})
        self._page.set_default_timeout(1000.0 * _PATIENCE_S)
        self._page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self._page.on("console", self._note)
        self._page.on("request", lambda request: self.requested.append(request.url))

    def _note(self, message: Any) -> None:
        if message.type in ("error", "assert"):
            self.complaints.append(f"{message.text} {message.location.get('url', '')}")

    def open(self, address: str) -> None:
        """Go to an address and return when the page is there."""
        self._page.goto(address)

    def value(self, expression: str) -> Any:
        """Return what an expression in JavaScript comes to."""
        return self._page.evaluate(expression)

    def wait_for(self, expression: str) -> None:
        """Return when an expression in JavaScript comes true.

        `wait_for_function` evaluates it within the page, which pages with a content security policy refuse.
        """
        until_s = time.monotonic() + _PATIENCE_S
        while not self.value(expression):
            assert time.monotonic() < until_s, f"{expression} is not true after {_PATIENCE_S} s"
            self._page.wait_for_timeout(50.0)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag from one point of the window to another."""
        self._page.mouse.move(*start)
        self._page.mouse.down()
        self._page.mouse.move(*end)
        self._page.mouse.up()

    def picture(self) -> npt.NDArray[np.uint8]:
        """Return what the window shows (h, w, 3)."""
        return np.asarray(Image.open(io.BytesIO(self._page.screenshot())).convert("RGB"))
