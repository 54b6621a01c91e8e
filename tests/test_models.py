"""Models of runs against the true surface: what `modeler evaluate RUN` measures, writes and refuses."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_runner import Run

from modeler import se3
from modeler.experiment import Modelled, ModelScore, model_scores
from modeler.export.reading import fault
from modeler.fusion import Fuser, Matcher
from modeler.sequences import bundled, open_sequence, true_mesh
from modeler.types import Array, InputError
from modeler.views import Sensor

BOX = bundled("box")
FUSER = Fuser(voxel_m=0.003)


@pytest.fixture(scope="module")
def modelled() -> Modelled:
    """Return a model of three frames whose poses are true, in an object frame of its own."""
    recorded = open_sequence(BOX)
    truth, noise, mesh = recorded.truth(), recorded.sensor(), true_mesh(recorded)
    assert truth is not None
    assert noise is not None
    views = {frame: Sensor(noise).ray_image(recorded.frame(frame), None) for frame in (0, 4, 9)}
    object_from_model = se3.exp(np.array([0.3, -0.2, 0.5, 0.1, 0.2, -0.1]))
    trajectory = {frame: object_from_model @ se3.inverse(truth[frame]) for frame in views}
    model = FUSER.fuse(views, trajectory)
    return Modelled("run", model, views, trajectory, truth, (mesh.vertices_m, mesh.triangles))


def _by(scores: list[ModelScore]) -> dict[tuple[str, str], ModelScore]:
    return {(score.poses, score.over): score for score in scores}


@pytest.fixture(scope="module")
def scored(modelled: Modelled) -> list[ModelScore]:
    return model_scores(modelled, FUSER, 0)


def test_true_poses_give_the_model_of_true_poses_in_whatever_frame(scored: list[ModelScore]) -> None:
    scores = _by(scored)
    assert list(scores) == [("run", "seen"), ("run", "whole"), ("true", "seen"), ("true", "whole")]
    for over in ("seen", "whole"):
        run, true = scores["run", over], scores["true", over]
        assert run.rotation_error_deg == pytest.approx(0.0, abs=1e-5)
        assert run.frames == 3
        assert run.accuracy_mm == pytest.approx(true.accuracy_mm, abs=0.05)
        assert run.f_3mm == pytest.approx(true.f_3mm, abs=0.01)
    seen, whole = scores["run", "seen"], scores["run", "whole"]
    assert seen.f_3mm > 0.97
    assert seen.accurate_3mm == whole.accurate_3mm
    # Nobody saw the bottom, 10.4 % of a box of 75 x 130 x 180 mm, of which 1.3 % lie within 3 mm of its rim.
    assert whole.complete_3mm < 0.91 < seen.complete_3mm


def test_a_model_ten_millimetres_too_far_scores_less_than_one_of_true_poses(modelled: Modelled) -> None:
    vertices_m = modelled.model.vertices_m
    grown = vertices_m + 0.01 * modelled.model.vertex_normals
    scores = _by(model_scores(replace(modelled, model=replace(modelled.model, vertices_m=grown)), FUSER, 0))
    assert scores["run", "seen"].accuracy_mm == pytest.approx(10.0, abs=0.7)
    assert scores["run", "seen"].f_3mm < 0.05
    assert scores["true", "seen"].f_3mm > 0.97


def test_one_wrong_pose_is_reported(modelled: Modelled) -> None:
    off = se3.exp(np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0]))
    wrong = {**modelled.trajectory, 9: modelled.trajectory[9] @ off}
    scores = model_scores(replace(modelled, trajectory=wrong), FUSER, 0)
    expected = np.degrees(0.3) * 2.0 / 3.0  # a third of it is shared by all
    assert scores[0].rotation_error_deg == pytest.approx(expected, rel=0.02)


def test_scores_are_the_same_for_the_same_seed(modelled: Modelled, scored: list[ModelScore]) -> None:
    assert model_scores(modelled, FUSER, 0) == scored


def test_refuses_what_cannot_be_compared(modelled: Modelled) -> None:
    with pytest.raises(InputError, match="true pose"):
        model_scores(replace(modelled, camera_from_model={77: np.eye(4)}), FUSER, 0)
    empty = replace(modelled.model, triangles=np.zeros((0, 3), dtype=np.int64))
    flat = replace(modelled.model, vertices_m=0.0 * modelled.model.vertices_m)
    for model in (empty, flat):
        with pytest.raises(InputError, match="its model has no surface"):
            model_scores(replace(modelled, model=model), FUSER, 0)
    vertices_m, triangles = modelled.truth
    with pytest.raises(InputError, match=r"true mesh .* no area"):
        model_scores(replace(modelled, truth=(0.0 * vertices_m, triangles)), FUSER, 0)


# the command


def test_evaluate_tells_how_good_the_model_of_a_run_is(built: Path, tmp_path: Path, cli: Run) -> None:
    status, out, err = cli("evaluate", built, "--out", tmp_path)
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert len(lines) == 5
    assert lines[1].split()[:4] == [str(built), "run", "seen", "3"]
    assert len({len(line) for line in lines}) == 1
    results = json.loads((tmp_path / "models.json").read_bytes())
    assert [(row["poses"], row["over"]) for row in results["models"]] == [
        (poses, over) for poses in ("run", "true") for over in ("seen", "whole")
    ]
    for row in results["models"]:
        assert row["f_3mm"] <= row["f_5mm"] <= 1.0
    with (tmp_path / "models.csv").open() as file:
        assert [float(row["f_3mm"]) for row in csv.DictReader(file)] == [row["f_3mm"] for row in results["models"]]


def test_a_run_that_cannot_be_judged_is_left_out_and_the_others_are_judged(
    scene: Path, built: Path, tmp_path: Path, cli: Run, refusal: Callable[..., str]
) -> None:
    _, run = _without(scene, built, tmp_path, "model.ply")
    out = tmp_path / "out"
    said = refusal("evaluate", run, built, tmp_path / "none", "--out", out)
    assert said.startswith(f"modeler: {tmp_path / 'none'}: no such folder")
    status, said, err = cli("evaluate", run, built, "--out", out)
    assert status == 2
    assert [line.split()[0] for line in said.splitlines()[1:]] == [str(built)] * 4
    assert [row["run"] for row in json.loads((out / "models.json").read_bytes())["models"]] == [str(built)] * 4
    assert err.startswith(f"modeler: {run} is left out: ")
    assert "model.ply" in err
    assert err.count("\n") == 1
    for name in ("models.json", "models.csv"):
        (out / name).unlink()
    for runs in ((run,), (run, run)):
        assert "no true surface" in refusal("evaluate", *runs, "--out", out)
    assert not (out / "models.json").exists()


@pytest.mark.slow
def test_another_sequence_is_not_taken_for_that_of_the_run(
    scene: Path, built: Path, tmp_path: Path, cli: Run, refusal: Callable[..., str]
) -> None:
    sequence, run = _without(scene, built, tmp_path)
    moved = sequence.rename(tmp_path / "moved")
    page = ("report", run, "--overwrite", "--out", tmp_path / "page.html")
    status, _, _ = cli("report", "--sequence", moved, *page[1:])
    assert status == 0
    assert "Errors against ground truth" in (tmp_path / "page.html").read_text()
    for command in (page, ("export", run, "--out", tmp_path / "m.ply", "--voxel-m", "0.005")):
        said = refusal(*command, "--sequence", bundled("tube"))
        assert "tube: frame 0 differs from the one" in said
        assert str(run) in said
        assert "--sequence is given 2 times" in refusal(*command, "--sequence", moved, "--sequence", moved)
    assert not (tmp_path / "m.ply").exists()
    (tmp_path / "page.html").unlink()
    assert cli(*page)[0] == 0  # without its sequence
    assert "There is no ground truth" in (tmp_path / "page.html").read_text()


@pytest.mark.parametrize(
    "place",
    [
        ("settings",),
        ("sequence",),
        ("seconds",),
        ("frames",),
        ("frames", 0, "points"),
        ("edges", 0, "covariance"),
        ("edges", 1, "outcome"),
        ("poses", 0, "object_from_camera"),
        ("poses", 1),
    ],
)
@pytest.mark.parametrize("value", ["gone", [1.0, 2.0], {}])
def test_damage_of_a_report_is_found(built: Path, place: tuple[str | int, ...], value: object) -> None:
    report = within = json.loads((built / "report.json").read_bytes())
    for key in place[:-1]:
        within = within[key]
    if value == "gone":
        del within[place[-1]]
    else:
        within[place[-1]] = value
    harmless = (place, value) in ((("poses", 1), "gone"), (("settings",), {}), (("seconds",), {}))
    assert (fault(report) is None) == harmless


def test_a_damaged_report_is_one_line(built: Path, tmp_path: Path, refusal: Callable[..., str]) -> None:
    shutil.copytree(built, tmp_path / "run", ignore=shutil.ignore_patterns("*.rrd", "*.ply"))
    path = tmp_path / "run" / "report.json"
    path.write_text(json.dumps(json.loads(path.read_bytes()) | {"poses": [{}]}))
    for command in (
        ["report"],
        ["convert", "--out", tmp_path / "poses.txt"],
        ["export", "--voxel-m", "0.01", "--out", tmp_path / "m.ply"],
        ["evaluate", "--out", tmp_path],
        ["join", built, "--out", tmp_path / "joined"],
    ):
        said = refusal(command[0], tmp_path / "run", *command[1:])
        assert f"{path}: " in said
        assert "build the run again" in said


@pytest.mark.slow
def test_a_joined_run_is_judged_where_its_parts_know_one_surface(
    built: Path, tmp_path: Path, cli: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    joined = tmp_path / "joined"
    shutil.copytree(built, tmp_path / "other")
    monkeypatch.setattr("modeler.pipeline.joining.Matcher", lambda: Matcher(rotations=40, scored=5))
    assert cli("join", built, tmp_path / "other", "--out", joined, "--pairs", "2")[0] in (0, 3)
    status, out, err = cli("evaluate", joined, "--out", tmp_path / "scores")
    assert (status, err) == (0, "")
    assert [line.split()[3] for line in out.splitlines()[1:]] == ["6"] * 4
    found = json.loads((tmp_path / "scores" / "models.json").read_bytes())["models"]
    assert {row["poses"]: row["f_5mm"] > 0.8 for row in found if row["over"] == "seen"} == {"run": True, "true": True}


def test_sequences_and_runs_are_not_mixed(built: Path, tmp_path: Path, refusal: Callable[..., str]) -> None:
    refusal("evaluate", BOX, built, "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def _without(scene: Path, built: Path, folder: Path, *names: str) -> tuple[Path, Path]:
    """Return a copy of the sequence without some files, and of the run as if it was made of that."""
    sequence, run = folder / "train" / "000001", folder / "run"
    shutil.copytree(scene, sequence, ignore=shutil.ignore_patterns("rgb", *names))
    shutil.copytree(built, run, ignore=shutil.ignore_patterns("*.rrd"))
    report = json.loads((run / "report.json").read_bytes())
    (run / "report.json").write_text(json.dumps(report | {"sequence": str(sequence)}))
    return sequence, run


@pytest.mark.parametrize(
    ("missing", "stated"), [("model.ply", "no true surface"), ("scene_gt.json", "no ground truth")]
)
def test_runs_without_truth_are_refused_in_one_line(
    scene: Path, built: Path, tmp_path: Path, refusal: Callable[..., str], missing: str, stated: str
) -> None:
    _, run = _without(scene, built, tmp_path, missing)
    assert stated in refusal("evaluate", run, "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_the_true_surface_may_lie_in_the_models_folder_of_a_dataset(scene: Path, built: Path, tmp_path: Path) -> None:
    sequence, _ = _without(scene, built, tmp_path, "model.ply")
    objects = json.loads((sequence / "scene_gt.json").read_bytes())
    number = objects["0"][0]["obj_id"]
    mesh = true_mesh(open_sequence(BOX))
    (tmp_path / "models").mkdir()
    in_mm = trimesh.Trimesh(1e3 * mesh.vertices_m, mesh.triangles, process=False)
    in_mm.export(tmp_path / "models" / f"obj_{number:06d}.ply")
    found = true_mesh(open_sequence(sequence))
    np.testing.assert_allclose(_bounds(found.vertices_m), _bounds(mesh.vertices_m), atol=1e-6)


def _bounds(vertices_m: Array) -> Array:
    return np.stack([vertices_m.min(axis=0), vertices_m.max(axis=0)])
