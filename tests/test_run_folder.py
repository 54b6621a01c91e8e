"""The run folder: whole, nothing lost unasked, an interrupted run is taken up, a damaged one refused in one line."""

import json
import os
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runner import Run
from run_builders import META, made_up_steps

from modeler.export import RunFolder, RunMeta, report_of, write_atomically
from modeler.export.reading import fault
from modeler.system import processes
from modeler.types import InputError, Step
from modeler.verdict import judged
from studies.fuzz.special import replace_by

FILES = {"trajectory.txt", "odometry.txt", "graph.g2o", "report.json", "cloud.ply", "model.ply"}


def filled(path: Path, count: int = 4) -> RunFolder:
    """Write a made-up run of `count` frames into a folder."""
    run = RunFolder.open(path)
    for step in made_up_steps(count):
        run.write(step, META)
    return run


def test_run_folder_is_complete_after_the_last_step(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path / "runs" / "box")
    steps = made_up_steps()
    for step in steps:
        run.write(step, META)
        expected = FILES if step.last else FILES - {"cloud.ply", "model.ply"}
        assert {path.name for path in run.path.iterdir()} == expected | {".pairs"}
    run.finish()
    assert {path.name for path in run.path.iterdir()} == FILES
    solution = steps[-1].solution
    for name, poses in (("trajectory.txt", solution.trajectory), ("odometry.txt", solution.odometry)):
        lines = np.loadtxt(run.path / name)
        np.testing.assert_allclose(lines[:, 0], [0.3, 0.5, 0.7, 0.9])
        np.testing.assert_array_equal(lines[:, 1:4], np.stack([poses[frame][:3, 3] for frame in (3, 5, 7, 9)]))
    np.testing.assert_array_equal(np.loadtxt(run.path / "trajectory.txt")[0, 1:], [0, 0, 0, 0, 0, 0, 1])


def test_existing_run_is_not_written_over_unasked(tmp_path: Path) -> None:
    filled(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / ".model.ply.1234.part").write_text("half")
    before = (tmp_path / "report.json").read_bytes()
    with pytest.raises(InputError, match=r"not empty") as caught:
        RunFolder.open(tmp_path)
    assert "\n" not in str(caught.value)
    assert (tmp_path / "report.json").read_bytes() == before
    (tmp_path / "report.html").write_text("a page about this run")
    RunFolder.open(tmp_path, resume=True)
    assert {path.name for path in tmp_path.iterdir()} == FILES | {"notes.txt", "report.html", ".pairs"}
    RunFolder.open(tmp_path, overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == {"notes.txt", ".pairs"}


def test_place_that_cannot_hold_a_run_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(InputError, match="choose another place"):
            RunFolder.open(path, overwrite=True)
    with pytest.raises(InputError, match=r"no report; give a run folder"):
        RunFolder(tmp_path).report()
    for content in ("{", "[]", '{"schema": 3}'):
        (tmp_path / "report.json").write_text(content)
        with pytest.raises(InputError, match=r"report\.json: "):
            RunFolder(tmp_path).report()


def test_resumed_run_keeps_what_it_had_until_it_is_there_again(tmp_path: Path) -> None:
    steps = made_up_steps(5)
    run = RunFolder.open(tmp_path)
    for step in steps[:3]:
        run.write(step, META)
    before = (tmp_path / "report.json").read_bytes()
    resumed = RunFolder.open(tmp_path, resume=True)
    assert not resumed.finished(META)
    for step in steps[:2]:
        resumed.write(step, META)
        assert (tmp_path / "report.json").read_bytes() == before
    resumed.write(steps[2], META)
    assert (tmp_path / "report.json").read_bytes() == before  # the same results, to the bit
    for step in steps[3:]:
        resumed.write(step, META)
    straight = RunFolder.open(tmp_path / "straight")
    for step in steps:
        straight.write(step, META)
    for name in FILES:
        assert (tmp_path / name).read_bytes() == (straight.path / name).read_bytes()


def test_resuming_with_other_settings_is_refused(tmp_path: Path) -> None:
    assert not RunFolder.open(tmp_path, resume=True).finished(META)
    RunFolder.open(tmp_path).write(made_up_steps()[0], META)
    run = RunFolder.open(tmp_path, resume=True)
    assert not run.finished(META)
    for other, words in (
        (replace(META, seed=META.seed + 1), f"seed was {META.seed} and is now {META.seed + 1};"),
        (replace(META, prior="general"), f"prior was {META.prior} and is now general;"),
        (replace(META, settings={**META.settings, "max_depth_m": 2.0}), "max-depth-m was not given and is now 2.0;"),
    ):
        with pytest.raises(InputError, match=rf"cannot resume, {re.escape(words)}"):
            run.finished(other)


def test_run_has_finished_when_its_registrations_are_those_of_a_complete_run(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    for step in made_up_steps(2):
        run.write(step, META)
        run.pairs.keep(made_up_steps()[-1].edges_so_far[0].posterior, ("views", "prior"))
        assert not run.finished(META)
    run.finish()
    assert run.finished(META)
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"recording.rrd"} | {".pairs.done"}
    step = made_up_steps(2)[-1]
    run.write(replace(step, verdict=judged(step, interrupted=True)), META)
    run.pairs.keep(made_up_steps(2)[-1].edges_so_far[0].posterior, ("views", "prior"))
    run.finish()
    assert not run.finished(META)
    assert run.pairs.folder.exists()


def test_a_folder_that_takes_long_to_write_is_written_less_often(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "_NO_TIME_S", 0.01)
    now_s, written = 0.0, []
    run, steps = RunFolder.open(tmp_path), made_up_steps(40)

    def slow(step: Step, meta: RunMeta) -> dict:
        nonlocal now_s
        now_s += 2.0
        written.append(step.frame.index)
        return report_of(step, meta)

    monkeypatch.setattr("modeler.system.processes.time.monotonic", lambda: now_s)
    monkeypatch.setattr("modeler.export.run_folder.report_of", slow)
    report = {}
    for step in steps:
        now_s += 1.0
        report = run.write(step, META)
    assert written == [3, 39, 75, 81]  # of 3, 5, 7 …: every eighteenth second, and the last
    assert report == run.report()
    assert len(report["frames"]) == 40
    assert len((tmp_path / "odometry.txt").read_text().splitlines()) == 40


def test_what_no_report_tells_of_is_not_resumed(tmp_path: Path) -> None:
    """A program that was killed at --overwrite may leave files of the earlier run; their report goes first."""
    run = filled(tmp_path)
    run.pairs.keep(made_up_steps()[-1].edges_so_far[0].posterior, ("views", "prior"))
    (tmp_path / "report.json").unlink()
    (tmp_path / "notes.txt").write_text("mine")
    RunFolder.open(tmp_path, resume=True)
    assert {path.name for path in tmp_path.iterdir()} == {"notes.txt", ".pairs"}
    assert list((tmp_path / ".pairs").iterdir()) == []


@pytest.mark.parametrize("how", [{"overwrite": True}, {"resume": True}])
def test_a_folder_that_is_no_run_is_left_alone(tmp_path: Path, how: dict[str, bool]) -> None:
    (tmp_path / "model.ply").write_text("somebody's own")
    for report in (None, "{", '{"schema": 3}'):
        if report is not None:
            (tmp_path / "report.json").write_text(report)
        before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        with pytest.raises(InputError, match="not the folder of a run"):
            RunFolder.open(tmp_path, **how)
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_run_with_a_damaged_report_can_be_replaced(tmp_path: Path) -> None:
    run = filled(tmp_path)
    run.finish()
    (tmp_path / "report.json").write_text("{")
    RunFolder.open(tmp_path, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == [".pairs"]


def test_a_recording_that_is_another_name_of_a_file_is_not_written_through(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("precious")
    run = RunFolder.open(tmp_path / "run")
    run.write(made_up_steps()[0], META)
    os.link(tmp_path / "precious", run.path / "recording.rrd")
    RunFolder.open(run.path, resume=True)
    assert not (run.path / "recording.rrd").exists()
    assert (tmp_path / "precious").read_text() == "precious"


def test_file_is_whole_whatever_happens_while_it_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "report.json"
    write_atomically(path, "old")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", fail)
        with pytest.raises(InputError, match=r"report.json: .*No space left on device"):
            write_atomically(path, "new")
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail)
        with pytest.raises(InputError, match="cannot be written"):
            write_atomically(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_kill_left_of_a_file_goes_when_it_is_written_again(tmp_path: Path) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    for name in (f".a.txt.{ended.pid}.part", f".a.txt.{os.getppid()}.part", ".a.txt.mine.part", f".b.{ended.pid}.part"):
        (tmp_path / name).write_text("half")
    write_atomically(tmp_path / "a.txt", "whole")
    left = {f".a.txt.{os.getppid()}.part", ".a.txt.mine.part", f".b.{ended.pid}.part"}
    assert {path.name for path in tmp_path.iterdir()} == {"a.txt", *left}


# Run folders that are damaged or made by hand are refused in one line, and give no broken mesh.


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
        _settings(joined=["a\0", "b"], offset=3),
        _settings(prior_args=["angle=\ud800"]),
        _settings(**{"\ud800": {"a": ["b"]}}),
        _all_poses_without_spread,
        _a_frame_twice,
        _an_edge_to_itself,
        lambda report: report.update(sequence="\ud800"),
        lambda report: report["versions"].update({"\ud800": "1"}),
        lambda report: report["reasons"].append("\ud800"),
        lambda report: report["frames"][0].update(cause="\ud800"),
        lambda report: report["edges"][0].update(reason="\ud800"),
    ],
)
def test_a_report_that_cannot_be_true_is_found_out(folder: Path, damage: Callable[[dict], None]) -> None:
    report = json.loads((folder / "report.json").read_bytes())
    assert fault(report) is None
    damage(report)
    assert fault(report) is not None


def test_a_run_that_is_part_of_itself_is_refused(refusal: Callable[..., str], folder: Path) -> None:
    report = json.loads((folder / "report.json").read_bytes())
    report["settings"] |= {"joined": [str(folder), str(folder / ".." / folder.name)], "offset": 10}
    (folder / "report.json").write_text(json.dumps(report))
    for command in (("export", folder, "--watertight"), ("join", folder, folder.parent)):
        refusal(*command, "--out", folder.parent / "out.ply")
    assert not (folder.parent / "out.ply").exists()


@pytest.mark.parametrize("corner", [10**9, -1])
def test_a_mesh_whose_triangles_have_no_such_corner_is_not_exported(
    refusal: Callable[..., str], folder: Path, corner: int
) -> None:
    content = (folder / "model.ply").read_bytes()
    (folder / "model.ply").write_bytes(content[:-4] + corner.to_bytes(4, "little", signed=True))
    for name in ("m.ply", "m.obj", "m.glb", "m.stl"):
        assert "model.ply" in refusal("export", folder, "--out", folder.parent / name)
        assert not (folder.parent / name).exists()


def test_a_sequence_whose_name_is_not_utf_8_is_not_damage(cli: Run, folder: Path) -> None:
    report = json.loads((folder / "report.json").read_bytes())
    report["sequence"] = os.fsdecode(b"/nowhere/caf\xe9")
    (folder / "report.json").write_text(json.dumps(report))
    assert cli("report", folder).status == 0


@pytest.mark.parametrize(("kind", "says"), [("FIFO", "is a FIFO"), ("folder", "is a folder"), ("device", "device")])
def test_a_report_that_is_no_file_is_said(tmp_path: Path, kind: str, says: str) -> None:
    (tmp_path / "trajectory.txt").write_text("")
    replace_by(kind, tmp_path / "report.json")
    for flags in ({}, {"resume": True}, {"overwrite": True}):
        with pytest.raises(InputError, match=rf"report\.json: .*{says}"):
            RunFolder(tmp_path).check(**flags)
