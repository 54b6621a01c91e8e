"""Posteriors with several modes in the graph: loops and the other edges decide, and what is not decided stays wide."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import final

import numpy as np
import pytest
from ring_graphs import OBJECT_M, covariance, edge, measured, nees, ring, rotation_error, spin, turntable

from modeler import se3
from modeler.graph import PoseGraph, Smoother, modes, solve
from modeler.registration.posterior import weighted_gaussian
from modeler.registration.visibility.sampling import AdaptiveSampler
from modeler.types import AbstractPoseDensity, Array, Edge, EdgeKind, Mode, PoseGaussian, are_separate

COUNT = 12
WRONG_RAD = (np.pi / 2, -np.pi / 2, np.pi)


def _spun(pose: PoseGaussian, angle_rad: float) -> PoseGaussian:
    """The same bump where the object has turned by a further angle about its own axis, as a square box might have."""
    return PoseGaussian(pose.mean @ spin([0.0, angle_rad, 0.0]), pose.covariance)


def _ambiguous(truth: Mapping[int, Array], target: int, source: int, *, rng: np.random.Generator, weights: list[float],
               kind: EdgeKind = "odometry") -> Edge:  # fmt: skip
    """An edge whose true mode has the first of the weights; they need not be in order."""
    true = measured(truth, target, source, rng)
    modes = [Mode(weights[0], true)]
    modes += [Mode(w, _spun(true, angle)) for w, angle in zip(weights[1:], WRONG_RAD, strict=False)]
    modes.sort(key=lambda mode: -mode.weight)
    centre, offsets = modes[0].pose.mean, []
    offsets = [se3.log(se3.inverse(centre) @ mode.pose.mean) for mode in modes]
    mean_xi = sum(mode.weight * xi for mode, xi in zip(modes, offsets, strict=True))
    spread = true.covariance + sum(
        mode.weight * np.outer(xi - mean_xi, xi - mean_xi) for mode, xi in zip(modes, offsets, strict=True)
    )
    whole = PoseGaussian(centre @ se3.exp(np.asarray(mean_xi)), spread)
    return edge(target, source, whole, kind, modes=modes)


def _heaviest(graph: PoseGraph) -> PoseGraph:
    """The graph with one Gaussian an edge, the heaviest mode."""
    kept = [
        replace(e, posterior=replace(e.posterior, pose=e.posterior.modes[0].pose, modes=())) if e.posterior.modes else e
        for e in graph.edges
    ]
    return PoseGraph(tuple(kept))


def _overall(graph: PoseGraph) -> PoseGraph:
    """The graph with one Gaussian an edge, mean and covariance of all modes."""
    return PoseGraph(tuple(replace(e, posterior=replace(e.posterior, modes=())) for e in graph.edges))


def _graph(rng: np.random.Generator, ambiguous: Mapping[int, list[float]], closures: list[tuple[int, int]]):
    graph, truth = ring(COUNT, rng, closures)
    edges = [
        _ambiguous(truth, e.target, e.source, rng=rng, weights=ambiguous[e.source])
        if e.source in ambiguous and e.kind == "odometry"
        else e
        for e in graph.edges
    ]
    return PoseGraph(tuple(edges)), truth


@pytest.mark.parametrize(
    "ambiguous",
    [
        {4: [0.4, 0.6]},
        {3: [0.3, 0.4, 0.3], 7: [0.2, 0.6, 0.2]},
        {2: [0.45, 0.55], 5: [0.3, 0.3, 0.3, 0.1], 8: [0.4, 0.6], 10: [0.35, 0.4, 0.25]},
    ],
)
def test_one_gaussian_breaks_the_loop_that_modes_close(ambiguous: dict[int, list[float]]) -> None:
    """The true mode is never the heaviest; three closures tell, as no one mode but the true one agrees with all."""
    rng = np.random.default_rng(len(ambiguous))
    graph, truth = _graph(rng, ambiguous, [(0, 3), (2, 6), (4, 9), (0, 11)])
    kept, overall, solution = solve(_heaviest(graph), {}), solve(_overall(graph), {}), solve(graph, {})
    assert solution.outliers == ()
    assert len(kept.outliers) >= 1  # a true closure is thrown out …
    assert rotation_error(kept.trajectory, truth) > np.radians(20.0)  # … and the model is broken
    good = rotation_error(solution.trajectory, truth)
    assert good < np.radians(3.0)
    assert good < rotation_error(overall.trajectory, truth)
    for number, weights in ambiguous.items():
        left = solution.mode_weights[number, number - 1]
        modes = next(e for e in graph.edges if e.source == number).posterior.modes
        true = [mode.weight for mode in modes].index(weights[0]) if weights[0] not in weights[1:] else None
        assert left.sum() == pytest.approx(1.0)
        assert left.max() > 0.999
        assert true is None or int(np.argmax(left)) == true


def test_poses_are_calibrated_where_loops_choose_the_modes() -> None:
    trials = 60
    values = np.zeros(trials)
    for trial in range(trials):
        rng = np.random.default_rng(100 + trial)
        graph, truth = _graph(rng, {3: [0.4, 0.6], 8: [0.3, 0.4, 0.3]}, [(0, 5), (4, 9), (0, 11)])
        solution = solve(graph, {})
        frame = 1 + trial % 11
        values[trial] = nees(PoseGaussian(solution.trajectory[frame], solution.covariances[frame]), truth[frame])
    assert values.mean() == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / trials))


def test_all_edges_ambiguous_are_decided_by_loops_that_overlap() -> None:
    """Two modes at each of eleven edges: two thousand combinations, of which loops of three edges leave one."""
    rng = np.random.default_rng(5)
    ambiguous = {k: [0.45, 0.55] for k in range(1, COUNT)}
    closures = [(k, k + 2) for k in range(COUNT - 2)] + [(k, k + 3) for k in range(COUNT - 3)] + [(0, 11)]
    graph, truth = _graph(rng, ambiguous, closures)
    solution = solve(graph, {})
    assert solution.outliers == ()
    assert rotation_error(solution.trajectory, truth) < np.radians(3.0)
    assert all(left.max() > 0.999 for left in solution.mode_weights.values())


def test_without_a_loop_an_edge_is_pooled_at_its_heaviest_mode() -> None:
    rng = np.random.default_rng(6)
    truth = turntable(COUNT)
    ambiguous = _ambiguous(truth, 0, 1, rng=rng, weights=[0.3, 0.7])
    solution = solve(PoseGraph((ambiguous,)), {})
    heavy, light = ambiguous.posterior.modes
    np.testing.assert_allclose(solution.trajectory[1], heavy.pose.mean, atol=1e-12)
    np.testing.assert_allclose(solution.mode_weights[1, 0], [0.7, 0.3])
    offset = se3.log(se3.inverse(heavy.pose.mean) @ light.pose.mean)
    # The variance along the way to the other mode is w (1 - w) d² about the mean, and w d² about the heavier mode.
    assert offset @ np.linalg.solve(solution.covariances[1], offset) == pytest.approx(1.0 / 0.3, rel=0.02)


def test_modes_that_no_loop_distinguishes_keep_their_weights() -> None:
    """Two edges each turned by 90° or not, and a loop that allows one turn: which of them it was stays open."""
    rng = np.random.default_rng(7)
    truth = {k: se3.inverse(spin([0.0, 0.5 * k, 0.0])) for k in range(3)}
    edges = []
    for source in (1, 2):
        spread = covariance(rng, 0.01, 0.002)
        pose = PoseGaussian(se3.inverse(truth[source - 1]) @ truth[source], spread)
        modes = [Mode(0.6, pose), Mode(0.4, _spun(pose, np.pi / 2))]
        edges.append(edge(source - 1, source, pose, modes=modes))
    direct = _spun(PoseGaussian(se3.inverse(truth[0]) @ truth[2], covariance(rng)), np.pi / 2)
    solution = solve(PoseGraph((*edges, edge(0, 2, direct, "closure"))), {})
    assert solution.outliers == ()
    one, other = (solution.mode_weights[source, source - 1] for source in (1, 2))
    assert one[0] + other[0] == pytest.approx(1.0, abs=1e-6)  # exactly one of them turned
    assert 0.2 < one[0] < 0.8
    sigma = np.sqrt(np.linalg.eigvalsh(solution.covariances[1][:3, :3])[-1])
    assert sigma > np.radians(30.0)


def test_modes_of_a_shape_that_looks_the_same_from_behind_all_stay_open() -> None:
    """Every edge and every loop allows a half turn: each view may be turned, and no combination is better than others.

    There are two thousand of them, far more than are optimised.
    """
    rng = np.random.default_rng(13)
    truth = {k: se3.inverse(spin([0.0, 2.0 * np.pi * k / COUNT, 0.0])) for k in range(COUNT)}
    pairs = [(k, k + 1) for k in range(COUNT - 1)] + [(k, k + 2) for k in range(COUNT - 2)] + [(0, COUNT - 1)]
    edges = []
    for target, source in pairs:
        true = PoseGaussian(se3.inverse(truth[target]) @ truth[source], covariance(rng))
        halves = [Mode(0.5, true), Mode(0.5, _spun(true, np.pi))]
        edges.append(edge(target, source, true, "odometry" if source == target + 1 else "closure", modes=halves))
    solution = solve(PoseGraph(tuple(edges)), {})
    assert solution.outliers == ()
    assert all(left.max() < 0.9 for left in solution.mode_weights.values())
    turns = [np.sqrt(np.linalg.eigvalsh(solution.covariances[k][:3, :3])[-1]) for k in range(1, COUNT)]
    assert min(turns) > np.radians(60.0)


def test_modes_of_a_closure_are_decided_by_the_chain() -> None:
    rng = np.random.default_rng(8)
    graph, truth = ring(COUNT, rng, [])
    closure = _ambiguous(truth, 0, 11, rng=rng, weights=[0.2, 0.8], kind="closure")
    solution = solve(graph.plus([closure]), {})
    assert solution.outliers == ()
    np.testing.assert_allclose(solution.mode_weights[11, 0], [0.0, 1.0], atol=1e-6)
    assert rotation_error(solution.trajectory, truth) < np.radians(3.0)


def test_false_closure_does_not_choose_a_mode() -> None:
    rng = np.random.default_rng(9)
    graph, truth = _graph(rng, {4: [0.4, 0.6]}, [(0, 5), (2, 7), (0, 11)])
    false = edge(1, 9, _spun(measured(truth, 1, 9, rng), 0.7), "closure")
    solution = solve(graph.plus([false]), {})
    assert solution.outliers == (false,)
    assert rotation_error(solution.trajectory, truth) < np.radians(3.0)


@pytest.mark.parametrize("weights", [[0.4, 0.6], [0.6, 0.4]])
def test_mode_settled_by_a_false_loop_is_corrected_by_true_ones(weights: list[float]) -> None:
    rng = np.random.default_rng(12)
    graph, truth = _graph(rng, {4: weights}, [])
    modes = graph.edges[3].posterior.modes
    (wrong,) = (mode.pose for mode in modes if mode.weight != weights[0])
    lie = edge(3, 4, PoseGaussian(wrong.mean, covariance(rng)), "closure")
    growing = Smoother().plus([*graph.edges, lie])
    settled = [float(mode.pose is wrong) for mode in modes]
    np.testing.assert_allclose(growing.solution.mode_weights[4, 3], settled)
    for target, source in ((2, 6), (1, 5), (0, 11)):
        growing = growing.plus([edge(target, source, measured(truth, target, source, rng), "closure")])
        np.testing.assert_allclose(growing.solution.mode_weights[4, 3], solve(growing.graph, {}).mode_weights[4, 3])
    assert growing.solution.outliers == (lie,)
    np.testing.assert_allclose(growing.solution.mode_weights[4, 3], [1.0 - weight for weight in settled])
    assert rotation_error(growing.solution.trajectory, truth) < np.radians(3.0)


def test_mode_of_almost_no_weight_changes_nothing() -> None:
    rng = np.random.default_rng(10)
    graph, _ = ring(COUNT, rng, [(0, 11)])
    first = graph.edges[4]
    pose = first.posterior.pose
    modes = (Mode(1.0 - 1e-12, pose), Mode(1e-12, _spun(pose, np.pi / 2)))
    again = replace(first, posterior=replace(first.posterior, modes=modes))
    solution = solve(PoseGraph((*graph.edges[:4], again, *graph.edges[5:])), {})
    wanted = solve(graph, {})
    for frame in range(COUNT):
        np.testing.assert_allclose(solution.trajectory[frame], wanted.trajectory[frame], atol=1e-7)
        np.testing.assert_allclose(solution.covariances[frame], wanted.covariances[frame], atol=1e-9)


def _rippled(of: Edge, sds: float) -> Edge:
    """The edge as two modes of equal covariance, so many standard deviations apart."""
    pose = of.posterior.pose
    step = np.asarray(np.linalg.cholesky(pose.covariance) @ np.array([sds, 0.0, 0.0, 0.0, 0.0, 0.0]), np.float64)
    parts = [PoseGaussian(pose.mean @ se3.exp(sign * 0.5 * step), pose.covariance) for sign in (1.0, -1.0)]
    whole = PoseGaussian(pose.mean, pose.covariance + 0.25 * np.outer(step, step))
    return edge(of.target, of.source, whole, of.kind, modes=[Mode(0.5, part) for part in parts])


def test_modes_are_separate_where_there_is_a_dip_between_them() -> None:
    graph, _ = ring(4, np.random.default_rng(0), [])
    assert not are_separate(graph.edges[0].posterior.modes)
    assert not are_separate(_rippled(graph.edges[0], 1.9).posterior.modes)
    assert are_separate(_rippled(graph.edges[0], 2.1).posterior.modes)


def test_ripples_on_one_peak_are_one_gaussian_and_cost_loops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, _ = ring(COUNT, np.random.default_rng(1), [(0, COUNT - 1), (0, COUNT // 2)])
    rippled = PoseGraph(tuple(_rippled(e, 0.5) if e.source % 3 == 0 else e for e in graph.edges))
    monkeypatch.setattr(modes, "optimise", None)  # nothing is to be solved for the sake of modes
    found, wanted = solve(rippled, {}), solve(_overall(rippled), {})
    assert not found.mode_weights
    for frame, pose in wanted.trajectory.items():
        np.testing.assert_array_equal(found.trajectory[frame], pose)
        np.testing.assert_array_equal(found.covariances[frame], wanted.covariances[frame])


# Evidence is counted once: what only proposes where to look reaches neither the edge nor the solved graph.


VARIANCE = 0.02e-2  # the check of the design, in units of a tenth of a radian and of a metre
SAMPLER = AdaptiveSampler(samples=1500)
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
    found = SAMPLER.run(density, lambda poses, _: _log_gaussian(poses, images), OBJECT_M, rng)
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
