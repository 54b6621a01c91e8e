"""What the default method must do beyond the contract: honest outcomes, and robustness to what cameras do."""

from dataclasses import replace

import numpy as np
import pytest

from modeler import se3
from modeler.evaluation import about_point, nees, rotation_error_deg, true_motion
from modeler.priors import GeneralPrior, TablePrior
from modeler.registration import VisibilityRegistrar
from modeler.segmentation import Scene, Segmenter
from modeler.sequences import bundled, open_sequence
from modeler.types import Camera, Frame, Outcome, SensorNoise
from modeler.verdict.advice import outcome_advice
from modeler.views import Sensor


@pytest.fixture(scope="module")
def flashlight():
    """The first two frames of the flashlight with their plane, the sensor, and the true motion from 1 to 0."""
    sequence = open_sequence(bundled("flashlight"))
    frames = [sequence.frame(index) for index in (0, 1)]
    plane = Segmenter().segment(frames[0], Scene()).plane
    truth, sensor = sequence.truth(), sequence.sensor()
    assert truth is not None
    assert sensor is not None
    return frames, plane, Sensor(sensor), true_motion(truth, target=0, source=1)


def occluded(frame, rng):
    """A rod held before the object."""
    depth_m, mask = frame.depth_m.copy(), frame.mask.copy()
    middle = int(np.median(np.nonzero(mask)[1])) + rng.integers(-10, 10)
    depth_m[:, middle - 6 : middle + 6], mask[:, middle - 6 : middle + 6] = 0.5, False
    return replace(frame, depth_m=depth_m, mask=mask)


def sparse(frame, rng):
    """Nine of ten pixels without a measurement."""
    return replace(frame, depth_m=np.where(rng.random(frame.depth_m.shape) < 0.9, np.nan, frame.depth_m))


def greedy(frame, rng):
    """A segmentation that takes a few rows of the table along."""
    del rng
    rows, columns = np.nonzero(frame.mask)
    mask = frame.mask.copy()
    mask[rows.max() - 2 : rows.max() + 4, columns.min() : columns.max()] = True
    return replace(frame, mask=mask & np.isfinite(frame.depth_m))


@pytest.mark.parametrize("harm", [occluded, sparse, greedy])
def test_harmed_images_cost_accuracy_not_honesty(flashlight, harm, rng):
    frames, plane, sensor, truth = flashlight
    target, source = (sensor.ray_image(harm(frame, rng), plane) for frame in frames)
    posterior = VisibilityRegistrar().register(source, target, TablePrior().between(source, target), rng=rng)
    assert posterior.usable
    assert rotation_error_deg(posterior.pose.mean, truth) < 3.0
    assert nees(posterior.pose, truth) < 22.5  # χ²₆ at 0.999


def test_a_motion_beyond_the_prior_is_not_passed_off_as_one_within(flashlight, rng):
    frames, plane, sensor, _ = flashlight
    target, source = (sensor.ray_image(frame, plane) for frame in frames)
    prior = TablePrior(max_rotation_deg=12.0)  # the object turned by 24°
    posterior = VisibilityRegistrar().register(source, target, prior.between(source, target), rng=rng)
    assert posterior.outcome is Outcome.AT_LIMIT
    assert not posterior.usable
    (beyond,) = posterior.beyond
    assert np.degrees(se3.rotation_angle(beyond)) == pytest.approx(24.0, abs=3.0)
    assert "`max_rotation_deg` 24" in outcome_advice(posterior.outcome, prior, posterior)


def test_surfaces_that_share_nothing_do_not_overlap(flashlight, rng):
    frames, plane, sensor, _ = flashlight
    target = sensor.ray_image(frames[0], plane)
    w, h = frames[1].camera.rays()
    ball = (w - 0.02) ** 2 + (h - 0.02) ** 2 < 0.05**2
    depth_m = np.where(ball, 0.75 - np.sqrt(np.maximum(0.05**2 - (w - 0.02) ** 2 - (h - 0.02) ** 2, 0)), np.nan)
    other = replace(frames[1], depth_m=depth_m.astype(np.float32), mask=ball)
    source = sensor.ray_image(other, plane)
    posterior = VisibilityRegistrar().register(source, target, GeneralPrior().between(source, target), rng=rng)
    assert not posterior.usable or posterior.overlap < 0.8


def flat_view(index, angle_rad, shift_m, sensor):
    """A rectangle of 18 × 10 cm seen from above on a table, without noise."""
    camera = Camera(320, 240, 287.0, 287.0, 159.5, 119.5)
    w, h = camera.rays()
    x, y = 0.6 * w - shift_m, 0.6 * h
    along, across = np.cos(angle_rad) * x + np.sin(angle_rad) * y, np.cos(angle_rad) * y - np.sin(angle_rad) * x
    mask = (np.abs(along) < 0.09) & (np.abs(across) < 0.05)
    return sensor.ray_image(Frame(index, float(index), np.where(mask, 0.6, 0.65).astype(np.float32), camera, mask))


@pytest.mark.parametrize("sensor", [Sensor(), Sensor(SensorNoise(0.0, 0.0))])
def test_a_flat_object_from_above_without_noise_is_registered(sensor, rng):
    source, target = flat_view(1, np.radians(20.0), 0.01, sensor), flat_view(0, 0.0, 0.0, sensor)
    posterior = VisibilityRegistrar().register(source, target, GeneralPrior().between(source, target), rng=rng)
    truth = se3.exp(np.array([0.0, 0.0, -np.radians(20.0), 0.0, 0.0, 0.0])) @ se3.translation(
        np.array([-0.01, 0.0, 0.0])
    )
    assert posterior.usable
    assert np.linalg.eigvalsh(posterior.pose.covariance)[0] > 0.0
    assert rotation_error_deg(posterior.pose.mean, truth) < 3.0


@pytest.mark.parametrize("name", ["box", "flashlight"])
def test_the_choice_of_points_moves_an_answer_by_less_than_half_its_standard_deviation(name: str) -> None:
    sequence = open_sequence(bundled(name))
    noise = sequence.sensor()
    assert noise is not None
    squares = []
    for first in (0, 4):
        target, source = (Sensor(noise).ray_image(sequence.frame(index)) for index in (first, first + 1))
        density = GeneralPrior().between(source, target)
        found = [
            about_point(
                VisibilityRegistrar().register(source, target, density, rng=np.random.default_rng(seed)).pose,
                source.centroid_m,
            )
            for seed in range(4)
        ]
        moved = np.array([se3.log(se3.inverse(found[0].mean) @ pose.mean) for pose in found])
        moved -= moved.mean(axis=0)
        stated = np.mean([pose.covariance for pose in found], axis=0)
        squares.append(np.sum(moved * np.linalg.solve(stated, moved.T).T) / 3 / 6)
    assert np.mean(squares) < 0.5**2


def test_limits_narrower_than_the_search_are_an_outcome(flashlight, rng):
    frames, plane, sensor, _ = flashlight
    target, source = (sensor.ray_image(frame, plane) for frame in frames)
    density = GeneralPrior(0.001, 1e-5).between(source, target)
    posterior = VisibilityRegistrar().register(source, target, density, rng=rng)
    assert not posterior.usable
    assert np.isfinite(posterior.pose.covariance).all()
