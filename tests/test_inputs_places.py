"""Paths that hold no sequence, or may not be read or written, are told with what is meant instead."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from refusal import refused

from modeler.cli import main
from sequences import open_sequence


def test_the_folder_of_a_run_is_no_sequence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "report.json").write_text("{}")
    (tmp_path / "model.ply").write_text("ply")
    assert main(["info", str(tmp_path)]) == 2
    assert "is the folder of a run" in capsys.readouterr().err


def test_pictures_that_lie_elsewhere_are_seen(
    written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for place in (tmp_path / "flat", tmp_path / "deeper" / "images"):
        shutil.copytree(written / "bop" / "depth", place)
    for name in ("flat", "deeper"):
        assert main(["info", str(tmp_path / name)]) == 2
        assert "holds images but no folder depth; put the depth images into one" in capsys.readouterr().err
    (tmp_path / "deeper" / "images").rename(tmp_path / "deeper" / "Depth_16bit")
    assert main(["info", str(tmp_path / "deeper")]) == 2
    assert "if its depth images are those in Depth_16bit, rename that to depth" in capsys.readouterr().err
    shutil.copytree(written / "bop", tmp_path / "monday" / "take 1" / "scan")
    assert main(["info", str(tmp_path / "monday")]) == 2
    assert "holds a sequence; give it: take 1/scan" in capsys.readouterr().err
    assert main(["info", str(tmp_path / "monday" / "take 1")]) == 2
    assert "holds a sequence; give it: scan" in capsys.readouterr().err


def test_a_path_that_is_misspelt_is_asked_about(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    with refused(f"no such folder or file; did you mean {tmp_path / 'scans'}? Else give a folder with depth/"):
        open_sequence(tmp_path / "scan")
    with refused("no such folder or file; give a folder with depth/"):
        open_sequence(tmp_path / "elsewhere")
    with refused("no such folder or file; give a folder with depth/"):
        open_sequence(tmp_path / "nowhere" / "scans")


@pytest.mark.parametrize("name", ["nowhere", "nowhere.bag", "", "file.txt"])
def test_a_path_without_a_sequence_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    (tmp_path / "file.txt").write_text("hello")
    assert main(["info", str(tmp_path / name)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert str(tmp_path / name) in said


@pytest.fixture
def as_nobody() -> Iterator[Callable[[], None]]:
    """Return what gives root's rights up until the end of the test; others have none to give up."""
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
def test_no_permission_is_said(
    written: Path, as_nobody: Callable[[], None], capsys: pytest.CaptureFixture[str], kind: str, what: str
) -> None:
    with tempfile.TemporaryDirectory() as place:  # pytest's own folders are closed to others
        os.chmod(place, 0o755)
        folder = Path(place) / kind
        shutil.copytree(written / kind, folder)
        (folder / what).chmod(0)
        as_nobody()
        status = main(["info", str(folder)])
        said = capsys.readouterr().err
        os.seteuid(os.getuid())
    assert status == 2
    assert said.count("\n") == 1
    assert "ermission" in said


def test_a_full_disk_leaves_nothing_behind(written: Path, tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk: writing fails in the same way, in the middle of a picture."""
    script = f"""
import resource, signal, sys
from modeler.cli import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))
sys.exit(main(["convert", {str(written / "bop")!r}, "--out", {str(tmp_path / "out")!r}]))
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith(f"modeler: {tmp_path / 'out'}: cannot be written (File too large)")
    assert ended.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_is_there_is_kept(written: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    assert main(["convert", str(written / "bop"), "--out", str(tmp_path / "file")]) == 2
    assert (tmp_path / "file").read_text() == "mine"


def test_a_link_within_the_folder_is_followed(written: Path, tmp_path: Path) -> None:
    shutil.copytree(written / "open3d", tmp_path / "in")
    (tmp_path / "in" / "color").rename(tmp_path / "in" / "pictures")
    (tmp_path / "in" / "color").symlink_to(tmp_path / "in" / "pictures")
    assert main(["info", str(tmp_path / "in")]) == 0
