"""Where the posterior may have its mass: the search, its separate places, and the mixture that samples start from."""

from dataclasses import replace

import numpy as np
import pytest
from calibration.specimens import load_specimen
from calibration.study import Condition, rendered_views, staged

from modeler import se3
from modeler.evaluation import rotation_error_deg, true_motion
from modeler.priors import GeneralPrior
from modeler.priors.general import GeneralDensity
from modeler.rays import Sensor
from modeler.registration.candidates import Candidates
from modeler.registration.mixture import Gaussians, MixtureProposal
from modeler.registration.modes import ModeSamples, split_modes, weigh_modes
from modeler.registration.search import Search
from modeler.registration.visibility import VisibilityRegistrar
from modeler.types import Outcome
from sequences import bundled, open_sequence
from sequences.rendering.renderer import RenderedSequence


def views(name, source, target):
    """Two frames of a bundled sequence made ready, and the true motion."""
    sequence = open_sequence(bundled(name))
    truth, noise = sequence.truth(), sequence.sensor()
    assert truth is not None
    assert noise is not None
    sensor = Sensor(*noise)
    made = [sensor.ray_image(sequence.frame(index)) for index in (source, target)]
    return *made, true_motion(truth, target=target, source=source)


def candidates(poses, sigmas, scores, coarse=None):
    """Candidates with round Gaussians: standard deviations of ξ, the same in rad and m."""
    spreads = np.array(sigmas)[:, None, None] * np.eye(6)
    coarse = np.zeros(len(poses), dtype=bool) if coarse is None else np.array(coarse)
    return Candidates(np.stack(poses), np.array(scores, dtype=float), spreads, coarse)


def turned(angle_rad):
    return se3.exp(np.array([angle_rad, 0, 0, 0, 0, 0]))


@pytest.mark.parametrize("name", ["box", "flashlight"])
def test_the_search_finds_the_motion_in_a_wide_prior(name, rng):
    source, target, truth = views(name, source=2, target=0)
    density = GeneralPrior(max_rotation_deg=110.0, max_offset_m=0.08).between(source, target)
    pair = VisibilityRegistrar().pair(source, target, rng)
    found = Search().candidates(pair, density, rng)
    assert np.isfinite(density.log_density(found.poses)).all()
    assert (np.diff(found.scores[~found.coarse]) <= 0).all()
    rolled_deg = min(rotation_error_deg(pose, truth) for pose in found.poses)
    assert rolled_deg < 8.0  # a flashlight's roll is all but free


def test_a_turn_beyond_the_prior_shows(rng):
    source, target, truth = views("box", source=1, target=0)
    pair = VisibilityRegistrar().pair(source, target, rng)
    narrow = GeneralPrior(max_rotation_deg=12.0).between(source, target)
    assert not np.isfinite(narrow.log_density(truth[None]))[0]
    assert Search().candidates(pair, narrow, rng).beyond > VisibilityRegistrar().max_beyond
    wide = GeneralPrior(max_rotation_deg=60.0, max_offset_m=0.08).between(source, target)
    assert Search().candidates(pair, wide, rng).beyond < VisibilityRegistrar().max_beyond
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
        found = Search().candidates(VisibilityRegistrar().pair(source, target, rng), density, rng)
        turned_deg = np.array([rotation_error_deg(pose, right) for pose in found.poses[~found.coarse]])
        assert (turned_deg < 3.0).any()
        assert (np.abs(turned_deg - 90.0) < 3.0).any()


def test_the_search_goes_on_along_the_ridge_of_a_roll(rng):
    """From one good pose of a tube the whole of its roll is found, and what was found coarse is kept."""
    source, target, truth = views("tube", source=1, target=0)
    density = GeneralPrior().between(source, target)
    pair, search = VisibilityRegistrar().pair(source, target, rng), Search()
    coarse = candidates([truth @ turned(0.1)], [0.1], [0.0], [True])
    onward = search.onward(pair, density, coarse, truth[None], rng)
    rolled_deg = [rotation_error_deg(pose, truth) for pose in onward.poses[~onward.coarse]]
    assert max(rolled_deg) > 20.0
    assert onward.coarse.sum() == 1
    sharp = onward.some(~onward.coarse)
    assert sharp.scores[0] >= search.scores(pair, truth[None], search.blurs[-1] * pair.size_m)[0] - 1e-6
    assert sharp.scores[-1] > sharp.scores[0] - search.negligible


def test_candidates_that_reach_each_other_share_a_place():
    near, far = turned(0.02), turned(1.5)
    places = split_modes(candidates([np.eye(4), near, far], [0.01, 0.01, 0.01], [3, 2, 1]), np.zeros(3))
    assert [len(place) for place in places] == [2, 1]
    np.testing.assert_array_equal(places[0].poses[0], np.eye(4))


def test_a_blunt_candidate_joins_what_it_covers_and_is_no_place_itself():
    ends = [turned(-0.2), turned(0.2)]
    alone = split_modes(candidates(ends, [0.01, 0.01], [2, 1]), np.zeros(3))
    joined = split_modes(
        candidates([*ends, np.eye(4), turned(2.0)], [0.01, 0.01, 0.1, 0.1], [2, 1, 0, 0], [False, False, True, True]),
        np.zeros(3),
    )
    assert [len(place) for place in alone] == [1, 1]
    assert [len(place) for place in joined] == [3]


def test_places_are_weighed_and_those_of_no_weight_dropped(rng):
    here = turned(0.0) @ se3.exp(0.01 * rng.normal(size=(200, 6)))
    there = turned(1.5) @ se3.exp(0.01 * rng.normal(size=(200, 6)))
    even = np.full(200, 1.0 / 200)
    one = weigh_modes([ModeSamples(here, even, 0.0, 200.0, 0.1), ModeSamples(there, even, -20.0, 200.0, 0.1)])
    two = weigh_modes([ModeSamples(here, even, 0.0, 200.0, 0.1), ModeSamples(there, even, np.log(3.0), 200.0, 0.1)])
    assert [share for share, _ in one] == [1.0]
    np.testing.assert_allclose([share for share, _ in two], [0.75, 0.25])
    assert rotation_error_deg(two[0][1].gaussian(np.zeros(3)).mean, turned(1.5)) < 1.0


def mixture(rng):
    """Three Gaussians a few centimetres off the axes of motion, over a general prior."""
    centre_m = np.array([0.02, -0.05, 0.8])
    known = GeneralDensity(centre_m, centre_m + 0.01, max_rotation_rad=0.9, max_offset_m=0.04)
    means = se3.exp(rng.normal(size=(3, 6)) * np.repeat([0.3, 0.02], 3))
    spreads = np.linalg.cholesky(np.stack([np.cov(rng.normal(size=(6, 20))) for _ in range(3)]))
    spreads *= np.repeat([0.1, 0.005], 3)[:, None]
    return MixtureProposal(known, Gaussians(means, spreads, np.log([0.5, 0.3, 0.2]), centre_m))


def test_a_mixture_has_the_density_of_its_samples(rng):
    """∫ q over a broad known density, by importance: 1; and the mean of log q agrees with the entropy of samples."""
    density = mixture(rng)
    broad = replace(density.gaussians, spreads=2.0 * density.gaussians.spreads)
    samples = broad.sample(40_000, rng)
    ratio = np.exp(density.log_density(samples) - broad.log_density(samples))
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std() / np.sqrt(len(ratio))


def test_a_narrow_component_has_the_gaussian_density(rng):
    density = mixture(rng)
    several = density.gaussians
    narrow = Gaussians(several.means[:1], 0.01 * several.spreads[:1], np.zeros(1), several.centre_m)
    centre = se3.translation(several.centre_m)
    xi = (narrow.spreads[0] @ rng.normal(size=(6, 50))).T
    poses = narrow.means[0] @ centre @ se3.exp(xi) @ se3.inverse(centre)
    covariance = narrow.spreads[0] @ narrow.spreads[0].T
    expected = -0.5 * np.einsum("ni,ij,nj->n", xi, np.linalg.inv(covariance), xi)
    expected -= 0.5 * np.linalg.slogdet(2.0 * np.pi * covariance)[1]
    np.testing.assert_allclose(narrow.log_density(poses), expected, atol=1e-4)


def test_a_mixture_only_proposes(rng):
    density = mixture(rng)
    samples = density.sample(200, rng)
    np.testing.assert_array_equal(density.log_evidence(samples), density.known.log_density(samples))
