"""Laws of the pose graph: calibrated poses, closure that helps, and independence of labels, direction and gauge."""

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path

import gtsam
import numpy as np
import pytest
from ring_graphs import OBJECT_M, covariance, edge, measured, ring, spin, spun, turntable

from modeler import se3
from modeler.export import g2o_text
from modeler.graph import PoseGraph, solve
from modeler.types import Array, Mode, PoseGaussian


def _assert_same(actual: Mapping[int, Array], expected: Mapping[int, Array], atol: float = 1e-8) -> None:
    assert set(actual) == set(expected)
    for frame, pose in expected.items():
        np.testing.assert_allclose(actual[frame], pose, atol=atol)


def _assert_same_covariance(actual: Array, expected: Array, atol: float = 2e-3) -> None:
    """Compare in the units in which `expected` is the identity, so that every direction counts."""
    whiten = np.linalg.inv(np.linalg.cholesky(expected))
    np.testing.assert_allclose(whiten @ actual @ whiten.T, np.eye(6), atol=atol)
    np.testing.assert_array_equal(actual, actual.T)


def test_empty_graph_has_no_poses_and_a_started_one_has_its_first() -> None:
    assert dict(solve(PoseGraph(), {}).trajectory) == {}
    solution = solve(PoseGraph(first=7), {})
    _assert_same(solution.trajectory, {7: np.eye(4)})
    _assert_same(solution.odometry, {7: np.eye(4)})
    np.linalg.cholesky(solution.covariances[7])


def test_chain_is_dead_reckoning_with_first_order_covariances() -> None:
    graph, _ = ring(5, np.random.default_rng(1), [])
    solution = solve(graph, {})
    pose, covariance = np.eye(4), np.zeros((6, 6))
    for factor in graph.edges:
        pose = pose @ factor.posterior.pose.mean
        covariance = se3.composed_covariance(covariance, factor.posterior.pose.mean, factor.posterior.pose.covariance)
        np.testing.assert_allclose(solution.trajectory[factor.source], pose, atol=1e-14)
        _assert_same_covariance(solution.covariances[factor.source], covariance)
    _assert_same(solution.odometry, solution.trajectory, atol=0.0)


def test_two_measurements_of_one_motion_fuse_in_the_source_frame() -> None:
    """Where the covariance is read in any other frame or order, the weighted mean comes out elsewhere."""
    rng = np.random.default_rng(2)
    truth = {0: np.eye(4), 1: se3.exp(np.array([0.1, np.pi / 2, 0.2, 0.3, -0.2, 0.5]))}
    first, second = (measured(truth, 0, 1, rng) for _ in range(2))
    solution = solve(PoseGraph((edge(0, 1, first), edge(0, 1, second, "closure"))), {})
    information: Array = (np.linalg.inv(first.covariance) + np.linalg.inv(second.covariance)).astype(np.float64)
    offset = se3.log(se3.inverse(first.mean) @ second.mean)
    step: Array = np.linalg.solve(information, np.linalg.solve(second.covariance, offset)).astype(np.float64)
    fused = first.mean @ se3.exp(step)
    np.testing.assert_allclose(solution.trajectory[1], fused, atol=2e-4)  # second order in errors of 0.01
    assert np.abs(first.mean - fused).max() > 2e-3
    # Both sit at the fused pose to first order only: a hundredth here.
    _assert_same_covariance(solution.covariances[1], np.linalg.inv(information).astype(np.float64), atol=0.05)


def test_closure_lowers_every_predicted_uncertainty() -> None:
    graph, _ = ring(10, np.random.default_rng(4), [(0, 9)])
    open_loop = solve(PoseGraph(graph.edges[:-1]), {})
    closed = solve(graph, {})
    for frame in range(1, 10):
        assert np.linalg.slogdet(closed.covariances[frame])[1] < np.linalg.slogdet(open_loop.covariances[frame])[1]


def test_relative_covariance_is_that_of_the_joint_marginal() -> None:
    graph, _ = ring(8, np.random.default_rng(5), [(0, 7), (2, 6)], luck=1e-3)
    solution = solve(graph, {})
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    for factor in graph.edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(factor.posterior.pose.covariance)
        factors.add(
            gtsam.BetweenFactorPose3(factor.target, factor.source, gtsam.Pose3(factor.posterior.pose.mean), noise)
        )
    for frame, pose in solution.trajectory.items():
        values.insert(frame, gtsam.Pose3(pose))
    marginals = gtsam.Marginals(factors, values)
    for target, source in itertools.permutations((1, 4, 7), 2):
        joint = marginals.jointMarginalCovariance([target, source]).fullMatrix()
        jacobian = np.hstack([-se3.adjoint(se3.inverse(solution.relative(target, source))), np.eye(6)])
        expected = jacobian @ joint @ jacobian.T
        _assert_same_covariance(solution.relative_covariance(target, source), expected)
    for frame in range(1, 8):
        _assert_same_covariance(solution.covariances[frame], marginals.marginalCovariance(frame))


def test_swapping_source_and_target_of_every_edge_changes_nothing() -> None:
    graph, _ = ring(9, np.random.default_rng(6), [(0, 8), (1, 7)], luck=1e-3)
    swapped = [edge(e.source, e.target, e.posterior.pose.inverse(), e.kind) for e in graph.edges]
    one, other = solve(graph, {}), solve(PoseGraph(tuple(swapped), first=0), {})
    _assert_same(other.trajectory, one.trajectory, atol=1e-7)  # log(a⁻¹b) against log(ba⁻¹)
    _assert_same(other.odometry, one.odometry, atol=1e-12)
    for frame in range(9):
        _assert_same_covariance(other.covariances[frame], one.covariances[frame])


@pytest.mark.parametrize("labels", list(itertools.permutations((3, 0, 12, 700))))
def test_frame_numbers_are_names_only(labels: tuple[int, ...]) -> None:
    graph, _ = ring(4, np.random.default_rng(7), [(0, 3)])
    renamed = PoseGraph(tuple(edge(labels[e.target], labels[e.source], e.posterior.pose, e.kind) for e in graph.edges))
    one, other = solve(graph, {}), solve(renamed, {})
    _assert_same(other.trajectory, {labels[frame]: pose for frame, pose in one.trajectory.items()})
    _assert_same(other.odometry, {labels[frame]: pose for frame, pose in one.odometry.items()}, atol=0.0)
    for frame in range(4):
        np.testing.assert_allclose(other.covariances[labels[frame]], one.covariances[frame], rtol=1e-6)


def test_order_of_arrival_does_not_matter() -> None:
    rng = np.random.default_rng(8)
    graph, _ = ring(8, rng, [(0, 7), (1, 6)])
    shuffled = [graph.edges[k] for k in rng.permutation(len(graph.edges))]
    _assert_same(solve(PoseGraph(tuple(shuffled), first=0), {}).trajectory, solve(graph, {}).trajectory)


def test_guess_and_its_gauge_do_not_move_the_answer() -> None:
    rng = np.random.default_rng(9)
    graph, truth = ring(10, rng, [(0, 9)])
    solution = solve(graph, {})
    elsewhere = se3.exp(rng.normal(size=6))
    disturbed = {frame: elsewhere @ pose @ se3.exp(0.2 * rng.normal(size=6)) for frame, pose in truth.items()}
    for guess in (solution.trajectory, disturbed, {4: elsewhere}):
        again = solve(graph, guess)
        _assert_same(again.trajectory, solution.trajectory)
        np.testing.assert_array_equal(again.trajectory[0], np.eye(4))


def test_same_edges_same_answer_to_the_bit(capfd: pytest.CaptureFixture[str]) -> None:
    graph, _ = ring(14, np.random.default_rng(10), [(0, 13), (1, 12)])
    one, other = solve(graph, {}), solve(graph, {})
    for frame in range(14):
        assert np.array_equal(one.trajectory[frame], other.trajectory[frame])
        assert np.array_equal(one.covariances[frame], other.covariances[frame])
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("good", [[], [(0, 11)]])
def test_false_closure_is_left_out(good: list[tuple[int, int]]) -> None:
    rng = np.random.default_rng(11)
    graph, truth = ring(12, rng, good)
    wrong = se3.exp(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))
    false = edge(1, 10, PoseGaussian(se3.inverse(truth[1]) @ truth[10] @ wrong, covariance(rng)), "closure")
    solution = solve(graph.plus([false]), {})
    assert solution.outliers == (false,)
    _assert_same(solution.trajectory, solve(graph, {}).trajectory)
    _assert_same_covariance(solution.covariances[11], solve(graph, {}).covariances[11], atol=1e-6)


def test_edges_not_accepted_take_no_part() -> None:
    rng = np.random.default_rng(12)
    graph, truth = ring(6, rng, [])
    refused = edge(0, 5, measured(truth, 0, 5, rng), "closure", accepted=False)
    _assert_same(solve(graph.plus([refused]), {}).trajectory, solve(graph, {}).trajectory, atol=0.0)


def test_closure_that_alone_holds_a_frame_is_part_of_the_chain() -> None:
    rng = np.random.default_rng(13)
    graph, truth = ring(5, rng, [])
    lost = dataclasses.replace(graph.edges[3], accepted=False)
    single = edge(0, 4, measured(truth, 0, 4, rng), "closure")
    solution = solve(PoseGraph((*graph.edges[:3], lost, single)), {})
    np.testing.assert_allclose(solution.odometry[4], single.posterior.pose.mean, atol=1e-14)
    np.testing.assert_allclose(solution.trajectory[4], single.posterior.pose.mean, atol=1e-14)


def test_frames_apart_from_the_first_are_left_out() -> None:
    graph, truth = ring(3, np.random.default_rng(14), [])
    island = edge(7, 8, measured(turntable(12), 7, 8, np.random.default_rng(0)))
    loop = edge(7, 8, island.posterior.pose, "closure")
    solution = solve(graph.plus([island, loop]), {})
    assert set(solution.trajectory) == set(solution.odometry) == set(solution.covariances) == set(truth)
    with pytest.raises(KeyError):
        solution.covariances[8]


@pytest.mark.parametrize("sigma_roll_rad", [1e-5, 1e-2, 1.0, np.pi])
def test_direction_nobody_observed_keeps_its_spread(sigma_roll_rad: float) -> None:
    """A tube's roll beside directions known to 10 µm: round a loop of n equal edges, k in series beside n - k."""
    count = 10
    about_object = np.diag([1e-5, sigma_roll_rad, 1e-5, 1e-5, 1e-5, 1e-5]) ** 2  # the same in every frame
    adjoint = se3.adjoint(se3.translation(OBJECT_M))
    covariance = adjoint @ about_object @ adjoint.T
    stops = [spin([0.0, angle, 0.0]) for angle in np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)]
    step = se3.inverse(stops[1])
    edges = [edge(k - 1, k, PoseGaussian(step, covariance)) for k in range(1, count)]
    closure = edge(0, count - 1, PoseGaussian(se3.inverse(step), covariance), "closure")
    solution = solve(PoseGraph((*edges, closure)), {})
    _assert_same(solution.trajectory, {k: se3.inverse(stop) for k, stop in enumerate(stops)}, atol=1e-7)
    for frame in range(1, count):
        _assert_same_covariance(solution.covariances[frame], covariance * frame * (count - frame) / count)


def test_invalid_covariance_is_rejected() -> None:
    flat = PoseGaussian(np.eye(4), np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0]))
    with pytest.raises(ValueError, match="edge 1 -> 0"):
        solve(PoseGraph((edge(0, 1, flat), edge(0, 1, flat, "closure"))), {})


def test_a_closure_that_comes_before_odometry_of_the_same_frames_does_not_bear_it() -> None:
    rng = np.random.default_rng(3)
    truth = turntable(6)
    odometry = [edge(k - 1, k, measured(truth, k - 1, k, rng)) for k in range(1, 6)]
    lie = spun(edge(0, 5, measured(truth, 0, 5, rng), "closure"), [0.0, 1.5, 0.0])
    solution = solve(PoseGraph((*odometry[:4], lie, odometry[4])), {})
    assert solution.outliers == (lie,)
    chain = solve(PoseGraph(tuple(odometry)), {}).trajectory
    assert all(np.allclose(solution.trajectory[frame], pose) for frame, pose in chain.items())


# What a solved graph writes is read by GTSAM as it was meant.


def _graph() -> PoseGraph:
    """A loop with an edge of two modes, whose wrong one is the heavier, and a closure that lies."""
    graph, truth = ring(12, np.random.default_rng(1), [(0, 11), (0, 6), (3, 9)])
    quarter = spin([0.0, np.pi / 2, 0.0])
    several, right = graph.edges[4], graph.edges[4].posterior.pose
    wrong = PoseGaussian(right.mean @ quarter, right.covariance)
    modes = [Mode(0.6, wrong), Mode(0.4, right)]
    lie = PoseGaussian(se3.inverse(truth[1]) @ truth[8] @ quarter, right.covariance)
    edges = [*graph.edges, edge(1, 8, lie, "closure")]
    edges[4] = edge(several.target, several.source, wrong, modes=modes)
    return PoseGraph(tuple(edges))


def test_solved_graph_is_the_optimum_of_its_own_file(tmp_path: Path) -> None:
    """GTSAM, given the file alone, finds the error that the solution has, and nothing to improve."""
    graph = _graph()
    solution = solve(graph, {})
    (tmp_path / "graph.g2o").write_text(g2o_text(graph.edges, solution))
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    assert factors.size() == len(graph.edges) - len(solution.outliers) == 14
    error = 0.0
    for taken in graph.edges:
        if taken in solution.outliers:
            continue
        pose = solution.edge_poses.get((taken.source, taken.target), taken.posterior.pose)
        xi = se3.log(se3.inverse(pose.mean) @ solution.relative(taken.target, taken.source))
        error += 0.5 * float(xi @ np.linalg.solve(pose.covariance, xi))
    assert factors.error(values) == pytest.approx(error, rel=1e-6)
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    best = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    assert factors.error(best) == pytest.approx(error, rel=1e-4)
    for frame, pose in solution.trajectory.items():
        np.testing.assert_allclose(best.atPose3(frame).matrix(), pose, atol=1e-4)
