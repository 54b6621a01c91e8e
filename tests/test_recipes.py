"""Recipes: what files say is what is built, it stands in view, and every fault is one line."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration.specimens import load_specimen, recipe_names
from refusal import refused
from slow import sampled

from modeler import se3
from modeler.types import InputError
from sequences.rendering.meshes import ply_bytes
from sequences.rendering.recipe import Recipe, Viewpoint, load_recipe
from sequences.rendering.renderer import RenderedSequence
from sequences.rendering.shapes import Box, Cylinder, MeshFile, Sphere
from sequences.rendering.trajectory import Hand, Place, Places, Tabletop, Turntable


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
        u = recipe.view.focal_px * seen[:, :2] / seen[:, 2:] + recipe.view.camera().cx * np.array([1, 0])
        assert np.abs(u[:, 0] - 319.5).max() < 300
        assert np.abs(u[:, 1]).max() < 220
        low_m = se3.transform(table_from_camera, seen)[:, 2].min()
        if isinstance(recipe.trajectory, Hand):
            assert low_m > 0.0
        else:
            assert low_m == pytest.approx(0.0, abs=1e-9)


def test_symmetric_shapes_are_symmetric_and_the_others_are_not() -> None:
    def turned_onto_itself(name: str, angle_deg: float) -> bool:
        mesh = load_specimen(name).object.mesh()
        angle = np.radians(angle_deg)
        turn = se3.exp(np.array([0.0, 0.0, angle, 0.0, 0.0, 0.0]))
        turned = se3.transform(turn, mesh.vertices_m)
        gaps = np.linalg.norm(turned[:, None] - mesh.vertices_m, axis=2).min(axis=1)
        return bool(gaps.max() < 1e-9)

    assert turned_onto_itself("two_fold", 180)
    assert not turned_onto_itself("two_fold", 90)
    assert turned_onto_itself("four_fold", 90)
    assert not turned_onto_itself("four_fold", 45)
    assert not turned_onto_itself("l_bracket", 180)
    assert not turned_onto_itself("held", 180)


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
    assert json_recipe.sensor is not None
    assert json_recipe.sensor.disparity is None
    assert json_recipe.sensor.jitter is not None  # the other effects stay
    assert replace(json_recipe, sensor=toml_recipe.sensor) == toml_recipe


@pytest.mark.parametrize("kind", [Tabletop, Turntable])
def test_recipes_may_say_how_much_motions_wobble(tmp_path: Path, kind: type[Tabletop | Turntable]) -> None:
    path = tmp_path / "r.json"
    wobble = {"kind": kind.__name__.lower(), "wobble_deg": 0.2, "wobble_m": 7e-4}
    path.write_text(json.dumps({"object": json.loads(BOX), "trajectory": wobble}))
    assert load_recipe(path).trajectory == kind(wobble_deg=0.2, wobble_m=7e-4)
    truth = np.array(list(RenderedSequence(load_recipe(path)).truth().values()))
    table_from_object = se3.inverse(Viewpoint().camera_from_table()) @ truth
    assert 0.0 < np.degrees(np.abs(table_from_object[:, :2, 2])).max() < 1.0  # the truth is what wobbles
    assert 0.0 < np.abs(table_from_object[:, 2, 3] - 0.05).max() < 0.003


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


def test_recipes_are_values() -> None:
    assert Recipe(Sphere(0.1)) == Recipe(Sphere(0.1))
    assert hash(Recipe(Sphere(0.1))) != hash(Recipe(Sphere(0.2)))
