"""The run folder: what stands in it is whole, exact, and read by other programs as it was meant."""

import json
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
import open3d as o3d
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.export import (
    RunFolder,
    RunMeta,
    edges_of,
    g2o_text,
    mesh_of,
    poses_of,
    read_model,
    report_of,
    simplified,
    textured,
    tinted,
    tum_text,
    write_atomically,
    write_bop,
    write_mesh,
)
from modeler.export.ply import cloud_ply, mesh_ply
from modeler.export.tints import MADE_UP_RGB
from modeler.graph import PoseGraph, solve
from modeler.types import (
    Array,
    Camera,
    Edge,
    EdgeKind,
    Frame,
    InputError,
    ObjectModel,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    Segmentation,
    Step,
)

META = RunMeta(sequence="box", seed=3, prior="table", settings={"every": 1}, seconds={"total": 1.5})
FILES = {"trajectory.txt", "odometry.txt", "graph.g2o", "report.json", "cloud.ply", "model.ply"}


def _model(*, coloured: bool = True) -> ObjectModel:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    normals = np.asarray(ball.vertices / 0.05)
    rng = np.random.default_rng(0)
    colours = rng.integers(0, 256, size=(len(normals), 3), dtype=np.uint8) if coloured else None
    cloud = np.asarray(ball.vertices) + np.array([0.0, 0.0, 0.8])
    return ObjectModel(cloud[::2], normals[::2], None if colours is None else colours[::2], cloud,
                       np.asarray(ball.faces, dtype=np.int64), normals, colours)  # fmt: skip


def _loaded(path: Path) -> Any:
    """The one mesh in a file, as trimesh reads it (its types are too wide to be of use)."""
    loaded = trimesh.load(path, process=False)
    if isinstance(loaded, trimesh.Scene):
        (loaded,) = loaded.geometry.values()
    return loaded


def _edge(target: int, source: int, rng: np.random.Generator, kind: EdgeKind = "odometry", **changes: Any) -> Edge:
    step = np.array([0.02, 0.4 * (source - target), 0.01, -0.3 * (source - target), 0.0, 0.05])
    factor = rng.normal(size=(6, 6)) * 0.003 + 0.004 * np.eye(6)
    pose = PoseGaussian(se3.exp(step + 0.005 * rng.normal(size=6)), factor @ factor.T)
    posterior = Posterior(source, target, pose, Outcome.CONVERGED, overlap=0.81, effective_samples=1234.5)
    return Edge(replace(posterior, **changes), kind, True, "made up")


def _steps(count: int = 4, *, closure: bool = True) -> list[Step]:
    """A run of `count` frames numbered 3, 5, 7 …"""
    rng = np.random.default_rng(1)
    camera = Camera(4, 3, 500.0, 500.0, 1.5, 1.0)
    graph, views, steps = PoseGraph(first=3), {}, []
    for number in range(count):
        index, last = 3 + 2 * number, number == count - 1
        frame = Frame(index, 0.1 * index, np.full((3, 4), 0.8, dtype=np.float32), camera)
        pixels = np.zeros((5, 2), dtype=np.int64)
        view = RayImage(frame, None, 0.001, 0.001, np.ones((5, 3)), np.ones((5, 3)), pixels)
        edges = [_edge(index - 2, index, rng)] if number else []
        if last and closure:
            edges.append(_edge(3, index, rng, "closure"))
        graph, views = graph.plus(edges), {**views, index: view}
        steps.append(
            Step(
                frame=frame,
                segmentation=Segmentation(np.ones((3, 4), dtype=bool), None, Outcome.CONVERGED),
                view=view,
                posteriors=tuple(edge.posterior for edge in edges),
                edges=tuple(edges),
                outcome="accepted",
                solution=solve(graph, {}),
                model=_model(),
                edges_so_far=graph.edges,
                views=views,
                last=last,
            )
        )
    return steps


def _strict(text: str) -> Any:
    """Parse JSON as the standard has it: no NaN, no Infinity."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_trajectory_reads_back_to_the_last_digit() -> None:
    rng = np.random.default_rng(2)
    trajectory = {k: se3.exp(rng.normal(size=6)) for k in (9, 2, 4)}
    text = tum_text(trajectory, {2: 1305031102.175304, 4: 1305031102.211214, 9: 1305031103.0})
    lines = [np.array(line.split(" "), dtype=np.float64) for line in text.splitlines()]
    assert [line[0] for line in lines] == [1305031102.175304, 1305031102.211214, 1305031103.0]
    for frame, line in zip((2, 4, 9), lines, strict=True):
        np.testing.assert_array_equal(line[1:4], trajectory[frame][:3, 3])
        np.testing.assert_allclose(Rotation.from_quat(line[4:]).as_matrix(), trajectory[frame][:3, :3], atol=1e-15)
        assert line[7] >= 0.0


def test_graph_reads_back_in_gtsam_with_the_same_error(tmp_path: Path) -> None:
    step = _steps(6)[-1]
    path = tmp_path / "graph.g2o"
    path.write_text(g2o_text(step.edges_so_far, step.solution))
    factors, values = gtsam.readG2o(str(path), True)
    assert factors.size() == len(step.edges_so_far) == 6
    assert set(values.keys()) == set(step.solution.trajectory)
    for frame, pose in step.solution.trajectory.items():
        np.testing.assert_allclose(values.atPose3(frame).matrix(), pose, atol=1e-14)
    # The error of every factor at poses well away from the optimum, against the definition.
    rng = np.random.default_rng(4)
    moved = {frame: pose @ se3.exp(0.05 * rng.normal(size=6)) for frame, pose in step.solution.trajectory.items()}
    for frame, pose in moved.items():
        values.update(frame, gtsam.Pose3(pose))
    for number, edge in enumerate(step.edges_so_far):
        xi = se3.log(se3.inverse(edge.posterior.pose.mean) @ se3.inverse(moved[edge.target]) @ moved[edge.source])
        expected = 0.5 * xi @ np.linalg.solve(edge.posterior.pose.covariance, xi)
        assert factors.at(number).error(values) == pytest.approx(expected, rel=1e-9)


def test_graph_holds_only_edges_that_take_part() -> None:
    step = _steps(4)[-1]
    refused = replace(step.edges_so_far[-1], accepted=False)
    outlier, other = _edge(3, 7, np.random.default_rng(0), "closure"), _edge(100, 101, np.random.default_rng(0))
    solution = replace(step.solution, outliers=(outlier,))
    text = g2o_text([*step.edges_so_far[:-1], refused, outlier, other], solution)
    assert [line.split()[1:3] for line in text.splitlines() if line.startswith("EDGE")] == [
        ["3", "5"], ["5", "7"], ["7", "9"]
    ]  # fmt: skip


@pytest.mark.parametrize("coloured", [True, False])
def test_ply_is_read_by_open3d_and_trimesh(tmp_path: Path, coloured: bool) -> None:
    model = _model(coloured=coloured)
    (tmp_path / "model.ply").write_bytes(mesh_ply(model))
    (tmp_path / "cloud.ply").write_bytes(cloud_ply(model))

    mesh = o3d.io.read_triangle_mesh(tmp_path / "model.ply")
    np.testing.assert_allclose(np.asarray(mesh.vertices), model.vertices_m, atol=1e-7)
    np.testing.assert_array_equal(np.asarray(mesh.triangles), model.triangles)
    np.testing.assert_allclose(np.asarray(mesh.vertex_normals), model.vertex_normals, atol=1e-6)
    assert mesh.has_vertex_colors() == coloured
    theirs = _loaded(tmp_path / "model.ply")
    np.testing.assert_allclose(theirs.vertices, model.vertices_m, atol=1e-7)
    np.testing.assert_array_equal(theirs.faces, model.triangles)
    np.testing.assert_allclose(theirs.vertex_normals, model.vertex_normals, atol=1e-6)

    cloud = o3d.io.read_point_cloud(tmp_path / "cloud.ply")
    np.testing.assert_allclose(np.asarray(cloud.points), model.points_m, atol=1e-7)
    np.testing.assert_allclose(np.asarray(cloud.normals), model.normals, atol=1e-6)
    if model.colours is not None and model.vertex_colours is not None:
        np.testing.assert_array_equal(np.round(255.0 * np.asarray(cloud.colors)), model.colours)
        np.testing.assert_array_equal(np.round(255.0 * np.asarray(mesh.vertex_colors)), model.vertex_colours)
        np.testing.assert_array_equal(theirs.visual.vertex_colors[:, :3], model.vertex_colours)


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb", "stl", "STL"])
def test_exported_mesh_is_the_same_surface(tmp_path: Path, suffix: str) -> None:
    model = _model()
    run = tmp_path / "run"
    run.mkdir()
    (run / "model.ply").write_bytes(mesh_ply(model))
    out = tmp_path / "new folder" / f"box.{suffix}"
    write_mesh(read_model(mesh_of(run)), out)
    mesh = _loaded(out)
    expected = model.vertices_m[model.triangles]
    np.testing.assert_allclose(mesh.triangles, expected, atol=1e-6)  # same place, same order, same side out
    if suffix.lower() != "stl":
        np.testing.assert_allclose(mesh.vertex_normals, model.vertex_normals, atol=1e-5)
        assert model.vertex_colours is not None
        np.testing.assert_allclose(mesh.visual.vertex_colors[:, :3], model.vertex_colours, atol=1)
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_vertices_tell_who_saw_them(tmp_path: Path) -> None:
    model = _model()
    views = np.arange(len(model.vertices_m))
    sigmas_m = np.where(views == 0, np.inf, 1e-3 / np.maximum(views, 1))
    path = tmp_path / "model.ply"
    path.write_bytes(mesh_ply(replace(model, vertex_views=views, vertex_sigmas_m=sigmas_m)))
    mesh = _loaded(path)
    columns = mesh.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(columns["views"].ravel(), views)
    np.testing.assert_allclose(columns["sigma_m"].ravel(), np.where(views == 0, -1.0, sigmas_m), rtol=1e-6)
    np.testing.assert_allclose(mesh.vertices, model.vertices_m, atol=1e-6)
    np.testing.assert_allclose(np.asarray(o3d.io.read_triangle_mesh(path).vertices), model.vertices_m, atol=1e-6)


def test_a_mesh_that_is_read_back_writes_the_same_bytes(tmp_path: Path) -> None:
    views = np.arange(len(_model().vertices_m))
    for model in (
        _model(),
        _model(coloured=False),
        replace(_model(), vertex_views=views, vertex_sigmas_m=np.where(views == 0, np.inf, 1e-3)),
    ):
        (tmp_path / "model.ply").write_bytes(mesh_ply(model))
        assert mesh_ply(read_model(tmp_path / "model.ply")) == (tmp_path / "model.ply").read_bytes()


def test_stl_of_a_closed_mesh_is_watertight_and_manifold_also_with_fewer_triangles(tmp_path: Path) -> None:
    for name, model in (("all", _model()), ("few", simplified(_model(), 100))):
        path = tmp_path / f"{name}.stl"
        write_mesh(model, path)
        mesh = trimesh.load_mesh(path)  # corners at one place become one vertex
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.is_volume
        theirs = o3d.io.read_triangle_mesh(path).merge_close_vertices(1e-6)
        assert theirs.is_edge_manifold(allow_boundary_edges=False)
        assert theirs.is_vertex_manifold()
    assert len(mesh.faces) <= 100


def test_simplified_keeps_the_shape_and_what_is_known_of_it() -> None:
    views = np.where(_model().vertices_m[:, 2] > 0.8, 3, 0)
    model = replace(_model(), vertex_views=views, vertex_sigmas_m=np.where(views == 0, np.inf, 1e-3))
    fewer = simplified(model, 150)
    assert 100 < len(fewer.triangles) <= 150
    radius = np.linalg.norm(fewer.vertices_m - [0.0, 0.0, 0.8], axis=1)
    assert np.abs(radius - 0.05).max() < 1.5e-3
    assert fewer.vertex_views is not None
    clear = np.abs(fewer.vertices_m[:, 2] - 0.8) > 0.015
    np.testing.assert_array_equal((fewer.vertex_views > 0)[clear], (fewer.vertices_m[:, 2] > 0.8)[clear])
    outward = (fewer.vertices_m - [0.0, 0.0, 0.8]) / radius[:, None]
    assert np.sum(outward * fewer.vertex_normals, axis=1).min() > 0.95
    assert simplified(model, 10**6) is model
    with pytest.raises(InputError, match="--triangles 3"):
        simplified(model, 3)


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_texture_shows_each_point_its_colour(tmp_path: Path, suffix: str) -> None:
    def paint(points: Array, normals: Array) -> npt.NDArray[np.uint8]:
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
        return np.rint(255.0 * ((points - [0.0, 0.0, 0.8]) / 0.1 + 0.5)).astype(np.uint8)

    model, texture = textured(_model(), paint, 1e-3)
    out = tmp_path / f"a ball.{suffix}"  # other programs end names at spaces
    write_mesh(model, out, texture)
    assert {path.name for path in tmp_path.iterdir()} - {out.name} <= {"a_ball.mtl", "a_ball.png"}
    assert {path.suffix for path in tmp_path.iterdir()} == ({".obj", ".mtl", ".png"} if suffix == "obj" else {".glb"})
    mesh = _loaded(out)
    assert {frozenset(map(tuple, t)) for t in np.round(mesh.triangles, 5)} == {
        frozenset(map(tuple, t)) for t in np.round(_model().vertices_m[_model().triangles], 5)
    }
    material = mesh.visual.material
    image = np.asarray(material.image if suffix == "obj" else material.baseColorTexture)[:, :, :3]
    np.testing.assert_array_equal(image, texture.image)
    u, v = mesh.visual.uv[mesh.faces].mean(axis=1).T  # the middles of the triangles
    height, width = image.shape[:2]
    shown = image[((1.0 - v) * height).astype(int), (u * width).astype(int)].astype(float)
    expected = 255.0 * ((mesh.triangles_center - [0.0, 0.0, 0.8]) / 0.1 + 0.5)
    assert np.abs(shown - expected).max() < 6.0  # half a texel moves a colour by two or three


def test_texture_needs_a_format_that_holds_it(tmp_path: Path) -> None:
    model, texture = textured(_model(), lambda points, _: np.full((len(points), 3), 7, dtype=np.uint8), 2e-3)
    with pytest.raises(InputError, match="holds no texture"):
        write_mesh(model, tmp_path / "ball.stl", texture)
    assert not list(tmp_path.iterdir())


def test_bop_model_is_in_mm_about_its_centre_with_its_entry(tmp_path: Path) -> None:
    folder = tmp_path / "models"
    write_bop(_model(), folder / "obj_000007.ply")
    write_bop(_model(), folder / "obj_000002.ply")
    entries = _strict((folder / "models_info.json").read_text())
    assert list(entries) == ["2", "7"]
    entry = entries["7"]
    assert entry["diameter"] == pytest.approx(100.0, abs=0.5)
    for axis in "xyz":
        assert entry[f"size_{axis}"] == pytest.approx(100.0, abs=0.5)
        assert entry[f"min_{axis}"] == pytest.approx(-50.0, abs=0.3)
    np.testing.assert_allclose(entry["origin_m"], [0.0, 0.0, 0.8], atol=1e-6)
    mesh = _loaded(folder / "obj_000007.ply")
    back = mesh.vertices / 1000.0 + entry["origin_m"]
    np.testing.assert_allclose(back, _model().vertices_m, atol=1e-6)
    header = (folder / "obj_000007.ply").read_bytes().split(b"end_header")[0].decode()
    kinds = {line.split()[1] for line in header.splitlines() if line.startswith("property") and "list" not in line}
    assert kinds <= {"float", "double", "int", "uchar"}  # what BOP's own reader takes
    for broken, words in (("{", "cannot be read"), ("[1]", "lists no objects"), ('{"cup": {}}', "lists no objects")):
        (folder / "models_info.json").write_text(broken)
        with pytest.raises(InputError, match=words):
            write_bop(_model(), folder / "obj_000007.ply")
        assert (folder / "models_info.json").read_text() == broken
    with pytest.raises(InputError, match="PLY files"):
        write_bop(_model(), folder / "model.obj")


def test_tints_tell_what_is_known_of_vertices() -> None:
    views = np.arange(len(_model().vertices_m)) % 5
    model = replace(_model(), vertex_views=views, vertex_sigmas_m=np.where(views == 0, np.inf, 1e-3 / (views + 1e-9)))
    for tint in ("views", "sigma"):
        colours = tinted(model, tint).vertex_colours
        assert colours is not None
        assert len(np.unique(colours, axis=0)) == 5
        made_up = np.all(colours == MADE_UP_RGB, axis=1)
        np.testing.assert_array_equal(made_up, views == 0)
    with pytest.raises(InputError, match="does not tell"):
        tinted(_model(), "views")


def test_mesh_that_cannot_be_exported_is_said_in_one_line(tmp_path: Path) -> None:
    empty = replace(_model(), triangles=np.zeros((0, 3), dtype=np.int64))
    (tmp_path / "empty.ply").write_bytes(mesh_ply(empty))
    (tmp_path / "broken.ply").write_bytes(mesh_ply(_model())[:3000])
    (tmp_path / "good.ply").write_bytes(mesh_ply(_model()))
    (tmp_path / "file").write_text("")
    for source, out, words in (
        ("missing", "a.obj", "no such mesh"),
        (".", "a.obj", "no such mesh"),
        ("empty.ply", "a.obj", "no triangles"),
        ("broken.ply", "a.ply", "broken.ply"),
        ("good.ply", "a.fbx", "unknown mesh format '.fbx'; use .ply, .obj, .glb, .stl"),
        ("good.ply", "a", "a: no ending says the mesh format; use .ply"),
        ("good.ply", "file/a.obj", "cannot be made"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            write_mesh(read_model(mesh_of(tmp_path / source)), tmp_path / out)
        assert "\n" not in str(caught.value)
    assert {path.name for path in tmp_path.iterdir()} == {"empty.ply", "broken.ply", "good.ply", "file"}


def test_run_folder_is_complete_after_the_last_step(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path / "runs" / "box")
    steps = _steps()
    for step in steps:
        run.write(step, META)
        expected = FILES if step.last else FILES - {"cloud.ply", "model.ply"}
        assert {path.name for path in run.path.iterdir()} == expected
    solution = steps[-1].solution
    for name, poses in (("trajectory.txt", solution.trajectory), ("odometry.txt", solution.odometry)):
        lines = np.loadtxt(run.path / name)
        np.testing.assert_allclose(lines[:, 0], [0.3, 0.5, 0.7, 0.9])
        np.testing.assert_array_equal(lines[:, 1:4], np.stack([poses[frame][:3, 3] for frame in (3, 5, 7, 9)]))
    np.testing.assert_array_equal(np.loadtxt(run.path / "trajectory.txt")[0, 1:], [0, 0, 0, 0, 0, 0, 1])


def test_report_has_the_promised_schema(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    for step in _steps():
        run.write(step, META)
    report = _strict((tmp_path / "report.json").read_text())
    assert report == run.report()
    head = {key: report[key] for key in ("schema", "sequence", "seed", "prior", "seconds")}
    assert head == {"schema": 1, "sequence": "box", "seed": 3, "prior": "table", "seconds": {"total": 1.5}}
    assert {"modeler", "gtsam", "numpy", "python"} <= set(report["versions"])
    assert report["frames"][1] == {"id": 5, "timestamp": 0.5, "points": 5, "outcome": "accepted"}
    assert [edge["kind"] for edge in report["edges"]] == ["odometry"] * 3 + ["closure"]
    edge, posterior = report["edges"][0], _steps()[1].posteriors[0]
    assert {key: edge[key] for key in ("source", "target", "accepted", "outcome", "overlap", "effective_samples")} == {
        "source": 5, "target": 3, "accepted": True, "outcome": "converged", "overlap": 0.81, "effective_samples": 1234.5
    }  # fmt: skip
    assert edge["log_evidence"] is None  # not known, and NaN is no JSON
    assert edge["seconds"] is None
    np.testing.assert_array_equal(np.reshape(edge["target_from_source"], (4, 4)), posterior.pose.mean)
    np.testing.assert_array_equal(np.reshape(edge["covariance"], (6, 6)), posterior.pose.covariance)
    assert [pose["id"] for pose in report["poses"]] == [3, 5, 7, 9]
    for pose in report["poses"]:
        np.linalg.cholesky(np.reshape(pose["covariance"], (6, 6)))
        np.testing.assert_allclose(np.reshape(pose["object_from_camera"], (4, 4))[3], [0, 0, 0, 1])
    assert (report["complete"], report["closed"], report["trustworthy"], report["reasons"]) == (True, True, True, [])


def _spoilt(change: Callable[[Step], Step], meta: RunMeta, path: Path) -> dict[str, Any]:
    run = RunFolder.open(path, overwrite=True)
    return [run.write(change(step), meta) for step in _steps(closure=meta.closure_expected is False)][-1]


def test_report_says_why_a_model_is_not_to_be_trusted(tmp_path: Path) -> None:
    lost = "no overlap: The views share too little surface"
    report = _spoilt(lambda step: replace(step, outcome=lost) if step.frame.index == 7 else step, META, tmp_path)
    assert (report["trustworthy"], report["reasons"]) == (False, [f"frame 7 was left out: {lost}"])

    report = _spoilt(lambda step: step, replace(META, closure_expected=True), tmp_path)
    assert (report["trustworthy"], report["closed"]) == (False, False)
    assert "no loop was closed" in report["reasons"][0]

    def refuse(step: Step) -> Step:
        edges = [replace(edge, accepted=edge.kind == "odometry", reason="it lies") for edge in step.edges_so_far]
        return replace(step, edges_so_far=tuple(edges))

    report = _spoilt(refuse, META, tmp_path)
    assert report["reasons"] == ["none of 1 closures closed a loop; the last refused, frame 9 on frame 3: it lies"]

    def break_off(step: Step) -> Step:  # 5 -> 7 falls, so that the closure 9 -> 3 is all that holds the rest
        edges = [replace(edge, accepted=(edge.source, edge.target) != (7, 5)) for edge in step.edges_so_far]
        return replace(step, edges_so_far=tuple(edges))

    report = _spoilt(break_off, META, tmp_path)
    assert report["closed"] is False
    assert report["reasons"] == ["what joins the first frames to the last is confirmed by nothing: no loop was closed"]

    def see_little(step: Step) -> Step:
        edges = [replace(edge, posterior=replace(edge.posterior, overlap=0.45)) for edge in step.edges_so_far]
        return replace(step, edges_so_far=tuple(edges))

    report = _spoilt(see_little, META, tmp_path)  # no edge of a loop stands alone
    assert report["reasons"] == []
    run, chain = RunFolder.open(tmp_path, overwrite=True), replace(META, closure_expected=False)
    report = [run.write(see_little(step), chain) for step in _steps(closure=False)][-1]
    assert [reason.partition(" share")[0] for reason in report["reasons"]] == [
        f"frames {frame} and {frame - 2}" for frame in (5, 7, 9)
    ]

    def leave_out(step: Step) -> Step:
        outliers = tuple(edge for edge in step.edges_so_far if edge.kind == "closure")
        return replace(step, solution=replace(step.solution, outliers=outliers))

    report = _spoilt(leave_out, META, tmp_path)
    assert report["closed"] is False
    assert report["edges"][-1]["accepted"] is False
    assert "contradict" in report["edges"][-1]["reason"]
    assert "contradict" in report["reasons"][0]


def test_report_doubts_a_model_some_of_whose_frames_may_be_turned(tmp_path: Path) -> None:
    """A mug whose handle is hidden for some frames: the loop closes, and yet nothing tells how far it turned there."""

    def vague(*frames: int) -> Callable[[Step], Step]:
        def change(step: Step) -> Step:
            spread = np.diag([0.0, np.radians(9.0) ** 2, 0.0, 0.0, 0.0, 0.0])
            sure = step.solution.covariances
            covariances = {frame: sure[frame] + spread * (frame in frames) for frame in step.solution.trajectory}
            return replace(step, solution=replace(step.solution, covariances=covariances))

        return change

    assert _spoilt(vague(), META, tmp_path)["reasons"] == []
    one, some = (_spoilt(vague(*frames), META, tmp_path) for frames in ((7,), (5, 7, 9)))
    assert (one["closed"], one["trustworthy"]) == (True, False)
    assert one["reasons"] == ["frame 7 may be turned by 9° (one standard deviation)"]
    assert some["reasons"][0].endswith("(one standard deviation), 2 more by over 5°")


def test_report_in_the_middle_of_a_run_says_so(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    report = [run.write(step, META) for step in _steps()[:2]][-1]
    assert (report["complete"], report["trustworthy"]) == (False, False)
    assert "the run has not finished" in report["reasons"]


def test_posteriors_come_back_from_the_report_to_the_bit(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    step = _steps()[-1]
    information = np.linalg.inv(step.edges_so_far[0].posterior.pose.covariance).astype(np.float64)
    rich = replace(
        step.edges_so_far[0].posterior,
        information=information, pareto_k=0.31, log_evidence=-12.3, seconds=0.1, outcome=Outcome.AMBIGUOUS,
    )  # fmt: skip
    edges = (replace(step.edges_so_far[0], posterior=rich), *step.edges_so_far[1:])
    run.write(replace(step, edges_so_far=edges), META)
    report = run.report()
    for edge, back in zip(edges, edges_of(report), strict=True):
        posterior = back.posterior
        assert (back.source, back.target, back.kind) == (edge.source, edge.target, edge.kind)
        assert (back.accepted, back.reason) == (edge.accepted, edge.reason)
        np.testing.assert_array_equal(posterior.pose.mean, edge.posterior.pose.mean)
        np.testing.assert_array_equal(posterior.pose.covariance, edge.posterior.pose.covariance)
        assert posterior.outcome is edge.posterior.outcome
        for name in ("overlap", "effective_samples", "pareto_k", "log_evidence", "seconds"):
            np.testing.assert_equal(getattr(posterior, name), getattr(edge.posterior, name))
        np.testing.assert_array_equal(posterior.information, edge.posterior.information)
    for frame, pose in poses_of(report).items():
        np.testing.assert_array_equal(pose.mean, step.solution.trajectory[frame])
        np.testing.assert_array_equal(pose.covariance, step.solution.covariances[frame])


def test_existing_run_is_not_written_over_unasked(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    for step in _steps():
        run.write(step, META)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / ".model.ply.1234.part").write_text("half")
    before = (tmp_path / "report.json").read_bytes()
    with pytest.raises(InputError, match=r"not empty; choose another --out, or give --overwrite or --resume") as caught:
        RunFolder.open(tmp_path)
    assert "\n" not in str(caught.value)
    assert (tmp_path / "report.json").read_bytes() == before
    (tmp_path / "report.html").write_text("a page about this run")
    RunFolder.open(tmp_path, resume=True)
    assert {path.name for path in tmp_path.iterdir()} == FILES | {"notes.txt", "report.html"}
    RunFolder.open(tmp_path, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_place_that_cannot_hold_a_run_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(InputError, match="choose another --out"):
            RunFolder.open(path, overwrite=True)
    with pytest.raises(InputError, match=r"is .* the folder of a run"):
        RunFolder(tmp_path).report()
    for content in ("{", "[]", '{"schema": 2}'):
        (tmp_path / "report.json").write_text(content)
        with pytest.raises(InputError, match="build again with --overwrite"):
            RunFolder(tmp_path).report()


def test_resumed_run_keeps_what_it_had_until_it_is_there_again(tmp_path: Path) -> None:
    steps = _steps(5)
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
    RunFolder.open(tmp_path).write(_steps()[0], META)
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
    for step in _steps(2):
        run.write(step, META)
        run.pairs.keep(_steps()[-1].edges_so_far[0].posterior, "question")
        assert not run.finished(META)
    run.finish()
    assert run.finished(META)
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"recording.rrd"}
    run.write(_steps(2)[-1], replace(META, interrupted=True))
    run.pairs.keep(_steps(2)[-1].edges_so_far[0].posterior, "question")
    run.finish()
    assert not run.finished(META)
    assert run.pairs.folder.exists()


def test_a_folder_that_takes_long_to_write_is_written_less_often(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, written = 0.0, []
    run, steps = RunFolder.open(tmp_path), _steps(40)

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
    for step in _steps():
        run.write(step, META)
    run.pairs.keep(_steps()[-1].edges_so_far[0].posterior, "question")
    (tmp_path / "report.json").unlink()
    (tmp_path / "notes.txt").write_text("mine")
    RunFolder.open(tmp_path, resume=True)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


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
