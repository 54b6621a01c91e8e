"""The focal length as a variable that all edges share: how registrations follow it, and what a graph makes of that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rings import edge, turntable

from modeler import se3
from modeler.closure.map_view import composed
from modeler.evaluation import nees, rotation_error_deg, true_motion
from modeler.fusion import widened
from modeler.graph import MovingGraph, PoseGraph, estimate_focal_length, solve
from modeler.graph.focal import RELIEF_ERROR
from modeler.kernels import planes
from modeler.pipeline import Modeler
from modeler.priors import GeneralPrior, TablePrior
from modeler.rays import Sensor, under_focal_length
from modeler.registration import VisibilityRegistrar
from modeler.registration.visibility.focal_length import averaged
from modeler.registration.visibility.refinement import focal_motion
from modeler.types import (
    Array,
    Edge,
    FocalLength,
    Mode,
    ObjectModel,
    Outcome,
    PoseGaussian,
    Posterior,
    Solution,
    Step,
)
from sequences import FocalFactor, RefocusedSequence, bundled, open_sequence


def drawn(points: Array, factor: float) -> Array:
    """Points (..., 3) as they are measured under a longer focal length."""
    return points / (factor, factor, 1.0)


def distance_m(carried: Array, on_plane: Array, normal: Array, log_factor: float) -> float:
    """How far a point is behind a plane that it lies on, both measured under a longer focal length, once carried."""
    factor = np.exp(log_factor)
    turned = normal * (factor, factor, 1.0)
    point = se3.transform(se3.inverse(carried), on_plane[None])
    moved = se3.transform(carried, drawn(point, factor))[0]
    return float(turned @ (drawn(on_plane, factor) - moved) / np.linalg.norm(turned))


def test_distances_of_carried_points_from_planes_follow_the_focal_length(rng: np.random.Generator) -> None:
    for _ in range(20):
        carried, step = se3.exp(rng.normal(size=6) * np.repeat([0.5, 0.1], 3)), 1e-5
        on_plane, normal = rng.normal(size=3) * 0.1 + (0.0, 0.0, 0.8), rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        less, more = (distance_m(carried, on_plane, normal, shift) for shift in (-step, step))
        by_focal = (more - less) / (2.0 * step)
        np.testing.assert_allclose(focal_motion(carried, on_plane[None])[0] @ normal, by_focal, rtol=1e-6, atol=1e-9)


def test_a_posterior_states_how_its_mean_follows_the_focal_length() -> None:
    """By registering again under others. Turns are left out: of one pair their derivatives are known to some 0.1."""
    sequence, prior, step = open_sequence(bundled("box")), GeneralPrior(), 0.02
    noise = sequence.sensor()
    assert noise is not None
    sensor = Sensor(*noise)
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


def test_views_under_another_focal_length_are_those_measured_with_it() -> None:
    sequence, step = open_sequence(bundled("box")), 0.05
    sensor = Sensor(*(sequence.sensor() or ()))
    view = sensor.ray_image(sequence.frame(1))
    want, got = sensor.refocused(view, step), under_focal_length(view, step)
    assert got.frame.camera == want.frame.camera
    known, other = ({tuple(pixel): k for k, pixel in enumerate(one.pixels.tolist())} for one in (want, got))
    shared = sorted(known.keys() & other.keys())
    assert len(shared) > 0.9 * len(want.pixels)
    mine, yours = ([numbers[pixel] for pixel in shared] for numbers in (other, known))
    distances_m = np.sum((got.points_m[mine] - want.points_m[yours]) * want.normals[yours], axis=1)
    assert np.sqrt(np.mean(distances_m**2)) < 0.1 * sensor.sigma_r_m
    assert np.median(np.sum(got.normals[mine] * want.normals[yours], axis=1)) > np.cos(np.radians(0.5))
    for one in (got, under_focal_length(got, -step)):  # points lie on the planes of their pixels
        cells = one.layers["cells"][one.pixels[:, 0], one.pixels[:, 1]]
        heights_m = np.sum(cells[:, : planes.DISTANCE] * one.points_m, axis=1) + cells[:, planes.DISTANCE]
        np.testing.assert_allclose(heights_m, 0.0, atol=1e-6)
        np.testing.assert_allclose(one.normals, cells[:, : planes.DISTANCE], atol=1e-6)
    np.testing.assert_allclose(under_focal_length(got, -step).points_m, view.points_m, atol=1e-12)


CENTRE_M, FAR = np.array([0.0, 0.0, 0.8]), np.diag(np.repeat([0.1, 0.001], 3) ** 2)


def posterior_of(pose: PoseGaussian, seed: int = 0) -> Posterior:
    """A posterior with samples of a Gaussian, whose moments they have exactly."""
    drawn = np.random.default_rng(seed).normal(size=(400, 6))
    white = np.linalg.solve(np.linalg.cholesky(np.cov(drawn.T, bias=True)), (drawn - drawn.mean(axis=0)).T).T
    samples = pose.mean @ se3.exp(white @ np.linalg.cholesky(pose.covariance).T)
    weights = np.full(400, 1 / 400)
    return Posterior(1, 0, pose, Outcome.CONVERGED, overlap=0.8, samples=samples, weights=weights, seconds=0.0)


def about_centre(pose: PoseGaussian) -> Array:
    return se3.covariance_about(pose.covariance, CENTRE_M)


def test_of_poses_far_apart_what_their_derivative_does_not_tell_widens_the_posterior(rng: np.random.Generator) -> None:
    by_focal, bend = rng.normal(size=6), np.array([0.0, 4.0, 0.0, 0.0, 0.0, 0.0])  # per unit, rad
    pose = PoseGaussian(se3.translation(np.array([0.1, 0.0, 0.0])), se3.covariance_about(FAR, -CENTRE_M), by_focal)

    def under(log_factor: float, bend: Array | float = 0.0) -> Posterior:
        moved = pose.under(log_factor)
        return posterior_of(replace(moved, mean=se3.moved(moved.mean, log_factor * bend * np.ones(6), CENTRE_M)))

    found, sigma = posterior_of(pose), 0.02
    same = averaged(found, under, sigma, CENTRE_M).pose
    np.testing.assert_allclose(about_centre(same), FAR, rtol=0.02, atol=1e-5)  # to first order in ξ
    np.testing.assert_array_equal(same.by_focal, by_focal)
    bent = averaged(found, lambda log_factor: under(log_factor, bend), sigma, CENTRE_M).pose
    np.testing.assert_allclose(about_centre(bent)[1, 1], FAR[1, 1] + (sigma * bend[1]) ** 2, rtol=0.03)
    np.testing.assert_allclose(about_centre(bent)[0, 0], FAR[0, 0], rtol=0.03)


def test_precise_poses_separate_modes_and_known_focal_lengths_are_not_averaged() -> None:
    def never(_: float) -> Posterior:
        raise AssertionError

    far = PoseGaussian(np.eye(4), FAR)
    apart = tuple(Mode(0.5, replace(far, mean=se3.exp(np.array([angle, 0.0, 0, 0, 0, 0])))) for angle in (0.0, 1.0))
    for found, sigma in (
        (posterior_of(replace(far, covariance=0.1 * FAR)), 0.02),
        (replace(posterior_of(far), modes=apart), 0.02),
        (replace(posterior_of(far), outcome=Outcome.NO_OVERLAP), 0.02),
        (posterior_of(far), 0.0),
    ):
        assert averaged(found, never, sigma, CENTRE_M) is found


@pytest.mark.parametrize(("name", "wider"), [("tube", True), ("box", False)])
def test_a_body_of_revolution_may_have_turned_under_a_wrong_focal_length(name: str, wider: bool) -> None:
    """Under it, it is none, and seems not to have turned."""
    sequence = open_sequence(bundled(name))
    noise = sequence.sensor()
    assert noise is not None
    focal = FocalFactor(0.93, stated_px=sequence.frame(0).camera.fx)
    frames = [RefocusedSequence(sequence, focal).frame(index) for index in (2, 3)]
    found = []
    for sigma_focal in (0.0, 0.04):
        target, source = (Sensor(*noise[:3], sigma_focal=sigma_focal).ray_image(frame) for frame in frames)
        density = GeneralPrior().between(source, target)
        found.append(VisibilityRegistrar().register(source, target, density, rng=np.random.default_rng(0)))
    known, uncertain = (np.sqrt(one.pose.rotation_variance_rad2) for one in found)
    if wider:
        assert uncertain > 1.3 * known
    else:
        assert uncertain == known
        np.testing.assert_array_equal(found[0].pose.mean, found[1].pose.mean)


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
    assert found.told_by == "loop"
    assert found.log_factor == pytest.approx(0.03, abs=1e-4)
    assert found.sigmas_after < 0.05 < found.sigmas_before
    for frame, pose in moving.at(0.03).poses.items():
        np.testing.assert_allclose(pose, se3.inverse(truth[0]) @ truth[frame], atol=1e-6)


@pytest.mark.parametrize(("sigma", "believed"), [(0.004, True), (0.019, False)])
def test_a_mean_far_from_the_prior_is_believed_only_where_loops_tell_it(sigma: float, believed: bool) -> None:
    """Rounds of registration that each move it on, as a wrong edge makes them."""

    def estimate_at(log_factor: float) -> FocalLength:
        step = 0.07 if log_factor == 0.0 else 0.02
        return FocalLength(step, sigma, prior_sigma=0.02, loops=1, sigmas_before=3.0, sigmas_after=2.0, by_focal={})

    found = estimate_focal_length(estimate_at, rounds=3, tolerance=1.0, reach=0.1)
    assert (found.log_factor > 0.08, found.told_by) == ((True, "loop") if believed else (False, "prior"))
    if not believed:
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

    found = estimate_focal_length(estimate_at, rounds=5, tolerance=0.25, reach=0.1)
    assert found.log_factor == pytest.approx(true, abs=1e-9)
    assert len(asked) <= 3
    assert found.sigma == pytest.approx(np.hypot(0.004, 0.003 / share))


def test_an_open_chain_tells_nothing_and_is_as_uncertain_as_the_focal_length(rng: np.random.Generator) -> None:
    graph, _ = ring(0.0, rng, luck=1.0, closed=False)
    solution = solve(graph, {})
    found = MovingGraph.of(graph, solution).estimate(0.02)
    assert (found.log_factor, found.sigma, found.loops, found.told_by) == (0.0, 0.02, 0, "prior")
    widened, first = solve(graph, {}, focal=found), graph.edges[0].posterior.pose
    np.testing.assert_allclose(widened.relative_covariance(0, 1), first.widened(0.02).covariance, atol=1e-9)
    for frame in range(1, 10):
        more = widened.covariances[frame] - solution.covariances[frame]
        assert np.linalg.eigvalsh(more)[-1] > 0.0
        assert np.linalg.matrix_rank(more, tol=1e-9) == 1


def test_covariances_are_those_of_a_graph_with_the_focal_length_as_a_variable(rng: np.random.Generator) -> None:
    """All errors and the logarithm in one dense system of equations (method.md, eq. G12 to G14)."""
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


@cache
def built(sigma_focal: float) -> tuple[Step, dict[int, Array]]:
    """The last step of a run whose focal length is stated 3 % too long, and its true poses."""
    whole = open_sequence(bundled("box"))
    noise, truth = whole.sensor(), whole.truth()
    assert noise is not None
    assert truth is not None
    wrong = RefocusedSequence(whole, FocalFactor(1.03, whole.frame(0).camera.fx))
    modeler = Modeler(sensor=Sensor(*noise[:3], sigma_focal=sigma_focal), prior=TablePrior())
    frames = list(wrong)
    *_, last = modeler.run(frames, modeler.segmenter.scene(frames))
    assert isinstance(last, Step)
    return last, truth


def test_poses_and_views_of_a_run_are_those_of_the_focal_length_that_its_loops_tell() -> None:
    (told, truth), (held, _) = built(0.02), built(0.0)
    focal = told.solution.focal
    assert focal is not None
    assert held.solution.focal is None
    assert focal.told_by == "loop"
    assert focal.factor == pytest.approx(1.0 / 1.03, abs=0.01)
    assert abs(np.log(1.03 * focal.factor)) < 3.0 * focal.sigma
    ratio = told.views[0].frame.camera.fx / held.views[0].frame.camera.fx
    assert ratio == pytest.approx(focal.factor)
    off, squares = [], []
    for step in (told, held):
        poses = {frame: step.solution.relative_gaussian(0, frame) for frame in step.views if frame}
        off.append(np.mean([rotation_error_deg(pose.mean, true_motion(truth, 0, k)) for k, pose in poses.items()]))
        squares.append(np.mean([nees(pose, true_motion(truth, 0, k)) / 6.0 for k, pose in poses.items()]))
    assert off[0] < 0.7 * off[1]
    assert squares[0] < 0.2 * squares[1]


def test_edges_of_an_accepted_graph_are_those_under_the_focal_length() -> None:
    told, _ = built(0.02)
    assert all(isinstance(one, Edge) for one in told.edges_so_far)
    chi = MovingGraph.of(PoseGraph(told.edges_so_far), told.solution).estimate(0.02)
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
