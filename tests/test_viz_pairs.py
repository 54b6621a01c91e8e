"""A pair of views is drawn as it was registered: before and after, what each sees, and how sure that is."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import rerun as rr
import rerun.chunk
from rerun_recordings import Recording, drawn
from turning_box import CENTRE_M, COUNT, COVARIANCE, HALF_M, LOST, object_from_camera

from modeler import se3
from modeler.types import Mode, Plane, PoseGaussian, Step, loop_closure_error
from modeler.viz import entities, images, pair_view, readings


def test_alignment_brings_the_pair_together(recording: Recording) -> None:
    targets = drawn(recording, entities.PAIR_TARGET, "positions")
    before, after = (drawn(recording, path, "positions") for path in (entities.PAIR_BEFORE, entities.PAIR_AFTER))
    assert set(targets) == set(before) == set(after) == set(range(1, COUNT))
    for index in targets:
        # The box moved into the target's frame fills the target's box: compare in the box's own axes.
        box_from_target = object_from_camera(index - 1 if index - 1 != LOST else LOST - 1)
        for clouds_m, inside in ((targets, True), (after, True), (before, False)):
            in_box = np.abs(se3.transform(box_from_target, clouds_m[index]) - CENTRE_M) - HALF_M
            assert (np.percentile(in_box.max(axis=1), 95) < 0.004) == inside


def test_draws_stand_for_the_posterior(run: list[Step]) -> None:
    rng = np.random.default_rng(0)
    posterior = run[1].posteriors[0]
    mean = posterior.pose.mean
    sigma_points = se3.log(se3.inverse(mean) @ pair_view.draws(posterior))
    np.testing.assert_allclose(sigma_points.T @ sigma_points / 2.0, posterior.pose.covariance, atol=1e-9)
    # Two modes, the lighter by three to one: the draws keep the proportion, and are the same every time.
    offsets = np.zeros((400, 6))
    offsets[:, 1] = np.where(np.arange(400) < 200, 1.0, -1.0)
    samples = mean @ se3.exp(offsets + 0.01 * rng.standard_normal((400, 6)))
    weights = np.where(offsets[:, 1] > 0, 0.75, 0.25) / 200.0
    modal = replace(posterior, samples=samples, weights=weights)
    drawn_poses = pair_view.draws(modal)
    share = np.mean(se3.log(se3.inverse(mean) @ drawn_poses)[:, 1] > 0)
    assert share == pytest.approx(0.75, abs=1 / 80)
    np.testing.assert_array_equal(drawn_poses, pair_view.draws(modal))


def test_the_ends_of_the_axes_gather_about_the_mean(recording: Recording, run: list[Step]) -> None:
    for step in run[1:]:
        arrows = recording[entities.PAIR_AXES][step.frame.index]
        ends = np.array(arrows["origins"]) + np.array(arrows["vectors"])
        dots = np.array(recording[entities.PAIR_DRAWS][step.frame.index]["positions"]).reshape(-1, 3, 3)
        distance_m = np.linalg.norm(dots - ends, axis=-1)
        assert 0.0 < distance_m.max() < 0.01


def test_the_visibility_picture_has_the_three_areas(run: list[Step], recording: Recording) -> None:
    target = run[0].view
    shape = target.frame.depth_m.shape
    areas = np.array(recording[entities.VISIBILITY_AREAS][1]["buffer"][0], dtype=np.uint8).reshape(shape)
    np.testing.assert_array_equal(areas == images.OBJECT, target.frame.mask)
    np.testing.assert_array_equal(areas == images.MISSING, np.isnan(target.frame.depth_m))


def test_points_hang_in_front_only_where_the_motion_is_wrong(run: list[Step]) -> None:
    source, target = run[1].view, run[0].view
    assert source is not None
    assert target is not None
    truth = se3.inverse(object_from_camera(0)) @ object_from_camera(1)

    def share(verdict: int, offset_m: list[float]) -> float:
        verdicts = images.projection(source, target, se3.translation(np.array(offset_m)) @ truth).verdicts
        judged = verdicts[verdicts != images.NO_SAY]
        assert len(judged) > 0.6 * len(verdicts)
        return float(np.mean(judged == verdict))

    assert share(images.VIOLATION, [0.0, 0.0, 0.0]) < 0.01
    assert share(images.AGREES, [0.0, 0.0, 0.0]) > 0.6
    assert share(images.VIOLATION, [0.0, 0.0, -0.05]) > 0.9
    assert share(images.HIDDEN, [0.0, 0.0, 0.05]) > 0.9
    assert share(images.VIOLATION, [0.25, 0.0, 0.0]) > 0.9  # before the background
    beyond = images.projection(source, target, se3.translation(np.array([5.0, 0.0, 0.0])) @ truth)
    assert len(beyond.pixels) == 0
    before = Plane(np.array([0.0, 0.0, -1.0]), 0.1, sigma_tilt_rad=0.001, sigma_offset_m=0.001)
    assert np.all(images.projection(source, replace(target, plane=before), truth).verdicts == images.VIOLATION)


def test_points_are_drawn_by_what_is_said_of_them(run: list[Step]) -> None:
    step = run[1]
    (posterior,) = step.posteriors

    def drawn_at(offset_m: list[float]) -> dict[str, Any]:
        mean = se3.translation(np.array(offset_m)) @ posterior.pose.mean
        moved = replace(posterior, pose=replace(posterior.pose, mean=mean))
        return dict(images.draw_projected_points(replace(step, posteriors=(moved,))))

    for path, offset_m in (
        (entities.VISIBILITY_AGREES, [0.0, 0.0, 0.0]),
        (entities.VISIBILITY_HIDDEN, [0.0, 0.0, 0.05]),
        (entities.VISIBILITY_VIOLATIONS, [0.0, 0.0, -0.05]),
    ):
        points = drawn_at(offset_m)[path]
        assert isinstance(points, rr.Points2D)
        assert len(points.positions.as_arrow_array()) > 100


def test_where_nothing_was_measured_no_point_is_judged(run: list[Step]) -> None:
    source, target = run[1].view, run[0].view
    assert source is not None
    assert target is not None
    nowhere = np.zeros_like(target.layers["cells"])  # cells of the kind MISSING
    blind = replace(target, layers=dict(target.layers) | {"cells": nowhere})
    verdicts = images.projection(source, blind, np.eye(4)).verdicts
    assert len(verdicts) > 100
    assert (verdicts == images.NO_SAY).all()


def test_ghosts_stay_with_their_mode_and_spread_about_it(run: list[Step]) -> None:
    step, rng = run[1], np.random.default_rng(2)
    posterior, view = step.posteriors[0], step.view
    assert view is not None
    centre = se3.translation(view.centroid_m)
    turned = posterior.pose.mean @ centre @ se3.exp(np.array([0.0, 1.5, 0.0, 0.0, 0.0, 0.0])) @ se3.inverse(centre)
    tight = 0.01 * COVARIANCE
    modes = (Mode(0.75, PoseGaussian(posterior.pose.mean, tight)), Mode(0.25, PoseGaussian(turned, tight)))
    spread = [rng.multivariate_normal(np.zeros(6), tight, round(400 * mode.weight)) for mode in modes]
    draws = np.concatenate([mode.pose.mean @ se3.exp(xi) for mode, xi in zip(modes, spread, strict=True)])
    modal = replace(posterior, modes=modes, samples=draws, weights=np.full(400, 1 / 400))
    shown = pair_view.magnified(modal, view)
    assert np.mean(shown.mode_of == 0) == pytest.approx(0.75, abs=1 / 20)
    assert shown.factor > 1.0
    for number, mode in enumerate(modes):
        apart_m = [
            np.linalg.norm(se3.transform(pose, view.centroid_m[None]) - se3.transform(mode.pose.mean, view.centroid_m))
            for pose in shown.poses[shown.mode_of == number]
        ]
        assert 0.0 < max(apart_m) < 0.3 * HALF_M.max()
    recording_of = dict(pair_view.draw_posterior(replace(step, posteriors=(modal,))))
    labels: Any = recording_of[entities.GHOST_LABELS]
    texts = labels.labels.as_arrow_array().to_pylist()
    assert [text.partition(",")[0] for text in texts] == ["mode 1: 75 %", "mode 2: 25 %"]


def test_readings_are_those_of_the_posterior(run: list[Step], recording: Recording) -> None:
    posterior = run[1].posteriors[0]
    values = {path: recording[f"{path}/odometry"][1]["scalars"][0] for path in entities.READINGS}
    assert values[entities.EFFECTIVE_SAMPLES] == pytest.approx(posterior.effective_samples)
    assert values[entities.OVERLAP] == pytest.approx(100 * posterior.overlap)
    assert values[entities.SECONDS] == pytest.approx(posterior.seconds)
    assert values[entities.TURNED] == pytest.approx(np.degrees(se3.rotation_angle(posterior.pose.mean)))
    assert f"turned by {values[entities.TURNED]:.1f}°" in recording[entities.NOW][1]["text"][0]
    samples = np.random.default_rng(0).multivariate_normal(np.zeros(6), posterior.pose.covariance, 50_000)
    turned = np.linalg.eigvalsh(np.cov(samples[:, :3].T))[-1] ** 0.5
    assert values[entities.ROTATION_SD] == pytest.approx(np.rad2deg(turned), rel=0.02)
    centre = np.append(run[1].view.centroid_m, 1.0)
    shifted = np.linalg.eigvalsh(np.cov((se3.exp(samples) @ centre)[:, :3].T))[-1] ** 0.5
    assert values[entities.TRANSLATION_SD] == pytest.approx(1000 * shifted, rel=0.02)


def test_every_pair_is_put_into_words(run: list[Step], recording: Recording) -> None:
    for step in run:
        now = recording[entities.NOW][step.frame.index]["text"][0]
        assert now.startswith(f"### Frame {step.frame.index}: {'left out' if step.frame.index == LOST else 'accepted'}")
        for edge in step.edges:
            assert readings.pair_words(edge, step) in now
            assert edge.posterior.outcome.advice in now
            assert ("rejected" in readings.pair_words(edge, step)) == (not edge.accepted)
            assert now.count(edge.posterior.outcome.advice) == sum(
                other.posterior.outcome is edge.posterior.outcome for other in step.edges
            )
    assert "nan" not in " ".join(row["text"][0] for row in recording[entities.NOW].values())


def test_the_last_words_tell_by_how_much_the_loop_was_open(run: list[Step], recording: Recording) -> None:
    last = run[-1]
    centroids_m = {frame: view.centroid_m for frame, view in last.views.items()}
    error = loop_closure_error(last.edges_so_far, last.solution, centroids_m)
    words = f"{np.degrees(error.rotation_rad):.1f}° and {1000.0 * error.translation_m:.1f} mm"
    assert f"has a closure error of {words}" in recording[entities.NOW][last.frame.index]["text"][0]


def test_what_the_graph_leaves_to_the_modes_of_a_pair_is_reported(run: list[Step]) -> None:
    step = run[1]
    pair = (step.edges[0].source, step.edges[0].target)
    wary = replace(step, solution=replace(step.solution, mode_weights={pair: np.array([0.9, 0.1])}))
    assert "its modes in the pose graph: 90%, 10%" in readings.now_words(wary)
    assert "modes" not in readings.now_words(step)


def test_readings_that_a_method_does_not_give_are_left_out(run: list[Step]) -> None:
    edge = run[1].edges[0]
    poor = replace(edge, posterior=replace(edge.posterior, effective_samples=float("nan"), seconds=float("nan")))
    assert "nan" not in readings.pair_words(poor, run[1])
    single = replace(
        edge.posterior,
        pose=PoseGaussian(edge.posterior.pose.mean, 1e-18 * np.eye(6)),
        overlap=0.02,
        effective_samples=1.2,
        seconds=0.1,
    )
    assert readings.pair_words(replace(edge, posterior=single), run[1]).endswith(
        "rotation sd <0.01°, translation sd <0.01 mm, overlap 2 %, 1 effective sample, 0.1 s"
    )
    paths = {path for path, _ in readings.draw_readings(replace(run[1], edges=(poor,)))}
    assert f"{entities.OVERLAP}/odometry" in paths
    assert f"{entities.SECONDS}/odometry" not in paths
