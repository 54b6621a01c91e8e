"""The run folder: what stands in it is whole, nothing is lost unasked, and an interrupted run is taken up."""

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_up import META, made_up_steps

from modeler.export import (
    RunFolder,
    RunMeta,
    report_of,
    write_atomically,
)
from modeler.types import (
    InputError,
    Step,
)

FILES = {"trajectory.txt", "odometry.txt", "graph.g2o", "report.json", "cloud.ply", "model.ply"}


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
    run = RunFolder.open(tmp_path)
    for step in made_up_steps():
        run.write(step, META)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / ".model.ply.1234.part").write_text("half")
    before = (tmp_path / "report.json").read_bytes()
    with pytest.raises(InputError, match=r"not empty; choose another place, or replace or resume the run") as caught:
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
    with pytest.raises(InputError, match=r"is .* the folder of a run"):
        RunFolder(tmp_path).report()
    for content in ("{", "[]", '{"schema": 2}'):
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


def test_run_has_finished_when_its_registrations_are_forgotten(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    for step in made_up_steps(2):
        run.write(step, META)
        run.pairs.keep(made_up_steps()[-1].edges_so_far[0].posterior, "question")
        assert not run.finished(META)
    run.finish()
    assert run.finished(META)
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"recording.rrd"}
    run.write(made_up_steps(2)[-1], replace(META, interrupted=True))
    run.pairs.keep(made_up_steps(2)[-1].edges_so_far[0].posterior, "question")
    run.finish()
    assert not run.finished(META)
    assert run.pairs.folder.exists()


def test_a_folder_that_takes_long_to_write_is_written_less_often(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, written = 0.0, []
    run, steps = RunFolder.open(tmp_path), made_up_steps(40)

    def slow(step: Step, frames: list, meta: RunMeta) -> dict:
        nonlocal now_s
        now_s += 2.0
        written.append(step.frame.index)
        return report_of(step, frames, meta)

    monkeypatch.setattr("modeler.export.run_folder.time.monotonic", lambda: now_s)
    monkeypatch.setattr("modeler.export.run_folder.report_of", slow)
    report = run.newest
    for step in steps:
        now_s += 1.0
        report = run.write(step, META)
    assert written == [3, 39, 75, 81]  # of 3, 5, 7 …: every eighteenth second, and the last
    assert report == run.report()
    assert len(report["frames"]) == 40
    assert len((tmp_path / "odometry.txt").read_text().splitlines()) == 40


def test_what_no_report_tells_of_is_not_resumed(tmp_path: Path) -> None:
    """A program that was killed at --overwrite may leave files of the earlier run; their report goes first."""
    run = RunFolder.open(tmp_path)
    for step in made_up_steps():
        run.write(step, META)
    run.pairs.keep(made_up_steps()[-1].edges_so_far[0].posterior, "question")
    (tmp_path / "report.json").unlink()
    (tmp_path / "notes.txt").write_text("mine")
    RunFolder.open(tmp_path, resume=True)
    assert {path.name for path in tmp_path.iterdir()} == {"notes.txt", ".pairs"}
    assert list((tmp_path / ".pairs").iterdir()) == []


@pytest.mark.parametrize("how", [{"overwrite": True}, {"resume": True}])
def test_a_folder_that_is_no_run_is_left_alone(tmp_path: Path, how: dict[str, bool]) -> None:
    (tmp_path / "model.ply").write_text("somebody's own")
    for report in (None, "{", '{"schema": 2}'):
        if report is not None:
            (tmp_path / "report.json").write_text(report)
        before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        with pytest.raises(InputError, match="not empty, and not the folder of a run"):
            RunFolder.open(tmp_path, **how)
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_run_with_a_damaged_report_can_be_replaced(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    for step in made_up_steps():
        run.write(step, META)
    run.finish()
    (tmp_path / "report.json").write_text("{")
    RunFolder.open(tmp_path, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == [".pairs"]


def test_what_a_kill_left_of_the_registrations_goes_with_the_next_run(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    run.pairs.keep(made_up_steps()[-1].edges_so_far[0].posterior, "question")
    (tmp_path / ".pairs").rename(tmp_path / ".pairs.dropped")
    assert run.is_run
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
        with pytest.raises(InputError, match=r"report.json: cannot be written \(No space left on device\)"):
            write_atomically(path, "new")
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail)
        with pytest.raises(InputError, match="cannot be written"):
            write_atomically(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
