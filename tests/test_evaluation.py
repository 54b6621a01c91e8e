"""Laws of the metrics: what they must not depend on, and values known in closed form."""

import numpy as np
import pytest
from scipy import stats

from modeler import se3
from modeler.evaluation import (
    LEVELS,
    about_point,
    align_to_model,
    coverage,
    nees,
    rotation_error_deg,
    trajectory_errors,
    translation_error_m,
    true_motion,
)
from modeler.types import Array, PoseGaussian

CENTROID_M = np.array([0.05, -0.02, 0.8])


def _about_centroid(xi: Array) -> Array:
    return se3.translation(CENTROID_M) @ se3.exp(xi) @ se3.translation(-CENTROID_M)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-6, 0.1, 12.0, 90.0, 179.9999, 180.0])
def test_rotation_about_the_object_is_no_translation(angle_deg: float) -> None:
    truth = se3.exp(np.random.default_rng(1).normal(size=6))
    estimate = truth @ _about_centroid(np.array([0.0, np.radians(angle_deg), 0.0, 0.0, 0.0, 0.0]))
    assert rotation_error_deg(estimate, truth) == pytest.approx(angle_deg, abs=1e-9)
    assert translation_error_m(estimate, truth, CENTROID_M) == pytest.approx(0.0, abs=1e-12)


def test_translation_error_is_what_the_object_moves() -> None:
    truth = se3.exp(np.random.default_rng(2).normal(size=6))
    shifted = truth @ se3.translation(np.array([0.003, 0.0, 0.004]))
    assert translation_error_m(shifted, truth, CENTROID_M) == pytest.approx(0.005)
    assert rotation_error_deg(shifted, truth) == pytest.approx(0.0, abs=1e-6)
    # One degree about the camera carries an object 0.8 m away by 14 mm, though its "translation part" is nil.
    turned = truth @ se3.exp(np.radians([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]))
    moved_m = 2.0 * np.hypot(CENTROID_M[0], CENTROID_M[2]) * np.sin(np.radians(0.5))
    assert translation_error_m(turned, truth, CENTROID_M) == pytest.approx(moved_m)


def test_errors_do_not_depend_on_the_choice_of_frames() -> None:
    rng = np.random.default_rng(3)
    truth, estimate, source, target = se3.exp(rng.normal(size=(4, 6)))
    moved, moved_truth = (target @ motion @ se3.inverse(source) for motion in (estimate, truth))
    centroid_m = se3.transform(source, CENTROID_M[None])[0]
    assert rotation_error_deg(moved, moved_truth) == pytest.approx(rotation_error_deg(estimate, truth))
    assert translation_error_m(moved, moved_truth, centroid_m) == pytest.approx(
        translation_error_m(estimate, truth, CENTROID_M)
    )


def _random_gaussian(rng: np.random.Generator) -> PoseGaussian:
    factor = 0.02 * (0.4 * rng.normal(size=(6, 6)) + np.eye(6))
    return PoseGaussian(se3.exp(rng.normal(size=6)), factor @ factor.T)


@pytest.mark.parametrize(("components", "degrees"), [(slice(0, 6), 6), (slice(0, 3), 3), (slice(3, 6), 3)])
def test_nees_of_draws_is_chi_squared_and_regions_cover(components: slice, degrees: int) -> None:
    rng = np.random.default_rng(4)
    count = 4000
    values = np.zeros(count)
    for number in range(count):
        gaussian = _random_gaussian(rng)
        truth = gaussian.mean @ se3.exp(rng.multivariate_normal(np.zeros(6), gaussian.covariance))
        values[number] = nees(gaussian, truth, components)
    assert stats.kstest(values, stats.chi2(degrees).cdf).pvalue > 1e-3
    covered = coverage(values, degrees)
    assert tuple(covered) == LEVELS
    for level, share in covered.items():
        assert share == pytest.approx(level, abs=4.0 * np.sqrt(level * (1.0 - level) / count))


def test_nees_is_in_units_of_the_covariance() -> None:
    rng = np.random.default_rng(5)
    gaussian = _random_gaussian(rng)
    factor = np.linalg.cholesky(gaussian.covariance)
    for direction in np.eye(6):
        truth = gaussian.mean @ se3.exp(2.0 * factor @ direction)
        assert nees(gaussian, truth) == pytest.approx(4.0)
    truth = gaussian.mean @ se3.exp(factor @ np.ones(6))
    assert nees(gaussian.inverse(), se3.inverse(truth)) == pytest.approx(nees(gaussian, truth))
    overconfident = PoseGaussian(gaussian.mean, gaussian.covariance / 100.0)
    assert nees(overconfident, truth) == pytest.approx(600.0)


def test_about_a_point_turns_about_it_and_keeps_the_nees() -> None:
    rng = np.random.default_rng(8)
    gaussian = _random_gaussian(rng)
    truth = gaussian.mean @ se3.exp(0.05 * rng.normal(size=6))
    shifted, there = about_point(gaussian, CENTROID_M), truth @ se3.translation(CENTROID_M)
    assert nees(shifted, there) == pytest.approx(nees(gaussian, truth))
    assert nees(shifted, there, slice(0, 3)) == pytest.approx(nees(gaussian, truth, slice(0, 3)))
    # An object that turns about its own centroid stays there; in the camera its translation looks uncertain.
    xi = rng.normal(size=(20000, 6)) * np.repeat([0.02, 1e-4], 3)
    draws = se3.translation(CENTROID_M) @ se3.exp(xi) @ se3.translation(-CENTROID_M)
    _, covariance = se3.mean(draws, np.ones(len(draws)))
    sigmas = np.sqrt(np.diag(about_point(PoseGaussian(np.eye(4), covariance), CENTROID_M).covariance))
    assert np.sqrt(covariance[3, 3]) > 0.01
    np.testing.assert_allclose(sigmas, np.repeat([0.02, 1e-4], 3), rtol=0.05)


def test_coverage_counts() -> None:
    radius = stats.chi2(6).ppf(0.9)
    assert coverage([0.0, radius - 1e-9, radius + 1e-9, 1e9], levels=[0.9]) == {0.9: 0.5}
    assert np.isnan(coverage([])[0.5])


def _turntable(count: int, rng: np.random.Generator) -> dict[int, Array]:
    """True camera_from_model by frame number 4, 6, 8 …"""
    model = se3.exp(rng.normal(size=6))
    return {4 + 2 * k: _about_centroid(np.array([0.1 * k, 0.4 * k, 0.0, 0.0, 0.0, 0.0])) @ model for k in range(count)}


def test_true_motions_compose_and_cancel_the_model_frame() -> None:
    truth = _turntable(4, np.random.default_rng(6))
    np.testing.assert_allclose(
        true_motion(truth, 4, 8), true_motion(truth, 4, 6) @ true_motion(truth, 6, 8), atol=1e-13
    )
    step = _about_centroid(np.array([0.1, 0.4, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(true_motion(truth, 6, 4), step, atol=1e-13)
    points = np.random.default_rng(7).normal(size=(5, 3))  # of the model, as each camera sees them
    seen = {frame: se3.transform(pose, points) for frame, pose in truth.items()}
    np.testing.assert_allclose(se3.transform(true_motion(truth, 8, 4), seen[4]), seen[8], atol=1e-13)


def test_trajectory_is_compared_relative_to_its_first_frame() -> None:
    rng = np.random.default_rng(8)
    truth = _turntable(5, rng)
    elsewhere = se3.exp(rng.normal(size=6))  # the object frame is anybody's choice
    exact = {frame: elsewhere @ se3.inverse(pose) for frame, pose in truth.items()}
    errors = trajectory_errors(exact, truth, CENTROID_M)
    assert errors.max_rotation_deg == pytest.approx(0.0, abs=1e-6)
    assert errors.max_translation_m == pytest.approx(0.0, abs=1e-12)

    first_from_object = truth[4]
    wrong = _about_centroid(np.radians([0.0, 5.0, 0.0, 0.0, 0.0, 0.0]))
    shift = se3.translation(np.array([0.0, 0.002, 0.0]))
    off = {
        frame: elsewhere @ se3.inverse(first_from_object) @ error @ first_from_object @ se3.inverse(truth[frame])
        for frame, error in ((4, np.eye(4)), (6, shift), (8, np.eye(4)), (10, wrong))
    }
    errors = trajectory_errors(off, truth, CENTROID_M)
    assert list(errors.rotation_deg) == [4, 6, 8, 10]
    assert errors.rotation_deg[10] == errors.max_rotation_deg == pytest.approx(5.0)
    assert errors.translation_m[6] == errors.max_translation_m == pytest.approx(0.002)
    assert errors.translation_m[10] == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(ValueError, match="accepted"):
        trajectory_errors({}, truth, CENTROID_M)


def test_an_object_is_laid_on_the_truth_by_all_frames_together() -> None:
    rng = np.random.default_rng(11)
    truth = {frame: se3.exp(rng.normal(size=6)) for frame in (2, 3, 5, 9)}
    model_from_object = se3.exp(rng.normal(size=6))
    trajectory = {frame: se3.inverse(pose @ model_from_object) for frame, pose in truth.items()}
    np.testing.assert_allclose(align_to_model(trajectory, truth), model_from_object, atol=1e-9)
    # One frame of four a little off moves the whole by a quarter of that; which frame comes first does not matter.
    off = se3.exp(np.array([0.0, 0.0, 0.004, 0.0, 0.0, 0.0]))
    for frame in (2, 9):
        moved = align_to_model(trajectory | {frame: trajectory[frame] @ off}, truth)
        assert np.linalg.norm(se3.log(se3.inverse(model_from_object) @ moved)[:3]) == pytest.approx(0.001, rel=1e-3)
    with pytest.raises(ValueError, match="no frame"):
        align_to_model(trajectory, {7: np.eye(4)})
