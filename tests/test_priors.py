"""What every prior must keep: samples follow the density, support is respected, the camera's frame does not matter."""

import dataclasses
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from prior_cases import CASES, NORMAL, edges, held, solution, stated, truth, turned, turntable, view, views
from scipy import stats

from modeler import priors, se3
from modeler.priors import Poke, PokePrior, PredictedProposal, TablePrior, VelocityPrior
from modeler.priors.common_axis import Axis, common_axis
from modeler.priors.mixtures import DefensiveMixture, Gaussian, KernelMixture, directions_about
from modeler.priors.table import on_plane
from modeler.types import AbstractPoseDensity, AbstractPrior, Array, InputError, Plane, PoseGaussian, RayImage
from modeler.types.base import check_parameter

every_prior = pytest.mark.parametrize("name", CASES)
HERE = np.eye(4)
SOURCE, TARGET = views(HERE)
CENTRE_M = SOURCE.centroid_m


@cache
def density_of(name: str) -> AbstractPoseDensity:
    return CASES[name].density()


@cache
def drawn(name: str) -> Array:
    return density_of(name).sample(6000, np.random.default_rng(1))


def readings(poses: Array) -> dict[str, Array]:
    """Numbers that tell where poses are, each (n,)."""
    plane = SOURCE.plane
    assert isinstance(plane, Plane)
    offset_m = poses[:, :3, :3] @ CENTRE_M + poses[:, :3, 3] - TARGET.centroid_m
    vectors = se3.log(poses)[:, :3]
    tilt = np.arccos(np.clip((poses[:, :3, :3] @ plane.normal) @ plane.normal, -1, 1))
    return {
        "angle": np.linalg.norm(vectors, axis=1),
        "turn": vectors @ plane.normal,
        "tilt": tilt,
        "height": offset_m @ plane.normal,
        "distance": np.linalg.norm(offset_m, axis=1),
        "x": offset_m[:, 0],
    }


def near(poses: Array, log_density: Array) -> Gaussian:
    """A Gaussian about the densest of some poses, narrow enough to lie among its like."""
    best = poses[np.argmax(log_density)]
    about = Gaussian(best, np.eye(6), CENTRE_M)
    deviations = about.deviations(poses)
    for share in (0.5, 0.5, 0.5):
        spread = deviations.T @ deviations / len(deviations) + np.diag(np.repeat([1e-6, 1e-8], 3))
        distance = np.sum(deviations * np.linalg.solve(spread, deviations.T).T, axis=1)
        deviations = deviations[np.argsort(distance)[: max(int(share * len(deviations)), 60)]]
    spread = deviations.T @ deviations / len(deviations) + np.diag(np.repeat([1e-6, 1e-8], 3)) ** 2
    return Gaussian(best, spread, CENTRE_M)


@every_prior
def test_samples_lie_in_the_support_and_repeat_under_a_seed(name: str) -> None:
    samples = drawn(name)[:500]
    assert np.isfinite(density_of(name).log_density(samples)).all()
    assert np.isfinite(density_of(name).log_prior(samples)).all()
    again = CASES[name].density().sample(6000, np.random.default_rng(1))
    np.testing.assert_array_equal(drawn(name), again)
    np.testing.assert_allclose(np.linalg.det(samples[:, :3, :3]), 1.0)
    np.testing.assert_allclose(samples[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (500, 1)))


@every_prior
def test_the_truth_is_in_the_support(name: str) -> None:
    assert np.isfinite(density_of(name).log_density(truth(np.eye(4))[None]))


@every_prior
def test_the_density_integrates_to_one(name: str) -> None:
    """Bridge sampling (Meng and Wong 1996) between the samples and a Gaussian among them, whose density is known."""
    samples = drawn(name)
    gaussian = near(samples[::2], density_of(name).log_density(samples[::2]))
    others = gaussian.sample(15_000, np.random.default_rng(3))
    samples = samples[1::2]
    here, there = (
        np.clip(density_of(name).log_density(poses) - gaussian.log_density(poses), -500.0, 500.0)
        for poses in (samples, others)
    )
    share = len(samples) / (len(samples) + len(others))
    log_integral, of_others, of_samples = 0.0, np.ones(1), np.ones(1)
    for _ in range(50):
        of_others = 1.0 / (share * np.exp(-log_integral) + (1.0 - share) * np.exp(-there))
        of_samples = 1.0 / (share * np.exp(here - log_integral) + (1.0 - share))
        log_integral = float(np.log(of_others.mean() / of_samples.mean()))
    error = np.sqrt(sum(np.var(part) / np.mean(part) ** 2 / len(part) for part in (of_others, of_samples)))
    assert error < 0.08
    assert log_integral == pytest.approx(0.0, abs=4.0 * error)


@every_prior
def test_samples_follow_the_density(name: str) -> None:
    """A Metropolis step that keeps the density must keep the samples as they are distributed."""
    rng = np.random.default_rng(2)
    samples = drawn(name)[:4000]
    local = near(drawn(name), density_of(name).log_density(drawn(name)))
    nudges = Gaussian(np.eye(4), 0.3 * local.covariance, np.zeros(3)).sample(len(samples), rng)
    moved = samples.copy()
    moved[:, :3, :3] = samples[:, :3, :3] @ nudges[:, :3, :3]
    place_m = samples[:, :3, :3] @ CENTRE_M + samples[:, :3, 3] + nudges[:, :3, 3]
    moved[:, :3, 3] = place_m - moved[:, :3, :3] @ CENTRE_M
    gain = density_of(name).log_density(moved) - density_of(name).log_density(samples)
    accept = np.log(rng.random(len(samples))) < gain
    assert 0.02 < accept.mean() < 0.995
    kept = np.where(accept[:, None, None], moved, samples)
    fresh = readings(density_of(name).sample(4000, rng))
    for reading, values in readings(kept).items():
        assert np.array(stats.ks_2samp(values, fresh[reading]))[1] > 1e-4, reading


@every_prior
def test_the_choice_of_camera_frame_does_not_matter(name: str) -> None:
    case = CASES[name]
    turn = se3.exp(np.array([0.3, -0.5, 0.2, 0.1, -0.2, 0.3]) * np.repeat([name != "features", 1], 3))
    samples = drawn(name)[:500]
    np.testing.assert_allclose(
        case.density(turn).log_density(turn @ samples @ se3.inverse(turn)),
        density_of(name).log_density(samples),
        atol=case.shaken,
    )


@every_prior
def test_evidence_is_all_of_the_density_or_what_is_known_without_the_guess(name: str) -> None:
    far = se3.exp(np.random.default_rng(0).normal(size=(500, 6)) * np.repeat([0.3, 0.03], 3)) @ truth(np.eye(4))
    poses = np.concatenate([drawn(name)[:500], far])
    density, evidence = (of(poses) for of in (density_of(name).log_density, density_of(name).log_prior))
    assert density_of(name).evidence is not CASES[name].proposes
    np.testing.assert_array_equal(np.isfinite(density), np.isfinite(evidence))
    if not CASES[name].proposes:
        np.testing.assert_allclose(evidence, density)


@pytest.mark.parametrize("name", ["velocity", "features", "turntable that has learnt", "velocity on a table"])
def test_a_guess_carries_no_information(name: str) -> None:
    """Weighted by evidence over density, samples of a guess are samples of what is known without it."""
    samples = drawn(name)
    log_weights = density_of(name).log_prior(samples) - density_of(name).log_density(samples)
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    known = getattr(density_of(name), "known").sample(6000, np.random.default_rng(7))  # noqa: B009
    for reading, values in readings(samples).items():
        expected = readings(known)[reading]
        error = np.sqrt(np.sum(weights**2 * (values - weights @ values) ** 2) + np.var(expected) / len(expected))
        assert weights @ values == pytest.approx(expected.mean(), abs=4.5 * error), reading


@pytest.mark.parametrize(("name", "variance"), [("held", 0.5), ("velocity", 1.0)])
def test_evidence_counts_once_and_guesses_not_at_all(name: str, variance: float) -> None:
    """Images as sure of the turn as the prior halve its variance where the prior is evidence, else they stand alone."""
    prior = CASES[name].prior(np.eye(4))
    sigma_deg = 3.0
    if isinstance(prior, priors.HeldPrior):
        prior = dataclasses.replace(held(np.eye(4)), held_sigma_deg=sigma_deg)
    elif isinstance(prior, priors.VelocityPrior):
        prior = dataclasses.replace(prior, velocity_sigma_deg=sigma_deg)
    density = prior.between(SOURCE, TARGET)
    samples = density.sample(40_000, np.random.default_rng(8))
    turn_deg = np.degrees(se3.log(se3.inverse(truth(np.eye(4))) @ samples)[:, 0])
    log_weights = density.log_prior(samples) - density.log_density(samples) - 0.5 * (turn_deg / sigma_deg) ** 2
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    found = weights @ (turn_deg - weights @ turn_deg) ** 2
    assert found == pytest.approx(variance * sigma_deg**2, rel=0.06)


@every_prior
def test_priors_learn_and_grow_without_changing_what_they_are(name: str) -> None:
    prior = CASES[name].prior(np.eye(4))
    assert type(prior.learned(solution(np.eye(4)), ())) is type(prior)
    assert type(prior.relaxed(3.0)) is type(prior)
    assert np.isfinite(prior.relaxed(2.0).between(SOURCE, TARGET).log_density(turned(-np.radians(24.0))[None]))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308, -1e308, 0.0])
@every_prior
def test_a_value_out_of_range_is_refused_by_name(name: str, bad: float) -> None:
    prior = CASES[name].prior(np.eye(4))
    assert dataclasses.is_dataclass(prior)
    for field in dataclasses.fields(prior):
        value = getattr(prior, field.name)
        if isinstance(value, float):
            values = {field.name: bad}
        elif isinstance(value, tuple) and value and isinstance(value[0], float) and bad:
            values = {field.name: (bad, *value[1:])}
        else:
            continue
        if bad == 1e308 and field.name in UNITLESS:
            continue
        if bad == 0.0 and field.name in MAY_BE_ZERO:
            check_parameter(field.name, bad)
            continue
        with pytest.raises(InputError, match=rf"^{field.name} .*out of range; give "):
            dataclasses.replace(prior, **values)


@pytest.mark.parametrize("bad", [np.zeros((6, 6)), np.full((6, 6), np.nan), -np.eye(6), np.triu(np.ones((6, 6)))])
def test_a_gaussian_needs_a_covariance(bad: Array) -> None:
    with pytest.raises(InputError, match="covariance"):
        Gaussian(np.eye(4), bad, np.zeros(3))


MAY_BE_ZERO = {"step_sigma_deg", "axis_sigma_deg", "axis_sigma_m", "wobble_deg", "wobble_m"}  # known for certain
UNITLESS = {"regrasp_probability", "steps", "kernels", "max_offset", "friction_sigma"}


def test_names_of_parameters_carry_units() -> None:
    found = [kind for kind in vars(priors).values() if isinstance(kind, type) and dataclasses.is_dataclass(kind)]
    numbers = [
        field.name
        for kind in found
        if issubclass(kind, AbstractPrior)
        for field in dataclasses.fields(kind)
        if str(field.type).startswith(("float", "tuple[float"))
    ]
    assert len(numbers) > 20
    for name in set(numbers) - UNITLESS:
        assert name.endswith(("_deg", "_m", "_s", "_direction")), name


# What priors know besides: how sure learnt axes are, what an unsure table tilts, where a finger stays.


def at(index: int, plane: Plane | None = TARGET.plane) -> RayImage:
    return view(index, TARGET.points_m, plane)


def turning(count: int, seed: int = 0) -> list[PoseGaussian]:
    return [edge.posterior.pose for edge in edges(HERE, count, seed=seed)]


def found(motions: list[PoseGaussian]) -> Axis:
    axis = common_axis(motions, 1e-5, 1e-6)
    assert axis is not None
    return axis


def test_an_axis_is_no_surer_than_the_pairs_agree() -> None:
    honest = turning(8)
    boasting = [replace(pose, covariance=pose.covariance / 25.0) for pose in honest]
    sure = np.mean([found(boasting).sigma_direction_rad / found(turning(8, s)).sigma_direction_rad for s in range(6)])
    assert sure > 0.6  # and not a fifth


def test_the_axis_is_that_of_the_newest_pairs() -> None:
    """A camera that somebody moves: what pairs of long ago turned about counts no more."""
    moved = se3.exp(np.array([0.5, 0.2, 0.0, 0.0, 0.0, 0.0]))
    before = [PoseGaussian(moved @ pose.mean @ se3.inverse(moved), pose.covariance) for pose in turning(200)]
    axis = found([*before, *turning(60, seed=1)])
    assert np.degrees(np.linalg.norm(np.cross(axis.direction, NORMAL))) < 1.0


def test_a_learnt_axis_is_a_line_without_an_upper_end() -> None:
    stated_up, stated_down = (
        turntable(HERE, learned_axis=Axis(side * NORMAL, 0.01, np.array([0.02, 0.03, 0.82]), 0.001))
        for side in (1.0, -1.0)
    )
    samples = stated_up.between(SOURCE, TARGET).sample(200, np.random.default_rng(0))
    np.testing.assert_allclose(
        stated_down.between(SOURCE, TARGET).log_density(samples),
        stated_up.between(SOURCE, TARGET).log_density(samples),
        rtol=1e-9,
    )


@pytest.mark.parametrize("turn_rad", [0.3, 1.2, np.pi])
def test_an_unsure_normal_tilts_what_turns_about_it(turn_rad: float) -> None:
    rng = np.random.default_rng(0)
    plane = Plane(NORMAL, 0.7, 0.03, 0.001)
    beside = on_plane(at(1, plane), at(0, plane), turn_rad=turn_rad, shift_m=0.0, sigma_tilt_rad=0.0, sigma_lift_m=1.0)
    off = 0.03 * rng.normal(size=(4000, 2)) @ beside.axes[:2]
    normals = se3.exp(np.concatenate([off, np.zeros((4000, 3))], axis=1))[:, :3, :3] @ NORMAL
    turns = se3.exp(np.concatenate([turn_rad * normals, np.zeros((4000, 3))], axis=1))[:, :3, :3]
    tilt_rad = np.arccos(np.clip(turns @ NORMAL @ NORMAL, -1.0, 1.0))
    assert beside.sigma_tilt_rad == pytest.approx(np.sqrt(np.mean(tilt_rad**2) / 2.0), rel=0.05)


def test_wherever_the_centre_of_friction_lies_the_contact_goes_with_the_finger() -> None:
    across = np.cross(NORMAL, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    aside = 0.03 * np.cross(NORMAL, across)
    contact_m = TARGET.centroid_m + aside
    prior = PokePrior(
        Poke(stated(contact_m), stated(across), 0.01),
        poke_sigma_m=1e-6,
        poke_sigma_deg=1e-4,
        centre_sigma_m=0.03,
        friction_sigma=1e-3,
    )
    motions = prior.between(at(0), at(1)).sample(2000, np.random.default_rng(0))
    off_m = motions[:, :3, :3] @ contact_m + motions[:, :3, 3] - (contact_m + 0.01 * across)
    in_plane_m = off_m - np.outer(off_m @ NORMAL, NORMAL)
    assert np.sqrt(np.mean(np.sum(in_plane_m**2, axis=1))) < 1.5e-3


@pytest.mark.parametrize(("index", "goes_on"), [(3, True), (5, True), (6, False), (12, False)])
def test_the_pace_is_not_used_for_long(index: int, goes_on: bool) -> None:
    prior = VelocityPrior(TablePrior(175.0, 0.2)).learned(solution(HERE, 3), ())
    assert isinstance(prior.between(at(index), at(2)), DefensiveMixture) == goes_on


def test_what_the_graph_foretells_is_never_taken_for_surer_than_a_search_needs() -> None:
    density = PredictedProposal(TablePrior(), PoseGaussian(turned(-0.1), 1e-14 * np.eye(6))).between(SOURCE, TARGET)
    assert isinstance(density, DefensiveMixture)
    (guess,) = density.proposals
    assert isinstance(guess, KernelMixture)
    assert (guess.sigma_rad, guess.sigma_m) == (pytest.approx(np.radians(2.0)), 0.004)


@pytest.mark.parametrize("concentration", [0.01, 3.0, 400.0])
def test_directions_about_an_axis_have_the_mean_that_their_concentration_says(concentration: float) -> None:
    drawn = directions_about(NORMAL, concentration, 40_000, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1.0)
    mean: Array = drawn.mean(axis=0)
    assert mean @ NORMAL == pytest.approx(1.0 / np.tanh(concentration) - 1.0 / concentration, abs=0.01)
    assert np.linalg.norm(mean - (mean @ NORMAL) * NORMAL) < 0.01
