"""A common axis in the graph: derivatives, what it adds, and that it adds no more than it knows."""

import numpy as np
import pytest
from ring_graphs import OBJECT_M, covariance, edge, nees, ring, rotation_error, spin

from modeler import se3
from modeler.graph import CommonAxis, PoseGraph, solve
from modeler.graph.axis import estimated_axis, least_variance_point, slip
from modeler.graph.pose_graph import Factor
from modeler.types import Array, Edge, PoseGaussian

COUNT, STEP_RAD, SIGMA_STEP_RAD = 14, np.radians(25.0), np.radians(1.0)
TABLE = CommonAxis(np.radians(0.2), sigma_shift_m=0.0005, sigma_lift_m=0.0005)


def _table(
    rng: np.random.Generator, count: int = COUNT, shift_m: float = TABLE.sigma_shift_m
) -> tuple[dict[int, Array], Array]:
    """Poses of an object on a turntable that errs as TABLE says, and camera_from_axis."""
    camera_from_axis = se3.translation(OBJECT_M + 0.02 * rng.normal(size=3)) @ se3.exp(
        np.array([np.pi / 2 + 0.4, 0.1 * rng.normal(), 0.1 * rng.normal(), 0.0, 0.0, 0.0])
    )
    sigmas = np.array([TABLE.sigma_tilt_rad] * 2 + [SIGMA_STEP_RAD] + [shift_m] * 2 + [TABLE.sigma_lift_m])
    poses = {0: np.eye(4)}
    for k in range(1, count):
        turn = se3.exp(np.array([0.0, 0.0, STEP_RAD, 0.0, 0.0, 0.0])) @ se3.exp(sigmas * rng.normal(size=6))
        poses[k] = poses[k - 1] @ camera_from_axis @ turn @ se3.inverse(camera_from_axis)
    return poses, camera_from_axis


def _graph(rng: np.random.Generator, truth: dict[int, Array], *, free_rad: float = 0.0) -> PoseGraph:
    """Edges between neighbours, vague by `free_rad` about an axis through the object that lies on the table."""
    edges = []
    for k in range(1, len(truth)):
        spread = covariance(rng, 0.03, 0.003)
        if free_rad:
            about = se3.adjoint(se3.translation(OBJECT_M))[:, 0]
            spread = spread + free_rad**2 * np.outer(about, about)
        xi = np.linalg.cholesky(spread) @ rng.normal(size=6)
        edges.append(edge(k - 1, k, PoseGaussian(se3.inverse(truth[k - 1]) @ truth[k] @ se3.exp(-xi), spread)))
    return PoseGraph(tuple(edges), first=0)


def test_derivatives_are_those_of_the_slip() -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        poses = [se3.exp(0.5 * rng.normal(size=6)) for _ in range(2)]
        poses.append(se3.exp(rng.normal(size=6)))
        small = se3.exp(np.array([0.0, 0.0, 0.4, 0.0, 0.0, 0.0])) @ se3.exp(0.02 * rng.normal(size=6))
        poses[1] = poses[0] @ poses[2] @ small @ se3.inverse(poses[2])
        _, *derivatives = slip(poses[0][None], poses[1][None], poses[2])
        for which, derivative in enumerate(derivatives):
            for column, direction in enumerate(np.eye(6)):
                ends = []
                for sign in (1e-6, -1e-6):
                    moved = [p @ se3.exp(sign * direction) if k == which else p for k, p in enumerate(poses)]
                    ends.append(slip(moved[0][None], moved[1][None], moved[2])[0][0])
                np.testing.assert_allclose(derivative[0, :, column], (ends[0] - ends[1]) / 2e-6, atol=1e-6)


def test_best_known_point_is_where_the_object_is() -> None:
    rng = np.random.default_rng(2)
    graph, _ = ring(14, rng, [])
    factors = [Factor(e, e.posterior.pose) for e in graph.edges]
    np.testing.assert_allclose(
        least_variance_point(factors), OBJECT_M, atol=0.05
    )  # covariances couple turns and shifts at random
    exact = se3.adjoint(se3.translation(OBJECT_M))
    pose = PoseGaussian(np.eye(4), exact @ np.diag([1e-3, 2e-4, 5e-4, 1e-6, 1e-6, 1e-6]) @ exact.T)
    np.testing.assert_allclose(least_variance_point([Factor(edge(0, 1, pose), pose)]), OBJECT_M, atol=1e-9)


def test_perfect_table_has_no_slip_and_shows_its_axis() -> None:
    rng = np.random.default_rng(1)
    _, camera_from_axis = _table(rng)
    turn = se3.exp(np.array([0.0, 0.0, STEP_RAD, 0.0, 0.0, 0.0]))
    poses = {0: np.eye(4)}
    for k in range(1, 5):
        poses[k] = poses[k - 1] @ camera_from_axis @ turn @ se3.inverse(camera_from_axis)
        slipped = slip(poses[k - 1][None], poses[k][None], camera_from_axis)[0]
        np.testing.assert_allclose(slipped, 0.0, atol=1e-12)
    found = estimated_axis(poses, OBJECT_M)
    assert found is not None
    axis_from_found = se3.inverse(camera_from_axis) @ found
    np.testing.assert_allclose(axis_from_found[:3, 2], [0.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(axis_from_found[:2, 3], 0.0, atol=1e-9)


def test_trajectory_gains_by_the_axis_and_stays_calibrated() -> None:
    seeds = 60
    without, together, first, first_without = (np.zeros(seeds) for _ in range(4))
    poses, near = np.zeros(seeds), np.zeros(seeds)
    for seed in range(seeds):
        rng = np.random.default_rng([7, seed])
        truth, _ = _table(rng)
        graph = _graph(rng, truth)
        plain, solution = solve(graph, {}), solve(graph, {}, axis=TABLE)
        without[seed], together[seed] = (rotation_error(s.trajectory, truth) for s in (plain, solution))
        first_without[seed], first[seed] = (
            float(se3.rotation_angle(se3.inverse(truth[1]) @ s.trajectory[1])) for s in (plain, solution)
        )
        k = 1 + seed % (COUNT - 1)
        poses[seed] = nees(PoseGaussian(solution.trajectory[k], solution.covariances[k]), truth[k])
        near[seed] = nees(solution.relative_gaussian(k - 1, k), se3.inverse(truth[k - 1]) @ truth[k])
    assert np.median(together) < 0.8 * np.median(without)
    assert np.median(first) < 0.75 * np.median(first_without)  # the first pair profits from all others
    for values in (poses, near):
        assert np.mean(values) == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / seeds))


@pytest.mark.parametrize("tilt_rad", [TABLE.sigma_tilt_rad, np.inf])
def test_axis_does_not_repeat_what_edges_hold(tilt_rad: float) -> None:
    """Edges hold the commanded turn and that nothing climbs, and it may be which way the axis points: exactly so."""
    seeds = 30
    shared = CommonAxis(sigma_tilt_rad=tilt_rad, sigma_shift_m=0.0005, sigma_lift_m=np.inf)
    without, together, poses = np.zeros(seeds), np.zeros(seeds), np.zeros(seeds)
    for seed in range(seeds):
        rng = np.random.default_rng([9, seed])
        truth, camera_from_axis = _table(rng)
        held = [_stated(e, camera_from_axis, direction=np.isinf(tilt_rad)) for e in _graph(rng, truth).edges]
        graph = PoseGraph(tuple(held), first=0)
        plain, solution = solve(graph, {}), solve(graph, {}, axis=shared)
        assert solution.camera_from_axis is not None
        without[seed], together[seed] = (rotation_error(s.trajectory, truth) for s in (plain, solution))
        k = 1 + seed % (COUNT - 1)
        poses[seed] = nees(PoseGaussian(solution.trajectory[k], solution.covariances[k]), truth[k])
    assert np.median(together) < 0.95 * np.median(without)
    assert np.mean(poses) == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / seeds))


def _stated(of: Edge, camera_from_axis: Array, *, direction: bool) -> Edge:
    """Return an edge that also has how far its step turned and climbed, and tilted if the axis' direction is known."""
    sigmas = np.array([TABLE.sigma_tilt_rad if direction else 10.0] * 2 + [SIGMA_STEP_RAD, 10.0, 10.0, 0.0005])
    to_axis = se3.adjoint(se3.inverse(camera_from_axis))
    given = to_axis.T @ np.diag(sigmas**-2.0) @ to_axis
    nominal = camera_from_axis @ se3.exp(np.array([0.0, 0.0, STEP_RAD, 0.0, 0.0, 0.0])) @ se3.inverse(camera_from_axis)
    pose = of.posterior.pose
    images = np.linalg.inv(pose.covariance)
    spread = np.asarray(np.linalg.inv(images + given), dtype=np.float64)
    pull = given @ se3.log(se3.inverse(pose.mean) @ nominal)
    return edge(of.target, of.source, PoseGaussian(pose.mean @ se3.exp(spread @ pull), spread))


def test_axis_settles_what_each_pair_leaves_open() -> None:
    """A tube that lies on the table rolls freely as far as any pair can tell; a table does not let it."""
    rng = np.random.default_rng(5)
    truth, _ = _table(rng)
    graph = _graph(rng, truth, free_rad=np.radians(30.0))
    plain, solution = solve(graph, {}), solve(graph, {}, axis=TABLE)
    assert rotation_error(solution.trajectory, truth) < 0.25 * rotation_error(plain.trajectory, truth)
    for frame in range(1, COUNT):
        assert np.linalg.slogdet(solution.covariances[frame])[1] < np.linalg.slogdet(plain.covariances[frame])[1]


@pytest.mark.slow
def test_table_on_which_things_are_pushed_about_still_has_one_normal() -> None:
    """Steps shift by centimetres, so that they share no axis's place; its direction settles the roll all the same."""
    pushed, seeds = CommonAxis(TABLE.sigma_tilt_rad, sigma_shift_m=0.03, sigma_lift_m=TABLE.sigma_lift_m), 20
    values, without, together = np.zeros(seeds), np.zeros(seeds), np.zeros(seeds)
    for seed in range(seeds):
        rng = np.random.default_rng([5, seed])
        truth, _ = _table(rng, shift_m=0.03)
        graph = _graph(rng, truth, free_rad=np.radians(30.0))
        plain, solution = solve(graph, {}), solve(graph, {}, axis=pushed)
        without[seed], together[seed] = (rotation_error(s.trajectory, truth) for s in (plain, solution))
        k = 1 + seed % (COUNT - 1)
        values[seed] = nees(PoseGaussian(solution.trajectory[k], solution.covariances[k]), truth[k])
    assert np.median(together) < 0.25 * np.median(without)
    assert np.mean(values) == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / seeds))


def test_axis_that_does_not_fit_is_left_out() -> None:
    """An object that is pushed about by centimetres does not turn about one axis, whatever is given."""
    rng = np.random.default_rng(3)
    truth, camera_from_axis = _table(rng)
    fitting = solve(_graph(rng, truth), {}, axis=TABLE)
    assert float(fitting.camera_from_axis[:3, 2] @ camera_from_axis[:3, 2]) > np.cos(np.radians(2.0))
    pushed, _ = _table(rng, shift_m=0.03)
    graph = _graph(rng, pushed)
    plain, solution = solve(graph, {}), solve(graph, {}, axis=TABLE)
    assert solution.camera_from_axis is None
    for frame, pose in plain.trajectory.items():
        np.testing.assert_array_equal(solution.trajectory[frame], pose)


def test_axis_works_with_true_and_false_closures() -> None:
    rng = np.random.default_rng(6)
    truth, _ = _table(rng)
    graph = _graph(rng, truth)
    spread = covariance(rng)
    good = [edge(0, k, PoseGaussian(se3.inverse(truth[0]) @ truth[k], spread), "closure") for k in (12, 13)]
    false = edge(1, 13, PoseGaussian(se3.inverse(truth[1]) @ truth[13] @ spin([0.0, 1.2, 0.0]), spread), "closure")
    closed, solution = (solve(graph.plus([*good, false]), {}, axis=axis) for axis in (None, TABLE))
    assert solution.outliers == (false,)
    for frame in range(1, COUNT):
        assert nees(PoseGaussian(solution.trajectory[frame], solution.covariances[frame]), truth[frame]) < 22.5
        assert np.linalg.slogdet(solution.covariances[frame])[1] < np.linalg.slogdet(closed.covariances[frame])[1]


def test_table_that_does_not_turn_shows_no_axis() -> None:
    rng = np.random.default_rng(8)
    still = {k: np.eye(4) for k in range(4)}
    spread = 1e-6 * np.eye(6)
    edges = [edge(k - 1, k, PoseGaussian(se3.exp(1e-3 * rng.normal(size=6)), spread)) for k in still if k]
    plain, solution = solve(PoseGraph(tuple(edges)), {}), solve(PoseGraph(tuple(edges)), {}, axis=TABLE)
    for frame, pose in plain.trajectory.items():
        np.testing.assert_array_equal(solution.trajectory[frame], pose)
    assert set(solve(PoseGraph(first=3), {}, axis=TABLE).trajectory) == {3}


def test_axis_and_shared_noise_are_not_for_the_same_solution() -> None:
    with pytest.raises(ValueError, match="shared"):
        solve(PoseGraph(first=0), {}, axis=TABLE, shared=0.5)


def test_slip_over_frames_that_are_missing_is_that_of_as_many_steps() -> None:
    rng = np.random.default_rng(7)
    graph = _graph(rng, _table(rng)[0])
    half = CommonAxis(0.5 * TABLE.sigma_tilt_rad, 0.5 * TABLE.sigma_shift_m, 0.5 * TABLE.sigma_lift_m)
    sparse = PoseGraph(tuple(edge(4 * e.target, 4 * e.source, e.posterior.pose) for e in graph.edges), first=0)
    dense, apart = solve(graph, {}, axis=TABLE), solve(sparse, {}, axis=half)
    assert dense.camera_from_axis is not None
    for frame, pose in dense.trajectory.items():
        np.testing.assert_allclose(apart.trajectory[4 * frame], pose, atol=1e-6)
        np.testing.assert_allclose(apart.covariances[4 * frame], dense.covariances[frame], rtol=1e-3, atol=1e-12)
