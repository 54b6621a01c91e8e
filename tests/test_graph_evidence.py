"""Evidence is counted once: what only proposes where to look reaches neither the edge nor the solved graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
import pytest
from rings import OBJECT_M, edge, nees

from modeler import se3
from modeler.graph import PoseGraph, solve
from modeler.registration.posterior import weighted_gaussian
from modeler.registration.visibility.sampling import AdaptiveSampler
from modeler.types import AbstractPoseDensity, Array, PoseGaussian

VARIANCE = 0.02e-2  # the check of the design, in units of a tenth of a radian and of a metre
SAMPLER = AdaptiveSampler(enough=1000.0, kept=2000)
CENTRE = se3.translation(OBJECT_M)
ABOUT = se3.adjoint(CENTRE)
SPREAD = VARIANCE * ABOUT @ ABOUT.T  # the variance in all directions, about the object


@final
@dataclass(frozen=True, eq=False)
class Known(AbstractPoseDensity):
    """A Gaussian about a motion, of VARIANCE in all directions about the object."""

    mean: Array
    evidence: bool

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        xi = np.sqrt(VARIANCE) * rng.normal(size=(count, 6))
        return self.mean @ CENTRE @ se3.exp(xi) @ se3.inverse(CENTRE)

    def log_density(self, target_from_source: Array) -> Array:
        return _log_gaussian(target_from_source, self.mean) - 3.0 * np.log(2.0 * np.pi * VARIANCE)


def _log_gaussian(poses: Array, mean: Array) -> Array:
    xi = se3.log(se3.inverse(mean @ CENTRE) @ poses @ CENTRE)
    return -0.5 * np.sum(xi**2, axis=-1) / VARIANCE


def _off(pose: Array, rng: np.random.Generator) -> Array:
    """A measurement of a pose with an error of VARIANCE."""
    return pose @ CENTRE @ se3.exp(-np.sqrt(VARIANCE) * rng.normal(size=6)) @ se3.inverse(CENTRE)


def _registered(density: AbstractPoseDensity, images: Array, rng: np.random.Generator) -> PoseGaussian:
    """The posterior of images that alone would say `images`, with VARIANCE, sampled from `density` on."""
    found = SAMPLER.run(density, lambda poses: _log_gaussian(poses, images), OBJECT_M, rng)
    return weighted_gaussian(found.poses, found.weights, OBJECT_M)


def _share(covariance: Array) -> float:
    """The variance as a share of VARIANCE, over all directions."""
    about = np.linalg.inv(ABOUT) @ covariance @ np.linalg.inv(ABOUT).T
    return float(np.exp(np.linalg.slogdet(about / VARIANCE)[1] / 6.0))


@pytest.mark.parametrize(("evidence", "wanted", "weight"), [(False, 1.0, 1.0), (True, 0.5, 0.5)])
def test_a_proposal_leaves_the_edge_to_the_images_and_evidence_does_not(
    evidence: bool, wanted: float, weight: float
) -> None:
    """Half a standard deviation apart, with variances of 0.02 each: images alone keep 0.02, both together have 0.01."""
    shares, pulls = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        expected = se3.exp(np.array([0.1, 0.4, 0.0, -0.3, 0.0, 0.1]))
        xi = np.full(6, 0.5 * np.sqrt(VARIANCE))
        images = expected @ CENTRE @ se3.exp(xi) @ se3.inverse(CENTRE)
        posterior = _registered(Known(expected, evidence), images, rng)
        shares.append(_share(posterior.covariance))
        moved = se3.log(se3.inverse(expected @ CENTRE) @ posterior.mean @ CENTRE)
        pulls.append(float(moved @ xi / (xi @ xi)))
    assert np.mean(shares) == pytest.approx(wanted, rel=0.08)
    assert np.mean(pulls) == pytest.approx(weight, abs=0.1)


def test_a_closure_proposed_by_the_graph_halves_its_variance_and_no_more() -> None:
    """Two measurements of variance 0.02 make 0.01. Were the proposal counted again, they would make 0.0067."""
    trials = 24
    errors, shares, twice = np.zeros(trials), np.zeros(trials), np.zeros(trials)
    truth = se3.exp(np.array([0.1, 0.4, 0.0, -0.3, 0.0, 0.1]))
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        first = edge(0, 1, PoseGaussian(_off(truth, rng), SPREAD))
        predicted = solve(PoseGraph((first,)), {}).relative(0, 1)
        images = _off(truth, rng)
        for evidence in (False, True):
            closure = edge(0, 1, _registered(Known(predicted, evidence), images, rng), "closure")
            solution = solve(PoseGraph((first, closure)), {})
            pose = PoseGaussian(solution.trajectory[1], solution.covariances[1])
            if evidence:
                twice[trial] = nees(pose, truth)
            else:
                errors[trial], shares[trial] = nees(pose, truth), _share(pose.covariance)
    assert np.mean(shares) == pytest.approx(0.5, rel=0.05)
    assert np.mean(errors) == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / trials))
    assert np.mean(twice) > 1.2 * np.mean(errors)  # what the mistake would look like
