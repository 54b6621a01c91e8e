"""Adaptive importance sampling: its samples stand for the posterior, whatever they were drawn from; mixtures, modes."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from modeler import se3
from modeler.evaluation import rotation_error_deg
from modeler.kernels.mixture import separate_two
from modeler.priors.general import GeneralDensity
from modeler.registration.posterior import effective_samples, pareto_tail, weighted_gaussian
from modeler.registration.visibility.registrar import overlapping
from modeler.registration.visibility.sampling import (
    AdaptiveSampler,
    GaussianMixture,
    LogLikelihood,
    MixtureProposal,
    WeightedSamples,
    thinned,
    weigh_modes,
)
from modeler.types import AbstractPoseDensity, Array

CENTRE_M = np.array([0.05, -0.02, 0.7])
ABOUT = se3.exp(np.array([0.2, -0.1, 0.3, 0.01, 0.02, -0.03]))
SIGMAS = np.array([0.05, 0.02, 0.08, 0.004, 0.01, 0.002])


@dataclass(frozen=True, eq=False)
class Around(AbstractPoseDensity):
    """A Gaussian of ξ about a motion, the only thing known."""

    sigmas: Array
    evidence: bool = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        return gaussian(ABOUT, self.sigmas).sample(count, rng)

    def log_density(self, target_from_source: Array) -> Array:
        return gaussian(ABOUT, self.sigmas).log_density(target_from_source)


def gaussian(mean: Array, sigmas: Array) -> GaussianMixture:
    return GaussianMixture(mean[None], np.diag(sigmas)[None], np.zeros(1), CENTRE_M)


def test_a_mixture_may_have_thousands_of_gaussians() -> None:
    one, count = gaussian(ABOUT, SIGMAS), 3000
    many = GaussianMixture(one.means.repeat(count, 0), one.spreads.repeat(count, 0), np.zeros(count), CENTRE_M)
    poses = one.sample(5, np.random.default_rng(0))
    np.testing.assert_allclose(many.log_density(poses), one.log_density(poses) + np.log(count), atol=1e-9)


def away(xi: Array) -> Array:
    return se3.moved(ABOUT, xi, CENTRE_M)


def of_poses(log_density: Callable[[Array], Array]) -> LogLikelihood:
    """A log-likelihood of poses alone, under a focal length that is certain."""
    return lambda poses, _: log_density(poses)


@pytest.mark.parametrize("narrower", [1.0, 0.3, 0.05])
def test_samples_are_those_of_prior_times_likelihood(narrower: float) -> None:
    """However little of the prior the likelihood leaves: mean, covariance and evidence are the product's."""
    shift = narrower * SIGMAS * np.array([1.0, -1.0, 0.5, 0.5, -1.0, 1.0])
    images = gaussian(away(shift), narrower * SIGMAS)
    found = AdaptiveSampler(samples=6000).run(
        Around(SIGMAS), of_poses(images.log_density), CENTRE_M, np.random.default_rng(1)
    )
    assert found.weights.sum() == pytest.approx(1.0)
    assert found.effective_samples > 3500.0
    mean, covariance = se3.mean(found.poses, found.weights, about_m=CENTRE_M)
    precision = 1.0 + narrower**-2.0
    off = se3.difference(ABOUT, mean, CENTRE_M) - shift * narrower**-2.0 / precision
    product = SIGMAS / np.sqrt(precision)
    np.testing.assert_allclose(off / product, 0.0, atol=0.08)
    np.testing.assert_allclose(covariance / np.outer(product, product), np.eye(6), atol=0.12)
    both = np.hypot(SIGMAS, narrower * SIGMAS)
    evidence = -0.5 * np.sum((shift / both) ** 2) - np.sum(np.log(both)) - 3.0 * np.log(2.0 * np.pi)
    assert found.log_marginal_likelihood == pytest.approx(evidence, abs=0.05)
    assert found.pareto_k < 0.5


def test_two_modes_and_a_curved_ridge_keep_their_shares() -> None:
    """What one Gaussian cannot draw well, several do; and the weights are right with either."""
    apart = np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])
    heaps = gaussian(away(apart), 0.8 * SIGMAS).times(3.0).plus(gaussian(away(-apart), 0.8 * SIGMAS))
    wide = Around(np.array([0.3, 0.03, 0.1, 0.006, 0.015, 0.003]))

    def bent(poses: Array) -> Array:
        xi = se3.difference(ABOUT, poses, CENTRE_M)
        return -0.5 * ((xi[:, 4] - 0.2 * xi[:, 0] ** 2) / 0.003) ** 2 - 0.5 * np.sum((xi[:, 1:3] / 0.02) ** 2, axis=1)

    shares, slopes = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        one = AdaptiveSampler(samples=2000).run(wide, of_poses(heaps.log_density), CENTRE_M, rng)
        shares.append(one.weights[se3.difference(ABOUT, one.poses, CENTRE_M)[:, 0] > 0.0].sum())
        other = AdaptiveSampler(samples=2000).run(wide, of_poses(bent), CENTRE_M, rng)
        xi = se3.difference(ABOUT, other.poses, CENTRE_M)
        slopes.append(other.weights @ (xi[:, 4] * xi[:, 0] ** 2) / (other.weights @ xi[:, 0] ** 4))
        assert min(one.effective_samples, other.effective_samples) > 500.0
    assert np.mean(shares) == pytest.approx(0.75, abs=0.02)
    assert np.mean(slopes) == pytest.approx(0.2, abs=0.02)


def test_a_poor_proposal_costs_samples_and_not_correctness() -> None:
    """What only proposes is divided out: the result is the likelihood's own Gaussian."""
    images = gaussian(away(3.0 * SIGMAS), SIGMAS)
    found = AdaptiveSampler(samples=3000).run(
        Around(SIGMAS, evidence=False), of_poses(images.log_density), CENTRE_M, np.random.default_rng(3)
    )
    mean, covariance = se3.mean(found.poses, found.weights, about_m=CENTRE_M)
    np.testing.assert_allclose(se3.difference(ABOUT, mean, CENTRE_M) / SIGMAS, 3.0, atol=0.1)
    np.testing.assert_allclose(np.diag(covariance) / SIGMAS**2, 1.0, atol=0.15)


def test_it_draws_no_more_than_it_may_and_states_its_effective_size() -> None:
    narrow = gaussian(away(4.0 * SIGMAS), 0.01 * SIGMAS)
    found = AdaptiveSampler(draws=200, max_draws=400).run(
        Around(SIGMAS), of_poses(narrow.log_density), CENTRE_M, np.random.default_rng(0)
    )
    assert len(found.poses) <= 400
    assert found.effective_samples < 100.0


@pytest.mark.parametrize(("roughness_nats", "usable"), [(3.0, True), (8.0, False)])
def test_a_rough_likelihood_determines_its_mode_less_precisely(roughness_nats: float, usable: bool) -> None:
    """Differences between neighbouring poses that are chance leave few samples; tempered, they are about the mode."""
    images, noise = gaussian(ABOUT, SIGMAS), np.random.default_rng(7)

    def rough(poses: Array) -> Array:
        return images.log_density(poses) + roughness_nats * noise.normal(size=len(poses))

    found = AdaptiveSampler(max_draws=3000).run(
        Around(SIGMAS, evidence=False), of_poses(rough), CENTRE_M, np.random.default_rng(0)
    )
    assert (found.effective_samples >= 100.0) == usable
    if usable:
        mean, covariance = se3.mean(found.poses, found.weights, about_m=CENTRE_M)
        np.testing.assert_allclose(se3.difference(ABOUT, mean, CENTRE_M) / SIGMAS, 0.0, atol=0.6)
        assert 0.7 < np.mean(np.diag(covariance) / SIGMAS**2) < 2.2


def test_the_likelihood_is_called_only_inside_the_support_and_an_empty_support_is_no_evidence() -> None:
    class Nowhere(Around):
        def log_prior(self, target_from_source: Array) -> Array:
            return np.full(len(target_from_source), -np.inf)

    def never(poses: Array, _: Array) -> Array:
        raise AssertionError(f"called with {len(poses)} impossible poses")

    found = AdaptiveSampler(max_draws=600).run(
        Nowhere(SIGMAS, evidence=False), never, CENTRE_M, np.random.default_rng(0)
    )
    assert found.log_marginal_likelihood == -np.inf
    assert np.all(np.isfinite(found.weights))


@pytest.mark.parametrize("spread", [0.0, 1.0, 4.0])
def test_thinned_samples_weigh_what_they_did_on_average(spread: float) -> None:
    rng = np.random.default_rng(0)
    weights = np.exp(spread * rng.normal(size=300))
    weights /= weights.sum()
    total, kept = np.zeros(300), np.zeros(0)
    for _ in range(2000):
        chosen, kept = thinned(weights, 60, rng)
        assert len(chosen) == len(np.unique(chosen)) <= 60
        assert kept.sum() == pytest.approx(1.0)
        total[chosen] += kept
    np.testing.assert_allclose(total / 2000, weights, atol=4.0 * np.sqrt(weights.max() / 60 / 2000))
    assert 1.0 / np.sum(kept**2) > 0.9 * min(60.0, effective_samples(np.log(weights)))


def test_thinning_leaves_the_few_as_they_are() -> None:
    chosen, kept = thinned(np.array([0.5, 0.0, 0.3, 0.2]), 3, np.random.default_rng(0))
    assert chosen.tolist() == [0, 2, 3]
    assert kept.tolist() == [0.5, 0.3, 0.2]


def test_the_tail_of_steeply_falling_weights_raises_no_warning() -> None:
    log_weights = -np.random.default_rng(0).exponential(400.0, size=2000)
    assert np.isfinite(pareto_tail(log_weights)) or pareto_tail(log_weights) == -np.inf
    assert pareto_tail(3.0 * np.random.default_rng(1).exponential(1.0, size=4000)) > 0.7


def turned(angle_rad):
    return se3.exp(np.array([angle_rad, 0, 0, 0, 0, 0]))


def mode(poses, log_marginal_likelihood):
    """Samples of equal weight."""
    return WeightedSamples(
        poses, np.full(len(poses), 1.0 / len(poses)), np.zeros(len(poses)), log_marginal_likelihood, 0.1
    )


def test_modes_are_weighed_and_those_of_no_weight_dropped(rng):
    here = turned(0.0) @ se3.exp(0.01 * rng.normal(size=(200, 6)))
    there = turned(1.5) @ se3.exp(0.01 * rng.normal(size=(200, 6)))
    one = weigh_modes([mode(here, 0.0), mode(there, -20.0)])
    two = weigh_modes([mode(here, 0.0), mode(there, np.log(3.0))])
    assert [share for share, _ in one] == [1.0]
    np.testing.assert_allclose([share for share, _ in two], [0.75, 0.25])
    heaviest = two[0][1]
    assert rotation_error_deg(weighted_gaussian(heaviest.poses, heaviest.weights, np.zeros(3)).mean, turned(1.5)) < 1.0


def mixture(rng):
    """Three Gaussians a few centimetres off the axes of motion, over a general prior."""
    centre_m = np.array([0.02, -0.05, 0.8])
    prior = GeneralDensity(centre_m, centre_m + 0.01, max_rotation_rad=0.9, max_offset_m=0.04)
    means = se3.exp(rng.normal(size=(3, 6)) * np.repeat([0.3, 0.02], 3))
    spreads = np.linalg.cholesky(np.stack([np.cov(rng.normal(size=(6, 20))) for _ in range(3)]))
    spreads *= np.repeat([0.1, 0.005], 3)[:, None]
    return MixtureProposal(prior, GaussianMixture(means, spreads, np.log([0.5, 0.3, 0.2]), centre_m))


def test_without_limits_the_volume_of_motions_without_overlap_does_not_outweigh_a_likelier_match() -> None:
    match, nothing = mode(turned(0.1)[None], 0.0), mode(turned(2.0)[None], 20.0)
    shown = {0.1: 0.9, 2.0: 0.1}

    def overlap(pose):
        return shown[round(float(se3.rotation_angle(pose)), 6)]

    likelier = replace(match, log_likelihoods=np.array([5.0]))
    assert overlapping([nothing, likelier], overlap, 0.5) == [likelier]
    assert overlapping([nothing, replace(match, log_likelihoods=np.array([-5.0]))], overlap, 0.5)[0] is nothing
    assert overlapping([nothing, likelier], overlap, 0.95) == [nothing, likelier]


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
    narrow = GaussianMixture(several.means[:1], 0.01 * several.spreads[:1], np.zeros(1), several.centre_m)
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
    np.testing.assert_array_equal(density.log_prior(samples), density.known.log_density(samples))


def test_a_narrow_peak_on_a_broad_ridge_is_separated_by_expectation_maximisation(rng: np.random.Generator) -> None:
    count, peak = 2000, np.full(6, 0.4)
    white = rng.normal(size=(count, 6))
    white[: count // 4] = peak + 0.1 * white[: count // 4]
    weights = rng.uniform(0.5, 1.5, count)
    near = np.sum((white - peak) ** 2, axis=1) < 0.5
    members = weights * np.stack([near, ~near])
    assert separate_two(white, weights, members, 30, 0.05, 1e-4)
    np.testing.assert_allclose(members.sum(axis=0), weights, rtol=1e-9)
    narrow, rest = members
    assert narrow.sum() / weights.sum() == pytest.approx(0.25, abs=0.02)
    np.testing.assert_allclose(narrow @ white / narrow.sum(), peak, atol=0.02)
    np.testing.assert_allclose(np.sqrt(narrow @ (white - peak) ** 2 / narrow.sum()), 0.1, rtol=0.1)
    np.testing.assert_allclose(np.sqrt(rest @ white**2 / rest.sum()), 1.0, rtol=0.1)


def test_a_gaussian_of_next_to_no_weight_is_not_determined(rng: np.random.Generator) -> None:
    white, weights = rng.normal(size=(500, 6)), np.ones(500)
    members = weights * np.stack([np.arange(500) < 3, np.arange(500) >= 3])
    assert not separate_two(white, weights, members, 12, 0.05, 1e-4)
