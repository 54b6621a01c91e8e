"""The focal length as a variable that all edges share: how registrations follow it, and what a graph makes of that."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from ring_graphs import edge, turntable

from modeler import se3
from modeler.closure.map_view import composed
from modeler.evaluation import nees, rotation_error_deg, true_motion
from modeler.graph import MovingGraph, PoseGraph, estimate_focal_length, solve
from modeler.graph.focal import RELIEF_ERROR
from modeler.pipeline import Modeler
from modeler.priors import GeneralPrior, TablePrior
from modeler.registration import VisibilityRegistrar
from modeler.registration.posterior import FocalNuisance
from modeler.registration.visibility import VisibilityLikelihood
from modeler.registration.visibility.sampling import AdaptiveSampler, GaussianMixture
from modeler.sequences import FocalFactor, RefocusedSequence, bundled, open_sequence
from modeler.types import (
    AbstractPoseDensity,
    Array,
    Edge,
    FocalLength,
    Frame,
    ObjectModel,
    PoseGaussian,
    SensorNoise,
    Solution,
    Step,
)
from modeler.verdict.spreads import widened
from modeler.views import Sensor
from modeler.views.rays import part_of


def test_a_posterior_states_how_its_mean_follows_the_focal_length() -> None:
    """By registering again under others. Turns are left out: of one pair their derivatives are known to some 0.1."""
    sequence, prior, step = open_sequence(bundled("box")), GeneralPrior(), 0.02
    noise = sequence.sensor()
    sensor = Sensor(noise._replace(sigma_focal=step))
    target, source = (sensor.ray_image(sequence.frame(index)) for index in (1, 2))

    def registered(log_factor: float, seed: int) -> PoseGaussian:
        one, other = (sensor.refocused(view, log_factor) for view in (source, target))
        rng = np.random.default_rng(seed)
        return VisibilityRegistrar().register(one, other, prior.between(one, other), rng=rng).pose

    centre_m = source.centroid_m
    again = [[registered(sign * step, seed).mean for sign in (-1.0, 1.0)] for seed in range(2)]
    wanted = np.mean([se3.difference(less, more, centre_m) for less, more in again], axis=0) / (2.0 * step)
    stated = np.mean([registered(0.0, seed).by_focal for seed in range(2)], axis=0)
    about_centre = se3.adjoint(se3.translation(-centre_m)) @ stated
    assert np.linalg.norm(wanted[3:]) > 0.05
    np.testing.assert_allclose(about_centre[3:], wanted[3:], atol=0.02)  # at 2 %: a standard deviation
    np.testing.assert_allclose(about_centre[:3], wanted[:3], atol=0.3)


CENTRE_M, SIGMAS = np.array([0.05, -0.02, 0.7]), np.repeat([0.01, 0.002], 3)
ABOUT = se3.exp(np.array([0.2, -0.1, 0.3, 0.01, 0.02, -0.03]))


class Free(AbstractPoseDensity):
    """A wide Gaussian about a motion, which proposes and is no evidence."""

    evidence = False

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        return gaussian(ABOUT, 3.0 * SIGMAS).sample(count, rng)

    def log_density(self, target_from_source: Array) -> Array:
        return gaussian(ABOUT, 3.0 * SIGMAS).log_density(target_from_source)


def gaussian(mean: Array, sigmas: Array) -> GaussianMixture:
    return GaussianMixture(mean[None], np.diag(sigmas)[None], np.zeros(1), CENTRE_M)


@pytest.mark.parametrize("bend", [0.0, 20.0])
def test_the_derivative_is_exact_and_what_it_does_not_tell_widens_the_posterior(
    bend: float, rng: np.random.Generator
) -> None:
    """Although proposals follow the focal length only roughly."""
    sigma, by_focal = 0.02, rng.normal(size=6) * np.repeat([1.0, 0.2], 3)
    curved = np.array([bend, 0.0, 0.0, 0.0, 0.0, 0.0])  # rad, per unit squared

    def log_likelihood(poses: Array, log_focal: Array) -> Array:
        given = poses @ se3.exp(-log_focal[:, None] * by_focal)
        xi = se3.difference(ABOUT, given, CENTRE_M) - log_focal[:, None] ** 2 * curved
        return -0.5 * np.sum((xi / SIGMAS) ** 2, axis=1)

    roughly = FocalNuisance(sigma, 0.8 * by_focal)
    sampler = AdaptiveSampler(samples=4000, max_draws=20000)
    found = sampler.run(Free(), log_likelihood, CENTRE_M, rng, nuisance=roughly).conditional(CENTRE_M)
    about_centre = se3.adjoint(se3.translation(-CENTRE_M)) @ (found.nuisance.by_focal - by_focal)
    np.testing.assert_allclose(sigma * about_centre / SIGMAS, 0.0, atol=0.15)
    mean, covariance = se3.mean(found.poses, found.weights, about_m=CENTRE_M)
    shift = se3.difference(ABOUT, mean, CENTRE_M) - sigma**2 * curved
    np.testing.assert_allclose(shift / SIGMAS, 0.0, atol=0.15)
    want = SIGMAS**2 + 2.0 * sigma**4 * curved**2
    # The tail of a bent posterior has few samples: over seeds 0.6 to 1.0; without what the bend adds, 0.44.
    np.testing.assert_allclose(np.diag(covariance) / want, 1.0, atol=0.4)


def test_a_narrow_prior_keeps_its_motion_under_every_focal_length(rng: np.random.Generator) -> None:
    class Exact(Free):
        def log_prior(self, target_from_source: Array) -> Array:
            return gaussian(ABOUT, 0.1 * SIGMAS).log_density(target_from_source)

    by_focal = np.array([0.5, 0.0, 0.0, 0.0, 0.1, 0.0])

    def log_likelihood(poses: Array, log_focal: Array) -> Array:
        return gaussian(ABOUT, SIGMAS).log_density(poses @ se3.exp(-log_focal[:, None] * by_focal))

    found = AdaptiveSampler(samples=1000).run(
        Exact(), log_likelihood, CENTRE_M, rng, nuisance=FocalNuisance(0.02, by_focal)
    )
    about_centre = se3.adjoint(se3.translation(-CENTRE_M)) @ found.conditional(CENTRE_M).nuisance.by_focal
    np.testing.assert_allclose(0.02 * about_centre / SIGMAS, 0.0, atol=0.15)  # 1 without the prior


def test_a_single_sample_depends_on_no_focal_length(rng: np.random.Generator) -> None:
    found = AdaptiveSampler(samples=100).run(
        Free(), lambda poses, log_focal: np.zeros(len(poses)), CENTRE_M, rng, nuisance=FocalNuisance(0.02, np.zeros(6))
    )
    single = replace(found, weights=np.eye(len(found.weights))[3])
    np.testing.assert_array_equal(single.conditional(CENTRE_M).poses, single.poses)


def test_poses_are_scored_under_a_focal_length_as_views_that_were_made_with_it() -> None:
    sequence, step = open_sequence(bundled("box")), 0.01
    sensor = Sensor(sequence.sensor() or SensorNoise())
    source, target = (sensor.ray_image(sequence.frame(index)) for index in (2, 1))
    truth = sequence.truth()
    assert truth is not None
    pose = true_motion(truth, target=1, source=2)[None]
    model = VisibilityLikelihood(points=5000)
    pair, other = (
        model.between(sensor.refocused(source, shift), sensor.refocused(target, shift), np.random.default_rng(0))
        for shift in (0.0, step)
    )
    as_given, under, wanted = (
        float(one.scores(pose, 0.001, stride=1, log_focal=shift).surface[0])
        for one, shift in ((pair, None), (pair, np.array([step])), (other, None))
    )
    assert abs(as_given - wanted) > 50.0  # nats
    assert under == pytest.approx(wanted, abs=0.2 * abs(as_given - wanted))


def test_inverse_and_composed_motions_follow_as_their_parts_do(rng: np.random.Generator) -> None:
    def gaussian() -> PoseGaussian:
        return PoseGaussian(se3.exp(rng.normal(size=6)), 1e-4 * np.eye(6), rng.normal(size=6))

    one, other, step = gaussian(), gaussian(), 1e-6
    np.testing.assert_allclose(one.inverse().under(0.3).mean, se3.inverse(one.under(0.3).mean), atol=1e-12)
    both = composed(one, other).under(step).mean
    np.testing.assert_allclose(both, composed(one.under(step), other.under(step)).mean, atol=1e-11)


def ring(
    log_factor: float, rng: np.random.Generator, *, luck: float, closed: bool = True
) -> tuple[PoseGraph, Mapping[int, Array]]:
    """A turn whose edges were registered under another focal length than the true one, and its true poses."""
    poses, edges = turntable(10), []
    for source in range(1, 11 if closed else 10):
        target, source = source - 1, source % 10
        covariance = np.diag(np.repeat([0.005, 0.001], 3) ** 2)
        by_focal = rng.normal(size=6) * np.repeat([0.2, 0.05], 3)
        noise = luck * rng.normal(size=6) * np.sqrt(np.diag(covariance))
        mean = se3.inverse(poses[target]) @ poses[source] @ se3.exp(noise) @ se3.exp(-log_factor * by_focal)
        edges.append(
            edge(target, source, PoseGaussian(mean, covariance, by_focal), "odometry" if source else "closure")
        )
    return PoseGraph(tuple(edges)), poses


def test_a_loop_tells_the_focal_length_and_the_poses_under_it(rng: np.random.Generator) -> None:
    graph, truth = ring(0.03, rng, luck=0.0)
    moving = MovingGraph.of(graph, solve(graph, {}))
    found = moving.estimate(1.0)
    assert found.determined_by == "loop"
    assert found.log_factor == pytest.approx(0.03, abs=1e-4)
    assert found.sigmas_after < 0.05 < found.sigmas_before
    for frame, pose in moving.at(0.03).poses.items():
        np.testing.assert_allclose(pose, se3.inverse(truth[0]) @ truth[frame], atol=1e-6)


@pytest.mark.parametrize(("sigma", "accepted"), [(0.004, True), (0.019, False)])
def test_a_mean_far_from_the_prior_is_accepted_only_where_loops_determine_it(sigma: float, accepted: bool) -> None:
    """Rounds of registration that each move it on, as a wrong edge makes them."""

    def estimate_at(log_factor: float) -> FocalLength:
        step = 0.07 if log_factor == 0.0 else 0.02
        return FocalLength(step, sigma, prior_sigma=0.02, loops=1, sigmas_before=3.0, sigmas_after=2.0, by_focal={})

    found = estimate_focal_length(estimate_at, reach=0.1)
    assert (found.log_factor > 0.08, found.determined_by) == ((True, "loop") if accepted else (False, "prior"))
    if not accepted:
        assert (found.log_factor, found.sigma) == (0.0, 0.02)


@pytest.mark.parametrize("share", [0.35, 0.6, 1.0])
def test_steps_that_are_too_short_are_followed_to_where_they_end(share: float) -> None:
    """And the less of the way they go, the more the noise of edges moves that place."""
    true, asked = 0.05, list[float]()

    def estimate_at(log_factor: float) -> FocalLength:
        asked.append(log_factor)
        step = share * (true - log_factor)
        sigma = float(np.hypot(0.004, 0.003))
        return FocalLength(step, sigma, 0.05, 9, sigmas_before=3.0, sigmas_after=1.0, by_focal={}, noise_sigma=0.003)

    found = estimate_focal_length(estimate_at, reach=0.1)
    assert found.log_factor == pytest.approx(true, abs=1e-9)
    assert len(asked) <= 3
    assert found.sigma == pytest.approx(np.hypot(0.004, 0.003 / share))


def test_an_open_chain_tells_nothing_and_is_as_uncertain_as_the_focal_length(rng: np.random.Generator) -> None:
    graph, _ = ring(0.0, rng, luck=1.0, closed=False)
    solution = solve(graph, {})
    found = MovingGraph.of(graph, solution).estimate(0.02)
    assert (found.log_factor, found.sigma, found.loops, found.determined_by) == (0.0, 0.02, 0, "prior")
    widened, first = solve(graph, {}, focal=found), graph.edges[0].posterior.pose
    np.testing.assert_allclose(widened.relative_covariance(0, 1), first.widened(0.02).covariance, atol=1e-9)
    for frame in range(1, 10):
        more = widened.covariances[frame] - solution.covariances[frame]
        assert np.linalg.eigvalsh(more)[-1] > 0.0
        assert np.linalg.matrix_rank(more, tol=1e-9) == 1


def test_covariances_are_those_of_a_graph_with_the_focal_length_as_a_variable(rng: np.random.Generator) -> None:
    """All errors and the logarithm in one dense system of equations (method, eq. 10.3 to 10.6)."""
    graph, _ = ring(0.0, rng, luck=1e-3)
    solution, prior_sigma = solve(graph, {}), 0.02
    found = MovingGraph.of(graph, solution).estimate(prior_sigma)
    found = replace(found, sigma=float(np.sqrt(found.sigma**2 - RELIEF_ERROR**2)))
    rows = [np.eye(1, 61, 60) / prior_sigma]
    for one in graph.edges:
        local = np.linalg.inv(np.linalg.cholesky(one.posterior.pose.covariance))
        block = np.zeros((6, 61))
        motion = local @ se3.adjoint(se3.inverse(solution.trajectory[one.source]))
        block[:, 6 * one.source : 6 * one.source + 6] += motion
        block[:, 6 * one.target : 6 * one.target + 6] -= motion
        block[:, 60] = -local @ one.posterior.pose.by_focal
        rows.append(block)
    information = np.vstack(rows)[:, 6:]
    joint = np.linalg.inv(information.T @ information)
    assert found.sigma == pytest.approx(np.sqrt(joint[-1, -1]), rel=0.02)
    widened = solve(graph, {}, focal=found)
    for frame in (1, 4, 9):
        own = slice(6 * frame - 6, 6 * frame)
        to_camera = se3.adjoint(se3.inverse(solution.trajectory[frame]))
        wanted = to_camera @ joint[own, own] @ to_camera.T
        whiten = np.linalg.inv(np.linalg.cholesky(wanted))
        np.testing.assert_allclose(whiten @ widened.covariances[frame] @ whiten.T, np.eye(6), atol=0.04)


def _small(frame: Frame) -> Frame:
    return replace(part_of(frame, slice(None, None, 4), slice(None, None, 4)), colour=None)


@cache
def built(sigma_focal: float) -> tuple[Step, dict[int, Array]]:
    """The last step of a run, of small images, whose focal length is stated 3 % too long, and the true poses."""
    whole = open_sequence(bundled("box"))
    noise, truth = whole.sensor(), whole.truth()
    assert truth is not None
    frames = [_small(frame) for frame in RefocusedSequence(whole, FocalFactor(1.03, whole.frame(0).camera.fx))]
    modeler = Modeler(sensor=Sensor(noise._replace(sigma_focal=sigma_focal)), prior=TablePrior())
    *_, last = modeler.run(frames, modeler.segmenter.scene(frames))
    assert isinstance(last, Step)
    return last, truth


def test_poses_and_views_of_a_run_are_those_of_the_focal_length_that_its_loops_tell() -> None:
    (shown, truth), (held, _) = built(0.02), built(0.0)
    focal = shown.solution.focal
    assert held.solution.focal is None
    assert focal.determined_by == "loop"
    assert focal.factor == pytest.approx(1.0 / 1.03, abs=0.01)
    assert abs(np.log(1.03 * focal.factor)) < 3.0 * focal.sigma
    ratio = shown.views[0].frame.camera.fx / held.views[0].frame.camera.fx
    assert ratio == pytest.approx(focal.factor)
    off, squares = [], []
    for step in (shown, held):
        poses = {frame: step.solution.relative_gaussian(0, frame) for frame in step.views if frame}
        off.append(np.mean([rotation_error_deg(pose.mean, true_motion(truth, 0, k)) for k, pose in poses.items()]))
        squares.append(np.mean([nees(pose, true_motion(truth, 0, k)) / 6.0 for k, pose in poses.items()]))
    assert off[0] < 0.7 * off[1]
    assert squares[0] < 0.2 * squares[1]


def test_edges_of_an_accepted_graph_are_those_under_the_focal_length() -> None:
    shown, _ = built(0.02)
    assert all(isinstance(one, Edge) for one in shown.edges_so_far)
    chi = MovingGraph.of(PoseGraph(shown.edges_so_far), shown.solution).estimate(0.02)
    assert abs(chi.log_factor) < 0.003


def test_vertices_are_as_uncertain_as_what_the_focal_length_does_to_them(rng: np.random.Generator) -> None:
    """A view at rest: its points are drawn towards the axis, so that surface moves along x and y in proportion."""
    normals = rng.normal(size=(50, 3)) * 0.2 - (0.0, 0.0, 1.0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices_m, empty = rng.normal(size=(50, 3)) * 0.05 + (0.0, 0.0, 0.8), np.zeros((0, 3))
    sigmas_m = np.full(50, 1e-4)
    model = ObjectModel(empty, empty, None, vertices_m, np.zeros((0, 3), np.int64), normals, None, None, sigmas_m)
    focal = FocalLength(0.0, 0.02, 0.02, 0, 0.0, 0.0, {0: np.zeros(6)})
    found = widened(model, Solution({0: np.eye(4)}, focal=focal)).vertex_sigmas_m
    drawn_m = 0.02 * np.sum(normals[:, :2] * vertices_m[:, :2], axis=1)
    assert found is not None
    np.testing.assert_allclose(found, np.hypot(1e-4, drawn_m))
    assert widened(model, Solution({0: np.eye(4)})) is model
