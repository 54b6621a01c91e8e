"""Runs and sequences that are moved, together or apart, and commands that are given from other folders."""

import json
import os
import shutil
from pathlib import Path

import pytest
from command_runner import QUICK, Run

from modeler.export import RunFolder
from modeler.sequences.calibrated import NoiseModel, noise_text

NEEDS_THE_SEQUENCE = (
    ("export", "RUN", "--out", "OUT.ply", "--watertight", "--voxel-m", "0.005"),
    ("suggest", "RUN"),
    ("evaluate", "RUN", "--out", "OUT"),
)
NEEDS_IT_NOT = (
    ("export", "RUN", "--out", "OUT.glb"),
    ("convert", "RUN", "--out", "OUT.txt"),
    ("report", "RUN", "--out", "OUT.html"),
)


@pytest.fixture
def home(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Run) -> Path:
    """A folder with a sequence and its run, built from there with relative paths and a file of the sensor's noise."""
    folder = tmp_path / "home"
    shutil.copytree(scene, folder / "scans" / "box")
    noise = NoiseModel(0.3, 150.0, 0.001, (1e-6, 0.0, 0.0))
    (folder / "noise.json").write_text(noise_text(noise, {}))
    monkeypatch.chdir(folder)
    ended = cli("build", "scans/box", "--out", "runs/box", "--sensor", "noise.json", *QUICK)
    assert ended.status == 0, ended.err
    return folder


def test_paths_are_relative_to_the_run_folder(home: Path) -> None:
    report = RunFolder(home / "runs" / "box").report()
    assert report["sequence"] == "../../scans/box"
    assert report["settings"]["sensor"] == "../../noise.json"


def asked(cli: Run, command: tuple[str, ...], run: Path, out: Path) -> tuple[int, str]:
    ended = cli(*(word.replace("RUN", str(run)).replace("OUT", str(out)) for word in command))
    return ended.status, ended.err


def test_run_and_sequence_move_together_and_serve_from_anywhere(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Run
) -> None:
    moved = tmp_path / "elsewhere" / "deeper"
    moved.parent.mkdir()
    home.rename(moved)
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    for number, command in enumerate(NEEDS_THE_SEQUENCE):
        status, words = asked(cli, command, moved / "runs" / "box", tmp_path / f"out{number}")
        assert status in (0, 3), words
    build = ("build", moved / "scans" / "box", "--out", moved / "runs" / "box", "--sensor", moved / "noise.json")
    ended = cli(*build, *QUICK, "--resume")
    assert ended.status == 0
    assert "already complete" in ended.err
    link = tmp_path / "link"
    link.symlink_to(moved)
    assert asked(cli, NEEDS_THE_SEQUENCE[0], link / "runs" / "box", tmp_path / "linked")[0] == 0


def test_a_missing_sequence_costs_what_needs_it_and_no_more(home: Path, tmp_path: Path, cli: Run) -> None:
    (home / "scans" / "box").rename(home / "box")
    for number, command in enumerate(NEEDS_THE_SEQUENCE):
        status, words = asked(cli, command, home / "runs" / "box", tmp_path / f"out{number}")
        assert (status, words.count("\n")) == (2, 1), words
        assert f"{home / 'scans' / 'box'}: the sequence of " in words
        assert "--sequence" in words
    for number, command in enumerate(NEEDS_IT_NOT):
        status, words = asked(cli, command, home / "runs" / "box", tmp_path / f"other{number}")
        assert status == 0, words
        assert ("errors against the truth are left out" in words) == (command[0] == "report")
    given = (*NEEDS_THE_SEQUENCE[0], "--sequence", str(home / "box"))
    assert asked(cli, given, home / "runs" / "box", tmp_path / "given")[0] == 0


def test_reports_of_earlier_versions_are_read_from_where_they_were_made(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Run
) -> None:
    path = home / "runs" / "box" / "report.json"
    report = json.loads(path.read_text())
    report["sequence"], report["settings"]["sensor"] = "scans/box", str(home / "noise.json")
    path.write_text(json.dumps(report))
    assert asked(cli, NEEDS_THE_SEQUENCE[0], home / "runs" / "box", tmp_path / "out")[0] == 0
    ended = cli("build", "scans/box", "--out", "runs/box", "--sensor", "noise.json", *QUICK, "--resume")
    assert "already complete" in ended.err
    monkeypatch.chdir(tmp_path)
    assert asked(cli, NEEDS_THE_SEQUENCE[0], home / "runs" / "box", tmp_path / "from elsewhere")[0] == 2


def test_what_is_no_file_keeps_its_name(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    assert folder.stored(Path("realsense")) == "realsense"
    assert folder.stored(tmp_path) == ".."
    assert folder.located("..") == tmp_path
    assert folder.located(os.fspath(tmp_path / "gone")) == tmp_path / "gone"
