"""Disks that are full or closed: one line, and nothing half-written."""

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_runner import QUICK, Run, refusal_of, with_files_of_at_most

from modeler.cli import main
from modeler.export import RunFolder
from modeler.sequences import write_bop
from modeler.types import InputError
from studies.formats.image_folders import small_frames


def ours(said: str) -> list[str]:
    """Return the lines of the program; Rerun complains where tests loaded it before the program asked it not to."""
    return [line for line in said.splitlines() if line.startswith("modeler: ")]


@pytest.mark.parametrize("file", ["recording.rrd", "model.ply"])
def test_a_disk_that_fills_ends_a_build_which_can_go_on(
    scene: Path, built: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], file: str
) -> None:
    command = ("build", str(scene), "--out", str(tmp_path / "run"), *QUICK)
    size = 2048 if file == "recording.rrd" else (built / file).stat().st_size - 1
    assert with_files_of_at_most(size, *command) == 2
    said = capfd.readouterr()
    assert (said.out, len(ours(said.err))) == ("", 1)
    assert f"{file}: cannot" in said.err
    assert "File too large" in said.err
    assert not any(path.name.endswith(".part") for path in (tmp_path / "run").rglob("*"))
    assert main([*command, "--resume"]) == 0
    for name in ("model.ply", "trajectory.txt", "graph.g2o"):
        assert (tmp_path / "run" / name).read_bytes() == (built / name).read_bytes()
    assert RunFolder(tmp_path / "run").report()["complete"]


@pytest.mark.parametrize("name", ["m.ply", "m.obj"])
def test_a_disk_that_is_full_keeps_the_mesh_that_was_there(
    built: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    (tmp_path / name).write_text("precious")
    assert with_files_of_at_most(3000, "export", str(built), "--out", str(tmp_path / name)) == 2
    said = capfd.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: "precious"}


def test_a_broken_input_leaves_the_run_of_before(scene: Path, built: Path, tmp_path: Path) -> None:
    shutil.copytree(built, tmp_path / "run")
    shutil.copytree(scene, tmp_path / "in")
    (tmp_path / "in" / "depth" / "000002.png").write_bytes(b"")

    def held() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}

    before = held()
    for flag in ("--overwrite", "--resume"):
        assert main(["build", str(tmp_path / "in"), "--out", str(tmp_path / "run"), *QUICK, flag]) == 2
    assert held() == before


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


def test_that_a_run_is_closed_to_others_is_said(closed: Path) -> None:
    user = os.geteuid()
    os.seteuid(os.getuid())
    os.chmod(closed, 0o600)
    os.seteuid(user)
    with pytest.raises(InputError, match="Permission denied"):
        RunFolder(closed).report()
    os.seteuid(os.getuid())
    os.chmod(closed, 0o700)


@pytest.mark.parametrize("command", ["build", "convert", "export", "evaluate", "poses"])
def test_a_closed_folder_is_said(scene: Path, built: Path, closed: Path, cli: Run, command: str) -> None:
    user = os.geteuid()
    os.seteuid(os.getuid())
    inputs = Path(tempfile.mkdtemp())  # pytest's own folders are closed to others
    os.chmod(inputs, 0o755)
    shutil.copytree(scene, inputs / "in")
    shutil.copytree(built, inputs / "run")
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
    ended = cli(*arguments[command])
    os.seteuid(os.getuid())
    shutil.rmtree(inputs)
    said = refusal_of(ended)
    assert "ermission denied" in said
    assert str(closed) in said
    assert list(closed.iterdir()) == []


def test_what_a_killed_program_left_is_tidied_up(tmp_path: Path) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    for process in (str(ended.pid), str(os.getppid()), "other"):
        (tmp_path / f".scene.{process}.partial" / "depth").mkdir(parents=True)
    write_bop(tmp_path / "scene", small_frames(1))
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"scene", f".scene.{os.getppid()}.partial", ".scene.other.partial"}
