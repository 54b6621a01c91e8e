"""What a run leaves is read by other programs as it was meant: poses, graph, and meshes in every format."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
import open3d as o3d
import pytest
import trimesh
from PIL import Image
from run_builders import an_edge, ball, block, made_up_steps, strict_json
from scipy.spatial.transform import Rotation
from turning_box import steps

from modeler import se3
from modeler.export import (
    RunMeta,
    format_of,
    g2o_text,
    mesh_of,
    model_upright,
    placement,
    read_model,
    report_of,
    simplified,
    textured,
    tinted,
    tum_text,
    write_bop,
    write_mesh,
)
from modeler.export.files import cloud_ply, mesh_ply
from modeler.export.mesh import MADE_UP_RGB
from modeler.export.placing import upright
from modeler.export.reading import fault
from modeler.fusion import Fuser
from modeler.runs.reopening import reopened
from modeler.system.pictures import raycaster, tensor
from modeler.types import Array, BoolArray, InputError, ObjectModel, Plane, Step


def loaded_mesh(path: Path) -> Any:
    """The one mesh in a file, as trimesh reads it (its types are too wide to be of use)."""
    loaded = trimesh.load(path, process=False)
    if isinstance(loaded, trimesh.Scene):
        (loaded,) = loaded.geometry.values()
    return loaded


def glb_tree(path: Path) -> dict[str, Any]:
    """The JSON of a GLB file: its first chunk, after a header of 12 bytes and its own of 8."""
    data = path.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


def glb_colours(path: Path) -> Array:
    """The colours (n, 3) of the vertices of a GLB file as a screen shows them: encoded as sRGB, 0 to 255."""
    tree, data = glb_tree(path), path.read_bytes()
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"]) == (5126, "VEC3")
    view = tree["bufferViews"][accessor["bufferView"]]
    start = 28 + int.from_bytes(data[12:16], "little") + view["byteOffset"]
    linear = np.frombuffer(data, "<f4", 3 * accessor["count"], start).reshape(-1, 3).astype(np.float64)
    return 255.0 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def seen_ball(views: npt.NDArray[np.int64]) -> ObjectModel:
    """A ball whose vertices so many views saw: to 1 mm, where any did."""
    return replace(ball(), vertex_views=views, vertex_sigmas_m=np.where(views == 0, np.inf, 1e-3))


@pytest.mark.parametrize("coloured", [True, False])
def test_a_glb_is_matt_and_no_metal(tmp_path: Path, coloured: bool) -> None:
    write_mesh(ball(coloured=coloured), tmp_path / "ball.glb")
    tree = glb_tree(tmp_path / "ball.glb")
    (primitive,) = tree["meshes"][0]["primitives"]
    material = tree["materials"][primitive["material"]]["pbrMetallicRoughness"]
    assert (material["metallicFactor"], material["roughnessFactor"]) == (0.0, 1.0)
    assert material.get("baseColorFactor", [1, 1, 1, 1]) == [1, 1, 1, 1]
    assert {*primitive["attributes"]} == {"POSITION", "NORMAL", *(("COLOR_0",) if coloured else ())}


@pytest.mark.parametrize("coloured", [True, False])
def test_3mf_is_read_by_its_library_with_unit_and_colours(tmp_path: Path, coloured: bool) -> None:
    lib3mf = pytest.importorskip("lib3mf")
    model, out = ball(coloured=coloured), tmp_path / "ball.3mf"
    write_mesh(model, out)
    content = lib3mf.get_wrapper().CreateModel()
    reader = content.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile(str(out))
    assert reader.GetWarningCount() == 0
    assert content.GetUnit() == lib3mf.ModelUnit.Meter
    objects = content.GetMeshObjects()
    assert objects.MoveNext()
    solid = objects.GetCurrentMeshObject()
    assert solid.IsManifoldAndOriented()
    places = np.array([tuple(vertex.Coordinates) for vertex in solid.GetVertices()])
    corners = np.array([tuple(triangle.Indices) for triangle in solid.GetTriangleIndices()])
    np.testing.assert_allclose(places[corners], model.vertices_m[model.triangles], atol=1e-7)
    if coloured:
        properties = solid.GetAllTriangleProperties()
        group = content.GetColorGroupByID(properties[0].ResourceID)
        for corner, found in zip(corners, properties, strict=True):
            colours = [group.GetColor(number) for number in found.PropertyIDs]
            given = [(colour.Red, colour.Green, colour.Blue) for colour in colours]
            np.testing.assert_array_equal(given, model.vertex_colours[corner])
    before = out.read_bytes()
    write_mesh(model, out)
    assert out.read_bytes() == before


def test_a_format_whose_library_is_missing_is_said_before_any_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"lib3mf is not installed; .* -m pip install 'modeler\[3mf\]'"):
        format_of(Path("ball.3mf"))


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
    step = made_up_steps(6)[-1]
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
    step = made_up_steps(4)[-1]
    refused = replace(step.edges_so_far[-1], accepted=False)
    rng = np.random.default_rng(0)
    outlier, other = an_edge(3, 7, rng, "closure"), an_edge(100, 101, rng)
    solution = replace(step.solution, outliers=(outlier,))
    text = g2o_text([*step.edges_so_far[:-1], refused, outlier, other], solution)
    assert [line.split()[1:3] for line in text.splitlines() if line.startswith("EDGE")] == [
        ["3", "5"], ["5", "7"], ["7", "9"]
    ]  # fmt: skip


@pytest.mark.parametrize("coloured", [True, False])
def test_ply_is_read_by_open3d_and_trimesh(tmp_path: Path, coloured: bool) -> None:
    model = ball(coloured=coloured)
    (tmp_path / "model.ply").write_bytes(mesh_ply(model))
    (tmp_path / "cloud.ply").write_bytes(cloud_ply(model))

    mesh = o3d.io.read_triangle_mesh(tmp_path / "model.ply")
    np.testing.assert_allclose(np.asarray(mesh.vertices), model.vertices_m, atol=1e-7)
    np.testing.assert_array_equal(np.asarray(mesh.triangles), model.triangles)
    np.testing.assert_allclose(np.asarray(mesh.vertex_normals), model.vertex_normals, atol=1e-6)
    assert mesh.has_vertex_colors() == coloured
    theirs = loaded_mesh(tmp_path / "model.ply")
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
    model = ball()
    run = tmp_path / "run"
    run.mkdir()
    (run / "model.ply").write_bytes(mesh_ply(model))
    out = tmp_path / "new folder" / f"box.{suffix}"
    write_mesh(read_model(mesh_of(run)), out)
    mesh = loaded_mesh(out)
    expected = model.vertices_m[model.triangles]
    np.testing.assert_allclose(mesh.triangles, expected, atol=1e-6)  # same place, same order, same side out
    if suffix.lower() != "stl":
        np.testing.assert_allclose(mesh.vertex_normals, model.vertex_normals, atol=1e-5)
        colours = glb_colours(out) if suffix == "glb" else mesh.visual.vertex_colors[:, :3]
        np.testing.assert_allclose(colours, np.asarray(model.vertex_colours), atol=1)
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_vertices_tell_who_saw_them(tmp_path: Path) -> None:
    model = ball()
    views = np.arange(len(model.vertices_m))
    sigmas_m = np.where(views == 0, np.inf, 1e-3 / np.maximum(views, 1))
    path = tmp_path / "model.ply"
    path.write_bytes(mesh_ply(replace(model, vertex_views=views, vertex_sigmas_m=sigmas_m)))
    mesh = loaded_mesh(path)
    columns = mesh.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(columns["views"].ravel(), views)
    np.testing.assert_allclose(columns["sigma_m"].ravel(), np.where(views == 0, -1.0, sigmas_m), rtol=1e-6)
    np.testing.assert_allclose(mesh.vertices, model.vertices_m, atol=1e-6)
    np.testing.assert_allclose(np.asarray(o3d.io.read_triangle_mesh(path).vertices), model.vertices_m, atol=1e-6)


def test_a_mesh_that_is_read_back_writes_the_same_bytes(tmp_path: Path) -> None:
    for model in (ball(), ball(coloured=False), seen_ball(np.arange(len(ball().vertices_m)))):
        (tmp_path / "model.ply").write_bytes(mesh_ply(model))
        assert mesh_ply(read_model(tmp_path / "model.ply")) == (tmp_path / "model.ply").read_bytes()


def test_stl_of_a_closed_mesh_is_watertight_and_manifold_also_with_fewer_triangles(tmp_path: Path) -> None:
    for name, model in (("all", ball()), ("few", simplified(ball(), 100))):
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
    model = seen_ball(np.where(ball().vertices_m[:, 2] > 0.8, 3, 0))
    fewer = simplified(model, 150)
    assert 100 < len(fewer.triangles) <= 150
    radius = np.linalg.norm(fewer.vertices_m - [0.0, 0.0, 0.8], axis=1)
    assert np.abs(radius - 0.05).max() < 1.5e-3
    clear = np.abs(fewer.vertices_m[:, 2] - 0.8) > 0.015
    np.testing.assert_array_equal((fewer.vertex_views > 0)[clear], (fewer.vertices_m[:, 2] > 0.8)[clear])
    outward = (fewer.vertices_m - [0.0, 0.0, 0.8]) / radius[:, None]
    assert np.sum(outward * fewer.vertex_normals, axis=1).min() > 0.95
    assert simplified(model, 10**6) is model
    with pytest.raises(InputError, match=r"^3 triangles"):
        simplified(model, 3)


def test_flat_surface_needs_few_triangles_and_moves_by_less_than_its_deviation(rng: np.random.Generator) -> None:
    cube = trimesh.creation.box((0.1, 0.1, 0.1))
    for _ in range(5):
        cube = cube.subdivide()
    sigmas_m = np.full(len(cube.vertices), 3e-4)
    sigmas_m[:50] = np.inf  # interpolated
    noise_m = 0.1 * sigmas_m[-1] * rng.standard_normal(cube.vertices.shape)
    model = replace(
        ball(coloured=False),
        vertices_m=np.asarray(cube.vertices) + noise_m,
        triangles=np.asarray(cube.faces, dtype=np.int64),
        vertex_normals=np.asarray(cube.vertex_normals),
        vertex_sigmas_m=sigmas_m,
    )
    fewer = simplified(model)
    assert len(fewer.triangles) < 0.1 * len(model.triangles)
    assert trimesh.Trimesh(fewer.vertices_m, fewer.triangles).is_watertight
    places = tensor(model.vertices_m.astype(np.float32))
    away_m = raycaster(fewer.vertices_m, fewer.triangles).compute_distance(places).numpy()
    assert np.quantile(away_m, 0.99) < 3e-4
    unknown = replace(model, vertex_sigmas_m=None)
    assert simplified(unknown) is unknown


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_texture_shows_each_point_its_colour(tmp_path: Path, suffix: str) -> None:
    def paint(points: Array, normals: Array, _: npt.NDArray[np.uint8]) -> tuple[npt.NDArray[np.uint8], BoolArray]:
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
        return np.rint(255.0 * ((points - [0.0, 0.0, 0.8]) / 0.1 + 0.5)).astype(np.uint8), points[:, 0] > 0.0

    model, texture = textured(ball(), paint, 256)
    assert texture.image.shape == (256, 256, 3)
    areas_m2 = np.pi * 0.1**2, (256.0 * texture.texel_m) ** 2  # of the ball, and of all of the image
    assert 0.4 < areas_m2[0] / areas_m2[1] < 0.9
    out = tmp_path / f"a ball.{suffix}"  # other programs end names at spaces
    write_mesh(model, out, texture)
    beside = {"a_ball_seen.png"} | ({"a_ball.mtl", "a_ball.png"} if suffix == "obj" else set())
    assert {path.name for path in tmp_path.iterdir()} == {out.name} | beside
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a_ball_seen.png")), 255 * texture.seen)
    mesh = loaded_mesh(out)
    assert {frozenset(map(tuple, t)) for t in np.round(mesh.triangles, 5)} == {
        frozenset(map(tuple, t)) for t in np.round(ball().vertices_m[ball().triangles], 5)
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
    def plain(points: Array, *_: npt.NDArray[np.generic]) -> tuple[npt.NDArray[np.uint8], BoolArray]:
        return np.full((len(points), 3), 7, dtype=np.uint8), np.ones(len(points), dtype=bool)

    model, texture = textured(ball(), plain, 64)
    with pytest.raises(InputError, match="has no textures"):
        write_mesh(model, tmp_path / "ball.stl", texture)
    assert not list(tmp_path.iterdir())


def test_bop_model_is_in_mm_about_its_centre_with_its_entry(tmp_path: Path) -> None:
    folder = tmp_path / "models"
    place = placement(ball(), {"poses": [], "up": [0.0, -0.6, -0.8]}, "bbox", "z")
    write_bop(ball(), folder / "obj_000007.ply", place)
    write_bop(ball(), folder / "obj_000002.ply", place)
    entries = strict_json((folder / "models_info.json").read_text())
    assert list(entries) == ["2", "7"]
    entry = entries["7"]
    assert entry["diameter"] == pytest.approx(100.0, abs=0.5)
    for axis in "xyz":
        assert entry[f"size_{axis}"] == pytest.approx(100.0, abs=0.5)
        assert entry[f"min_{axis}"] == pytest.approx(-50.0, abs=0.3)
    mesh = loaded_mesh(folder / "obj_000007.ply")
    back = se3.transform(np.reshape(entry["object_from_mesh"], (4, 4)), np.asarray(mesh.vertices) / 1000.0)
    np.testing.assert_allclose(back, ball().vertices_m, atol=1e-6)
    header = (folder / "obj_000007.ply").read_bytes().split(b"end_header")[0].decode()
    kinds = {line.split()[1] for line in header.splitlines() if line.startswith("property") and "list" not in line}
    assert kinds <= {"float", "double", "int", "uchar"}  # what BOP's own reader takes
    for broken, words in (("{", "not valid JSON"), ("[1]", "lists no objects"), ('{"cup": {}}', "lists no objects")):
        (folder / "models_info.json").write_text(broken)
        with pytest.raises(InputError, match=words):
            write_bop(ball(), folder / "obj_000007.ply", place)
        assert (folder / "models_info.json").read_text() == broken
    with pytest.raises(InputError, match="PLY files"):
        write_bop(ball(), folder / "model.obj", place)


def test_tints_tell_what_is_known_of_vertices() -> None:
    views = np.arange(len(ball().vertices_m)) % 5
    model = replace(ball(), vertex_views=views, vertex_sigmas_m=np.where(views == 0, np.inf, 1e-3 / (views + 1e-9)))
    for tint in ("views", "sigma"):
        colours = tinted(model, tint).vertex_colours
        assert len(np.unique(np.asarray(colours), axis=0)) == 5
        made_up = np.all(colours == MADE_UP_RGB, axis=1)
        np.testing.assert_array_equal(made_up, views == 0)
    with pytest.raises(InputError, match="has no view counts"):
        tinted(ball(), "views")


def test_mesh_that_cannot_be_exported_is_said_in_one_line(tmp_path: Path) -> None:
    empty = replace(ball(), triangles=np.zeros((0, 3), dtype=np.int64))
    (tmp_path / "empty.ply").write_bytes(mesh_ply(empty))
    (tmp_path / "broken.ply").write_bytes(mesh_ply(ball())[:3000])
    (tmp_path / "good.ply").write_bytes(mesh_ply(ball()))
    (tmp_path / "file").write_text("")
    for source, out, words in (
        ("missing", "a.obj", "no such mesh"),
        (".", "a.obj", "no such mesh"),
        ("empty.ply", "a.obj", "no triangles"),
        ("broken.ply", "a.ply", "broken.ply"),
        ("good.ply", "a.fbx", "unknown mesh format '.fbx'; use .ply, .obj, .glb, .stl"),
        ("good.ply", "a", "a: no suffix selects the mesh format; use .ply"),
        ("good.ply", "file/a.obj", "cannot be written"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            write_mesh(read_model(mesh_of(tmp_path / source)), tmp_path / out)
        assert "\n" not in str(caught.value)
    assert {path.name for path in tmp_path.iterdir()} == {"empty.ply", "broken.ply", "good.ply", "file"}


# What stood on a table, or turned in front of the camera, is shown upright.

META = RunMeta(sequence="box", seed=0, prior="table")


@pytest.fixture(scope="module")
def last() -> Step:
    return list(steps())[-1]


def _looking_down(tilt_deg: float) -> Array:
    """What is up for a camera that looks down by so many degrees."""
    return np.array([0.0, -np.cos(np.radians(tilt_deg)), -np.sin(np.radians(tilt_deg))])


def _on(step: Step, up: Array) -> Step:
    """The step with a support under the object in the first frame."""
    views = dict(step.views)
    views[0] = replace(views[0], plane=Plane(up, 0.5, 0.01, 0.001))
    return replace(step, views=views)


def _stands(rotation: Array, up: Array) -> None:
    """Check that a rotation's columns are right, down and forward, as a camera that looks down on what is up has it."""
    right, down, forward = rotation.T
    np.testing.assert_allclose(down, -up, atol=1e-9)
    np.testing.assert_allclose(right, [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.cross(right, down), forward, atol=1e-9)


def _tower(up: Array) -> ObjectModel:
    """A long box in front of the camera, whose long side points up."""
    side, pose = np.cross(up, [0.0, 0.0, 1.0]), se3.translation(np.array([0.1, 0.2, 0.8]))
    pose[:3, :3] = np.stack([side, np.cross(up, side), up], axis=1)
    return block((0.05, 0.05, 0.3), pose)


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 60.0])
def test_a_glb_stands_as_the_object_stood(tmp_path: Path, last: Step, tilt_deg: float) -> None:
    """In glTF y is up and z points at the viewer: what the camera looked down on leans in no viewer."""
    up = _looking_down(tilt_deg)
    write_mesh(_tower(up), tmp_path / "tower.glb", object_from_upright=model_upright(report_of(_on(last, up), META)))
    shown = trimesh.load_scene(tmp_path / "tower.glb").to_mesh()
    assert shown.extents[1] == pytest.approx(0.3, abs=1e-6)
    (kept,) = trimesh.load_scene(tmp_path / "tower.glb").geometry.values()
    np.testing.assert_allclose(kept.vertices, _tower(up).vertices_m, atol=1e-6)  # the node turns, the mesh stays
    assert shown.volume == pytest.approx(kept.volume)  # turned, not mirrored
    np.testing.assert_allclose(shown.vertices[:, 0], kept.vertices[:, 0], atol=1e-6)  # from the camera's side


def test_a_glb_of_an_unknown_support_is_shown_as_the_camera_saw_it(tmp_path: Path) -> None:
    model = _tower(_looking_down(35.0))
    write_mesh(model, tmp_path / "tower.glb")
    shown = trimesh.load_scene(tmp_path / "tower.glb").to_mesh()
    np.testing.assert_allclose(shown.vertices, model.vertices_m * [1.0, -1.0, -1.0], atol=1e-6)


def test_the_report_tells_what_was_up_in_the_object_frame(last: Step) -> None:
    up = _looking_down(35.0)
    report = report_of(_on(last, up), META)
    np.testing.assert_allclose(report["up"], up)
    assert fault(report) is None
    np.testing.assert_allclose(model_upright(report)[:, 1], -up, atol=1e-9)
    assert report_of(last, META)["up"] is None


@pytest.mark.parametrize("wrong", [[0.0, 0.0, 0.0], [0.0, 1.0], [0.0, None, 1.0], "up", [0.0, 0.0, 1e300]])
def test_what_is_no_direction_is_found_out(last: Step, wrong: object) -> None:
    assert "'up'" in (fault(report_of(last, META) | {"up": wrong}) or "")


def test_reports_of_earlier_versions_stand_by_the_ring_of_their_cameras(last: Step) -> None:
    report = report_of(_on(last, _looking_down(35.0)), META)
    del report["up"]
    assert fault(report) is None
    np.testing.assert_allclose(model_upright(report)[:, 1], [0.0, 1.0, 0.0], atol=1e-6)  # the run turns about y


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 60.0])
def test_what_turned_on_a_table_stands_upright(tilt_deg: float) -> None:
    """The camera looks down on the ring that it makes around the object, by so many degrees."""
    up = _looking_down(tilt_deg)
    turns = [se3.exp(np.concatenate([angle * up, np.zeros(3)])) for angle in np.linspace(0.0, 5.0, 8)]
    poses = [turn @ se3.translation(np.array([0.0, 0.0, -0.7])) for turn in turns]
    records = [
        {"id": k, "object_from_camera": pose.ravel(), "covariance": np.eye(6).ravel()} for k, pose in enumerate(poses)
    ]
    _stands(model_upright({"poses": records}), up)
    for few in (1, 2):
        assert np.array_equal(model_upright({"poses": records[:few]}), np.eye(3))


def test_a_support_that_is_seen_lies_level_in_a_view(last: Step) -> None:
    view, up = last.views[0], _looking_down(35.0)
    _stands(upright(replace(view, plane=Plane(up, 0.5, 0.01, 0.001))), up)
    above = replace(view, plane=Plane(np.array([0.0, 0.0, -1.0]), 0.5, 0.01, 0.001))
    for without in (above, replace(view, plane=None)):
        assert np.array_equal(upright(without), np.eye(3))


def test_a_model_that_is_fused_again_is_as_uncertain(built: Path) -> None:
    run, before = reopened(built), read_model(built / "model.ply")
    model = run.model(run.volume(Fuser()))
    sigmas_m = [np.asarray(one.vertex_sigmas_m) for one in (model, before)]
    np.testing.assert_allclose(*sigmas_m, rtol=1e-3)
