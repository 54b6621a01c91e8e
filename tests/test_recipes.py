"""Recipes, and the shapes and trajectories they name: what files say is what is built, and every fault is one line."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from input_errors import refused
from slow_cases import sampled

from modeler import se3
from modeler.sequences.meshes import Mesh, outer_surface, ply_bytes
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import (
    Hand,
    Place,
    Places,
    RobotReadings,
    Tabletop,
    Turntable,
    Viewpoint,
    load_recipe,
)
from modeler.sequences.rendering.shapes import (
    AnyShape,
    Box,
    Capsule,
    Compound,
    Cone,
    Cylinder,
    Extrusion,
    Lathe,
    MeshFile,
    Part,
    Sphere,
    Torus,
    ear_clipped,
)
from modeler.types import InputError
from studies.calibration.specimens import load_specimen, recipe_names


@pytest.mark.parametrize("name", sampled(recipe_names(), every=12))
def test_recipes_stand_on_the_table_in_view(name: str) -> None:
    recipe = load_specimen(name)
    assert recipe.name == name
    sequence = RenderedSequence(recipe)
    truth = sequence.truth()
    assert len(sequence) >= 12
    vertices_m = recipe.object.mesh().vertices_m
    table_from_camera = se3.inverse(recipe.view.camera_from_table())
    for pose in truth.values():
        seen = se3.transform(pose, vertices_m)
        reach_px = np.abs(recipe.view.focal_px * seen[:, :2] / seen[:, 2:]).max(axis=0)
        assert reach_px[0] < 0.94 * recipe.view.width / 2
        assert reach_px[1] < 0.92 * recipe.view.height / 2
        low_m = se3.transform(table_from_camera, seen)[:, 2].min()
        if isinstance(recipe.trajectory, Hand):
            assert low_m > 0.0
        else:
            assert low_m == pytest.approx(0.0, abs=1e-9)


def test_toml_and_json_say_the_same(tmp_path: Path) -> None:
    (tmp_path / "r.json").write_text(
        '{"object": {"kind": "cylinder", "radius_m": 0.03, "height_m": 1}, "wall": {"distance_m": 0.7},'
        ' "trajectory": {"kind": "places", "poses": [{}, {"offset_m": [0, 0.1, 0]}]}, "sensor": {"disparity": null}}'
    )
    (tmp_path / "r.toml").write_text(
        'object = {kind = "cylinder", radius_m = 0.03, height_m = 1}\n[wall]\ndistance_m = 0.7\n'
        '[trajectory]\nkind = "places"\nposes = [{}, {offset_m = [0, 0.1, 0]}]\n[sensor.disparity]\nsigma_px = 0.0\n'
    )
    json_recipe, toml_recipe = load_recipe(tmp_path / "r.json"), load_recipe(str(tmp_path / "r.toml"))
    assert json_recipe.object == toml_recipe.object == Cylinder(0.03, 1.0)
    assert json_recipe.trajectory == toml_recipe.trajectory == Places((Place(), Place((0.0, 0.1, 0.0))))
    assert json_recipe.wall == toml_recipe.wall
    assert json_recipe.sensor.disparity is None
    assert json_recipe.sensor.jitter is not None  # the other effects stay
    assert replace(json_recipe, sensor=toml_recipe.sensor) == toml_recipe


def test_mesh_files_are_found_beside_the_recipe(tmp_path: Path) -> None:
    (tmp_path / "part.ply").write_bytes(ply_bytes(Box((100, 100, 100)).mesh()))
    (tmp_path / "r.json").write_text('{"object": {"kind": "mesh_file", "path": "part.ply", "scale": 0.001}}')
    mesh = load_recipe(tmp_path / "r.json").object.mesh()
    np.testing.assert_allclose(np.ptp(mesh.vertices_m, axis=0), 0.1)


BOX = '{"kind": "box", "size_m": [0.1, 0.1, 0.1]}'
FAULTS = {
    "not JSON": ("{", "line 1"),
    "no object": ("{}", '"object"'),
    "object a text": ('{"object": "mug"}', "object"),
    "no kind": ('{"object": {"size_m": [1, 1, 1]}}', '"kind"'),
    "unknown kind": ('{"object": {"kind": "cube"}}', "cylinder"),
    "kind a number": ('{"object": {"kind": 3}}', "cylinder"),
    "misspelt key": (f'{{"object": {BOX}, "sede": 3}}', "did you mean seed?"),
    "strange key": (f'{{"object": {BOX}, "zzzz": 3}}', "it takes object"),
    "wrong kind": (f'{{"object": {BOX}, "view": {{"kind": "wide"}}}}', "is not known"),
    "short list": ('{"object": {"kind": "box", "size_m": [0.1, 0.1]}}', "3 values"),
    "text for number": ('{"object": {"kind": "sphere", "radius_m": "big"}}', '"object"."radius_m"'),
    "NaN": ('{"object": {"kind": "sphere", "radius_m": NaN}}', "finite"),
    "negative radius": ('{"object": {"kind": "sphere", "radius_m": -1}}', "radius_m must be positive"),
    "zero size": ('{"object": {"kind": "box", "size_m": [0.1, 0, 0.1]}}', "size_m must be positive"),
    "fat torus": ('{"object": {"kind": "torus", "radius_m": 0.1, "tube_radius_m": 0.2}}', "radius_m must be positive"),
    "clockwise": (
        '{"object": {"kind": "extrusion", "height_m": 1, "outline_m": [[0, 0], [0, 1], [1, 1], [1, 0]]}}',
        "counter-clockwise",
    ),
    "crossing": (
        '{"object": {"kind": "extrusion", "height_m": 1, "outline_m": [[0, 0], [1, 1], [1, 0], [0, 1]]}}',
        "counter-clockwise",
    ),
    "thin profile": ('{"object": {"kind": "lathe", "profile_m": [[0, 0], [0, 1]]}}', "profile_m must be positive"),
    "empty compound": ('{"object": {"kind": "compound", "parts": []}}', "must not be empty"),
    "bad part": (f'{{"object": {{"kind": "compound", "parts": [{{"shape": {BOX}, "rgb": [1, 2, 300]}}]}}}}', "255"),
    "seed negative": (f'{{"object": {BOX}, "seed": -1}}', "seed must not be negative"),
    "seed broken": (f'{{"object": {BOX}, "seed": 1.5}}', "whole number"),
    "masks a number": (f'{{"object": {BOX}, "masks": 1}}', "true or false"),
    "colour": (f'{{"object": {BOX}, "colour": "bmp"}}', '"jpg"'),
    "no frames": (f'{{"object": {BOX}, "trajectory": {{"kind": "hand", "frames": 0}}}}', "number of frames"),
    "far shifts": (f'{{"object": {BOX}, "trajectory": {{"kind": "tabletop", "shift_m": 1}}}}', "reach_m"),
    "wobble negative": (
        f'{{"object": {BOX}, "trajectory": {{"kind": "tabletop", "wobble_m": -1}}}}',
        "not be negative",
    ),
    "wobble in a hand": (f'{{"object": {BOX}, "trajectory": {{"kind": "hand", "wobble_deg": 1}}}}', "is not known"),
    "no baseline": (f'{{"object": {BOX}, "sensor": {{"baseline_m": 0}}}}', "baseline_m must not be 0"),
    "ranges": (f'{{"object": {BOX}, "sensor": {{"min_range_m": 9}}}}', "less than max_range_m"),
    "bad effect": (f'{{"object": {BOX}, "sensor": {{"mixed": {{"probability": 2}}}}}}', "from 0 to 1"),
    "grazing": (f'{{"object": {BOX}, "sensor": {{"grazing": {{"start_deg": 89}}}}}}', "less than end_deg"),
    "view": (f'{{"object": {BOX}, "view": {{"distance_m": 0}}}}', "distance_m positive"),
    "huge view": (f'{{"object": {BOX}, "view": {{"width": 100000}}}}', "from 2 to 8192"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_one_line_that_names_the_recipe(tmp_path: Path, fault: str) -> None:
    text, says = FAULTS[fault]
    path = tmp_path / "r.json"
    path.write_text(text)
    with refused(says, str(path)):
        load_recipe(path)


def test_a_recipe_nested_without_end_is_refused(tmp_path: Path) -> None:
    shape: dict = {"kind": "box", "size_m": [1, 1, 1]}
    for _ in range(180):
        shape = {"kind": "compound", "parts": [{"shape": shape}]}
    (tmp_path / "r.json").write_text(json.dumps({"object": shape}))
    with pytest.raises(InputError, match="nested too deeply"):
        load_recipe(tmp_path / "r.json")


def test_unknown_recipes_and_meshes_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"teapott: .* bottle, .*can, .*teapot"):
        load_recipe("teapott")
    with pytest.raises(InputError, match="no such file"):
        load_recipe(tmp_path / "nothing.json")
    with pytest.raises(InputError, match="no such file"):
        MeshFile(tmp_path / "nothing.ply").mesh()
    (tmp_path / "broken.ply").write_bytes(b"ply\nnonsense")
    (tmp_path / "empty.obj").write_bytes(b"# nothing\n")
    for name in ("broken.ply", "empty.obj"):
        with refused(name):
            MeshFile(tmp_path / name).mesh()


def test_the_camera_looks_at_the_table() -> None:
    view = Viewpoint(distance_m=0.8, elevation_deg=35, look_height_m=0.05)
    camera_from_table = view.camera_from_table()
    np.testing.assert_allclose(camera_from_table[:3, :3] @ camera_from_table[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera_from_table) == pytest.approx(1.0)
    np.testing.assert_allclose(camera_from_table @ [0, 0, 0.05, 1], [0, 0, 0.8, 1], atol=1e-12)
    up, right = camera_from_table[:3, 2], camera_from_table[:3, 0]
    assert up[1] < 0  # up on the table is up in the image, where y points down
    np.testing.assert_allclose(right, [1, 0, 0], atol=1e-12)
    eye_m = se3.inverse(camera_from_table)[:3, 3]
    assert eye_m[2] - 0.05 == pytest.approx(0.8 * np.sin(np.radians(35)))


# Shapes: closed surfaces of the right size, their unions, and what the built-in recipes are made of.

PI = np.pi
L_OUTLINE = ((0.0, 0.0), (0.14, 0.0), (0.14, 0.025), (0.025, 0.025), (0.025, 0.09), (0.0, 0.09))
CUP = ((0.0, 0.0), (0.04, 0.0), (0.04, 0.1), (0.03, 0.1), (0.03, 0.01), (0.0, 0.01))
SOLIDS: dict[str, tuple[AnyShape, float]] = {
    "box": (Box((0.1, 0.2, 0.3)), 0.1 * 0.2 * 0.3),
    "cylinder": (Cylinder(0.03, 0.2), PI * 0.03**2 * 0.2),
    "cone": (Cone(0.03, 0.1), PI * 0.03**2 * 0.1 / 3),
    "frustum": (Cone(0.03, 0.1, 0.01), PI * 0.1 * (0.03**2 + 0.03 * 0.01 + 0.01**2) / 3),
    "funnel": (Cone(0.0, 0.1, 0.03), PI * 0.03**2 * 0.1 / 3),
    "sphere": (Sphere(0.05), 4 / 3 * PI * 0.05**3),
    "capsule": (Capsule(0.02, 0.1), PI * 0.02**2 * 0.1 + 4 / 3 * PI * 0.02**3),
    "torus": (Torus(0.05, 0.01), 2 * PI**2 * 0.05 * 0.01**2),
    "handle": (Torus(0.05, 0.01, 210), 2 * PI**2 * 0.05 * 0.01**2 * 210 / 360),
    "cup": (Lathe(CUP), PI * (0.04**2 * 0.1 - 0.03**2 * 0.09)),
    "bracket": (Extrusion(L_OUTLINE, 0.06), (0.14 * 0.025 + 0.025 * 0.065) * 0.06),
    "stretched": (Compound((Part(Sphere(0.05), stretch=(1, 2, 0.5)),)), 4 / 3 * PI * 0.05**3),
}


def volume_m3(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.corners(), 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def assert_closed(mesh: Mesh) -> None:
    edges = mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    there, back = (np.sort(edges @ weights) for weights in ([len(mesh.vertices_m), 1], [1, len(mesh.vertices_m)]))
    assert np.all(np.diff(there) > 0)  # no edge is run through twice in one direction ...
    assert np.array_equal(there, back)  # ... and each is in the other: closed, and oriented alike


def area_m2(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.corners(), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_and_of_the_right_volume(name: str) -> None:
    shape, expected_m3 = SOLIDS[name]
    mesh = shape.mesh()
    assert_closed(mesh)
    assert volume_m3(mesh) == pytest.approx(expected_m3, rel=0.02)  # facets lie inside; positive: outwards
    assert volume_m3(mesh) <= expected_m3 * (1 + 1e-9)


def test_facets_of_round_shapes_are_fine() -> None:
    for radius_m in (0.005, 0.03, 0.1):
        middles = Cylinder(radius_m, 0.1).mesh().corners()
        edges = 0.5 * (middles + np.roll(middles, -1, axis=1)).reshape(-1, 3)
        rims = edges[np.abs(np.abs(edges[:, 2]) - 0.05) < 1e-9]
        outside = np.hypot(rims[:, 0], rims[:, 1])
        outside = outside[outside > 0.75 * radius_m]  # the rest are spokes of the discs
        assert outside.min() > radius_m - 16e-6


def test_the_outer_surface_of_a_union_has_its_area() -> None:
    cross = Compound((Part(Box((0.1, 0.04, 0.04))), Part(Box((0.03, 0.1, 0.03)), rgb=(9, 8, 7))))
    expected_m2 = (4 * 0.1 * 0.04 + 2 * 0.04**2) + 2 * 4 * 0.03 * 0.03  # what two caps add, two holes take
    surface = outer_surface(cross.mesh())
    assert area_m2(surface) == pytest.approx(expected_m2, rel=0.01)
    assert area_m2(cross.mesh()) > expected_m2 * 1.1
    inner = np.abs(surface.corners().mean(axis=1)) < np.array([0.05, 0.02, 0.02]) - 1.1e-3
    assert not inner.all(axis=1).any()
    assert {tuple(rgb) for rgb in surface.albedo.tolist()} == {(190, 190, 190), (9, 8, 7)}


def test_the_outer_surface_finds_a_small_part_in_a_large_face() -> None:
    button = Compound((Part(Box((0.2, 0.2, 0.2))), Part(Sphere(0.004), offset_m=(0.03, 0.02, 0.1))))
    expected_m2 = 6 * 0.2**2 - PI * 0.004**2 + 2 * PI * 0.004**2
    assert area_m2(outer_surface(button.mesh())) == pytest.approx(expected_m2, abs=8e-6)


def test_ply_files_are_read_back(tmp_path: Path) -> None:
    mesh = SOLIDS["bracket"][0].mesh()
    path = tmp_path / "m.ply"
    path.write_bytes(ply_bytes(mesh))
    loaded = trimesh.load_mesh(path)
    assert loaded.is_watertight
    assert loaded.volume == pytest.approx(volume_m3(mesh), rel=1e-5)
    again = MeshFile(path, scale=2.0).mesh()
    assert volume_m3(again) == pytest.approx(8 * volume_m3(mesh), rel=1e-5)


def lathes(shape: AnyShape) -> list[Lathe]:
    if isinstance(shape, Compound):
        return [lathe for part in shape.parts for lathe in lathes(part.shape)]
    return [shape] if isinstance(shape, Lathe) else []


@pytest.mark.parametrize("name", sampled(recipe_names(), every=12))
def test_recipes_are_well_formed_and_of_a_size_to_handle(name: str) -> None:
    shape = load_specimen(name).object
    mesh = shape.mesh()
    assert 0.05 < np.ptp(mesh.vertices_m, axis=0).max() < 0.3
    for number in np.unique(mesh.part):
        part = mesh.only(mesh.part == number)
        assert_closed(part)
        assert volume_m3(part) > 0.0
    for lathe in lathes(shape):
        bottom, *_, top = lathe.profile_m
        ends = [(0.0, height) for radius, height in (top, bottom) if radius > 0.0]
        ear_clipped(np.array([*lathe.profile_m, *ends]))  # complains of a profile that crosses itself


# Trajectories: how objects move on tables, on turntables and in hands.


def motions(table_from_object: np.ndarray) -> np.ndarray:
    return table_from_object[1:] @ se3.inverse(table_from_object[:-1])


def test_an_object_pushed_about_stays_upright_and_near() -> None:
    poses = Tabletop(2000, 25, 3, 0.03, 0.05).table_from_object(np.zeros(3), np.random.default_rng(0))
    np.testing.assert_allclose(poses[:, 2], np.broadcast_to([0, 0, 1, 0], (2000, 4)), atol=1e-12)
    assert np.hypot(poses[:, 0, 3], poses[:, 1, 3]).max() <= 0.05
    turns_deg = np.degrees(se3.rotation_angle(motions(poses)))
    assert np.mean(turns_deg) == pytest.approx(25, abs=0.3)
    assert np.std(turns_deg) == pytest.approx(3, abs=0.2)
    shifts_m = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)
    assert shifts_m.min() >= 0.015 - 1e-12
    assert shifts_m.max() <= 0.045 + 1e-12


def test_a_turntable_keeps_its_axis() -> None:
    poses = Turntable(50, 24, 0.5).table_from_object(np.zeros(3), np.random.default_rng(0))
    for motion in motions(poses):
        np.testing.assert_allclose(motion[:3, 3], 0.0, atol=1e-12)
        np.testing.assert_allclose(se3.log(motion)[:2], 0.0, atol=1e-12)
        assert np.degrees(se3.log(motion)[2]) == pytest.approx(24, abs=2.5)


@pytest.mark.parametrize("kind", [Tabletop, Turntable])
def test_motions_wobble_as_much_as_is_said(kind: type[Tabletop | Turntable]) -> None:
    wobbling = kind(4001, wobble_deg=0.2, wobble_m=0.0007).table_from_object(np.zeros(3), np.random.default_rng(0))
    tilted = motions(wobbling)[:, :3, 2]  # where motions take the vertical
    np.testing.assert_allclose(np.degrees(tilted[:, :2].std(axis=0)), 0.2, rtol=0.05)
    np.testing.assert_allclose(np.degrees(tilted[:, :2].mean(axis=0)), 0.0, atol=0.01)
    lifts_m = np.diff(wobbling[:, 2, 3])
    assert np.std(lifts_m) == pytest.approx(0.0007, rel=0.05)
    assert abs(np.corrcoef(tilted[:, 0], lifts_m)[0, 1]) < 0.06


@pytest.mark.parametrize("kind", [Tabletop, Turntable])
@pytest.mark.parametrize(("wobble_deg", "wobble_m"), [(0.2, 0.0), (0.0, 0.0007), (0.2, 0.0007)])
def test_a_wobble_is_about_the_foot_and_changes_nothing_else(
    kind: type[Tabletop | Turntable], wobble_deg: float, wobble_m: float
) -> None:
    true = kind(50).table_from_object(np.zeros(3), np.random.default_rng(0))
    trajectory = kind(50, wobble_deg=wobble_deg, wobble_m=wobble_m)
    wobbling = trajectory.table_from_object(np.zeros(3), np.random.default_rng(0))
    wobble = se3.inverse(true) @ wobbling
    turn, lift_m = se3.log(wobble)[:, :3], wobble[:, :3, 3]
    np.testing.assert_allclose(turn[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(lift_m[:, :2], 0.0, atol=1e-12)
    assert len(np.unique(turn[:, :2])) == (100 if wobble_deg else 1)  # every frame its own, the first too
    assert len(np.unique(lift_m[:, 2])) == (50 if wobble_m else 1)
    shorter = replace(trajectory, frames=20).table_from_object(np.zeros(3), np.random.default_rng(0))
    np.testing.assert_array_equal(shorter, wobbling[:20])


def test_a_hand_turns_the_object_about_its_centre() -> None:
    centre_m = np.array([0.0, 0.0, 0.07])
    hand = Hand(400, 18, 3, 0.01, height_m=0.15)
    poses = hand.table_from_object(centre_m, np.random.default_rng(0))
    places_m = (poses @ np.append(centre_m, 1.0))[:, :3]
    np.testing.assert_allclose(places_m.mean(axis=0), [0, 0, 0.15], atol=0.003)
    np.testing.assert_allclose(places_m.std(axis=0), 0.01, rtol=0.15)
    assert np.degrees(se3.rotation_angle(motions(poses))).mean() == pytest.approx(18, abs=0.5)
    axes = se3.log(motions(poses))[:, :3]
    assert np.linalg.matrix_rank(axes, tol=1.0) == 3  # it turns every way


def test_a_robot_reads_its_hand_with_the_noise_it_says() -> None:
    poses = np.broadcast_to(se3.exp(np.arange(6) / 10), (4000, 4, 4))
    read = RobotReadings(2.0, 0.005).camera_from_hand(poses, np.random.default_rng(0))
    spread = se3.log(se3.inverse(poses) @ read).std(axis=0)
    np.testing.assert_allclose(spread, np.repeat([np.radians(2.0), 0.005], 3), rtol=0.05)
