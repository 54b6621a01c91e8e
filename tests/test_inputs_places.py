"""Paths that hold no sequence, may not be read or written, or are no regular file: one line, and no waiting."""

import json
import os
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import pytest
from command_runner import Run, refusal_of, with_files_of_at_most
from input_errors import refused

from modeler.cli import main
from modeler.sequences import open_sequence, write_bop
from modeler.system.regular_files import check_regular, create_regular, read_json, read_regular
from modeler.types import InputError
from studies.formats.image_folders import small_frames, small_truth
from studies.fuzz.special import SPECIAL, lengthen, remove, replace_by
from studies.fuzz.targets import TARGETS, Target, fresh


def test_the_folder_of_a_run_is_no_sequence(tmp_path: Path, refusal: Callable[..., str]) -> None:
    (tmp_path / "report.json").write_text("{}")
    (tmp_path / "model.ply").write_text("ply")
    assert "is the folder of a run" in refusal("info", tmp_path)


def test_pictures_that_lie_elsewhere_are_seen(written: Path, tmp_path: Path, refusal: Callable[..., str]) -> None:
    for place in (tmp_path / "flat", tmp_path / "deeper" / "images"):
        shutil.copytree(written / "bop" / "depth", place)
    for name, words in (("flat", "no folder depth"), ("deeper", "no depth images")):
        assert words in refusal("info", tmp_path / name)
    (tmp_path / "deeper" / "images").rename(tmp_path / "deeper" / "Depth_16bit")
    assert "Depth_16bit" in refusal("info", tmp_path / "deeper")
    shutil.copytree(written / "bop", tmp_path / "monday" / "take 1" / "scan")
    assert "take 1/scan" in refusal("info", tmp_path / "monday")
    assert "holds a sequence; give it: scan" in refusal("info", tmp_path / "monday" / "take 1")


def test_a_path_that_is_misspelt_is_asked_about(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    with refused("no such folder", f"{tmp_path / 'scans'}?"):
        open_sequence(tmp_path / "scan")
    with refused("no such folder", "depth/"):
        open_sequence(tmp_path / "elsewhere")
    with refused("no such folder", "depth/"):
        open_sequence(tmp_path / "nowhere" / "scans")


@pytest.mark.parametrize("name", ["nowhere", "nowhere.bag", "", "file.txt"])
def test_a_path_without_a_sequence_is_refused(tmp_path: Path, refusal: Callable[..., str], name: str) -> None:
    (tmp_path / "file.txt").write_text("hello")
    assert str(tmp_path / name) in refusal("info", tmp_path / name)


@pytest.fixture
def as_nobody() -> Iterator[Callable[[], None]]:
    """Return what gives root's rights up until the end of the test; others have none to give up."""
    import rich.console  # noqa: F401  # messages load it, from where others may not read

    user = os.geteuid()
    yield lambda: os.seteuid(65534) if user == 0 else None
    os.seteuid(user)


@pytest.mark.parametrize(
    ("kind", "what"),
    [
        ("bop", "."),
        ("bop", "depth"),
        ("bop", "scene_camera.json"),
        ("bop", "depth/000001.png"),
        ("tum", "depth.txt"),
        ("open3d", "camera_intrinsic.json"),
    ],
)
def test_no_permission_is_said(written: Path, as_nobody: Callable[[], None], cli: Run, kind: str, what: str) -> None:
    with tempfile.TemporaryDirectory() as place:  # pytest's own folders are closed to others
        os.chmod(place, 0o755)
        folder = Path(place) / kind
        shutil.copytree(written / kind, folder)
        (folder / what).chmod(0)
        as_nobody()
        ended = cli("info", folder)
        os.seteuid(os.getuid())
    assert "ermission" in refusal_of(ended)


def test_a_full_disk_leaves_nothing_behind(written: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert with_files_of_at_most(6000, "convert", str(written / "bop"), "--out", str(tmp_path / "out")) == 2
    said = capfd.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert said.err.startswith(f"modeler: {tmp_path / 'out'}: ")
    assert "File too large" in said.err
    assert list(tmp_path.iterdir()) == []


def test_a_link_within_the_folder_is_followed(written: Path, tmp_path: Path) -> None:
    shutil.copytree(written / "open3d", tmp_path / "in")
    (tmp_path / "in" / "color").rename(tmp_path / "in" / "pictures")
    (tmp_path / "in" / "color").symlink_to(tmp_path / "in" / "pictures")
    assert main(["info", str(tmp_path / "in")]) == 0


# Where a regular file is expected, nothing else is read, or waited for: each reader, and each command.

LIMIT_S = 60


@contextmanager
def in_time() -> Iterator[None]:
    """Fail where something waits."""

    def late(number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"took longer than {LIMIT_S} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def refusal(target: Target, path: Path) -> str | None:
    """Return what an input is refused with; None if it is read."""
    try:
        with in_time():
            target.read(path)
    except InputError as error:
        return str(error)
    return None


@pytest.mark.parametrize("kind", [kind for kind in SPECIAL if kind != "empty file"])
def test_what_is_no_regular_file_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "file"
    SPECIAL[kind](path)
    with in_time():
        for read in (read_regular, read_json, check_regular)[: 2 if kind == "huge sparse file" else 3]:
            with refused(str(path)):
                read(path)


@pytest.mark.parametrize("kind", ["FIFO", "socket", "folder", "device"])
def test_nothing_special_is_written_to(tmp_path: Path, kind: str) -> None:
    SPECIAL[kind](tmp_path / "file")
    with in_time(), pytest.raises((InputError, OSError)):
        create_regular(tmp_path / "file")
    create_regular(tmp_path / "other")
    assert (tmp_path / "other").read_bytes() == b""


def test_json_may_not_be_deep(tmp_path: Path) -> None:
    for text in ("[" * 100_000, '{"a":' * 100_000, "9" * 5000, "{"):
        (tmp_path / "s.json").write_text(text)
        with pytest.raises(InputError, match=r"is not valid JSON \("):
            read_json(tmp_path / "s.json")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if target.share < 0.5 else []) for name, target in TARGETS.items()],
)
def test_every_reader_refuses_special_files(tmp_path: Path, name: str) -> None:
    target = TARGETS[name]
    path, files = fresh(target, tmp_path / "in")
    intact = {file: file.read_bytes() for file in files}
    for file in files[:: max(1, len(files) // 3)]:
        for kind in SPECIAL:
            replace_by(kind, file)
            message = refusal(target, path)
            assert message is not None or kind in ("empty file", "huge sparse file"), f"{kind} for {file.name} was read"
            assert "\n" not in (message or "")
            remove(file)
            file.write_bytes(intact[file])
        lengthen(file)
        assert "\n" not in (refusal(target, path) or "")
        file.write_bytes(intact[file])
    target.read(path)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a sequence and two runs of it."""
    folder = tmp_path_factory.mktemp("special")
    write_bop(folder / "s", small_frames(4), small_truth(4), depth_scale_mm=1.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        main(["build", "s", "--out", "a", "--prior", "table", "--method", "icp"])
    shutil.copytree(folder / "a", folder / "b")
    return folder


COMMANDS = {
    "join a": (("join", "a", "b", "--out", "joined"), "a/report.json"),
    "join b": (("join", "a", "b", "--out", "joined"), "b/report.json"),
    "export": (("export", "a", "--out", "a.obj"), "a/model.ply"),
    "export of a report": (("export", "a", "--out", "a.obj"), "a/report.json"),
    "report": (("report", "a"), "a/report.json"),
    "report of a recording": (("report", "a"), "a/recording.rrd"),
    "view": (("view", "a", "--web"), "a/recording.rrd"),
    "evaluate": (("evaluate", "a", "--out", "evaluated"), "a/report.json"),
    "resume": (("build", "s", "--out", "a", "--resume", "--prior", "table", "--method", "icp"), "a/report.json"),
    "info": (("info", "s"), "s/scene_camera.json"),
    "truth": (("info", "s"), "s/scene_gt.json"),
    "mask": (("info", "s"), "s/mask_visib/000001_000000.png"),
    "meta": (("build", "s", "--out", "new"), "s/sequence.json"),
    "convert": (("convert", "s", "--out", "new"), "s/depth/000001.png"),
    "robot": (("build", "s", "--out", "new", "--prior", "held"), "s/robot.txt"),
    "sensor": (("build", "s", "--out", "new", "--sensor", "noise.json"), "noise.json"),
    "render": (("render", "recipe.json", "--out", "new"), "recipe.json"),
}


@pytest.mark.parametrize("kind", ["FIFO", "folder", "loop of links"])
@pytest.mark.parametrize("case", COMMANDS)
def test_every_command_refuses_special_files(
    built: Path, tmp_path: Path, cli: Run, monkeypatch: pytest.MonkeyPatch, case: str, kind: str
) -> None:
    arguments, name = COMMANDS[case]
    shutil.copytree(built, tmp_path / "in")
    monkeypatch.chdir(tmp_path / "in")
    replace_by(kind, Path(name))
    with in_time():
        ended = cli(*arguments)
    assert (ended.status, ended.out) == (2, "")
    last = ended.err.splitlines()[-1]
    assert last.startswith("modeler: ")
    assert Path(name).name in last or last.startswith(f"modeler: {Path(name).parent}: ")
    assert not Path("new").exists()


def test_a_resumed_build_makes_again_what_is_no_kept_pair(
    built: Path, tmp_path: Path, cli: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(built, tmp_path / "in")
    monkeypatch.chdir(tmp_path / "in")
    build = ("build", "s", "--out", "a", "--resume", "--prior", "table", "--method", "icp")
    report = json.loads(Path("a/report.json").read_text())
    Path("a/report.json").write_text(json.dumps(report | {"complete": False}))
    kept = list(Path("a/.pairs.done").iterdir())
    assert kept
    for file in kept:
        replace_by("FIFO", file)
    with in_time():
        assert cli(*build).status in (0, 3)
    assert json.loads(Path("a/report.json").read_text())["poses"] == report["poses"]
