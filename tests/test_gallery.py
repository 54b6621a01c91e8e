"""The page about many models, as a browser shows it."""

import io
import json
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from chromium import Page, needs_chromium, started
from command_runner import Run
from PIL import Image

from modeler.batch.jobs import NOTES
from modeler.batch.models import THUMBNAIL_PX, enclosed_m3
from modeler.sequences.meshes import Mesh
from modeler.sequences.rendering.shapes import Box

COUNT = 1000


def picture(number: int) -> bytes:
    """Return a made-up picture of its own, as large as those of models."""
    rng = np.random.default_rng(number)
    coarse = Image.fromarray(rng.integers(0, 256, (20, 20, 3), dtype=np.uint8))
    content = io.BytesIO()
    coarse.resize((THUMBNAIL_PX, THUMBNAIL_PX), Image.Resampling.BICUBIC).save(content, "JPEG", quality=85)
    return content.getvalue()


def note(number: int) -> dict[str, Any]:
    """Return what is known of a made-up model: every tenth failed, every fifth is not to be trusted."""
    if number % 10 == 9:
        return {"sequence": f"/s/{number}", "status": 2, "line": "no <depth> images", "tries": 2}
    record = {
        "trustworthy": number % 5 != 0,
        "reasons": [] if number % 5 else ["the loop </script> is open"],
        "frames": 14,
        "triangles": 1,
        "width_m": 0.001 * ((number * 37) % COUNT),
        "seconds": None if number == 1 else 10.0,
    }
    return {"sequence": f"/s/{number}", "status": 0 if number % 5 else 3, "record": record}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of a thousand made-up models."""
    out = tmp_path_factory.mktemp("many")
    (out / NOTES).mkdir()
    pictures = [picture(number) for number in range(30)]
    for number in range(COUNT):
        name = f"model-{number:04d}"
        (out / NOTES / f"{name}.json").write_text(json.dumps(note(number)))
        if number % 10 != 9:
            (out / NOTES / f"{name}.jpg").write_bytes(pictures[number % len(pictures)])
            (out / name).mkdir()
            (out / name / "report.json").write_text("{}")
    (out / "model-0000" / "report.html").write_text("a page")
    return out


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with started() as browser:
        yield Page(browser, 1400, 1000)


@needs_chromium
def test_a_thousand_models_are_there_and_only_what_is_near_is_laid_out(cli: Run, folder: Path, page: Page) -> None:
    ended = cli("gallery", folder, "--overwrite")
    assert (ended.status, ended.out) == (0, "")
    assert {path.name for path in folder.iterdir() if path.is_file()} == {"gallery.html", "models.parquet"}
    pictures = sum(path.stat().st_size for path in (folder / NOTES).glob("*.jpg"))
    assert (folder / "gallery.html").stat().st_size < 1.4 * pictures + 500 * COUNT  # each once, in base 64
    page.open((folder / "gallery.html").as_uri())
    assert page.value("document.querySelectorAll('.model').length") == COUNT
    style = "getComputedStyle(card).contentVisibility"
    assert page.value(f"[...document.querySelectorAll('.model')].every((card) => {style} == 'auto')")
    page.wait_for("document.querySelector('.model img').naturalWidth == 160")
    decoded = page.value("[...document.images].filter((image) => image.src).length")
    assert 20 < decoded < 200  # those near the window: by this the page is there at once
    assert page.picture()[200:, :].std() > 20.0
    page.value("window.scrollTo(0, document.body.scrollHeight)")
    page.wait_for("[...document.images].at(-1).naturalWidth == 160")
    assert page.complaints == []
    assert all(address.startswith(("file:", "data:")) for address in page.requested)
    words = page.value(
        "[...document.querySelectorAll('.model')].slice(0, 10).map((card) => card.children[2].textContent)"
    )
    assert words == [
        "cannot be trusted",
        *["can be trusted"] * 4,
        "cannot be trusted",
        *["can be trusted"] * 3,
        "failed",
    ]
    assert page.value("document.querySelector('a').getAttribute('href')") == "model-0000/report.html"
    assert page.value("document.querySelectorAll('a')[1].getAttribute('href')") == "model-0001/report.json"


def test_a_model_that_was_removed_leaves_its_row(cli: Run, tmp_path: Path) -> None:
    (tmp_path / NOTES).mkdir()
    (tmp_path / NOTES / "gone.json").write_text(json.dumps(note(1)))
    assert cli("gallery", tmp_path).status == 0
    assert '"link":null' in (tmp_path / "gallery.html").read_text()


def test_runs_that_others_have_closed_are_named_and_left_out(cli: Run) -> None:
    user = os.geteuid()
    with tempfile.TemporaryDirectory() as place:  # pytest's own folders are closed to others
        os.chmod(place, 0o777)
        for folder, mode in ((NOTES, 0o777), ("other", 0)):
            (Path(place) / folder).mkdir()
            (Path(place) / folder).chmod(mode)
        (Path(place) / NOTES / "own.json").write_text(json.dumps(note(1)))
        assert [cli(command, place).status for command in ("gallery", "view")] == [0, 2]  # loads what is root's alone
        try:
            if user == 0:
                os.seteuid(65534)
            done = cli("gallery", place, "--out", Path(place) / "other.html")
            refused = cli("view", Path(place) / "other")
        finally:
            os.seteuid(user)
            (Path(place) / "other").chmod(0o700)
    assert done.status == 0
    assert re.findall(r"modeler: (.*): cannot be read \(Permission denied\)", done.err) == ["other"]
    assert refused.status == 2
    assert "Permission denied" in refused.err


@needs_chromium
def test_models_are_sorted_and_filtered(cli: Run, folder: Path, page: Page) -> None:
    assert cli("gallery", folder, "--overwrite").status == 0
    page.open((folder / "gallery.html").as_uri())

    def choose(**values: object) -> list[str]:
        for name, value in values.items():
            field = "checked" if isinstance(value, bool) else "value"
            page.value(f"document.getElementById('{name}').{field} = {json.dumps(value)}")
        page.value("document.getElementById('words').dispatchEvent(new Event('input'))")
        return page.value("[...document.querySelectorAll('.model')].map((card) => card.children[1].textContent)")

    def named(numbers: list[int]) -> list[str]:
        return [f"model-{number:04d}" for number in numbers]

    everyone = range(COUNT)
    assert choose() == named([*everyone])
    assert choose(down=True) == named([*reversed(everyone)])
    assert choose(down=False, status="failed") == named([k for k in everyone if k % 10 == 9])
    assert choose(status="3") == named([k for k in everyone if k % 5 == 0])
    assert choose(status="", words="OPEN") == named([k for k in everyone if k % 5 == 0])
    assert choose(words="0042") == ["model-0042"]
    width = page.value("[...document.getElementById('column').options].find((one) => one.text == 'width').value")
    built = [k for k in everyone if k % 10 != 9]
    by_width = sorted(built, key=lambda k: ((k * 37) % COUNT, k))
    assert choose(words="", column=width)[: len(built)] == named(by_width)
    assert choose(least=100, most=120) == named([k for k in by_width if 100 <= (k * 37) % COUNT <= 120])
    seconds = page.value("[...document.getElementById('column').options].find((one) => one.text == 'build time').value")
    order = choose(least="", most="", column=seconds)
    assert order[-101:] == named([k for k in everyone if k % 10 == 9 or k == 1])  # unknown ones last
    assert page.complaints == []


def test_the_list_is_brought_up_to_date_and_a_page_is_kept(cli: Run, folder: Path, tmp_path: Path) -> None:
    (folder / "models.parquet").unlink(missing_ok=True)
    out = tmp_path / "page.html"
    assert cli("gallery", folder, "--out", out).status == 0
    rows = {row["name"]: row for row in pq.read_table(folder / "models.parquet").to_pylist()}
    assert len(rows) == COUNT
    assert rows["model-0009"]["failure"] == "no <depth> images"
    assert rows["model-0002"]["width_m"] == pytest.approx(0.074)
    assert out.read_text().count("</script>") == 1
    assert cli("gallery", folder, "--out", out).status == 2
    ended = cli("gallery", tmp_path)
    assert (ended.status, ended.err.count("\n")) == (2, 1)


def test_a_model_without_picture_gets_one(cli: Run, built: Path, tmp_path: Path) -> None:
    (tmp_path / "run").symlink_to(built)
    before = sorted(path.name for path in built.iterdir())
    assert cli("gallery", tmp_path).status == 0
    image = np.asarray(Image.open(tmp_path / NOTES / "run.jpg"), dtype=float)
    assert image.shape == (THUMBNAIL_PX, THUMBNAIL_PX, 3)
    shown = image.min(axis=2) < 240.0
    assert 0.1 < shown.mean() < 0.7
    assert sorted(path.name for path in built.iterdir()) == before
    (row,) = pq.read_table(tmp_path / "models.parquet").to_pylist()
    assert (row["name"], row["status"]) == ("run", 0)
    os.utime(tmp_path / NOTES / "run.jpg", (1, 1))  # as if the model had been built anew
    assert cli("gallery", tmp_path, "--overwrite").status == 0
    assert (tmp_path / NOTES / "run.jpg").stat().st_mtime > 1.0


def opened(mesh: Mesh) -> np.ndarray:
    """Return the triangles of a box without those of its bottom."""
    z = mesh.vertices_m[mesh.triangles][:, :, 2]
    return mesh.triangles[~np.all(z < mesh.vertices_m[:, 2].min() + 1e-9, axis=1)]


def test_the_volume_of_a_mesh_with_a_plane_hole_is_that_of_the_closed_one() -> None:
    mesh = Box((0.13, 0.075, 0.18)).mesh()
    apart = mesh.vertices_m + 5.0  # wherever it is
    for triangles in (mesh.triangles, opened(mesh)):
        assert enclosed_m3(apart, triangles) == pytest.approx(0.13 * 0.075 * 0.18, rel=1e-9)
    assert len(opened(mesh)) < len(mesh.triangles)
    two = np.concatenate([apart, apart + 1.0])
    holes = np.concatenate([opened(mesh), opened(mesh) + len(apart)])
    assert enclosed_m3(two, holes) == pytest.approx(2 * 0.13 * 0.075 * 0.18, rel=1e-9)
