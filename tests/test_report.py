"""The page about a run: whole, true to the run, and in need of nothing else."""

import base64
import io
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from html import escape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from command_runner import Run, refusal_of
from PIL import Image
from scipy import ndimage
from turning_box import CENTRE_M, COUNT, HALF_M, LOST, object_from_camera, steps

from modeler import se3
from modeler.export import RunFolder, RunMeta
from modeler.export.files import mesh_ply
from modeler.export.mesh import MADE_UP_RGB
from modeler.fusion import Symmetries
from modeler.fusion.symmetries import Axis
from modeler.types import Array
from modeler.viz import entities, reader
from modeler.viz.report import CHECKS, cards, rotation_words, run_data, write_page
from modeler.viz.report.mesh import read_mesh, scene
from modeler.viz.report.run_data import Result, recorded, surfaces
from modeler.viz.stream import open_stream

TRUTH = {k: se3.inverse(object_from_camera(k)) for k in range(COUNT)}
ODD_NAME = 'a <b> & "c"'


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = RunFolder.open(tmp_path_factory.mktemp("report") / "run")
    stream = open_stream("box", save=folder.path / "recording.rrd")
    meta = RunMeta(
        sequence=ODD_NAME, seed=7, prior="table", settings={"max_shift_m": 0.05, "frames": ":"}, seconds={"total": 12.3}
    )
    for step in steps(COUNT, lost=LOST):
        folder.write(step, meta)
        stream(step)
    stream.close()
    return folder.path


@pytest.fixture(scope="module")
def page(run: Path) -> str:
    write_page(run, run / "page.html", TRUTH)
    return (run / "page.html").read_text(encoding="utf-8")


def mask_of(rows: dict[str, Any], frame: int) -> Image.Image:
    """Return the picture of a mask as a recording has it."""
    (blob,) = rows[entities.MASK][frame]["blob"]
    content = blob.as_py()
    return Image.open(io.BytesIO(bytes(content[0] if isinstance(content[0], list) else content)))


READ: dict[bytes, dict[int, reader.LoggedStep]] = {}


@pytest.fixture(autouse=True)
def _read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read equal recordings once: a process reads each, which takes a second to start."""

    def steps_of(recording: Path) -> dict[int, reader.LoggedStep]:
        content = recording.read_bytes()
        if content not in READ:
            READ[content] = reader.steps_of(recording)
        return READ[content]

    monkeypatch.setattr(run_data, "steps_of", steps_of)


@pytest.fixture
def _undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave plots, the picture of the mesh and its symmetries blank, which take most of the time of a page."""
    monkeypatch.setattr(
        "modeler.viz.report.plots._svg", lambda figure: b"<svg xmlns='http://www.w3.org/2000/svg'></svg>"
    )
    monkeypatch.setattr("modeler.viz.report.portrait", lambda mesh, object_from_upright, size: b"")
    monkeypatch.setattr("modeler.viz.report.symmetry_section", lambda mesh, report: [])


class Elements(HTMLParser):
    """Collects what a browser would load, and checks that elements close in order."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.headings: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "img", "input", "br"):
            self.open.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("h1", "h2", "h3"):
            self.headings.append(data)


@pytest.mark.usefixtures("_undrawn")
def test_the_evidence_is_explained_and_stands_beside_its_limits(run: Path, page: str, tmp_path: Path) -> None:
    section = page.partition("<h2>Checks</h2>")[2].partition("<h2>")[0]
    evidence = json.loads((run / "report.json").read_text())["evidence"]
    assert set(evidence) >= {"unsure_masks", "motion_m", "other_modes"}
    assert section.count("</td></tr>") == len(evidence)
    assert set(evidence) <= set(CHECKS)
    for name in evidence:
        words, why, _ = CHECKS[name]
        assert f"<th>{escape(words)}<p class='quiet'>{escape(why)}</p></th>" in section
    assert re.search("unsure mask.*</th><td>0 %</td><td class='quiet'>at most 50 %</td><td>holds", section)
    assert "at least" in section
    older = tmp_path / "older"
    shutil.copytree(run, older)
    report = json.loads((older / "report.json").read_text())
    report["evidence"]["unsure_masks"] |= {"value": 0.8, "holds": False}
    (older / "report.json").write_text(json.dumps(report))
    write_page(older, older / "page.html")
    assert "<td>80 %</td><td class='quiet'>at most 50 %</td><td><b class='no'>does not hold" in (
        older / "page.html"
    ).read_text(encoding="utf-8")
    del report["evidence"]
    (older / "report.json").write_text(json.dumps(report))
    write_page(older, older / "page.html")
    assert "class='evidence'" not in (older / "page.html").read_text(encoding="utf-8")


def test_the_page_is_whole_and_needs_no_network(page: str) -> None:
    elements = Elements(page)
    assert elements.open == []
    assert all(address.startswith("data:image/") for address in elements.addresses)
    assert not re.search(r"https?://|@import|\bfetch\(|XMLHttpRequest", page.replace("http://www.w3.org/", ""))
    assert "default-src 'none'" in page


def test_every_section_is_there(page: str) -> None:
    headings = Elements(page).headings
    assert ODD_NAME in headings
    wanted = ["Model", "Checks", "Symmetries", "Camera poses", "Uncertainty", "Merged points"]
    wanted.append("Errors against ground truth")
    assert [heading for heading in headings if heading in wanted] == wanted
    assert {"Calibration of the covariances", "Pairs", "Settings"} <= set(headings)


def test_every_pair_is_reported_with_its_pictures(page: str, run: Path) -> None:
    result = Result.read(run)
    headings = Elements(page).headings
    for edge in result.edges:
        (words,) = [text for text in headings if text.startswith(f"{edge.source} → {edge.target}:")]
        assert ("rejected" in words) == (not edge.accepted)
    assert page.count("data:image/jpeg") - 1 - COUNT == 3 * sum(edge.kind == "odometry" for edge in result.edges)
    assert "5 of 6" in page
    assert f"frame {LOST} was left out" in page


@pytest.mark.usefixtures("_undrawn")
def test_the_worst_pairs_come_first(run: Path, tmp_path: Path) -> None:
    report = json.loads((run / "report.json").read_bytes())
    placed = {pose["id"] for pose in report["poses"]}
    joined = [edge for edge in report["edges"] if {edge["source"], edge["target"]} <= placed]
    turned = se3.exp(np.array([0.0, 0.2, 0.0, 0.0, 0.0, 0.0]))
    wrong = joined[2]
    wrong["target_from_source"] = (np.array(wrong["target_from_source"]).reshape(4, 4) @ turned).ravel().tolist()
    (tmp_path / "report.json").write_text(json.dumps(report))
    write_page(tmp_path, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    pairs = [text for text in Elements(page).headings if " → " in text]
    lost = sum(not {edge["source"], edge["target"]} <= placed for edge in report["edges"])
    assert all(str(LOST) in text.partition(":")[0] for text in pairs[:lost])
    assert pairs[lost].startswith(f"{wrong['source']} → {wrong['target']}:")
    sds = [float(words) for words in re.findall(r"([\d.]+) sd from the poses", page)]
    assert sds == sorted(sds, reverse=True)
    assert sds[0] > 3.0


@pytest.mark.usefixtures("_undrawn")
def test_contradicted_surface_is_coloured_in_its_frame_and_the_remedy_stated(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "wrong")
    report = json.loads((run / "report.json").read_text())
    mask = np.asarray(mask_of(recorded(run / "recording.rrd"), 1))
    row, column = np.argwhere(mask).mean(axis=0).astype(int).tolist()
    surface = [number for k in range(-4, 5) for number in (row + k, column, 3, 1)]
    report["contradicted"] = {"1": {"size": mask.shape, "surface": surface, "free": []}}
    report |= {"trustworthy": False, "reasons": ["a < b"], "remedies": ["do this: modeler build 'a b'"]}
    (tmp_path / "wrong" / "report.json").write_text(json.dumps(report))
    write_page(tmp_path / "wrong", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert escape("do this: modeler build 'a b'") in page.partition("<h2>")[0]
    masks = page.partition("<h2>Masks</h2>")[2].partition("<h2>")[0]
    assert "1, contradicted" in re.findall(r"<p>([^<]*)</p>", masks)
    pictures = [base64.b64decode(found) for found in re.findall(r"base64,([^']*)'", masks)]
    red = []
    for picture in pictures[:3]:
        shown = np.asarray(Image.open(io.BytesIO(picture)), dtype=float)
        red.append((shown[..., 0] > shown[..., 1:].max(axis=2) + 60.0).mean())
    assert red[1] > 10.0 * max(red[0], red[2], 1e-5)


def test_where_colour_is_against_depth_stands_at_the_head(run: Path, page: str, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    report = json.loads((folder / "report.json").read_text())
    place = {"shift_px": [-0.8, 0.1], "shift_sigma_px": [0.2, 12.8], "scale": 0.998, "scale_sigma": 0.003}
    report["colour"] = {**place, "flip": "", "frames": -1}
    (folder / "report.json").write_text(json.dumps(report))
    write_page(folder, folder / "page.html")
    shown = (folder / "page.html").read_text(encoding="utf-8")
    for words in ("-0.8 ± 0.2, 0.1 ± 12.8 px", "-0.2 ± 0.3 %", "colour is of the frame before"):
        assert words in shown
        assert words not in page


def test_the_mask_of_every_frame_is_shown(run: Path, page: str) -> None:
    masks = page.partition("<h2>Masks</h2>")[2].partition("<h2>")[0]
    assert re.findall(r"<p>([^<]*)</p>", masks) == [f"{k}, left out" if k == LOST else str(k) for k in range(COUNT)]
    pictures = [base64.b64decode(found) for found in re.findall(r"base64,([^']*)'", masks)]
    rows = recorded(run / "recording.rrd")
    for frame, picture in enumerate(pictures):
        shown = np.asarray(Image.open(io.BytesIO(picture)), dtype=float)
        line = (shown[..., 1] > shown[..., 0] + 40.0) & (shown[..., 1] > shown[..., 2] + 40.0)
        inside = ndimage.binary_fill_holes(line)
        mask = mask_of(rows, frame)
        left, top, right, bottom = mask.convert("L").getbbox() or (0, 0, 0, 0)
        rows_in, columns_in = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        height, width = np.ptp(rows_in) + 1, np.ptp(columns_in) + 1
        assert width / height == pytest.approx((right - left) / (bottom - top), rel=0.1)
        assert min(shown.shape[1] / width, shown.shape[0] / height) > 1.3  # there is room around it
        share = np.asarray(mask.convert("L").crop((left, top, right, bottom))).astype(bool).mean()
        assert inside.sum() / (height * width) == pytest.approx(share, abs=0.1)


def test_points_of_a_frame_that_is_tried_again_are_its_own(tmp_path: Path) -> None:
    taken = list(steps(4))
    again = replace(taken[2], views=taken[-1].views)  # which stands beside the latest frame on the timeline
    stream = open_stream("box", save=tmp_path / "r.rrd")
    for step in (*taken, again):
        stream(step)
    stream.close()
    found = surfaces(recorded(tmp_path / "r.rrd"))
    assert found.keys() == taken[-1].views.keys()
    for frame, view in taken[-1].views.items():
        np.testing.assert_allclose(found[frame], view.points_m, atol=1e-6)


@pytest.mark.usefixtures("_undrawn")
def test_without_a_closure_there_is_nothing_to_compare(run: Path, tmp_path: Path) -> None:
    report = json.loads((run / "report.json").read_text())
    report["edges"] = [edge for edge in report["edges"] if edge["kind"] == "odometry"]
    (tmp_path / "report.json").write_text(json.dumps(report))
    (tmp_path / "recording.rrd").write_bytes((run / "recording.rrd").read_bytes())
    write_page(tmp_path, tmp_path / "page.html")
    assert "Merged points" not in (tmp_path / "page.html").read_text()


def test_symmetries_are_named_by_their_axes() -> None:
    up = np.array([0.0, -1.0, 0.0])
    quarters = tuple(se3.exp(np.array([0.0, turn, 0.0, 0.0, 0.0, 0.0])) for turn in (np.pi / 2, np.pi, -np.pi / 2))
    flips = tuple(
        se3.exp(np.array([np.pi * np.cos(a), 0.0, np.pi * np.sin(a), 0.0, 0.0, 0.0])) for a in (0.2, 0.2 + np.pi / 2)
    )
    said = rotation_words(Symmetries(1e-3, (*quarters, *flips)), up)
    assert said == "90°, 180°, 270° about the vertical; 180° about level axes"
    axis = Axis(np.array([0.0, -1.0, 0.0]), np.zeros(3))
    assert rotation_words(Symmetries(1e-3, flips[:1], (axis,)), up).startswith(
        "any angle about the vertical; 180° about"
    )
    assert rotation_words(Symmetries(1e-3, (), (axis,) * 3), up) == "every rotation about its centre"
    assert rotation_words(Symmetries(1e-3), up) == "none"


def test_settings_and_names_are_text_and_nothing_more(page: str) -> None:
    assert "<b> &" not in page
    assert "<th>max shift m</th><td>0.05</td>" in page
    assert "<th>seed</th><td>7</td>" in page
    assert "<th>frames</th><td>all</td>" in page


def unpacked(text: str, kind: str) -> Array:
    return np.frombuffer(base64.b64decode(text), dtype=kind).astype(np.float64).reshape(-1, 3)


def test_the_viewer_gets_the_mesh_of_the_run(page: str, run: Path) -> None:
    (data,) = re.findall(r"<script type='application/json' id='scene'>(.*?)</script>", page, re.DOTALL)
    drawn = json.loads(data)
    radius_m = np.linalg.norm(HALF_M)
    corners = unpacked(drawn["positions"], "<i2") / 32767 * radius_m + CENTRE_M
    np.testing.assert_allclose(np.abs(corners - CENTRE_M), np.tile(HALF_M, (8, 1)), atol=1e-5)
    triangles = unpacked(drawn["triangles"], "<u4").astype(int)
    assert drawn["count"] == triangles.size == 36
    a, b, c = np.moveaxis(corners[triangles], 1, 0)
    assert (np.sum(np.cross(b - a, c - a) * (a - CENTRE_M), axis=1) > 0).all()  # seen from outside
    normals = unpacked(drawn["normals"], "i1")
    assert (np.sum(normals * (corners - CENTRE_M), axis=1) > 0).all()
    assert len(unpacked(drawn["colours"], "u1")) == 8
    tips = unpacked(drawn["lines"], "<f4").reshape(COUNT - 1, -1, 3)[:, 0] * radius_m + CENTRE_M
    poses = [pose.mean[:3, 3] for pose in Result.read(run).poses.values()]
    np.testing.assert_allclose(tips, poses, atol=1e-6)


def test_a_mesh_without_colour_is_drawn_plain(run: Path, tmp_path: Path) -> None:
    folder = RunFolder.open(tmp_path / "grey")
    for step in steps(2, colour=False):
        folder.write(step, RunMeta("box", 0, "general"))
    mesh = read_mesh(tmp_path / "grey" / "model.ply")
    assert mesh is not None
    drawn = scene(mesh, [], np.eye(3))
    assert (drawn["colours"], drawn["certainty"]) == (None, None)


def test_the_viewer_shows_how_sure_each_vertex_is_and_what_is_made_up(tmp_path: Path) -> None:
    model = list(steps(2))[-1].model
    assert model is not None
    sigmas_m = np.array([np.inf, 0.0, 1e-3, 2e-3, 5e-3, 0.0, 0.0, 0.0])
    views = np.where(np.isfinite(sigmas_m), 3, 0)
    (tmp_path / "model.ply").write_bytes(mesh_ply(replace(model, vertex_views=views, vertex_sigmas_m=sigmas_m)))
    mesh = read_mesh(tmp_path / "model.ply")
    assert mesh is not None
    assert mesh.certainty is not None
    order = [int(np.argmin(np.linalg.norm(mesh.vertices_m - vertex, axis=1))) for vertex in model.vertices_m]
    painted = mesh.certainty[order].astype(int)
    assert tuple(painted[0]) == MADE_UP_RGB
    lightness = painted[1:4].sum(axis=1)
    assert (np.diff(lightness) > 100).all()
    np.testing.assert_array_equal(painted[3], painted[4])


@pytest.mark.parametrize("ending", ["os.abort()", "sys.exit('damaged')", "raise ValueError"])
def test_a_recording_that_ends_its_reader_is_as_good_as_none(
    run: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], ending: str
) -> None:
    monkeypatch.setattr(run_data, "steps_of", reader.steps_of)
    monkeypatch.setattr(reader, "_READER", ("-c", f"import os, sys; {ending}"))
    assert not any(recorded(run / "recording.rrd").values())
    assert capfd.readouterr().err == ""


@pytest.mark.usefixtures("_undrawn")
def test_damaged_points_of_a_recording_are_drawn_nowhere() -> None:
    points = [[0.0, 0.0, 0.0], [0.1, 0.1, 0.1], [1e30, 0.0, 0.0], [np.inf, -np.inf, 0.0], [np.nan] * 3]
    row = {"positions": pa.scalar(points), "colors": pa.scalar([255])}
    found = run_data.cloud(row)
    assert found is not None
    np.testing.assert_array_equal(found[0][:, 0], [0.0, 0.1, 1e30])
    sound = found[0][:2], found[1][:2]
    assert cards._pair_picture(sound, found) == cards._pair_picture(sound, sound)
    assert run_data.cloud(row | {"positions": pa.scalar(points[3:])}) is None


def test_without_truth_recording_or_mesh_the_page_says_so(run: Path, tmp_path: Path) -> None:
    (tmp_path / "report.json").write_bytes((run / "report.json").read_bytes())
    write_page(tmp_path, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert Elements(page).open == []
    assert "There is no ground truth" in page
    assert "recording.rrd is missing" in page
    assert "Merged points" not in page
    assert "no mesh" in page


def test_a_run_without_any_frame_is_said_to_have_none(run: Path, tmp_path: Path, refusal: Callable[..., str]) -> None:
    report = json.loads((run / "report.json").read_bytes())
    (tmp_path / "report.json").write_text(json.dumps(report | {"poses": [], "edges": []}))
    for command in (("report",), ("export", "--out", tmp_path.parent / "m.ply")):
        assert refusal(*command, tmp_path).startswith(f"modeler: {tmp_path}: no frame of this run was accepted")


def test_the_command_writes_the_page_and_says_where(run: Path, tmp_path: Path, cli: Run) -> None:
    out = tmp_path / "pages" / "page.html"
    ended = cli("report", run, "--out", out)
    assert (ended.status, ended.out) == (0, "")
    assert str(out) in ended.err
    assert "There is no ground truth" in out.read_text()  # the sequence is not there
    ended = cli("report", run, "--out", out, "--sequence", tmp_path / "moved", "--overwrite")
    assert "moved" in refusal_of(ended)


@pytest.mark.usefixtures("_undrawn")
def test_modes_what_a_pair_leaves_open_and_both_names_of_joined_runs_are_reported(run: Path, tmp_path: Path) -> None:
    report = json.loads((run / "report.json").read_bytes())
    edge = report["edges"][0]
    mode = {key: edge[key] for key in ("target_from_source", "covariance")}
    edge["modes"] = [mode | {"weight": 0.7, "weight_in_graph": 0.99}, mode | {"weight": 0.3, "weight_in_graph": 0.01}]
    edge["undetermined"] = ["free to turn about <its> axis: 12° sd"]
    report["settings"]["joined"] = ["upright_run", "lying_run"]
    report["sequence"] = "some/upright + other/lying"
    (tmp_path / "report.json").write_text(json.dumps(report))
    write_page(tmp_path, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert [
        words for words in ("2 modes", "70 %, 30 %", "99 %, 1 %", "&lt;its&gt; axis: 12°") if words not in page
    ] == []
    assert "<h1>upright + lying</h1>" in page


def test_the_same_run_makes_the_same_page(run: Path, page: str, tmp_path: Path) -> None:
    write_page(run, tmp_path / "again.html", TRUTH)
    assert (tmp_path / "again.html").read_text(encoding="utf-8") == page


def test_the_chain_of_the_page_is_the_chain_of_the_run(run: Path) -> None:
    result = Result.read(run, TRUTH)
    odometry = np.loadtxt(run / "odometry.txt")
    np.testing.assert_allclose([pose.mean[:3, 3] for pose in result.chain.values()], odometry[:, 1:4], atol=1e-9)
    for frame in result.poses:
        true = result.true_pose(frame)
        assert true is not None
        np.testing.assert_allclose(true, object_from_camera(frame), atol=1e-12)
