"""`modeler track`: what it writes, says and refuses."""

import csv
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_runner import Run
from rerun_recordings import drawn, read

from modeler import se3
from modeler.sequences import bundled, open_sequence
from modeler.viz import entities

BOX = bundled("box")
FEW = ("--frames", "0:3", "--no-colour")


@pytest.fixture(scope="module")
def track(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the bundled box was tracked with its true mesh."""
    from modeler.cli import main

    out = tmp_path_factory.mktemp("track") / "out"
    assert main(["track", str(BOX / "model.ply"), str(BOX), "--out", str(out), *FEW]) == 0
    return out


def test_poses_are_those_of_the_truth_but_for_symmetries(track: Path) -> None:
    report, truth = json.loads((track / "poses.json").read_text()), open_sequence(BOX).truth()
    assert report["schema"] == 1
    assert [pose["id"] for pose in report["poses"]] == [0, 1, 2]
    for pose in report["poses"]:
        found = np.array(pose["camera_from_model"]).reshape(4, 4)
        assert pose["outcome"] in ("found", "followed")
        assert pose["usable"]
        assert np.linalg.norm(found[:3, 3] - truth[pose["id"]][:3, 3]) < 0.003
        off_deg = [np.degrees(se3.rotation_angle(se3.inverse(found @ turn) @ truth[pose["id"]])) for turn in TURNS]
        assert min(off_deg) < 1.5
        covariance = np.array(pose["covariance"]).reshape(6, 6)
        assert np.allclose(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance)[0] > 0.0


TURNS = [np.diag([*signs, np.prod(signs), 1.0]) for signs in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))]
"""Half turns of a box about its axes."""


def test_a_page_shows_every_frame_with_the_model_outlined(track: Path) -> None:
    page = (track / "report.html").read_text()
    assert "In every frame the object was placed" in page
    assert page.count("<img src='data:image/jpeg;base64,") == 3
    assert page.count("<tr><td>") == 3
    assert not re.findall(r"(src|href)=['\"]?(?!data:)\w", page)


def test_trajectory_and_results_of_bop_hold_the_same_poses(track: Path) -> None:
    poses = json.loads((track / "poses.json").read_text())["poses"]
    lines = [list(map(float, line.split())) for line in (track / "trajectory.txt").read_text().splitlines()]
    with (track / "bop.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
    for pose, line, row in zip(poses, lines, rows, strict=True):
        matrix = np.array(pose["camera_from_model"]).reshape(4, 4)
        assert line[0] == pose["timestamp"]
        assert np.allclose(line[1:4], matrix[:3, 3])
        assert int(row["im_id"]) == pose["id"]
        assert np.allclose([float(number) for number in row["R"].split()], matrix[:3, :3].ravel())
        assert np.allclose([float(number) for number in row["t"].split()], 1000.0 * matrix[:3, 3])


def test_the_recording_has_the_model_in_its_pose(track: Path) -> None:
    recording = read(track / "recording.rrd")
    pose = json.loads((track / "poses.json").read_text())["poses"][1]
    shown = drawn(recording, entities.TRACKED_MODEL, "Transform3D:translation")
    shown = shown or drawn(recording, entities.TRACKED_MODEL, "translation")
    assert np.allclose(np.ravel(shown[1]), np.array(pose["camera_from_model"]).reshape(4, 4)[:3, 3], atol=1e-6)
    assert entities.TRACKED_MESH in recording
    assert entities.TRACKED_PLACE_3_SIGMA in recording


def test_another_object_is_not_there_which_is_an_answer(cli: Run, tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=3, radius=0.09).export(tmp_path / "ball.ply")
    ended = cli("track", tmp_path / "ball.ply", BOX, "--out", tmp_path / "out", "--frames", "0:1", "--no-colour")
    assert ended.status == 0
    assert "not there in 1" in ended.err
    [pose] = json.loads((tmp_path / "out" / "poses.json").read_text())["poses"]
    assert (pose["outcome"], pose["camera_from_model"], pose["usable"]) == ("not there", None, False)
    assert pose["reason"]


def test_a_folder_with_other_things_is_left_alone(refusal: Callable[..., str], track: Path, tmp_path: Path) -> None:
    killed, other = tmp_path / "killed", tmp_path / "other"
    for folder in (killed, other):
        folder.mkdir()
    (other / "mine.txt").write_text("mine")
    (killed / f".poses.json.{2**30}.part").touch()  # by a process that is no more
    for out, words in ((other, "not the folder of a track"), (track, "--overwrite"), (killed, "--overwrite")):
        said = refusal("track", BOX / "model.ply", BOX, "--out", out, *FEW)
        assert words in said
        assert str(out) in said


def test_bad_models_are_refused_in_one_line(refusal: Callable[..., str], tmp_path: Path) -> None:
    shutil.copy(BOX / "model.ply", tmp_path / "mm.ply")
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.ply").write_text("ply")
    mesh = trimesh.load_mesh(tmp_path / "mm.ply")
    mesh.apply_scale(1000.0)
    mesh.export(tmp_path / "mm.ply")
    faults = {"mm.ply": "give --unit mm", "empty": "report", "bad.ply": "bad.ply", "no.obj": "no.obj"}
    for name, words in faults.items():
        assert words in refusal("track", tmp_path / name, BOX, "--out", tmp_path / "out", "--overwrite", *FEW)
