"""The study of whole builds: captures of another renderer, their truth, and their two halves."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from slow_cases import quick_first

from modeler import se3
from studies.multiplied.judged import apart
from studies.whole.cameras import KINDS as CAMERAS
from studies.whole.capture import Capture
from studies.whole.plan import HALVES, Factors, Plan, motion
from studies.whole.shapes import KINDS
from studies.whole.study import Outcome, symmetries
from studies.whole.tables import COLUMNS, counts
from studies.whole.things import Thing, read

PICTURES = [np.random.default_rng(number).integers(0, 255, (16, 16, 3)).astype(np.uint8) for number in range(6)]


def _things() -> list[Thing]:
    things = []
    for name, shape in KINDS.items():
        for number in range(2):
            mesh = shape(np.random.default_rng(number))
            things.append(Thing.of(f"{name} {number}", np.asarray(mesh.vertices), np.asarray(mesh.faces)))
    return things


THINGS = _things()


def _drawn(count: int) -> list[Factors]:
    return [Plan(half, number).factors(THINGS, len(PICTURES)) for half in HALVES for number in range(count)]


def test_halves_share_no_mesh_and_no_photograph() -> None:
    meshes, pictures = [], []
    for half in HALVES:
        drawn = [Plan(half, number).factors(THINGS, len(PICTURES)) for number in range(60)]
        meshes.append({one.thing for one in drawn})
        pictures.append({number for one in drawn for number in one.pictures})
    assert meshes[0].isdisjoint(meshes[1])
    assert pictures[0].isdisjoint(pictures[1])
    assert len(meshes[0] | meshes[1]) == len(THINGS)


def test_draws_span_their_ranges() -> None:
    drawn = _drawn(150)
    assert min(one.size_m for one in drawn) < 0.03
    assert max(one.size_m for one in drawn) > 1.5
    assert min(one.step_deg for one in drawn) < 8.0
    assert max(one.step_deg for one in drawn) > 75.0
    assert {one.camera for one in drawn} == set(CAMERAS)
    assert all(6 <= one.frames <= 14 for one in drawn)
    assert all(0.149 < one.distance_m < 4.001 for one in drawn)


@pytest.mark.parametrize("camera", quick_first(CAMERAS))
def test_depth_is_that_of_the_mesh_in_its_true_pose(camera: str) -> None:
    import open3d as o3d

    drawn = replace(
        Plan("tuning", 3).factors(THINGS, len(PICTURES)),
        camera=camera,
        noise=0.0005,
        bias=0.0,
        support="table",
        steps="even",
        masks="exact",
        cut=0.0,
        focal_error=0.0,
        frames=6,
        unit_m=1e-5,
    )
    capture = Capture(drawn, 3, THINGS, PICTURES)
    frame, truth = capture.frame(2), capture.truth()[2]
    w, h = frame.camera.rays()
    seen = frame.mask & np.isfinite(frame.depth_m)
    assert seen.sum() > 300
    depth_m = frame.depth_m[seen].astype(float)
    points_m = np.stack([w[seen] * depth_m, h[seen] * depth_m, depth_m], axis=1)
    scene = o3d.t.geometry.RaycastingScene()
    mesh = capture.mesh
    vertices_m, triangles = mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32)
    scene.add_triangles(o3d.core.Tensor.from_numpy(vertices_m), o3d.core.Tensor.from_numpy(triangles))
    places_m = se3.transform(se3.inverse(truth), points_m).astype(np.float32)
    apart_m = scene.compute_distance(o3d.core.Tensor.from_numpy(places_m)).numpy()
    assert np.median(apart_m) < 2.0 * 0.0005 * capture.factors.distance_m
    again = Capture(drawn, 3, THINGS, PICTURES).frame(2)
    assert np.array_equal(again.depth_m, frame.depth_m, equal_nan=True)


@pytest.mark.parametrize(
    ("camera", "kind_given", "intrinsics", "sensor"),
    [
        ("time of flight", True, "nominal", (0.02, 0.1)),
        ("time of flight", True, "device", (0.005, 0.1)),
        ("time of flight", False, "exact", None),
        ("stereo", True, "device", (0.005, 0.0)),
        ("stereo", True, "exact", None),
    ],
)
def test_a_camera_is_stated_as_far_as_it_was_drawn(
    camera: str, kind_given: bool, intrinsics: str, sensor: tuple[float, float] | None
) -> None:
    drawn = replace(_drawn(1)[0], camera=camera, kind_told=kind_given, intrinsics=intrinsics)
    found = Capture(drawn, 0, THINGS, PICTURES).sensor()
    assert (None if found is None else (found.sigma_focal, found.sigma_multipath)) == sensor


def test_steps_are_as_they_are_called() -> None:
    drawn = Plan("tuning", 0).factors(THINGS, len(PICTURES))
    drawn = replace(drawn, support="turntable", step_deg=20.0, frames=12, order="as turned")
    of = {
        steps: motion(replace(drawn, steps=steps), np.random.default_rng(0))[1]
        for steps in ("even", "uneven", "with stops")
    }
    assert np.abs(of["even"] - 20.0).max() < 2.5
    assert np.ptp(of["uneven"]) > 10.0
    assert (of["with stops"] < 3.0).any()
    swapped = motion(replace(drawn, steps="even", order="halves swapped"), np.random.default_rng(0))[1]
    assert swapped.max() > 60.0


def test_errors_ignore_a_shift_of_all_views_but_not_a_pose() -> None:
    rng = np.random.default_rng(0)
    true = {k: se3.exp(np.concatenate([[0.0, 0.4 * k, 0.0], rng.normal(0.0, 0.1, 3)])) for k in range(4)}
    points_m = {k: rng.normal(0.0, 0.05, (50, 3)) for k in true}
    shift = se3.translation(np.array([0.0, 0.0, 0.004]))
    deg, m = apart({k: pose @ shift for k, pose in true.items()}, true, points_m)
    assert deg < 1e-5
    assert m < 1e-4
    assert apart({**true, 2: true[2] @ shift}, true, points_m)[1] > 1e-3
    wrong = {**true, 2: true[2] @ se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))}
    assert apart(wrong, true, points_m)[0] > 4.0


def test_a_plain_box_is_the_same_after_half_a_turn_and_a_jug_is_not() -> None:
    box, square = (trimesh.creation.box(size) for size in ([0.3, 0.2, 0.1], [0.2, 0.2, 0.1]))
    jug = THINGS[0]
    found = [len(symmetries(np.asarray(mesh.vertices), np.asarray(mesh.faces))) for mesh in (box, square)]
    assert found == [4, 8]
    assert len(symmetries(jug.vertices, jug.triangles)) == 1


def test_outcomes_are_read_as_they_are_written() -> None:
    drawn = Plan("tuning", 0).factors(THINGS, len(PICTURES))
    one = Outcome("tuning", 0, drawn, 6, 3, ("x",), ("y",), {"e": (1.0, None)}, {"3": "no"}, 0.01, 2.0, 0.02, 1.0)
    again = Outcome.of(json.loads(json.dumps(one.values())))
    assert not again.right
    assert counts([again])[0] == ("all", 1, f"{600 / drawn.frames:.0f} %", 0, 0, 0, 1, 0)
    assert all(len(row) == 1 + len(COLUMNS) for row in counts([again]))
    assert replace(one, error_m=0.005).right


def test_things_are_read_as_they_are_written(tmp_path: Path) -> None:
    path = tmp_path / "things.npz"
    one = THINGS[0]
    arrays = {f"vertices: {one.name}": one.vertices, f"triangles: {one.name}": one.triangles}
    np.savez(path, pictures=np.stack(PICTURES), **arrays)
    things, pictures = read(path)
    assert [thing.name for thing in things] == [one.name]
    assert np.allclose(things[0].vertices, one.vertices, atol=1e-6)
    assert len(pictures) == len(PICTURES)
