"""Statistics of solved loops over many seeds: covariances are true before and after closing, lies are found out."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from ring_graphs import OBJECT_M, edge, measured, nees, ring, rotation_error, spin, spun, turntable
from scipy import stats
from slow_cases import quick_first, sampled

from modeler import se3
from modeler.graph import PoseGraph, Smoother, shared_noise, solve, variance_factor
from modeler.types import Array, Camera, Edge, Frame, PoseGaussian, RayImage, Solution
from modeler.verdict.spreads import AboutMean, spread_of_positions
from studies.loops import covariances

SEEDS = 120
CAMERA = Camera(1, 1, 1.0, 1.0, 0.0, 0.0)


def _assert_chi2(values: np.ndarray) -> None:
    """NEES of six dimensions: its mean within four standard errors of 6, its distribution chi²."""
    assert np.mean(values) == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / len(values)))
    assert stats.kstest(values, stats.chi2(6).cdf).pvalue > 1e-3


def _nees(solution: Solution, truth: dict[int, np.ndarray], frame: int) -> float:
    return nees(PoseGaussian(solution.trajectory[frame], solution.covariances[frame]), truth[frame])


@pytest.mark.parametrize("count", [5, 14, pytest.param(24, marks=pytest.mark.slow)])
def test_poses_of_a_loop_are_calibrated_before_and_after_it_closes(count: int) -> None:
    before, after, every = np.zeros(SEEDS), np.zeros(SEEDS), np.zeros(SEEDS)
    spread_before, spread_after = np.zeros(SEEDS), np.zeros(SEEDS)
    truth = turntable(count)
    for seed in range(SEEDS):
        rng = np.random.default_rng([count, seed])
        odometry = [edge(k - 1, k, measured(truth, k - 1, k, rng)) for k in range(1, count)]
        growing = Smoother(graph=PoseGraph(first=0)).plus(odometry)
        last = count - 1
        before[seed] = _nees(growing.solution, truth, last)
        spread_before[seed] = np.linalg.slogdet(growing.solution.covariances[last])[1]
        growing = growing.plus([edge(0, last, measured(truth, 0, last, rng), "closure")])
        after[seed] = _nees(growing.solution, truth, last)
        every[seed] = _nees(growing.solution, truth, 1 + seed % last)
        spread_after[seed] = np.linalg.slogdet(growing.solution.covariances[last])[1]
    for values in (before, after, every):
        _assert_chi2(values)
    assert np.all(spread_after < spread_before)


def _two_turns(seed: int, spoil: Callable[[Edge, np.random.Generator], Edge]) -> tuple[PoseGraph, list[Edge], dict]:
    """Two turns of 18 stops, each stop of the second closed on the first, a fifth of the closures spoilt."""
    rng = np.random.default_rng(seed)
    truth = turntable(36, 18)
    edges = [edge(k - 1, k, measured(truth, k - 1, k, rng)) for k in range(1, 36)]
    pairs = [(k - 18, k) for k in range(18, 36)] + [(k - 17, k) for k in range(18, 36)]
    closures = [edge(t, s, measured(truth, t, s, rng), "closure") for t, s in pairs]
    chosen = rng.choice(len(closures), size=len(closures) // 5, replace=False)
    false = [spoil(closures[number], rng) for number in chosen]
    kept = [closure for number, closure in enumerate(closures) if number not in chosen]
    return PoseGraph((*edges, *kept)), false, truth


def _anywhere(of: Edge, rng: np.random.Generator) -> Edge:
    axis = rng.normal(size=3)
    return spun(of, rng.uniform(0.5, np.pi) * axis / np.linalg.norm(axis))


def _all_alike(of: Edge, rng: np.random.Generator) -> Edge:
    """Wrong by the same quarter turn every time, as a square box is: the lies agree with each other."""
    return spun(of, [0.0, 0.5 * np.pi, 0.0])


@pytest.mark.parametrize("spoil", [_anywhere, _all_alike])
def test_a_fifth_of_the_closures_may_be_false(spoil: Callable[[Edge, np.random.Generator], Edge]) -> None:
    for seed in range(4):
        graph, false, truth = _two_turns(seed, spoil)
        without = rotation_error(solve(graph, {}).trajectory, truth)
        spoilt = solve(graph.plus(false), {})
        assert rotation_error(spoilt.trajectory, truth) <= 1.2 * without
        assert set(false) <= set(spoilt.outliers)
        assert len(spoilt.outliers) <= len(false) + 1


def test_false_closures_are_rejected_as_they_come() -> None:
    graph, false, truth = _two_turns(11, _anywhere)
    edges = sorted([*graph.edges, *false], key=lambda e: e.source)
    growing, error = Smoother(graph=PoseGraph(first=0)), {}
    for source in range(1, 36):
        growing = growing.plus([e for e in edges if e.source == source])
        so_far = {k: truth[k] for k in range(source + 1)}
        error[source] = rotation_error(growing.solution.trajectory, so_far)
    assert set(false) <= set(growing.solution.outliers)
    assert max(error.values()) < 0.1
    assert error[35] <= 1.2 * rotation_error(solve(graph, {}).trajectory, truth)


# Edges that share noise: covariances stay true where edges use the same image, and where all views err alike.


COUNT = 14
SIGMAS = np.repeat([0.01, 0.002], 3)
ABOUT = se3.adjoint(se3.translation(OBJECT_M))
WHOLE = ABOUT @ np.diag(SIGMAS**2) @ ABOUT.T  # an edge's covariance, the same from every side of the object


TRUTH = {k: se3.inverse(spin([0.0, 2.0 * np.pi * k / COUNT, 0.0])) for k in range(COUNT)}
PAIRS = [(k - step, k) for step in (1, 2, 3) for k in range(step, COUNT)] + [(0, COUNT - 1), (0, COUNT - 2)]


def _graph(rng: np.random.Generator, share: float, common: float = 0.0, distance_sigma: float = 0.0) -> PoseGraph:
    """Every frame has a noise of its own, in all its edges, and every edge another; shares of WHOLE, ends counted.

    Beside that all frames err alike, by a share of WHOLE, and in the distance of the object.
    """

    def noise(variance: float) -> Array:
        return np.sqrt(variance) * ABOUT @ (SIGMAS * rng.normal(size=6))

    seen = {k: pose @ se3.exp(noise(0.5 * share)) for k, pose in TRUTH.items()}
    rest = [se3.exp(noise(1.0 - share)) for _ in PAIRS]
    alike = se3.exp(noise(common)) @ se3.translation(distance_sigma * rng.normal() * OBJECT_M)
    edges = []
    for (target, source), own in zip(PAIRS, rest, strict=True):
        mean = se3.inverse(seen[target] @ alike) @ seen[source] @ alike @ own
        edges.append(edge(target, source, PoseGaussian(mean, WHOLE), "odometry" if source - target == 1 else "closure"))
    return PoseGraph(tuple(edges))


def _mean_nees(
    share: float, solved: Callable[[PoseGraph], Solution], seeds: int = 100, common: float = 0.0
) -> tuple[float, float, float]:
    """Mean NEES of poses, and of motions between neighbours and between far frames."""
    poses, near, far = [], [], []
    for seed in range(seeds):
        solution = solved(_graph(np.random.default_rng(seed), share, common))
        k = 1 + seed % (COUNT - 1)
        poses.append(nees(PoseGaussian(solution.trajectory[k], solution.covariances[k]), TRUTH[k]))
        for pair, values in (((k - 1, k), near), ((k, (k + 6) % COUNT), far)):
            values.append(nees(solution.relative_gaussian(*pair), se3.inverse(TRUTH[pair[0]]) @ TRUTH[pair[1]]))
    return float(np.mean(poses)), float(np.mean(near)), float(np.mean(far))


TOLERANCE = 4.0 * np.sqrt(12.0 / 100)


@pytest.mark.parametrize("share", sampled([0.0, 0.4, 0.8], every=3, fast=1))
def test_poses_and_motions_are_calibrated_where_the_share_is_known(share: float) -> None:
    for mean in _mean_nees(share, lambda graph: solve(graph, {}, shared=share)):
        assert mean == pytest.approx(6.0, abs=TOLERANCE)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "common"), [(0.0, 0.5), (0.6, 0.5)])
def test_poses_and_motions_are_calibrated_where_all_views_err_alike(share: float, common: float) -> None:
    for mean in _mean_nees(share, lambda graph: solve(graph, {}, shared=share, common=common), common=common):
        assert mean == pytest.approx(6.0, abs=TOLERANCE)
    poses, _, far = _mean_nees(share, lambda graph: solve(graph, {}, shared=share), common=common)
    assert min(poses, far) > 6.0 + 2.0 * TOLERANCE


def test_a_biased_distance_of_all_views_is_part_of_the_covariances() -> None:
    sigma = 0.01
    shift = sigma**2 * np.outer(OBJECT_M, OBJECT_M)
    values = []
    for seed in range(100):
        solution = solve(_graph(np.random.default_rng(seed), 0.0, 0.0, sigma), {}, common_shift_m2=shift)
        k = 1 + seed % (COUNT - 1)
        values.append(nees(PoseGaussian(solution.trajectory[k], solution.covariances[k]), TRUTH[k]))
    assert np.mean(values) == pytest.approx(6.0, abs=TOLERANCE)


def test_a_biased_distance_of_all_views_does_not_speak_against_a_model() -> None:
    graph = _graph(np.random.default_rng(0), 0.0)
    shift = 0.1**2 * np.outer(OBJECT_M, OBJECT_M)
    plain, shifted = solve(graph, {}), solve(graph, {}, common_shift_m2=shift)
    seen = RayImage(Frame(0, 0.0, np.zeros((1, 1), np.float32), CAMERA), None, 0.0, 0.0, OBJECT_M[None], OBJECT_M[None],
                    np.zeros((1, 2), np.int64))  # fmt: skip
    spreads = [
        spread_of_positions(dict.fromkeys(TRUTH, seen), solution, AboutMean.of(solution), 0.005)
        for solution in (plain, shifted)
    ]
    assert spreads[1].check.value == pytest.approx(spreads[0].check.value, rel=1e-6)
    assert np.trace(shifted.covariances[COUNT // 2][3:, 3:]) > 2.0 * np.trace(plain.covariances[COUNT // 2][3:, 3:])


def test_errors_that_all_poses_share_are_none_of_the_model() -> None:
    """Along a chain of 8 steps, ends are known to √8 of a step from each other, to about √(8 / 3) from the mean."""
    motion = PoseGaussian(spin([0.0, 0.3, 0.0]), np.diag(np.repeat([0.01, 0.002], 3) ** 2))
    chain = [edge(k - 1, k, motion) for k in range(1, 9)]
    found = AboutMean.of(solve(PoseGraph(tuple(chain)), {}))
    for end in (0, 8):
        covariance = found.covariances[end]
        np.testing.assert_allclose(covariance[:3, :3], covariance[0, 0] * np.eye(3), atol=1e-9)
        assert 0.01 * np.sqrt(8 / 4) < np.sqrt(covariance[0, 0]) < 0.01 * np.sqrt(8 / 2.5)
    lost = edge(8, 9, PoseGaussian(motion.mean, 1e4 * motion.covariance))
    among = AboutMean.of(solve(PoseGraph((*chain, lost)), {}))
    assert among.covariances[9][0, 0] > 0.99
    assert among.covariances[8][0, 0] < 1.1 * found.covariances[8][0, 0]  # one lost pose makes no other one uncertain


@pytest.mark.parametrize("share", quick_first([0.8, 0.0]))
def test_errors_from_the_mean_of_all_poses_are_calibrated(share: float) -> None:
    values = []
    for seed in range(50):
        solution = solve(_graph(np.random.default_rng(seed), share), {}, shared=share)
        moved = {
            k: se3.adjoint(pose) @ se3.log(se3.inverse(pose) @ TRUTH[k]) for k, pose in solution.trajectory.items()
        }
        k = seed % COUNT
        about_mean = AboutMean.of(solution)
        error = moved[k] - sum(weight * moved[frame] for frame, weight in about_mean.weights.items())
        to_object = se3.adjoint(solution.trajectory[k])
        covariance = to_object @ about_mean.covariances[k] @ to_object.T
        values.append(error @ np.linalg.solve(covariance, error))
    assert np.mean(values) == pytest.approx(6.0, abs=np.sqrt(2.0) * TOLERANCE)


def test_no_loop_tells_what_all_views_err_by() -> None:
    unlike, alike = (_graph(np.random.default_rng(2), 0.5, common) for common in (0.0, 4.0))
    assert shared_noise(alike, solve(alike, {})) == pytest.approx(shared_noise(unlike, solve(unlike, {})), abs=0.01)


def test_edges_taken_for_independent_are_too_sure() -> None:
    poses, near, far = _mean_nees(0.8, lambda graph: solve(graph, {}))
    assert min(poses, near, far) > 6.0 + 2.0 * TOLERANCE


@pytest.mark.parametrize("share", sampled([0.0, 0.4, 0.8], every=3, fast=1))
def test_loops_tell_the_share(share: float) -> None:
    """Found from the graph alone it errs to the side of independence by about a standard error of 0.1 (1 - share)."""
    shares = [shared_noise(graph := _graph(np.random.default_rng(seed), share), solve(graph, {})) for seed in range(40)]
    assert share - 0.2 < np.mean(shares) < share + 0.04

    def solved(graph: PoseGraph) -> Solution:
        return solve(graph, {}, shared=shared_noise(graph, solve(graph, {})))

    for mean in _mean_nees(share, solved, seeds=60):
        assert 5.0 - TOLERANCE < mean < 6.0 + 1.3 * TOLERANCE


def test_one_edge_alone_keeps_its_covariance() -> None:
    single = edge(0, 1, PoseGaussian(se3.inverse(TRUTH[0]) @ TRUTH[1], WHOLE))
    solution = solve(PoseGraph((single,)), {}, shared=0.7)
    np.testing.assert_allclose(solution.covariances[1], WHOLE, atol=1e-12)
    np.testing.assert_allclose(solution.relative_covariance(0, 1), WHOLE, atol=1e-12)
    apart = np.eye(6) - se3.adjoint(se3.inverse(TRUTH[1]) @ TRUTH[0])
    alike = solve(PoseGraph((single,)), {}, shared=0.7, common=0.5).covariances[1]
    np.testing.assert_allclose(alike, WHOLE + 0.5 * apart @ WHOLE @ apart.T, atol=1e-12)


def test_share_moves_no_pose_and_none_changes_nothing() -> None:
    graph = _graph(np.random.default_rng(3), 0.5)
    plain, shared = solve(graph, {}), solve(graph, {}, shared=0.5)
    zero = Smoother(shared=0.0).to(graph).solution
    for frame, pose in plain.trajectory.items():
        np.testing.assert_array_equal(shared.trajectory[frame], pose)
        np.testing.assert_array_equal(zero.covariances[frame], plain.covariances[frame])
        np.linalg.cholesky(shared.covariances[frame])
    np.testing.assert_array_equal(shared.relative_covariance(3, 3), plain.relative_covariance(3, 3))
    with pytest.raises(KeyError):
        shared.relative_covariance(0, 99)


def test_graph_without_loops_tells_nothing() -> None:
    graph, _ = ring(6, np.random.default_rng(0), [])
    assert shared_noise(graph, solve(graph, {})) == 0.0
    assert shared_noise(PoseGraph(), Solution()) == 0.0
    assert variance_factor(graph, solve(graph, {}), 0.1) == variance_factor(PoseGraph(), Solution(), 0.1) == 1.0


@pytest.mark.parametrize("stated", [1.0, 10.0])
def test_loops_tell_by_how_much_covariances_are_overstated(stated: float) -> None:
    factors = []
    for seed in range(40):
        graph = _graph(np.random.default_rng(seed), 0.0)
        edges = [edge(one.target, one.source, replace(one.posterior.pose, covariance=stated * WHOLE), one.kind)
                 for one in graph.edges]  # fmt: skip
        graph = PoseGraph(tuple(edges))
        factors.append(variance_factor(graph, solve(graph, {}), 0.02))
        assert variance_factor(graph, solve(graph, {}), 0.5) >= 0.5
    assert 0.95 / stated < np.mean(factors) < 1.5 / stated


def test_a_variance_factor_scales_what_edges_say() -> None:
    graph = _graph(np.random.default_rng(0), 0.3)
    whole = Smoother(shared=0.3, common=0.1).to(graph).solution
    part = Smoother(shared=0.3, common=0.1, variance_factor=0.2).to(graph).solution
    for frame in (1, COUNT - 1):
        np.testing.assert_allclose(part.covariances[frame], 0.2 * whole.covariances[frame], rtol=1e-9)


def test_it_does_not_matter_which_way_round_edges_are_written() -> None:
    rng = np.random.default_rng(4)
    graph, _ = ring(COUNT, rng, [(0, COUNT - 1), (2, 6), (3, 9)])
    back = [edge(one.source, one.target, one.posterior.pose.inverse(), one.kind) for one in graph.edges]
    forth, written_back = (solve(PoseGraph(tuple(edges), first=0), {}, shared=0.6) for edges in (graph.edges, back))
    for frame in range(1, COUNT):
        sigmas = np.sqrt(np.diag(forth.covariances[frame]))
        off = (written_back.covariances[frame] - forth.covariances[frame]) / np.outer(sigmas, sigmas)
        assert np.abs(off).max() < 1e-4


# Whole runs of shapes that look alike from several sides are as sure of their poses as they may be.


@pytest.mark.slow
def test_poses_of_a_run_are_no_surer_than_they_may_be() -> None:
    """A body with four sides alike, of which two steps match as well a quarter turn on, beyond the prior's limits.

    Errors of one run go together, so that its mean scatters: three times the expected is no lie.
    """
    found = covariances.run("stepper_motor", 42, 6, 25.0, "table")
    assert [len(values) for values in found.values()] == [5, 5, 6]
    assert all(np.mean(values) < 3.0 * 6.0 for values in found.values()), found


def test_a_line_of_the_table_counts_what_lies_within_the_region() -> None:
    row = covariances.row("cup", [{"pose": [6.0, 6.0], "near": [3.0], "far": [60.0]}, {kind: [6.0] for kind in _KINDS}])
    assert row.split() == ["cup", "1.00", "100", "%", "0.75", "100", "%", "5.50", "50", "%"]


_KINDS = ("pose", "near", "far")
