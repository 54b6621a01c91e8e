"""`modeler edit`: frames taken out of a finished run, without registering again."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_runner import QUICK, Run

from modeler import se3
from modeler.cli import main
from modeler.runs.reopening import reopened
from modeler.sequences import write_bop
from modeler.types import Array
from studies.formats.image_folders import small_frames


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a few small frames of the bundled box."""
    folder = tmp_path_factory.mktemp("edit")
    write_bop(folder / "box", small_frames(4), depth_scale_mm=1.0)
    main(["build", str(folder / "box"), "--out", str(folder / "run"), *QUICK, "--voxel-m", "0.004"])
    return folder / "run"


def poses(run: Path) -> dict[int, Array]:
    report = json.loads((run / "report.json").read_text())
    return {pose["id"]: np.array(pose["object_from_camera"]).reshape(4, 4) for pose in report["poses"]}


def test_a_frame_is_taken_out_and_the_others_stay_where_they_were(cli: Run, built: Path, tmp_path: Path) -> None:
    before, ended = poses(built), cli("edit", built, "--drop", "2", "--out", tmp_path / "new")
    assert ended.status in (0, 3)
    after = poses(tmp_path / "new")
    assert after.keys() <= before.keys() - {2}
    assert len(after) >= 2
    moved = se3.inverse(before[min(after)])
    for frame, pose in after.items():
        off = se3.log(se3.inverse(moved @ before[frame]) @ pose)
        assert np.degrees(np.linalg.norm(off[:3])) < 1.0
        assert np.linalg.norm(off[3:]) < 0.005
    report = json.loads((tmp_path / "new" / "report.json").read_text())
    assert 2 in report["settings"]["dropped"]
    assert 2 not in [frame["id"] for frame in report["frames"]]
    assert not [edge for edge in report["edges"] if 2 in (edge["source"], edge["target"])]
    assert (tmp_path / "new" / "model.ply").stat().st_size != (built / "model.ply").stat().st_size
    assert reopened(tmp_path / "new").views.keys() == after.keys()


def test_a_run_is_as_certain_when_it_is_opened_again(built: Path) -> None:
    """Edited, joined and continued runs are judged by the same covariances as those of `modeler build`."""
    run = reopened(built)
    for pose in run.report["poses"]:
        covariance = np.reshape(pose["covariance"], (6, 6))
        np.testing.assert_allclose(run.solution.covariances[pose["id"]], covariance, rtol=1e-3, atol=1e-12)
    camera = run.report["camera"]
    assert run.solution.focal.sigma == camera["focal_factor_sigma"] > 0.0


def test_a_frame_that_was_left_out_can_be_taken_out(cli: Run, built: Path, tmp_path: Path) -> None:
    run = built.parent / "with_lost"  # beside it, as it names its sequence by a relative path
    shutil.copytree(built, run)
    report = json.loads((run / "report.json").read_text())
    lost = report["frames"][-1] | {"id": 99, "outcome": "no overlap", "cause": "no_overlap", "points": 0}
    report["frames"].append(lost)
    (run / "report.json").write_text(json.dumps(report))
    cli("edit", run, "--drop", "99", "--out", tmp_path / "new")
    after = json.loads((tmp_path / "new" / "report.json").read_text())
    assert [frame["id"] for frame in after["frames"]] == [frame["id"] for frame in report["frames"][:-1]]
    assert "left_out" not in after["reason_codes"]
    assert poses(tmp_path / "new").keys() == poses(built).keys()


def test_what_is_kept_is_what_is_not_dropped(cli: Run, built: Path, tmp_path: Path) -> None:
    frames = sorted(poses(built))
    some = ",".join(map(str, frames[:-1]))
    cli("edit", built, "--drop", str(frames[-1]), "--out", tmp_path / "one")
    cli("edit", built, "--keep", some, "--out", tmp_path / "other")
    for name in ("model.ply", "trajectory.txt", "graph.g2o"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


def test_a_run_may_be_edited_in_place(cli: Run, built: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(built, run)
    report = json.loads((run / "report.json").read_text())
    report["sequence"] = str(built.parent / "box")
    (run / "report.json").write_text(json.dumps(report))
    last = max(poses(run))
    assert cli("edit", run, "--drop", str(last)).status in (0, 3)
    assert last not in poses(run)
    assert len(poses(run)) == len(poses(built)) - 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), "--drop"),
        (("--drop", "1", "--keep", "2"), "--keep"),
        (("--drop", "99"), "frame 99 is not in the run"),
        (("--drop", "one"), "'one' is no list of frames"),
        (("--keep", "0"), "keep at least 2"),
        (("--keep", "0:99"), "no frame would be taken out"),
    ],
)
def test_what_makes_no_sense_is_refused(
    refusal: Callable[..., str], built: Path, tmp_path: Path, options: tuple[str, ...], words: str
) -> None:
    assert words in refusal("edit", built, *options, "--out", tmp_path / "new")
    assert not (tmp_path / "new" / "report.json").exists()
