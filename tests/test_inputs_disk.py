"""Disks that are full or closed: one line, and nothing half-written."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from recordings import small_frames, small_truth

from modeler.cli import main
from modeler.export import RunFolder
from sequences import open_sequence, write_bop
from viz.ending import ends_whole

QUICK = ("--prior", "table", "--method", "icp")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("disk") / "in"
    write_bop(folder, small_frames(3), small_truth(3), depth_scale_mm=1.0)
    return folder


@pytest.fixture(scope="module")
def run(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("disk") / "run"
    assert main(["build", str(sequence), "--out", str(folder), *QUICK]) == 0
    return folder


def with_files_of_at_most(size: int, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command that cannot write larger files: to it that is what a full disk is, in the middle of a file."""
    script = f"""
import resource, signal, sys
from modeler.cli import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size}))
sys.exit(main({list(arguments)!r}))
"""
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)


def test_a_disk_that_fills_ends_a_build_which_can_go_on(sequence: Path, run: Path, tmp_path: Path) -> None:
    command = ("build", str(sequence), "--out", str(tmp_path / "run"), *QUICK)
    size = (run / "model.ply").stat().st_size - 1
    ended = with_files_of_at_most(size, *command)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.count("\n") == 1
    assert "cannot be written (File too large)" in ended.stderr
    assert not any(path.name.endswith(".part") for path in (tmp_path / "run").rglob("*"))
    assert main([*command, "--resume"]) == 0
    for name in ("model.ply", "trajectory.txt", "graph.g2o"):
        assert (tmp_path / "run" / name).read_bytes() == (run / name).read_bytes()
    assert RunFolder(tmp_path / "run").report()["complete"]


def test_a_recording_that_is_cut_off_is_said(sequence: Path, tmp_path: Path) -> None:
    short = write_half(sequence, tmp_path / "in")
    assert main(["build", str(short), "--out", str(tmp_path / "run"), *QUICK]) == 0
    size = max(path.stat().st_size for path in (tmp_path / "run").iterdir() if path.suffix != ".rrd")
    recording = tmp_path / "run" / "recording.rrd"
    assert recording.stat().st_size > size
    assert ends_whole(recording)
    recording.write_bytes(recording.read_bytes()[:-100])
    assert not ends_whole(recording)
    ended = with_files_of_at_most(size, "build", str(short), "--out", str(tmp_path / "run"), *QUICK, "--overwrite")
    assert ended.returncode == 0
    said = [line for line in ended.stderr.splitlines() if not line.startswith("modeler: 2 of 2 frames")]
    assert len(said) == 1
    assert "recording.rrd: is cut off (is the disk full?)" in said[0]


def write_half(sequence: Path, path: Path) -> Path:
    """Write the first frames of a sequence, without colour: their model is small."""
    frames = [replace(frame, colour=None) for frame in open_sequence(sequence)][:2]
    write_bop(path, frames, depth_scale_mm=1.0)
    return path


@pytest.mark.parametrize("name", ["m.ply", "m.obj"])
def test_a_disk_that_is_full_keeps_the_mesh_that_was_there(run: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("precious")
    ended = with_files_of_at_most(3000, "export", str(run), "--out", str(tmp_path / name))
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.count("\n") == 1
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: "precious"}


def test_a_broken_input_leaves_the_run_of_before(sequence: Path, run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    shutil.copytree(sequence, tmp_path / "in")
    (tmp_path / "in" / "depth" / "000002.png").write_bytes(b"")
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    for flag in ("--overwrite", "--resume"):
        assert main(["build", str(tmp_path / "in"), "--out", str(tmp_path / "run"), *QUICK, flag]) == 2
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before


@pytest.fixture
def closed() -> Iterator[Path]:
    """Return a folder into which one may look and not write, to a user who is not root."""
    user = os.geteuid()
    with tempfile.TemporaryDirectory() as place:
        os.chmod(place, 0o555)
        if user == 0:
            os.seteuid(65534)
        yield Path(place)
        os.seteuid(user)


@pytest.mark.parametrize("command", ["build", "convert", "export", "evaluate", "poses"])
def test_a_closed_folder_is_said(
    sequence: Path, run: Path, closed: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    user = os.geteuid()
    os.seteuid(os.getuid())
    inputs = Path(tempfile.mkdtemp())  # pytest's own folders are closed to others
    os.chmod(inputs, 0o755)
    shutil.copytree(sequence, inputs / "in")
    shutil.copytree(run, inputs / "run")
    report = json.loads((inputs / "run" / "report.json").read_text())
    (inputs / "run" / "report.json").write_text(json.dumps(report | {"sequence": str(inputs / "in")}))
    arguments = {
        "build": ["build", inputs / "in", "--out", closed / "run", *QUICK],
        "convert": ["convert", inputs / "in", "--out", closed / "bop"],
        "export": ["export", inputs / "run", "--out", closed / "m.ply"],
        "evaluate": ["evaluate", inputs / "in", "--out", closed / "figures", "--methods", "icp"],
        "poses": ["convert", inputs / "run", "--out", closed / "poses.txt"],
    }
    os.seteuid(user)
    status = main([str(word) for word in arguments[command]])
    said = capsys.readouterr()
    os.seteuid(os.getuid())
    shutil.rmtree(inputs)
    assert (status, said.out) == (2, "")
    assert said.err.count("\n") == 1
    assert "ermission denied" in said.err
    assert str(closed) in said.err
    assert list(closed.iterdir()) == []


def test_what_a_killed_program_left_is_tidied_up(tmp_path: Path) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    for process in (str(ended.pid), str(os.getppid()), "other"):
        (tmp_path / f".scene.{process}.partial" / "depth").mkdir(parents=True)
    write_bop(tmp_path / "scene", small_frames(1))
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"scene", f".scene.{os.getppid()}.partial", ".scene.other.partial"}


def test_the_sequence_is_intact(sequence: Path) -> None:
    assert len(list(open_sequence(sequence))) == 3
