"""Run folders that are damaged or made by hand are refused in one line, and give no broken mesh."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from commanded import Run, runner
from made_up import META, made_up_steps

from modeler.export import RunFolder


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Run:
    return runner(capfd)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the folder of a made-up run."""
    folder = RunFolder.open(tmp_path / "run")
    for step in made_up_steps():
        folder.write(step, replace(META, sequence=str(tmp_path / "nowhere")))
    folder.finish()
    return folder.path


def _settings(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda report: report["settings"].update(values)


def _all_poses_without_spread(report: dict[str, Any]) -> None:
    for pose in report["poses"]:
        pose["covariance"] = [0.0] * 36


def _a_frame_twice(report: dict[str, Any]) -> None:
    report["frames"].append(report["frames"][0])


def _an_edge_to_itself(report: dict[str, Any]) -> None:
    report["edges"][0]["source"] = report["edges"][0]["target"]


@pytest.mark.parametrize(
    "damage",
    [
        _settings(sensor="a\0b"),
        _settings(sensor="\ud800"),
        _settings(joined=["a\0", "b"], offset=3),
        _all_poses_without_spread,
        _a_frame_twice,
        _an_edge_to_itself,
        lambda report: report.update(sequence="\ud800"),
        lambda report: report.update(sequence="a\0b"),
    ],
)
def test_a_report_that_cannot_be_true_is_refused(run: Run, folder: Path, damage: Callable[[dict], None]) -> None:
    report = json.loads((folder / "report.json").read_bytes())
    damage(report)
    (folder / "report.json").write_text(json.dumps(report))
    for command in (["report"], ["export", "--out", "m.ply"], ["convert", "--out", "poses.txt"]):
        ended = run(command[0], folder, *(word.replace("m.", f"{folder.parent}/m.") for word in command[1:]))
        assert (ended.status, ended.out, ended.err.count("\n")) == (2, "", 1)
        assert "report.json" in ended.err


@pytest.mark.parametrize("text", ["[" * 100_000, '{"schema": 1, "x": ' + "[" * 100_000 + "]" * 100_000 + "}"])
def test_a_report_that_is_nested_too_deeply_is_refused(run: Run, folder: Path, text: str) -> None:
    (folder / "report.json").write_text(text)
    ended = run("report", folder)
    assert (ended.status, ended.out, ended.err.count("\n")) == (2, "", 1)


def test_a_run_that_is_part_of_itself_is_refused(run: Run, folder: Path) -> None:
    report = json.loads((folder / "report.json").read_bytes())
    report["settings"] |= {"joined": [str(folder), str(folder / ".." / folder.name)], "offset": 10}
    (folder / "report.json").write_text(json.dumps(report))
    for command in (("export", folder, "--watertight"), ("join", folder, folder.parent)):
        ended = run(*command, "--out", folder.parent / "out.ply")
        assert (ended.status, ended.out, ended.err.count("\n")) == (2, "", 1)
    assert not (folder.parent / "out.ply").exists()


@pytest.mark.parametrize("corner", [10**9, -1])
def test_a_mesh_whose_triangles_have_no_such_corner_is_not_exported(run: Run, folder: Path, corner: int) -> None:
    content = (folder / "model.ply").read_bytes()
    (folder / "model.ply").write_bytes(content[:-4] + corner.to_bytes(4, "little", signed=True))
    for name in ("m.ply", "m.obj", "m.glb", "m.stl"):
        ended = run("export", folder, "--out", folder.parent / name)
        assert (ended.status, ended.out, ended.err.count("\n")) == (2, "", 1)
        assert "model.ply" in ended.err
        assert not (folder.parent / name).exists()


def test_a_sequence_whose_name_is_not_utf_8_is_not_damage(run: Run, folder: Path) -> None:
    report = json.loads((folder / "report.json").read_bytes())
    report["sequence"] = os.fsdecode(b"/nowhere/caf\xe9")
    (folder / "report.json").write_text(json.dumps(report))
    assert run("report", folder).status == 0
