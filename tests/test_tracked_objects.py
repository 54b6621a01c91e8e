"""Objects found in rendered frames with their model, and followed: errors, covariances, and what is not there."""

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from run_builders import model_of
from scipy import stats
from slow_cases import quick_first

from modeler import se3
from modeler.kernels import planes
from modeler.runs.known_objects import known_object
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Viewpoint
from modeler.tracking import ModelRenderer, Tracked, Tracker
from modeler.tracking.candidates import CandidateFinder
from modeler.tracking.tracked import of_the_camera, of_the_model
from modeler.types import Array, Camera, Frame, InputError, ObjectModel, PoseGaussian
from modeler.views import Sensor
from modeler.views.rays import part_of, thinned
from studies.calibration.specimens import load_specimen
from studies.calibration.study import Condition, staged
from studies.tracking.clutter import model_of as model_on_table
from studies.tracking.clutter import noise, scene

CAMERA = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)


@cache
def rendered(shape: str, frames: int = 2, step_deg: float = 40.0) -> tuple[RenderedSequence, ObjectModel]:
    """A sequence of a shape, and its true model."""
    sequence = RenderedSequence(staged(load_specimen(shape), Condition(step_deg=step_deg), frames=frames, seed=1))
    mesh = sequence.model()
    return sequence, model_of(trimesh.Trimesh(mesh.vertices_m, mesh.triangles, process=True))


def tracked(shape: str, model: ObjectModel, *, independent: bool) -> Iterator[tuple[Tracked, Array]]:
    """What a tracker says to each frame, and the truth."""
    sequence, _ = rendered(shape) if independent else rendered(shape, 4, 6.0)
    tracker, truth = Tracker(model, Sensor(sequence.sensor()), independent=independent), sequence.truth()
    for frame in sequence:
        yield tracker.update(frame), truth[frame.index]


@cache
def answers(shape: str, *, independent: bool) -> list[tuple[Tracked, Array]]:
    return list(tracked(shape, rendered(shape)[1], independent=independent))


SHAPES = ("boot", "stapler")


@pytest.mark.parametrize("shape", SHAPES)
def test_an_object_is_found_with_any_rotation(shape: str) -> None:
    for found, truth in answers(shape, independent=True):
        assert found.outcome == "found"
        assert found.usable, found.reason
        assert np.degrees(se3.rotation_angle(se3.inverse(found.pose.mean) @ truth)) < 1.0
        centre_m = rendered(shape)[1].vertices_m.mean(axis=0)[None]
        assert np.linalg.norm(se3.transform(found.pose.mean, centre_m) - se3.transform(truth, centre_m)) < 0.002


def test_an_object_is_followed_once_it_is_found() -> None:
    outcomes = [found.outcome for found, _ in answers("boot", independent=False)]
    assert outcomes == ["found", "followed", "followed", "followed"]


def test_covariances_hold_the_truth_as_often_as_they_say() -> None:
    squares = []
    for shape in SHAPES:
        for found, truth in [*answers(shape, independent=True), *answers(shape, independent=False)]:
            xi = se3.log(se3.inverse(found.pose.mean) @ truth)
            squares.append(float(xi @ np.linalg.solve(found.pose.covariance, xi)))
    low, high = stats.chi2.ppf([0.001, 0.999], 6 * len(squares))
    assert 0.5 * low < sum(squares) < 1.5 * high  # covariances are estimates, too
    assert max(squares) < stats.chi2.ppf(1.0 - 1e-6, 6)


@pytest.mark.parametrize(("shown", "sought"), quick_first([("boot", "drill"), ("stapler", "boot")]))
def test_another_object_is_not_there(shown: str, sought: str) -> None:
    found, _ = next(tracked(shown, rendered(sought)[1], independent=True))
    assert found.outcome == "not there"
    assert found.pose is None
    assert found.reason
    assert not found.usable


def test_an_object_is_found_and_followed_without_masks() -> None:
    sequence, model = rendered("boot", 4, 6.0)
    tracker, truth = Tracker(model, Sensor(sequence.sensor())), sequence.truth()
    for frame in sequence:
        found = tracker.update(replace(frame, mask=None))
        assert found.outcome == ("found" if frame.index == 0 else "followed")
        assert np.degrees(se3.rotation_angle(se3.inverse(found.pose.mean) @ truth[frame.index])) < 1.5


@pytest.mark.parametrize("between_m", [0.4, 0.0, 2.0])
def test_parts_of_an_object_are_one_piece_if_what_is_between_them_is_hidden(between_m: float) -> None:
    renderer, finder = ModelRenderer(model_of(trimesh.creation.box((0.27, 0.11, 0.02)))), CandidateFinder()
    depth_m = np.full((480, 640), 2.0, np.float32)
    left, right = (np.zeros(depth_m.shape, dtype=bool) for _ in range(2))
    left[200:280, 220:300], right[200:280, 340:420] = True, True
    depth_m[left | right], depth_m[150:330, 300:340] = 0.8, between_m
    masks = finder.masks(finder.things(Frame(0, 0.0, depth_m, CAMERA), renderer), renderer)
    shares = np.array([[np.mean(mask[part]) for part in (left, right)] for mask in masks])
    assert np.all(shares.max(axis=0) > 0.9)
    assert np.any(shares.min(axis=1) > 0.9) == (between_m < 0.8)


def test_what_hides_an_object_is_left_out_of_its_mask_and_surface_that_goes_on_is_not() -> None:
    renderer, finder = ModelRenderer(model_of(trimesh.creation.box((0.2, 0.2, 0.02)))), CandidateFinder()
    pose = se3.translation(np.array([0.0, 0.0, 0.81]))
    for before_m, left_out in ((0.76, True), (0.79, False)):
        depth_m = np.full((480, 640), 2.0, np.float32)
        depth_m[165:315, 245:395], depth_m[200:250, 300:360] = 0.8, before_m
        things = finder.things(Frame(0, 0.0, depth_m, CAMERA), renderer)
        near = finder.near(things.frame, pose, renderer, things)
        assert near[225, 330]
        bare = finder.bared(things, near, pose, renderer)
        assert (bare is not None) == left_out
        assert bare is None or (bare[180, 260] and not bare[225, 330])


@pytest.mark.parametrize("there", quick_first([True, False]))
def test_on_a_table_with_others_an_object_is_found_or_not_there(there: bool) -> None:
    sought, others = "stapler", ("whistle", "boot", "can")
    shown = scene(sought if there else None, others, 4)
    view = Viewpoint()
    found = Tracker(model_on_table(sought), Sensor(noise(view.distance_m, view))).update(shown.frame)
    if not there:
        assert found.outcome == "not there"
        return
    assert found.pose is not None
    assert shown.camera_from_model is not None
    assert np.degrees(se3.rotation_angle(se3.inverse(found.pose.mean) @ shown.camera_from_model)) < 1.5


def test_the_turn_of_a_can_about_its_axis_is_open_and_its_pose_of_use() -> None:
    _, model = rendered("can")
    tracker_axis = np.array([0.0, 0.0, 1.0])
    found, truth = next(tracked("can", model, independent=True))
    assert found.usable, found.reason
    about = se3.covariance_about(found.pose.covariance, model.vertices_m.mean(axis=0))
    assert np.degrees(np.sqrt(tracker_axis @ about[:3, :3] @ tracker_axis)) > 90.0
    tilt = np.degrees(np.arccos(abs(found.pose.mean[:3, 2] @ truth[:3, 2])))
    assert tilt < 1.5


def test_the_same_seed_gives_the_same_bits() -> None:
    once, again = answers("boot", independent=True)[0][0], next(tracked("boot", rendered("boot")[1], independent=True))
    assert np.array_equal(once.pose.mean, again[0].pose.mean)
    assert np.array_equal(once.pose.covariance, again[0].pose.covariance)


@pytest.mark.parametrize(("factor", "unit"), [(100.0, "cm"), (1000.0, "mm"), (0.01, "m"), (0.001, "m")])
def test_a_model_in_the_wrong_unit_is_recognised(factor: float, unit: str) -> None:
    sequence, model = rendered("boot")
    tracker = Tracker(replace(model, vertices_m=factor * model.vertices_m), Sensor(sequence.sensor()))
    with pytest.raises(InputError, match=f"lengths are in {unit}, give `unit` {unit}$"):
        tracker.update(sequence.frame(0))


def test_a_model_without_seen_surface_is_refused() -> None:
    model = model_of(trimesh.creation.box((0.1, 0.1, 0.1)))
    unseen = replace(model, vertex_sigmas_m=np.full(len(model.vertices_m), np.inf))
    with pytest.raises(InputError, match="no surface"):
        Tracker(unseen)


def test_a_frame_is_thinned_to_pixels_of_the_same_rays() -> None:
    sequence, _ = rendered("boot")
    frame = sequence.frame(0)
    for step in (2, 3):
        small, sensor = thinned(frame, Sensor(), step)
        w, h = frame.camera.rays()
        start = (step - 1) // 2
        assert np.allclose(small.camera.rays()[0], w[start::step, start::step])
        assert np.allclose(small.camera.rays()[1], h[start::step, start::step])
        assert np.array_equal(small.depth_m, frame.depth_m[start::step, start::step], equal_nan=True)
        assert sensor.noise.sigma_colour_px == Sensor().noise.sigma_colour_px / step


def test_a_part_of_a_frame_has_pixels_of_the_same_rays(rng: np.random.Generator) -> None:
    frame = rendered("boot")[0].frame(0)
    mask, occluder, *colour = rng.integers(0, 256, (5, *frame.depth_m.shape)).astype(np.uint8)
    frame = replace(frame, mask=mask < 128, occluder=occluder < 128, colour=np.stack(colour, axis=-1))
    for step in (1, 3):
        rows, columns = slice(40, 90, step), slice(7, 140, step)
        part = part_of(frame, rows, columns)
        for seen, whole in zip(part.camera.rays(), frame.camera.rays(), strict=True):
            assert np.allclose(seen, whole[rows, columns])
        for image in ("depth_m", "mask", "colour", "occluder"):
            np.testing.assert_array_equal(getattr(part, image), getattr(frame, image)[rows, columns])


def test_a_view_of_the_model_serves_wherever_the_object_is_shifted_or_turned_about_the_line_of_sight() -> None:
    sequence, model = rendered("boot")
    frame, truth = sequence.frame(0), sequence.truth()[0]
    tracker = Tracker(model, Sensor(sequence.sensor()))
    view = tracker._view(frame, support=False)
    assert view is not None
    first, rendered_at = tracker._shown(truth, view)
    about = se3.translation(tracker.renderer.centre_m)
    sight = se3.transform(se3.inverse(truth), np.zeros((1, 3)))[0] - tracker.renderer.centre_m
    for angle, same in ((1.5, True), (0.1, False)):
        axis = sight / np.linalg.norm(sight) if same else np.cross(sight, (0.0, 0.0, 1.0)) / np.linalg.norm(sight)
        turned = truth @ about @ se3.exp(np.append(angle * axis, np.zeros(3))) @ se3.inverse(about)
        seen, pose = tracker._shown(turned, view)
        assert (seen is first) == same
        assert np.allclose(pose, rendered_at if same else turned)


def test_an_object_that_jumps_to_and_fro_is_followed() -> None:
    sequence, model = rendered("boot")
    renderer, pose, camera = ModelRenderer(model), sequence.truth()[0], sequence.frame(0).camera
    tracker = Tracker(model, Sensor(sequence.sensor()))
    for index, outcome in enumerate(("found", "followed", "followed")):
        jump = se3.translation(np.array([1.0, 0.5, 0.3]) * (index % 2) * 0.7 * renderer.radius_m)  # and back
        seen, depth_m = renderer.silhouette(jump @ pose, camera)
        found = tracker.update(Frame(index, 0.5 * index, np.where(seen, depth_m, 0.0), camera, seen))
        assert found.outcome == outcome
        assert np.degrees(se3.rotation_angle(se3.inverse(found.pose.mean) @ jump @ pose)) < 1.0


def striped(camera_from_model: Array) -> tuple[Frame, ModelRenderer]:
    """A photograph of a wide box with random stripes, and the renderer of its model."""
    box = trimesh.creation.box((0.3, 0.2, 0.1))
    model = model_of(trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(box.vertices, box.faces, 0.004)[:2]))
    stripes = np.random.default_rng(0).integers(20, 235, 400)
    grey = stripes[np.floor((model.vertices_m[:, 0] + model.vertices_m[:, 1]) / 0.006).astype(int)]
    renderer = ModelRenderer(replace(model, vertex_colours=np.repeat(grey[:, None], 3, axis=1).astype(np.uint8)))
    view = renderer.view(camera_from_model, CAMERA, Sensor(), most_px=np.inf)
    return replace(view.frame, index=0, occluder=None), renderer


def test_colours_of_a_wide_object_tell_half_turns_apart() -> None:
    pose = se3.exp(np.array([0.4, 0.3, 0.1, 0.0, 0.0, 0.0]))
    pose[:3, 3] = [0.02, 0.0, 0.42]
    frame, renderer = striped(pose)
    found = Tracker(renderer.model, independent=True).update(frame)
    assert found.view.frame.camera.fx < frame.camera.fx  # wider than is of use
    assert not found.modes
    assert np.degrees(se3.rotation_angle(se3.inverse(found.pose.mean) @ pose)) < 1.0


def ball_at(distance_m: float, radius_m: float = 0.05) -> tuple[ModelRenderer, Array]:
    ball = model_of(trimesh.creation.icosphere(subdivisions=5, radius=radius_m))
    return ModelRenderer(ball), se3.translation(np.array([0.05, -0.02, distance_m]))


def test_a_rendered_ball_lies_where_it_is() -> None:
    renderer, pose = ball_at(0.6)
    view = renderer.view(pose, CAMERA, replace(Sensor(), smoothing=0.0))
    away = view.points_m - pose[:3, 3]
    assert len(view.points_m) > 1000
    assert np.abs(np.linalg.norm(away, axis=1) - 0.05).max() < 5e-4
    assert np.sum(view.normals * away, axis=1).min() > 0.048


def test_space_beside_a_closed_model_is_free_and_beside_a_part_of_one_unknown() -> None:
    renderer, pose = ball_at(0.6)
    whole = renderer.model
    part = whole.triangles[whole.vertices_m[whole.triangles][:, :, 2].mean(axis=1) < -0.02]
    for model, kind in ((whole, planes.BACKGROUND), (replace(whole, triangles=part), planes.RAGGED)):
        view = ModelRenderer(model).view(pose, CAMERA, Sensor())
        kinds = view.layers["cells"][..., planes.KIND]
        assert kinds[0, 0] == kind
        assert (kinds == planes.SURFACE).any()


def test_surface_that_no_view_saw_says_nothing() -> None:
    renderer, pose = ball_at(0.6)
    sigmas_m = np.where(renderer.model.vertices_m[:, 0] > 0.0, np.inf, 1e-3)
    view = ModelRenderer(replace(renderer.model, vertex_sigmas_m=sigmas_m)).view(pose, CAMERA, Sensor())
    assert len(view.points_m)
    assert (view.points_m[:, 0] < pose[0, 3] + 1e-3).all()
    assert view.layers["variance_m2"].min() >= 1e-6 * 0.999


def test_a_models_error_moves_a_ball_but_turns_it_not() -> None:
    renderer, pose = ball_at(0.6)
    model = replace(renderer.model, vertex_sigmas_m=np.full(len(renderer.model.vertices_m), 1e-3))
    renderer = ModelRenderer(model)
    seen, away = renderer.view(pose, CAMERA, Sensor()), 1e-8 * np.eye(6)
    away[:3, :3] = 1e-10 * np.eye(3)  # something besides surface tells the turn of the ball
    covariance = of_the_model(seen, PoseGaussian(pose, away), renderer)
    assert np.sqrt(np.trace(covariance[:3, :3])) < np.radians(0.2)
    assert 2e-4 < np.sqrt(np.trace(covariance[3:, 3:])) < 3e-3


def test_a_longer_focal_length_moves_an_object_to_the_axis() -> None:
    pose = se3.exp(np.array([0.3, -0.2, 1.0, 0.0, 0.0, 0.0]))
    pose[:3, 3] = [0.2, 0.0, 1.0]
    covariance = of_the_camera(pose, np.zeros(3), 0.01, 0.0)
    in_camera = pose[:3, :3] @ covariance[3:, 3:] @ pose[:3, :3].T
    assert np.allclose(in_camera, np.diag([0.002**2, 0.0, 0.0]), atol=1e-12)
    along = pose[:3, :3] @ of_the_camera(pose, np.zeros(3), 0.0, 0.01)[3:, 3:] @ pose[:3, :3].T
    assert np.sqrt(np.trace(along)) == pytest.approx(0.01 * np.hypot(0.2, 1.0))


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb", "stl"])
def test_meshes_of_all_formats_are_read_in_their_unit(suffix: str, tmp_path: Path) -> None:
    mesh, path = trimesh.creation.box((100.0, 60.0, 40.0)), tmp_path / f"box.{suffix}"
    mesh.export(path)
    assert np.allclose(np.ptp(known_object(path, "mm").model.vertices_m, axis=0), [0.1, 0.06, 0.04])
    assert np.allclose(np.ptp(known_object(path).model.vertices_m, axis=0), [100.0, 60.0, 40.0])
    (tmp_path / "models_info.json").write_text("{}")
    assert np.allclose(np.ptp(known_object(path).model.vertices_m, axis=0), [0.1, 0.06, 0.04])


def test_symmetries_of_bop_are_read_beside_a_model(tmp_path: Path) -> None:
    path, turn = tmp_path / "obj_000007.ply", np.diag([-1.0, -1.0, 1.0, 1.0])
    turn[0, 3] = 20.0
    trimesh.creation.box((100.0, 60.0, 40.0)).export(path)
    entry: dict[str, Any] = {
        "symmetries_discrete": [turn.ravel().tolist()],
        "symmetries_continuous": [{"axis": [0, 0, 2], "offset": [10, 0, 0]}],
    }
    info = path.with_name("models_info.json")
    info.write_text(json.dumps({"7": entry}))
    found = known_object(path).symmetries
    assert np.allclose(found.discrete[0][:3, 3], [0.02, 0.0, 0.0])
    assert np.allclose(found.continuous[0].direction, [0.0, 0.0, 1.0])
    assert np.allclose(found.continuous[0].point_m, [0.01, 0.0, 0.0])
    info.write_text(json.dumps({"7": {}}))
    assert known_object(path).symmetries is None
    info.write_text(json.dumps({"7": {"symmetries_discrete": [[1.0, 2.0]]}}))
    with pytest.raises(InputError, match="symmetries of object 7"):
        known_object(path)


@pytest.mark.parametrize("name", ["box.obj", "box.stl", "box.ply", "box.xyz"])
def test_what_is_no_mesh_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("no mesh")
    with pytest.raises(InputError, match=name):
        known_object(tmp_path / name)
