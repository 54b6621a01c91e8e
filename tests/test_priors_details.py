"""What priors know besides: how sure learnt axes are, what an unsure table tilts, where a finger stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from prior_cases import NORMAL, edges, solution, told, turned, turntable, view, views

from modeler import se3
from modeler.priors import Poke, PokePrior, PredictedProposal, TablePrior, VelocityPrior
from modeler.priors.common_axis import Axis, common_axis
from modeler.priors.mixtures import DefensiveMixture, KernelMixture, directions_about
from modeler.priors.table import on_plane
from modeler.types import Array, Plane, PoseGaussian, RayImage

HERE = np.eye(4)
SOURCE, TARGET = views(HERE)


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
    told_up, told_down = (
        turntable(HERE, learned_axis=Axis(side * NORMAL, 0.01, np.array([0.02, 0.03, 0.82]), 0.001))
        for side in (1.0, -1.0)
    )
    samples = told_up.between(SOURCE, TARGET).sample(200, np.random.default_rng(0))
    np.testing.assert_allclose(
        told_down.between(SOURCE, TARGET).log_density(samples),
        told_up.between(SOURCE, TARGET).log_density(samples),
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
        Poke(told(contact_m), told(across), 0.01),
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
def test_the_pace_is_not_believed_for_long(index: int, goes_on: bool) -> None:
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
