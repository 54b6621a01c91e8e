"""The frame of an exported mesh: where its origin lies, what is up, and the pose that takes it back."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from run_builders import ball, block
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.export import AS_GIVEN, default_up, placement, pose_file, write_mesh
from modeler.export.placing import Origin, Up, level_axes
from modeler.types import Array, ObjectModel


def brick(pose: Array) -> ObjectModel:
    """A box of 0.06 m × 0.1 m × 0.2 m; its own z is up, and it stands on z = 0."""
    return block((0.06, 0.1, 0.2), pose @ se3.translation(np.array([0.0, 0.0, 0.1])))


def seen_from(tilt_deg: float) -> Array:
    """The pose, in the camera, of what stands in front of a camera that looks down by so many degrees."""
    up = np.array([0.0, -np.cos(np.radians(tilt_deg)), -np.sin(np.radians(tilt_deg))])
    pose = se3.translation(np.array([0.05, 0.1, 0.7]))
    pose[:3, :3] = level_axes(up)
    return pose


def report_of_a_support(pose: Array) -> dict[str, object]:
    """What a report tells of the plane z = 0 of an object at a pose."""
    up = pose[:3, 2]
    return {"up": up.tolist(), "support_offset_m": -float(up @ pose[:3, 3]), "poses": []}


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 89.0, 90.0])
def test_what_stood_on_a_support_stands_at_the_origin(tilt_deg: float) -> None:
    pose = seen_from(tilt_deg)
    place = placement(brick(pose), report_of_a_support(pose), "base", "z")
    np.testing.assert_allclose(place.object_from_mesh, pose, atol=1e-12)
    assert (place.up_from, place.base_from) == ("support", "support")
    np.testing.assert_allclose(place.placed(brick(pose)).vertices_m.min(axis=0), [-0.03, -0.05, 0.0], atol=1e-12)


@pytest.mark.parametrize("origin", ["camera", "base", "centre", "bbox"])
@pytest.mark.parametrize("up", ["z", "y", None])
def test_the_sidecar_takes_every_export_back(tmp_path: Path, origin: Origin, up: Up | None) -> None:
    pose = seen_from(30.0)
    for suffix in ("obj", "glb", "stl", "ply"):
        model, out = ball() if suffix == "glb" else brick(pose), tmp_path / f"m.{suffix}"
        place = placement(model, report_of_a_support(pose), origin, up)
        assert se3.is_rigid(place.object_from_mesh, tolerance=1e-9, farthest_m=10.0)
        write_mesh(place.placed(model), out, object_from_upright=AS_GIVEN, axes=place.axes)
        place.write(out)
        given = json.loads(pose_file(out).read_text())
        assert (given["mesh"], given["unit"], given["axes"]) == (out.name, "m", place.axes)
        mesh = trimesh.load_mesh(out, process=False)  # of a scene with its nodes' turns
        mesh.apply_transform(np.reshape(given["object_from_mesh"], (4, 4)))
        np.testing.assert_allclose(mesh.triangles, model.vertices_m[model.triangles], atol=2e-6)


@pytest.mark.parametrize("origin", ["base", "centre", "bbox"])
def test_y_up_is_z_up_turned_about_x(origin: Origin) -> None:
    pose = seen_from(20.0)
    upright, lying = (
        placement(brick(pose), report_of_a_support(pose), origin, up).placed(brick(pose)).vertices_m
        for up in ("z", "y")
    )
    np.testing.assert_allclose(Rotation.from_euler("x", -90, degrees=True).apply(upright), lying, atol=1e-12)
    assert np.ptp(upright[:, 2]) == pytest.approx(0.2)
    assert np.ptp(lying[:, 1]) == pytest.approx(0.2)


def test_origins_lie_where_they_are_named_after() -> None:
    pose, model = seen_from(20.0), ball()
    for origin in ("centre", "bbox"):
        place = placement(model, report_of_a_support(pose), origin, "z")
        np.testing.assert_allclose(place.object_from_mesh[:3, 3], [0.0, 0.0, 0.8], atol=1e-3)  # the ball's centre
    kept = placement(model, report_of_a_support(pose), "camera", None)
    assert np.array_equal(kept.object_from_mesh, np.eye(4))
    assert placement(model, report_of_a_support(pose), "camera", "z").object_from_mesh[:3, 3].tolist() == [0, 0, 0]


def test_without_a_support_the_base_is_the_lowest_vertex_and_that_is_said() -> None:
    pose = seen_from(20.0)
    upright = {"poses": []} | report_of_a_support(pose) | {"support_offset_m": None}  # of an earlier version
    place = placement(brick(pose), upright, "base", "z")
    np.testing.assert_allclose(place.object_from_mesh, pose, atol=1e-12)
    assert "lowest vertex" in place.words
    ring = [
        {"id": k, "object_from_camera": turned(pose, angle).ravel().tolist(), "covariance": np.eye(6).ravel().tolist()}
        for k, angle in enumerate(np.linspace(0.0, 300.0, 6))
    ]
    place = placement(brick(pose), {"poses": ring}, "base", "z")
    np.testing.assert_allclose(place.object_from_mesh, pose, atol=1e-9)
    assert (place.up_from, place.base_from) == ("ring", "lowest vertex")
    assert "no support was seen" in place.words
    place = placement(brick(pose), {"poses": ring[:1]}, "base", "y")
    assert place.up_from == "camera"
    np.testing.assert_allclose(place.object_from_mesh[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    assert "neither a support nor a ring" in place.words


def turned(pose: Array, angle_deg: float) -> Array:
    """The camera's pose in the object frame after it has gone about the object's own z by so many degrees."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()
    return pose @ turn @ se3.inverse(pose)


def test_y_is_up_in_gltf_alone() -> None:
    assert {suffix: default_up(suffix, "base") for suffix in (".ply", ".obj", ".stl", ".glb")} == {
        ".ply": "z", ".obj": "z", ".stl": "z", ".glb": "y"
    }  # fmt: skip
    assert default_up(".glb", "camera") is None
