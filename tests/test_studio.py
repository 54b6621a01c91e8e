"""What the page stands on: scans, commands and the guard, without a browser."""

import asyncio
import json
import random
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="needs the extra studio")

from scipy.spatial.transform import Rotation
from studio_server import Server, served

from modeler.cli import parsed
from modeler.sequences import GivenSequence, open_sequence, write_bop
from modeler.studio.capture import Recorder
from modeler.studio.jobs import Job, Queue
from modeler.studio.scan import Scan, drawn
from modeler.studio.server import MOST_BYTES, Guard
from modeler.studio.state import Studio
from modeler.studio.widgets import outline_svg, ring_svg, thumbnail, turns_deg
from modeler.types import BoolArray, Frame, InputError
from studies.formats.image_folders import small_frames

PORT = 8080


def ready(scan: Scan) -> Scan:
    """Return a scan once the object has been looked for in all frames."""
    deadline = time.monotonic() + 60.0
    while scan.looking:
        assert time.monotonic() < deadline, scan.fault
        time.sleep(0.02)
    return scan


def same(mask: BoolArray | None, other: BoolArray | None) -> bool:
    return mask is not None and other is not None and np.array_equal(mask, other)


@pytest.fixture
def scan(scene: Path, tmp_path: Path) -> Scan:
    return ready(Studio(tmp_path / "studio").open(scene))


def test_masks_of_a_capture_are_shown_as_the_build_reads_them(scan: Scan, scene: Path) -> None:
    sequence = open_sequence(scene)
    for k in sequence.indices:
        expected, shown = sequence.frame(k).mask, scan.mask(k)
        assert expected is not None
        assert shown is not None
        assert np.array_equal(shown, expected)


def test_a_stroke_corrects_one_frame_and_the_build_reads_all_masks(scan: Scan, scene: Path) -> None:
    before = {k: scan.mask(k) for k in scan.sequence.indices}
    scan.paint(1, [(5.0, 5.0), (40.0, 5.0)], 3.0, add=True)
    corrected = scan.mask(1)
    assert corrected[5, 20]
    job, page = scan.build_jobs()
    written = Path(job.words[1])
    assert (job.words[0], page.words[0]) == ("build", "report")
    assert written.parent == scan.folder
    sequence = open_sequence(written)
    for k in sequence.indices:
        assert same(sequence.frame(k).mask, corrected if k == 1 else before[k])
    assert same(open_sequence(scene).frame(1).mask, before[1])
    assert scan.build_jobs()[0].words[1] == str(written)
    scan.unpaint(1)
    assert same(scan.mask(1), before[1])
    assert scan.build_jobs()[0].words[1] == str(scene)


def test_a_stroke_erases(scan: Scan) -> None:
    mask = scan.mask(0)
    assert mask is not None
    row, column = (int(values.mean()) for values in np.nonzero(mask))
    scan.paint(0, [(column, row)], 2.0, add=False)
    after = scan.mask(0)
    assert after is not None
    assert not after[row, column]
    assert 5 <= np.count_nonzero(mask & ~after) <= 30


def test_a_brush_covers_what_is_within_its_radius_of_the_stroke() -> None:
    stroke = drawn((20, 30), [(5.0, 10.0), (24.0, 10.0)], 3.0)
    rows, columns = np.nonzero(stroke)
    assert (rows.min(), rows.max()) == (7, 13)
    assert columns.min() == 2
    assert columns.max() == 27
    assert not drawn((20, 30), [(-50.0, -50.0)], 3.0).any()


def test_a_box_is_an_option_of_the_build_and_outlives_the_server(scan: Scan, scene: Path, tmp_path: Path) -> None:
    scan.box((100.0, 90.0), (30.2, 20.9))
    assert scan.choices.roi == (30, 20, 101, 91)
    assert "--roi 30 20 101 91" in scan.line()
    ready(scan).paint(2, [(60.0, 60.0)], 2.0, add=True)
    painted = scan.mask(2)
    again = Studio(tmp_path / "studio").open(scene)
    assert again.choices == scan.choices
    assert same(ready(again).mask(2), painted)
    with pytest.raises(InputError, match="outside the image"):
        scan.box((-20.0, -20.0), (-10.0, -10.0))


def test_a_click_finds_the_object_again_after_a_wrong_box(scan: Scan) -> None:
    mask = scan.mask(0)
    assert mask is not None
    row, column = (int(np.median(values)) for values in np.nonzero(mask))
    scan.box((0.0, 0.0), (9.0, 9.0))
    ready(scan)
    assert not scan.mask(0).any()  # type: ignore[union-attr]
    with pytest.raises(InputError, match="draw a box"):
        scan.point_at(0, 2.0, 2.0)
    scan.point_at(0, column, row)
    assert scan.choices.roi is None
    assert same(ready(scan).mask(0), mask)


def test_command_lines_that_are_shown_are_understood(scan: Scan) -> None:
    (scan.folder / "run-1").mkdir()
    scan.choose(prior="turntable", step_deg=25.0, step_sigma_deg=3.0)
    jobs = [*scan.build_jobs(), *scan.edit_jobs([1]), scan.calibrate_job("depth"), scan.suggest_job()]
    jobs += [scan.export_job(what, texture=True) for what in ("glb", "stl", "mujoco")]
    for job in jobs:
        assert parsed(job.words).run.__doc__
        assert job.line == f"modeler {' '.join(job.words)}"
    assert jobs[0].words[3] == str(scan.folder / "run-2")
    assert "--step-deg 25 --step-sigma-deg 3" in jobs[0].line


def test_captures_of_the_same_name_have_folders_of_their_own(scene: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / scene.name
    other.parent.mkdir()
    other.symlink_to(scene)
    studio = Studio(tmp_path / "studio")
    first, second = studio.open(scene), studio.open(other)
    assert (first.name, second.name) == (scene.name, f"{scene.name}-2")
    assert studio.open(scene) is first
    assert {folder.name for folder in studio.folders()} == {first.name, second.name}


def test_what_is_no_capture_is_refused(tmp_path: Path) -> None:
    studio = Studio(tmp_path / "studio")
    with pytest.raises(InputError):
        studio.open(tmp_path)
    assert studio.current is None
    assert list((tmp_path / "studio").iterdir()) == []


def log_of(folder: Path, *lines: str) -> Job:
    log = folder / "run-1.log"
    stamp = time.strftime("%Y-%m-%dT%H:%M:%S")
    log.write_text("".join(f"{stamp} debug: {line}\n" for line in lines))
    return Job(("build",), log, "Building", frames=10)


def test_progress_follows_the_messages_of_a_build(tmp_path: Path) -> None:
    frames = [f"frame {k}: {k + 1} joined, 0 loops closed; 0.1 s of registration" for k in range(10)]
    shares = []
    for lines in (
        [],
        frames[:1],
        frames[:5],
        [*frames[:5], "frame 5 is left out: no overlap"],
        frames,
        [*frames, "choosing more pairs", "registering more pairs", "registering more pairs: 3 of 6"],
        [*frames, "registering more pairs: 6 of 6", "fusing the model"],
    ):
        shares.append(log_of(tmp_path, *lines).progress().share)
    assert shares[0] is None
    assert shares[1:] == sorted(shares[1:])
    assert shares[-1] < 1.0
    halfway = log_of(tmp_path, *frames[:5]).progress()
    assert halfway.words == "frame 5 of 10, 5 joined, 0 loops closed"
    assert halfway.left_s is not None


def test_a_command_that_fails_says_why_and_what_depends_on_it_is_not_begun(tmp_path: Path) -> None:
    missing = tmp_path / "none"
    queue = Queue(tmp_path / "jobs.json")
    queue.add([Job(("info", str(missing)), tmp_path / "a.log", "A"), Job(("info", "x"), tmp_path / "b.log", "B")])
    finish(queue)
    assert queue.last.failure is not None
    assert str(missing) in queue.last.failure
    assert (queue.waiting, queue.current) == ([], None)
    assert not (tmp_path / "b.log").exists()


def finish(queue: Queue) -> None:
    deadline = time.monotonic() + 120.0
    while queue.current is not None:
        assert time.monotonic() < deadline
        queue.advance()
        time.sleep(0.05)


def test_a_server_takes_over_the_command_that_one_before_it_has_started(tmp_path: Path, scene: Path) -> None:
    queue = Queue(tmp_path / "jobs.json")
    queue.add([Job(("info", str(scene)), tmp_path / "a.log", "A"), Job(("info", str(scene)), tmp_path / "b.log", "B")])
    after = Queue(tmp_path / "jobs.json")
    assert after.current.pid == queue.current.pid
    assert after.current.running
    assert [job.title for job in after.waiting] == ["B"]
    queue.waiting.clear()
    queue.stop()
    finish(queue)
    idle = Queue(tmp_path / "jobs.json")
    assert (idle.current, idle.waiting) == (None, [])
    (tmp_path / "jobs.json").write_text('[{"words": 3}]')
    assert Queue(tmp_path / "jobs.json").current is None


def turned(angle_deg: float) -> list[float]:
    """Return a pose (16 numbers) turned about the vertical, which is -y in the camera."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.0, -np.radians(angle_deg), 0.0]).as_matrix()
    return pose.ravel().tolist()


def test_pictures_show_the_mask(scan: Scan) -> None:
    mask = scan.mask(0)
    assert outline_svg(None) == ""
    assert outline_svg(mask).count("<path") == 2
    turns = [{"id": k, "object_from_camera": turned(30.0 * k)} for k in range(12)]
    report = {"poses": turns, "up": [0.0, -1.0, 0.0]}
    assert np.allclose(list(turns_deg(report).values()), 30.0 * np.arange(12))
    assert ring_svg(report).count("<title>") == 12
    assert thumbnail(scan.sequence.frame(0), mask) != thumbnail(scan.sequence.frame(0), None)


@pytest.mark.slow
def test_a_folder_that_is_being_written_is_followed_and_built_though_it_stalls(tmp_path: Path) -> None:
    whole, folder = tmp_path / "whole", tmp_path / "growing"
    write_bop(whole, small_frames(4), depth_scale_mm=1.0)
    frames = sorted(path.stem for path in (whole / "depth").iterdir())
    studio = Studio(tmp_path / "studio")
    studio.queue.add(studio.watch(folder, "table", None))
    capture = studio.capture
    assert capture.job.line.startswith(f"modeler build {folder} --watch")
    assert (capture.count, capture.said(), capture.facts()) == (0, (None, ""), [])
    for number, name in enumerate(frames):
        for kind in ("depth", "rgb", "mask_visib"):
            (folder / kind).mkdir(parents=True, exist_ok=True)
            for path in (whole / kind).glob(f"{name}*"):
                shutil.copy(path, folder / kind)
        if not number:
            shutil.copy(whole / "scene_camera.json", folder)
        wait(lambda number=number: capture.count > number)
        time.sleep(2.0 * (number == 2))  # it stalls
    (folder / "done").touch()
    finish(studio.queue)
    assert "away" in capture.facts()[0]
    assert capture.facts()[1].startswith("exposure: ")
    assert capture.doubts() == []
    assert capture.said()[0] is True
    capture.stop()
    scan = studio.open(folder)
    report = scan.report()
    assert len(report["poses"]) == 4
    assert report["prior"] == "table"


def test_views_are_taken_from_a_camera_when_wanted(tmp_path: Path) -> None:
    frames, more = small_frames(4), threading.Event()

    def images() -> Iterator[Frame]:
        yield from frames[:3]
        for number in range(3, 10_000):
            more.wait(0.02)
            yield replace(frames[3], index=number)

    recorder = Recorder(GivenSequence.of(images(), live=True), tmp_path / "taken")
    wait(lambda: recorder.shown > 3)
    assert recorder.taken == 0
    for number in (1, 2):
        recorder.take()
        wait(lambda number=number: recorder.taken == number)
    recorder.stop()
    assert recorder.fault == ""
    sequence = open_sequence(tmp_path / "taken")
    assert sequence.indices == (0, 1)
    view, seen = sequence.frame(1), frames[3]
    assert np.allclose(np.nan_to_num(view.depth_m), np.nan_to_num(seen.depth_m), atol=2e-4)
    assert np.array_equal(view.colour, seen.colour)  # type: ignore[arg-type]
    assert view.camera.fx == pytest.approx(seen.camera.fx)


def test_a_camera_that_is_not_there_is_reported_and_nothing_is_begun(tmp_path: Path) -> None:
    studio = Studio(tmp_path / "studio")
    with pytest.raises(InputError, match=r"realsense|pyrealsense2"):
        studio.record("realsense:", None, None)
    assert (studio.capture, studio.recorder, studio.folders()) == (None, None, [])


def wait(until: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60.0
    while not until():
        assert time.monotonic() < deadline
        time.sleep(0.05)


# The guard


def answer(**request: Any) -> tuple[int, bool]:
    """Return the status of an answer of the guard, and whether the application was asked."""
    return asyncio.run(answered(**request))


async def answered(
    *,
    kind: str = "http",
    path: str = "/x",
    query: str = "",
    method: str = "GET",
    headers: dict[str, str] | None = None,
    body: bytes = b"",
) -> tuple[int, bool]:
    asked: list[int] = []
    sent: list[dict[str, Any]] = []

    async def application(scope: Any, receive: Any, send: Any) -> None:
        got = 0
        while (message := await receive())["type"] == "http.request":
            got += len(message["body"])
            if not message.get("more_body"):
                break
        asked.append(got)
        await send({"type": f"{kind}.response.start", "status": 200, "headers": []})

    pieces = [body[at : at + 65536] for at in range(0, len(body), 65536)] or [b""]
    coming = iter(
        {"type": "http.request", "body": piece, "more_body": n + 1 < len(pieces)} for n, piece in enumerate(pieces)
    )

    async def receive() -> dict[str, Any]:
        return next(coming)

    async def send(message: Any) -> None:
        sent.append(message)

    given = {"host": f"127.0.0.1:{PORT}", "cookie": f"modeler-studio-{PORT}=secret"} | (headers or {})
    encoded = [(name.encode(), value.encode("latin-1")) for name, value in given.items()]
    scope = {"type": kind, "path": path, "query_string": query.encode(), "method": method, "headers": encoded}
    await Guard(application, "secret", PORT)(scope, receive, send)  # type: ignore[arg-type]
    assert all(got <= MOST_BYTES for got in asked)
    return int(sent[0].get("status", sent[0].get("code", 0))), bool(asked)


def test_only_the_browser_that_has_the_token_is_let_in() -> None:
    assert answer() == (200, True)
    assert answer(headers={"cookie": ""}) == (403, False)
    assert answer(headers={"cookie": f"modeler-studio-{PORT}=secreT"}) == (403, False)
    assert answer(headers={"cookie": f"modeler-studio-{PORT + 1}=secret"}) == (403, False)
    assert answer(headers={"cookie": ""}, query="token=secret") == (200, True)
    assert answer(headers={"cookie": ""}, query="token=wrong") == (403, False)
    assert answer(headers={"cookie": ""}, path="/", query="token=secret") == (303, False)


@pytest.mark.parametrize("host", ["example.org", "example.org:8080", "127.0.0.1.example.org:8080", "", "127.0.0.1"])
def test_names_of_other_machines_are_refused(host: str) -> None:
    assert answer(headers={"host": host}) == (421, False)
    assert answer(kind="websocket", headers={"host": host})[1] is False


def test_pages_of_other_origins_change_nothing() -> None:
    other = {"origin": "http://127.0.0.1:9999"}
    assert answer(method="POST", headers=other) == (403, False)
    assert answer(kind="websocket", headers=other) == (4403, False)
    assert answer(kind="websocket", headers={"origin": "null"}) == (4403, False)
    assert answer(method="POST", headers={"origin": f"http://127.0.0.1:{PORT}"}) == (200, True)


def test_huge_bodies_are_refused_whether_or_not_they_tell_their_length() -> None:
    assert answer(method="POST", headers={"content-length": str(MOST_BYTES + 1)}) == (413, False)
    assert answer(method="POST", headers={"content-length": "1e3"}) == (413, False)
    assert answer(method="POST", body=bytes(3 * MOST_BYTES)) == (200, True)  # of which it has seen no more than allowed


def test_no_request_of_thousands_gets_past_without_the_token() -> None:
    source = random.Random(0)
    alphabet = "abc=;:/?&%.\\\"' \x00\xff127.0.0.1secrettokenmodeler-studio-8080"

    async def attack() -> None:
        for _ in range(2_000):
            words = ["".join(source.choices(alphabet, k=source.randrange(24))) for _ in range(4)]
            host = source.choice([words[2], f"127.0.0.1:{PORT}"])
            status, asked = await answered(
                kind=source.choice(["http", "websocket"]),
                method=source.choice(["GET", "POST", "PUT", "\xff"]),
                path=f"/{words[3]}",
                query=words[2][:10],
                headers={"cookie": words[0], "origin": words[1], "host": host},
            )
            assert not asked
            assert status in (403, 413, 421, 4403)

    asyncio.run(attack())


# The server


@pytest.fixture(scope="module")
def server(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with served(scene, tmp_path_factory.mktemp("served") / "studio") as running:
        yield running


def test_the_server_answers_with_the_page_and_pictures_and_nothing_from_elsewhere(server: Server) -> None:
    status, page = server.get("/")
    assert status == 200
    assert b"modeler studio" in page
    assert not [word for word in page.split(b'"') if word.startswith((b"http://", b"https://", b"//"))]
    for path in ("/frames/box/0.jpg", "/thumbnails/box/2.jpg"):
        status, picture = server.get(path)
        assert (status, picture[:3]) == (200, b"\xff\xd8\xff")


def test_the_server_refuses_strangers_and_gives_no_file_that_is_not_its_own(server: Server) -> None:
    assert server.get("/", Cookie="")[0] == 403
    assert server.get("/", Host="example.org")[0] == 421
    for path in (
        "/take-away/box/..%2f..%2fscan.json",
        "/take-away/..%2f..%2f..%2fetc/passwd",
        "/take-away/box/../../../../etc/passwd",
        "/runs/box/run-1/..%2fscan.json",
        "/runs/box/..%2f/scan.json",
        "/runs/box/%00/report.html",
        "/frames/box/99999999999999999999999.jpg",
        "/frames/..%2f/0.jpg",
        "/models/box/run-9.jpg",
        "/openapi.json",
        "/docs",
    ):
        status, content = server.get(path)
        assert status in (404, 422), path
        assert b"root:" not in content
        assert b"sequence" not in content
    assert server.get("/frames/box/0.jpg")[0] == 200


def test_a_server_that_is_interrupted_ends_in_order(scene: Path, tmp_path: Path) -> None:
    with served(scene, tmp_path / "studio") as running:
        assert running.interrupt() == 0
    assert json.loads((tmp_path / "studio" / "box" / "scan.json").read_text())["sequence"] == str(scene)


def test_wrong_use_is_reported_in_a_line(refusal: Callable[..., str], tmp_path: Path, scene: Path) -> None:
    out = ("--out", tmp_path / "studio")
    assert "no such folder" in refusal("studio", tmp_path / "none", *out)
    assert "only read" in refusal("studio", scene, "--out", scene / "studio")
    assert "--port 99999" in refusal("studio", scene, *out, "--port", "99999")
    assert list(scene.glob("studio")) == []
