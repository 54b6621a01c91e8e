"""What stood on a table, or turned in front of the camera, is shown upright."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from turning_box import steps

from modeler import se3
from modeler.export import RunMeta, model_upright, report_of, write_mesh
from modeler.export.reading import fault
from modeler.export.run_folder import frame_record
from modeler.export.standing import ring_upright, upright
from modeler.types import Array, ObjectModel, Plane, Step

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


def _report(step: Step) -> dict:
    return report_of(
        step, [frame_record(replace(step, view=view, frame=view.frame)) for view in step.views.values()], META
    )


def _tower(up: Array) -> ObjectModel:
    """A long box in front of the camera, whose long side points up."""
    box = trimesh.creation.box((0.05, 0.05, 0.3))
    side = np.cross(up, [0.0, 0.0, 1.0])
    turn = np.stack([side, np.cross(up, side), up], axis=1)
    return ObjectModel(
        points_m=np.zeros((0, 3)),
        normals=np.zeros((0, 3)),
        colours=None,
        vertices_m=box.vertices @ turn.T + [0.1, 0.2, 0.8],
        triangles=np.asarray(box.faces, dtype=np.int64),
        vertex_normals=np.asarray(box.vertex_normals) @ turn.T,
        vertex_colours=None,
    )


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 60.0])
def test_a_glb_stands_as_the_object_stood(tmp_path: Path, last: Step, tilt_deg: float) -> None:
    """In glTF y is up and z points at the viewer: what the camera looked down on leans in no viewer."""
    up = _looking_down(tilt_deg)
    write_mesh(_tower(up), tmp_path / "tower.glb", object_from_upright=model_upright(_report(_on(last, up))))
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
    report = _report(_on(last, up))
    np.testing.assert_allclose(report["up"], up)
    assert fault(report) is None
    np.testing.assert_allclose(model_upright(report)[:, 1], -up, atol=1e-9)
    assert _report(last)["up"] is None


@pytest.mark.parametrize("wrong", [[0.0, 0.0, 0.0], [0.0, 1.0], [0.0, None, 1.0], "up", [0.0, 0.0, 1e300]])
def test_what_is_no_direction_is_found_out(last: Step, wrong: object) -> None:
    assert fault(_report(last) | {"up": wrong}) == "'up' is missing or is not what it should be"


def test_reports_of_earlier_versions_stand_by_the_ring_of_their_cameras(last: Step) -> None:
    report = _report(_on(last, _looking_down(35.0)))
    del report["up"]
    assert fault(report) is None
    np.testing.assert_allclose(model_upright(report)[:, 1], [0.0, 1.0, 0.0], atol=1e-6)  # the run turns about y


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 60.0])
def test_what_turned_on_a_table_stands_upright(tilt_deg: float) -> None:
    """The camera looks down on the ring that it makes around the object, by so many degrees."""
    up = _looking_down(tilt_deg)
    turns = [se3.exp(np.concatenate([angle * up, np.zeros(3)])) for angle in np.linspace(0.0, 5.0, 8)]
    centres_m = np.array([turn[:3, :3] @ [0.0, 0.0, -0.7] for turn in turns])
    right, down, forward = ring_upright(centres_m).T
    np.testing.assert_allclose(down, -up, atol=1e-9)
    np.testing.assert_allclose(right, [1.0, 0.0, 0.0], atol=1e-9)  # as the first camera sees it
    np.testing.assert_allclose(np.cross(right, down), forward, atol=1e-9)
    for few in (1, 2):
        assert np.array_equal(ring_upright(centres_m[:few]), np.eye(3))


def test_a_support_that_is_seen_lies_level_in_a_view(last: Step) -> None:
    view, up = last.views[0], _looking_down(35.0)
    right, down, forward = upright(replace(view, plane=Plane(up, 0.5, 0.01, 0.001))).T
    np.testing.assert_allclose(down, -up, atol=1e-9)
    np.testing.assert_allclose(right, [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.cross(right, down), forward, atol=1e-9)
    above = replace(view, plane=Plane(np.array([0.0, 0.0, -1.0]), 0.5, 0.01, 0.001))
    for without in (above, replace(view, plane=None)):
        assert np.array_equal(upright(without), np.eye(3))
