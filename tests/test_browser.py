"""What a browser makes of the page about a run and of the viewer that the run is streamed to: the model, drawn."""

import functools
import http.server
import shutil
import subprocess
import tarfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from chromium import Page, needs_chromium, started
from turning_box import object_from_camera, steps

from modeler import se3
from modeler.cli import main
from modeler.export import RunFolder, RunMeta
from modeler.sequences import bundled
from modeler.viz import viewer
from modeler.viz.report import write_page
from modeler.viz.stream import open_stream

pytestmark = needs_chromium
COUNT = 4


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = RunFolder.open(tmp_path_factory.mktemp("browser") / "run")
    stream = open_stream("box", save=folder.path / "recording.rrd")
    for step in steps(COUNT):
        folder.write(step, RunMeta("box", 0, "table"))
        stream(step)
    stream.close()
    write_page(folder.path, folder.path / "report.html", {k: se3.inverse(object_from_camera(k)) for k in range(COUNT)})
    return folder.path


@pytest.fixture
def page() -> Iterator[Page]:
    with started() as browser:
        yield Page(browser, 1600, 1000)


def coloured(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    """Return which pixels (h, w) are far from grey."""
    return np.ptp(picture.astype(int), axis=2) > 40


def test_the_report_draws_the_model_and_turns_it(run: Path, page: Page) -> None:
    page.open((run / "report.html").as_uri())
    page.wait_for("document.getElementById('mesh')?.dataset.drawn == '12'")
    page.value("document.getElementById('mesh').scrollIntoView()")
    left, top, width, height = (
        page.value(f"document.getElementById('mesh').getBoundingClientRect().{side}")
        for side in ("left", "top", "width", "height")
    )
    inside = np.s_[round(top) : round(top + height), round(left) : round(left + width)]
    before = page.picture()[inside].astype(int)
    drawn = np.abs(before - before[2, 2]).max(axis=2) > 25
    assert 0.03 < drawn.mean() < 0.6
    rows, columns = np.nonzero(drawn)
    assert abs(rows.mean() / drawn.shape[0] - 0.5) < 0.1
    assert abs(columns.mean() / drawn.shape[1] - 0.5) < 0.1
    middle = (left + 0.5 * width, top + 0.5 * height)
    page.drag(middle, (middle[0] + 120.0, middle[1] + 40.0))
    after = page.picture()[inside].astype(int)
    assert np.mean(np.abs(after - before).max(axis=2) > 25) > 0.01
    page.value("document.getElementById('cameras').click()")
    with_cameras = page.picture()[inside].astype(int)
    assert np.any(np.abs(with_cameras - after).max(axis=2) > 25)
    page.value("document.getElementById('cameras').click()")
    bare = page.picture()[inside].astype(int)
    page.value("chosen = document.getElementById('paint'); chosen.value = 'plain'")
    page.value("chosen.dispatchEvent(new Event('change'))")
    plain = page.picture()[inside].astype(int)
    assert np.mean(np.abs(plain - bare).max(axis=2) > 5) > 0.01
    page.value("document.querySelector('.mask button').click()")
    assert page.value("document.querySelector('#large[open] img').getBoundingClientRect().width") > 700.0
    page.value("document.getElementById('large').click()")
    assert not page.value("document.getElementById('large').open")
    broken = page.value("[...document.images].filter((image) => !image.naturalWidth).length")
    assert broken == 0
    assert page.value("document.images.length") > 5
    assert page.complaints == []
    assert all(address.startswith(("file:", "data:")) for address in page.requested)


@pytest.mark.slow
def test_the_web_viewer_draws_the_run(run: Path, page: Page) -> None:
    served = viewer.view(run, web=True)
    try:
        page.open(f"{served.address}&renderer=webgl")
        deadline = time.monotonic() + 90.0
        while coloured(page.picture()).mean() < 0.004:  # cameras, edges and the frame: an empty layout has less
            assert time.monotonic() < deadline, page.complaints
            time.sleep(1.0)
    finally:
        served.stop()
    # The viewer asks its makers' servers for fonts and news; without a network that is an error, but none of ours.
    theirs = ("https://", "TypeError: Failed to fetch")
    assert [words for words in page.complaints if not any(mark in words for mark in theirs)] == []


@pytest.fixture
def site(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A folder with a viewer of GLB files from npm, and its address."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed")
    folder = tmp_path / "site"
    folder.mkdir()
    got = subprocess.run([npm, "pack", "@google/model-viewer@4.4.0"], cwd=tmp_path, capture_output=True, check=False)
    if got.returncode:
        pytest.skip("npm's registry cannot be reached")
    with tarfile.open(next(tmp_path.glob("*.tgz"))) as archive:
        script = archive.extractfile("package/dist/model-viewer.min.js")
        (folder / "viewer.js").write_bytes(script.read())
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield folder, f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


@pytest.mark.slow
def test_a_viewer_in_the_browser_draws_an_exported_model_with_its_texture(
    site: tuple[Path, str], tmp_path: Path, page: Page
) -> None:
    folder, address = site
    assert main(["build", str(bundled("box")), "--prior", "table", "--out", str(tmp_path / "run")]) == 0
    assert main(["export", str(tmp_path / "run"), "--out", str(folder / "box.glb"), "--texture"]) == 0
    (folder / "index.html").write_text(
        "<!DOCTYPE html><script type='module' src='viewer.js'></script><body style='margin:0'>"
        "<model-viewer id='v' src='box.glb' camera-orbit='30deg 60deg auto' style='width:800px;height:800px'>"
        "</model-viewer>"
    )
    page.open(f"{address}index.html")
    page.wait_for("document.getElementById('v')?.loaded === true")
    box = page.value("JSON.stringify(document.getElementById('v').getDimensions())")
    assert '"y":0.1' in box  # 0.18 m high, and y is up
    deadline = time.monotonic() + 60.0
    while (seen := coloured(page.picture())[:800, :800]).mean() < 0.05:  # its print is yellow
        assert time.monotonic() < deadline, page.complaints
        time.sleep(0.5)
    rows, columns = np.nonzero(seen)
    assert abs(rows.mean() - 400.0) < 80.0
    assert abs(columns.mean() - 400.0) < 80.0
    assert [words for words in page.complaints if "favicon" not in words] == []
