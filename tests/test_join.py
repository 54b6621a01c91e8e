"""Two runs of one object, upright and lying: joined to one model, and exported."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tabletop
import trimesh

from modeler import se3
from modeler.cli import main
from modeler.export import RunFolder, RunMeta
from modeler.fusion import Fuser, Matcher
from modeler.graph import PoseGraph, solve
from modeler.rays import Sensor
from modeler.types import Array, Edge, Outcome, PoseGaussian, Posterior, Segmentation, Step
from sequences.bop import BopSequence

FIGURE = {
    "kind": "compound",
    "parts": [
        {"shape": {"kind": "sphere", "radius_m": 0.045}, "offset_m": [0, 0, 0.05], "stretch": [1, 0.8, 1.1]},
        {"shape": {"kind": "sphere", "radius_m": 0.03}, "offset_m": [0.015, -0.005, 0.12], "rgb": [90, 160, 90]},
        {
            "shape": {"kind": "capsule", "radius_m": 0.013, "height_m": 0.05},
            "offset_m": [0.03, 0.04, 0.07],
            "rotation_deg": [35, 60, 0],
        },
        {"shape": {"kind": "cylinder", "radius_m": 0.036, "height_m": 0.014}, "offset_m": [0.004, 0, 0.007]},
    ],
}
LYING = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.045], [0.0, 0.0, 0.0, 1.0]])
COVARIANCE = np.diag([1e-3, 1e-3, 1e-3, 5e-4, 5e-4, 5e-4]) ** 2


def recipe(name: str, shape: dict[str, Any], seed: int) -> dict[str, Any]:
    return {
        "name": name,
        "seed": seed,
        "object": shape,
        "trajectory": {"kind": "turntable", "frames": 9, "step_deg": 40, "step_sigma_deg": 0.5},
        "view": {"width": 320, "height": 240, "focal_px": 400, "distance_m": 0.7, "look_height_m": 0.04},
        "table": {"size_m": [0.64, 0.84]},
        "colour": "png",
    }


def true_run(sequence: BopSequence, path: Path) -> None:
    """Write the run folder of a build that found every motion."""
    truth, noise = sequence.truth(), sequence.sensor()
    assert truth is not None
    assert noise is not None
    views = {frame.index: Sensor(*noise).ray_image(frame) for frame in sequence}
    edges = []
    for before, after in [*zip(sequence.indices, sequence.indices[1:], strict=False), (0, sequence.indices[-1])]:
        pose = PoseGaussian(truth[before] @ se3.inverse(truth[after]), COVARIANCE)
        kind = "odometry" if after - before == 1 else "closure"
        edges.append(Edge(Posterior(after, before, pose, Outcome.CONVERGED, overlap=0.9), kind, True, "true"))
    solution = solve(PoseGraph(tuple(edges), first=0), {})
    folder = RunFolder.open(path)
    meta = RunMeta(sequence=str(sequence.path), seed=0, prior="turntable")
    for k, view in views.items():
        last = k == max(views)
        assert view.frame.mask is not None
        step = Step(
            frame=view.frame,
            segmentation=Segmentation(view.frame.mask, None, Outcome.CONVERGED),
            view=view,
            posteriors=(),
            edges=(),
            outcome="accepted",
            solution=solution,
            model=Fuser().fuse(views, solution.trajectory) if last else None,
            edges_so_far=tuple(edges),
            views=views,
            last=last,
        )
        folder.write(step, meta)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path, dict[int, Array]]:
    """Return two runs, the run that joins them, and true object_from_camera but for the object frame, by number."""
    folder = tmp_path_factory.mktemp("join")
    lying = {"kind": "compound", "parts": [{"shape": FIGURE, "offset_m": [0, 0, 0.045], "rotation_deg": [90, 0, 0]}]}
    poses: dict[int, Array] = {}
    for name, shape, seed in (("upright", FIGURE, 3), ("lying", lying, 4)):
        (folder / f"{name}.json").write_text(json.dumps(recipe(name, shape, seed)))
        assert main(["render", str(folder / f"{name}.json"), "--out", str(folder / name)]) == 0
        sequence = BopSequence(folder / name)
        true_run(sequence, folder / f"{name}_run")
        upright_from_model = np.eye(4) if name == "upright" else se3.inverse(LYING)
        for k, pose in (sequence.truth() or {}).items():
            poses[k + (9 if name == "lying" else 0)] = upright_from_model @ se3.inverse(pose)
    parts = folder / "upright_run", folder / "lying_run"
    status = main(["join", *map(str, parts), "--out", str(folder / "joined"), "--pairs", "4"])
    assert status == 0
    return *parts, folder / "joined", poses


def test_frames_of_both_runs_find_their_places(runs: tuple[Path, Path, Path, dict[int, Array]]) -> None:
    report = RunFolder(runs[2]).report()
    assert [frame["id"] for frame in report["frames"]] == list(range(18))
    assert report["settings"]["joined"] == [str(run) for run in runs[:2]]
    poses = {pose["id"]: np.reshape(pose["object_from_camera"], (4, 4)) for pose in report["poses"]}
    base = poses[0] @ se3.inverse(runs[3][0])
    for k, pose in poses.items():
        off = se3.inverse(base @ runs[3][k]) @ pose
        assert np.degrees(se3.rotation_angle(off)) < 2.0
    assert {path.name for path in runs[2].iterdir()} == {
        "model.ply", "cloud.ply", "trajectory.txt", "odometry.txt", "graph.g2o", "recording.rrd", "report.json"
    }  # fmt: skip
    joining = [edge for edge in report["edges"] if edge["source"] >= 9 > edge["target"]]
    assert len(joining) == 4
    assert sum(edge["accepted"] for edge in joining) >= 2


def test_a_joined_model_has_what_each_run_hid(runs: tuple[Path, Path, Path, dict[int, Array]]) -> None:
    areas = [trimesh.load_mesh(run / "model.ply", process=False).area for run in runs[:3]]
    assert areas[2] > 1.02 * max(areas[:2])
    mesh = trimesh.load_mesh(runs[2] / "model.ply", process=False)
    report = RunFolder(runs[2]).report()
    object_from_model = np.reshape(report["poses"][0]["object_from_camera"], (4, 4)) @ se3.inverse(runs[3][0])
    bottom = se3.transform(se3.inverse(object_from_model), np.asarray(mesh.vertices))
    under = (np.abs(bottom[:, 2]) < 3e-3) & (np.hypot(bottom[:, 0] - 0.004, bottom[:, 1]) < 0.025)
    assert under.sum() > 50  # only the lying run shows it


def test_exports_made_anew_from_the_frames(
    runs: tuple[Path, Path, Path, dict[int, Array]], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "figure.stl"
    assert main(["export", str(runs[2]), "--out", str(out), "--watertight", "--triangles", "4000"]) == 0
    assert "% of the vertices of" in capfd.readouterr().err
    mesh = trimesh.load_mesh(out)
    assert mesh.is_volume
    assert 3000 < len(mesh.faces) <= 4000
    assert mesh.volume == pytest.approx(5.1e-4, rel=0.08)  # of the parts, less where they overlap


def test_a_textured_export_shows_the_colours(runs: tuple[Path, Path, Path, dict[int, Array]], tmp_path: Path) -> None:
    out = tmp_path / "figure.glb"
    assert main(["export", str(runs[0]), "--out", str(out), "--texture", "--triangles", "1500"]) == 0
    (mesh,) = trimesh.load_scene(out).geometry.values()
    image = np.asarray(mesh.visual.material.baseColorTexture)[:, :, :3].reshape(-1, 3).astype(float)
    green = image[:, 1] - image[:, 0]
    assert 0.05 < (green > 30.0).mean() < 0.5  # the head


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--texture", "--out", "a.stl"], "--texture goes with"),
        (["--bop", "--out", "a.obj"], "BOP models are PLY files"),
        (["--tint", "views", "--out", "a.stl"], "STL carries no colour"),
        (["--triangles", "2", "--out", "a.stl"], "--triangles 2 is too few"),
        (["--voxel-m", "-1", "--out", "a.stl"], "--voxel-m -1 is out of range"),
        (["--texture", "--tint", "views", "--out", "a.glb"], "give one of them"),
        (["--watertight", "--sequence", "nowhere", "--out", "a.stl"], "say where it is with --sequence"),
    ],
)
def test_exports_that_cannot_be_are_said_in_one_line(
    runs: tuple[Path, Path, Path, dict[int, Array]],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    arguments = [str(tmp_path / word) if word.startswith("a.") else word for word in arguments]
    assert main(["export", str(runs[0]), *arguments]) == 2
    told = capfd.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert not list(tmp_path.iterdir())


def scanned(body: tabletop.Body, object_from_model: Array, change: Callable[[Array], Array]) -> Any:
    poses = [change(pose) for pose in tabletop.turntable(8)]
    return Fuser(voxel_m=0.004).scanned(tabletop.views(body, poses), tabletop.trajectory(poses, object_from_model))


def test_models_are_laid_on_each_other_from_any_side() -> None:
    brick = tabletop.Box((0.07, 0.05, 0.03))
    moved = se3.exp(np.array([2.0, -0.7, 1.1, 0.2, 0.1, -0.3]))
    one, other = scanned(brick, np.eye(4), lambda pose: pose), scanned(brick, moved, lambda pose: pose)
    best, *rest = Matcher(rotations=120, judged=15).matches(one, other, (one.model(), other.model()))
    laid = se3.transform(best.target_from_source, other.model().points_m)
    assert np.quantile(np.abs(brick.distance(laid)), 0.95) < 2e-3
    assert best.score > 0.85
    assert all(match.score <= best.score for match in rest)


def test_the_size_of_voxels_is_checked_before_a_build(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["build", str(tmp_path), "--out", str(tmp_path / "run"), "--voxel-m", "0"]) == 2
    assert "--voxel-m 0 is out of range" in capfd.readouterr().err
    assert not (tmp_path / "run").exists()


def test_joins_that_cannot_be_are_said_in_one_line(
    runs: tuple[Path, Path, Path, dict[int, Array]], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    for arguments, words in (
        ([str(runs[0]), str(runs[1]), "--out", str(tmp_path)], "not empty"),
        ([str(runs[0]), str(tmp_path / "none"), "--out", str(tmp_path / "new")], "there is no report"),
        ([str(runs[0]), str(runs[1]), "--out", str(tmp_path / "new"), "--pairs", "0"], "--pairs 0"),
        ([str(runs[0]), str(runs[1]), "--out", str(tmp_path / "new"), "--seed", "-1"], "--seed -1"),
    ):
        assert main(["join", *arguments]) == 2
        told = capfd.readouterr().err
        assert words in told
        assert told.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
