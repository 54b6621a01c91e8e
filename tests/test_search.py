"""The search for modes of the posterior."""

from dataclasses import replace

import numpy as np
import pytest
from bundled_views import views

from modeler import se3
from modeler.evaluation import rotation_error_deg, true_motion
from modeler.priors import GeneralPrior, TablePrior
from modeler.registration.visibility import VisibilityLikelihood, VisibilityRegistrar
from modeler.registration.visibility.search import Candidates, Search
from modeler.sequences.rendering import RenderedSequence
from modeler.types import Outcome
from studies.calibration.by_camera import shown, viewed
from studies.calibration.depth_cameras import CAMERAS
from studies.calibration.specimens import load_specimen
from studies.calibration.study import Condition, rendered_views, staged

MIN_OVERLAP = VisibilityRegistrar().min_overlap
WIDE = GeneralPrior(max_rotation_deg=95.0, max_offset_m=0.08)  # the other way round a box is beyond


def candidates(poses, sigmas, scores):
    """Candidates with round Gaussians: standard deviations of ξ, the same in rad and m."""
    spreads = np.array(sigmas)[:, None, None] * np.eye(6)
    return Candidates(np.stack(poses), np.array(scores, dtype=float), spreads)


def turned(angle_rad):
    return se3.exp(np.array([angle_rad, 0, 0, 0, 0, 0]))


@pytest.mark.parametrize("name", ["box", "flashlight"])
def test_the_search_finds_the_motion_in_a_wide_prior(name, rng):
    source, target, truth = views(name, source=2, target=0)
    density = GeneralPrior(max_rotation_deg=110.0, max_offset_m=0.08).between(source, target)
    pair = VisibilityLikelihood().between(source, target, rng)
    found = Search().run(pair, density, rng, min_overlap=MIN_OVERLAP)
    assert np.isfinite(density.log_density(found.poses)).all()
    assert (np.diff(found.scores) <= 0).all()
    rolled_deg = min(rotation_error_deg(pose, truth) for pose in found.poses)
    assert rolled_deg < 8.0  # a flashlight's roll is all but free


@pytest.mark.parametrize(("limit_deg", "any_rotation"), [(50.0, False), (110.0, False), (180.0, True)])
def test_a_prior_without_limits_leaves_the_rotation_open(limit_deg, any_rotation, rng):
    """Then poses match by chance, and the images must not contradict the answer: of cut-off masks they do."""
    source, target, _ = views("box", source=1, target=0)
    pair = VisibilityLikelihood().between(source, target, rng)
    density = GeneralPrior(max_rotation_deg=limit_deg, max_offset_m=0.3).between(source, target)
    assert Search().run(pair, density, rng, min_overlap=MIN_OVERLAP).any_rotation == any_rotation


@pytest.fixture(scope="module")
def bracket():
    """A rendered bracket turned by 50° on a table, and the true motion."""
    sequence = RenderedSequence(staged(load_specimen("l_bracket"), Condition(step_deg=50.0), frames=2, seed=1))
    made, (earlier, later) = rendered_views(sequence), sequence.indices
    return made[later], made[earlier], true_motion(sequence.truth(), earlier, later)


@pytest.mark.parametrize("seed", range(2))
def test_any_turn_may_be_found_from_nothing(bracket, seed):
    source, target, truth = bracket
    density = GeneralPrior(max_rotation_deg=180.0, max_offset_m=0.2).between(source, target)
    posterior = VisibilityRegistrar().register(source, target, density, rng=np.random.default_rng(seed))
    assert posterior.outcome is Outcome.CONVERGED
    assert rotation_error_deg(posterior.pose.mean, truth) < 5.0


def test_nothing_lies_below_the_support(bracket, rng):
    """Turned by half a turn about an axis in the table, through it: surface that no image contradicts."""
    source, target, truth = bracket
    likelihood = VisibilityLikelihood()
    flipped = truth.copy()
    lying = np.cross(target.plane.normal, [0.0, 0.0, 1.0])
    half = 2.0 * np.outer(lying, lying) / (lying @ lying) - np.eye(3)
    centre = se3.transform(truth, source.centroid_m[None])[0] - target.plane.normal * 2.0 * source.size_m
    flipped[:3, :3] = half @ truth[:3, :3]
    flipped[:3, 3] = centre - flipped[:3, :3] @ source.centroid_m
    poses = np.stack([truth, flipped])
    standing = likelihood.between(source, target, np.random.default_rng(0))
    floating = likelihood.between(replace(source, plane=None), replace(target, plane=None), np.random.default_rng(0))
    seen, unseen = (pair.scores(poses, 0.002, stride=1).surface for pair in (standing, floating))
    assert seen[0] == pytest.approx(unseen[0], abs=1.0)
    assert seen[1] < unseen[1] - 1000.0


def test_a_turn_beyond_the_prior_shows(rng):
    source, target, truth = views("box", source=1, target=0)
    pair = VisibilityLikelihood().between(source, target, rng)
    narrow = GeneralPrior(max_rotation_deg=12.0).between(source, target)
    assert not np.isfinite(narrow.log_density(truth[None]))[0]
    assert Search().run(pair, narrow, rng, min_overlap=MIN_OVERLAP).beyond_gain > 5.0
    wide = GeneralPrior(max_rotation_deg=60.0, max_offset_m=0.08).between(source, target)
    assert Search().run(pair, wide, rng, min_overlap=MIN_OVERLAP).beyond_gain < 5.0
    assert VisibilityRegistrar().register(source, target, narrow, rng=rng).outcome is Outcome.AT_LIMIT


def test_a_stool_may_have_turned_either_way():
    """Four legs: 40° on and 50° back look alike, and both are found, however near descent leads to either."""
    sequence = RenderedSequence(staged(load_specimen("stool"), Condition(step_deg=40.0), frames=2, seed=3660532166))
    made, truth = rendered_views(sequence), sequence.truth()
    target, source = (made[index] for index in sequence.indices)
    right = true_motion(truth, target.index, source.index)
    density = GeneralPrior().between(source, target)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        found = Search().run(VisibilityLikelihood().between(source, target, rng), density, rng, min_overlap=MIN_OVERLAP)
        turned_deg = np.array([rotation_error_deg(pose, right) for pose in found.poses])
        assert (turned_deg < 3.0).any()
        assert (np.abs(turned_deg - 90.0) < 3.0).any()


def test_a_small_part_that_alone_determines_the_spin_is_not_blurred_away():
    """The lever of a fire extinguisher: coarsely, its views match best 75° off."""
    specimen = load_specimen("fire_extinguisher")
    sequence = RenderedSequence(staged(specimen, Condition(step_deg=40.0), frames=3, seed=1283680154))
    target, source = viewed([sequence.frame(index) for index in sequence.indices[:2]], None)
    right, density = true_motion(sequence.truth(), target.index, source.index), TablePrior().between(source, target)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        found = Search().run(VisibilityLikelihood().between(source, target, rng), density, rng, min_overlap=MIN_OVERLAP)
        assert min(rotation_error_deg(pose, right) for pose in found.poses) < 10.0


def observed(camera, shape, condition):
    """Source and target of a shape before a depth camera, the true motion, and its density under the table prior."""
    sequence = RenderedSequence(staged(load_specimen(shape), condition, frames=2, seed=1))
    target, source = viewed(shown(sequence, CAMERAS[camera], np.random.default_rng(1), seed=1), CAMERAS[camera])
    truth = true_motion(sequence.truth(), target.index, source.index)
    return source, target, truth, TablePrior().between(source, target)


def test_noise_leaves_more_than_one_spin_of_a_body_of_revolution():
    """With the noise of a D435, the spins of a soup plate differ by chance, in which the true one may lose."""
    source, target, right, density = observed("D435", "soup_plate", Condition(distance_m=0.7, step_deg=25.0))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        found = Search().run(VisibilityLikelihood().between(source, target, rng), density, rng, min_overlap=MIN_OVERLAP)
        turned_deg = [rotation_error_deg(pose, right) for pose in found.poses]
        assert min(turned_deg) < 10.0
        assert max(turned_deg) > 40.0


def test_a_six_fold_shape_may_have_turned_farther():
    """40° on and 20° back look alike, but for what the object and the laser's shadows hide of 40°."""
    source, target, right, density = observed("laser stripe", "gear_wheel", Condition(distance_m=0.6, step_deg=40.0))
    for seed in range(3):
        found = VisibilityRegistrar().register(source, target, density, rng=np.random.default_rng(seed))
        shares = [mode.weight for mode in found.modes if rotation_error_deg(mode.pose.mean, right) < 3.0]
        assert sum(shares) > 0.1  # 0.01 to 0.03 if hidden points and holes count


@pytest.mark.parametrize("seed", range(2))
def test_the_posterior_of_a_tube_spans_its_roll(seed):
    """Turning a body of revolution about its axis moves no surface: what the prior leaves open stays open."""
    source, target, truth = views("tube", source=1, target=0)
    density = GeneralPrior().between(source, target)
    found = VisibilityRegistrar().register(source, target, density, rng=np.random.default_rng(seed))
    axis = np.linalg.svd(source.points_m - source.centroid_m, full_matrices=False)[2][0]
    rolls_deg = np.degrees(se3.difference(truth, found.samples, source.centroid_m)[:, :3] @ axis)
    mean = found.weights @ rolls_deg
    sigma_deg = np.sqrt(found.weights @ (rolls_deg - mean) ** 2)
    assert sigma_deg > 10.0  # more than of any rotation that is called known
    assert abs(mean) < 3.0 * sigma_deg


def test_a_chain_of_candidates_shares_a_mode():
    basin = np.repeat([0.2, 0.01], 3)
    poses = [np.eye(4), turned(1.5), turned(0.7), turned(0.35)]
    modes = candidates(poses, [0.01, 0.01, 0.01, 0.01], [4, 3, 2, 1]).modes(np.zeros(3), basin)
    assert [len(mode) for mode in modes] == [3, 1]
    np.testing.assert_array_equal(modes[0].poses[0], np.eye(4))


def test_candidates_near_a_better_one_are_dropped():
    found = candidates([np.eye(4), turned(0.005), turned(0.02)], [0.01, 0.01, 0.01], [3, 2, 1]).distinct(np.zeros(3))
    assert found.scores.tolist() == [3.0, 1.0]


@pytest.fixture(scope="module")
def box():
    """A box turned by 75°: one of its sides is all that both views show."""
    source, target, truth = views("box", source=3, target=0)
    pair = VisibilityLikelihood().between(source, target, np.random.default_rng(0))
    return pair, WIDE.between(source, target), truth


def test_a_uniform_prior_does_not_pull_to_its_mean(box):
    """Where little surface matches, the mean of the prior is no better than its limits."""
    pair, density, truth = box
    found = Search().run(pair, density, np.random.default_rng(1), min_overlap=MIN_OVERLAP)
    assert rotation_error_deg(found.poses[0], truth) < 5.0
