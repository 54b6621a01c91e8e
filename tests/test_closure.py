"""Which pairs are tried on the kinds of sequence people take, and that only closures that agree are accepted."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from closing import ABOUT_OBJECT, COVARIANCE, REGULAR_DEG, Run, posterior_of, told, turned, view, witnessed

from modeler import se3
from modeler.closure import Closer, MapView
from modeler.types import (
    Array,
    Consistency,
    Degenerate,
    Failed,
    LowEvidence,
    NotPlaced,
    Outcome,
    PoseGaussian,
    Posterior,
    Solution,
    explain,
)


def test_first_frame_has_nothing_to_be_registered_against() -> None:
    assert Closer().placement([], MapView({}, Solution())) == (None, NotPlaced())
    assert Closer().judge([], MapView({}, Solution())) == ()


@pytest.mark.parametrize(
    ("name", "angles_deg"),
    [
        ("rendered, 25°", REGULAR_DEG),
        ("dragon, 24°, ends at 336°", 24.0 * np.arange(15)),
        ("cap, 17-24°, ends at 375°", np.linspace(0.0, 375.0, 19) + 1.5 * np.sin(np.arange(19.0))),
        ("kleenex, 16°", 16.0 * np.arange(23)),
        ("by hand, 11-37°", np.cumsum([0.0, *([11, 25, 18, 37, 14, 15, 19, 22, 13, 17] * 2)[:19]])),
        ("few frames, 28-92°", np.array([0.0, 60.0, 152.0, 220.0, 300.0, 328.0])),
    ],
)
def test_last_frames_of_a_full_turn_close_on_the_first(name: str, angles_deg: Array) -> None:
    run = Run(list(angles_deg))
    run.run(Closer())
    assert any(0 in run.tried[frame][1:] for frame in run.numbers[-2:]), name
    closures = run.closures()
    assert closures
    assert all(edge.accepted for edge in closures)
    for edge in closures:
        between_deg = np.degrees(se3.rotation_angle(run.truth_between(edge.target, edge.source)))
        assert between_deg < 48.0, name


@pytest.mark.parametrize("sigma_deg", [1.0, 20.0])
def test_last_frame_is_tried_on_the_first_unless_the_graph_is_sure_that_it_is_elsewhere(sigma_deg: float) -> None:
    """A mug whose handle is hidden for four steps: registrations see half of each turn, and say so or do not."""
    spread = se3.adjoint(ABOUT_OBJECT)
    unsure = COVARIANCE + spread @ np.diag([0.0, np.radians(sigma_deg) ** 2, 0.0, 0.0, 0.0, 0.0]) @ spread.T

    def spoil(posterior: Posterior) -> Posterior:
        if posterior.source not in (3, 4, 5, 6) or posterior.source - posterior.target != 1:
            return posterior
        half = se3.exp(0.5 * se3.log(posterior.pose.mean))
        return replace(posterior, pose=PoseGaussian(half, unsure))

    run = Run(list(REGULAR_DEG))
    run.run(Closer(), spoil)
    closed = [edge.accepted for edge in run.judged[13] if edge.target == 0]
    assert closed == ([True] if sigma_deg > 10.0 else [])


def test_previous_view_comes_first_and_recent_neighbours_are_no_closures() -> None:
    run = Run(list(REGULAR_DEG))
    run.run(Closer())
    for frame in run.numbers[1:]:
        assert run.tried[frame][0] == frame - 1
        assert len(run.tried[frame]) <= 3
        assert len(set(run.tried[frame])) == len(run.tried[frame])
    assert all(run.tried[frame] == (frame - 1,) for frame in range(1, 12))
    assert run.tried[13] == (12, 0, 1)[: len(run.tried[13])]


def test_no_closure_without_coming_back() -> None:
    for angles_deg in (20.0 * np.arange(9), 4.0 * np.arange(20), np.tile([0.0, 30.0], 8)):
        run = Run(list(angles_deg))
        run.run(Closer())
        assert run.closures() == []


@pytest.mark.parametrize("angles_deg", [4.0 * np.arange(25), np.tile([0.0, 30.0], 9), [*range(0, 150, 15)] * 2])
def test_many_small_steps_are_spanned_where_that_tells_much(angles_deg: Sequence[float]) -> None:
    run = Run(list(angles_deg))
    run.run(Closer())
    spanning = [edge for edges in run.judged.values() for edge in edges[1:]]
    assert spanning
    assert all(edge.accepted for edge in spanning)
    assert len(spanning) < len(angles_deg)
    assert _largest_deg(run, run.solution.trajectory) < 0.6 * _largest_deg(run, run.solution.odometry)


def _largest_deg(run: Run, trajectory: Mapping[int, Array]) -> float:
    apart = [se3.inverse(run.truth_between(0, frame)) @ pose for frame, pose in trajectory.items()]
    return float(np.degrees(se3.rotation_angle(np.stack(apart)).max()))


def test_number_of_closures_is_bounded_and_none_means_none() -> None:
    angles_deg = list(15.0 * np.arange(30))
    for count in (0, 1, 2, 3):
        run = Run(angles_deg)
        run.run(Closer(max_closures=count))
        assert max(len(targets) for targets in run.tried.values()) == 1 + count


def test_second_turn_meets_the_first_turn_again_and_again() -> None:
    run = Run(list(20.0 * np.arange(36)))
    run.run(Closer())
    met = [frame for frame in range(18, 36) if any(target < 18 for target in run.tried[frame][1:])]
    assert len(met) >= 3
    assert max(np.diff(met)) <= 6
    assert all(edge.accepted for edge in run.closures())
    assert _largest_deg(run, run.solution.trajectory) < 0.6 * _largest_deg(run, run.solution.odometry)


def test_frame_numbers_need_not_start_at_zero_nor_be_dense() -> None:
    dense, sparse = Run(list(REGULAR_DEG)), Run(list(REGULAR_DEG), list(range(7, 7 + 5 * 14, 5)))
    dense.run(Closer())
    sparse.run(Closer())
    renamed = {7 + 5 * k: tuple(7 + 5 * t for t in targets) for k, targets in dense.tried.items()}
    assert sparse.tried == renamed


def test_odometry_is_accepted_where_usable_and_refused_with_advice() -> None:
    closer = Closer()
    start = Solution({0: np.eye(4)})
    for outcome in Outcome:
        (edge,) = closer.judge([posterior_of(1, 0, np.eye(4), outcome)], MapView({0: view(0)}, start))
        assert edge.kind == "odometry"
        assert edge.accepted == (outcome in (Outcome.CONVERGED, Outcome.AMBIGUOUS))
        assert edge.accepted or edge.reason == Failed(outcome)


@pytest.mark.parametrize(
    "covariance", [np.zeros((6, 6)), np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-9]), np.full((6, 6), np.nan)]
)
def test_covariance_that_is_none_is_refused(covariance: Array) -> None:
    posterior = replace(posterior_of(1, 0, np.eye(4)), pose=PoseGaussian(np.eye(4), covariance))
    (edge,) = Closer().judge([posterior], MapView({0: view(0)}, Solution({0: np.eye(4)})))
    assert not edge.accepted
    assert isinstance(edge.reason, Degenerate)


def _spoiled_closures(change: Array) -> Callable[[Posterior], Posterior]:
    moved = ABOUT_OBJECT @ se3.exp(change) @ se3.inverse(ABOUT_OBJECT)

    def spoil(posterior: Posterior) -> Posterior:
        if posterior.source - posterior.target == 1:
            return posterior
        return replace(posterior, pose=PoseGaussian(posterior.pose.mean @ moved, COVARIANCE))

    return spoil


@pytest.mark.parametrize(
    "change",
    [
        np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]),  # the carton's symmetry
        np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]),
        np.array([0.0, np.radians(25.0), 0.0, 0.0, 0.0, 0.0]),  # one step of the turntable
        np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0]),
    ],
)
def test_closure_that_contradicts_the_chain_is_refused(change: Array) -> None:
    run = Run(list(REGULAR_DEG))
    run.run(Closer(), _spoiled_closures(change))
    assert run.closures()
    for edge in run.closures():
        assert not edge.accepted
        assert isinstance(edge.reason, Consistency)


def test_closure_survives_a_chain_whose_small_errors_all_point_one_way() -> None:
    """Each edge turns 0.3° too far (1.7 of its own sigmas); over 14 edges that is far outside its stated covariance."""
    run = Run(list(REGULAR_DEG))
    run.run(Closer(), bias=np.array([0.0, np.radians(0.3), 0.0, 0.0, 0.0, 0.0]))
    assert run.closures()
    assert all(edge.accepted for edge in run.closures())
    assert run.solution.outliers == ()
    drift_deg = np.degrees(se3.rotation_angle(se3.inverse(run.truth[13]) @ run.solution.odometry[13]))
    left_deg = np.degrees(se3.rotation_angle(se3.inverse(run.truth[13]) @ run.solution.trajectory[13]))
    assert left_deg < 0.5 * drift_deg


def test_reason_states_how_far_off_a_closure_is_at_the_object() -> None:
    run = Run(list(REGULAR_DEG))
    run.run(Closer(max_closures=1), _spoiled_closures(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0])))
    reason = run.closures()[-1].reason
    assert isinstance(reason, Consistency)
    assert reason.angle_deg == pytest.approx(90.0, abs=3.0)
    assert reason.offset_m < 0.015  # turned about its own centroid, not about the camera: that would be a metre


def test_closures_need_overlap_and_a_usable_outcome() -> None:
    for spoiled in ({"overlap": 0.1}, {"overlap": float("nan")}, {"outcome": Outcome.DEGENERATE}):
        run = Run(list(REGULAR_DEG))
        run.run(Closer(), lambda p, s=spoiled: p if p.source - p.target == 1 else replace(p, **s))
        assert run.closures()
        assert not any(edge.accepted for edge in run.closures())


def test_closure_that_the_images_contradict_is_refused_though_it_agrees() -> None:
    run = Run(list(REGULAR_DEG))
    run.run(Closer(), told(13))
    (closure,) = [edge for edge in run.judged[13] if edge.target == 0]
    assert not closure.accepted
    assert isinstance(closure.reason, LowEvidence)
    assert closure.reason.log_evidence == -90.0
    assert -30.0 < closure.reason.median_nats <= -20.0
    taken = Run(list(REGULAR_DEG))
    taken.run(Closer(), told(13, wrong=-45.0))
    assert all(edge.accepted for edge in taken.judged[13])


def test_evidence_that_scatters_or_is_not_told_refuses_nothing() -> None:
    for spoil in (told(13, scatter=15.0), lambda posterior: witnessed(posterior, np.nan)):
        run = Run(list(REGULAR_DEG))
        run.run(Closer(), spoil)
        assert all(edge.accepted for edge in run.judged[13])


def test_once_all_frames_are_in_each_is_tried_over_two_steps() -> None:
    run = Run(list(REGULAR_DEG))
    run.run(Closer(max_closures=0))
    pairs = Closer().span_pairs(MapView(run.views, run.solution, run.graph.edges))
    assert {(source, source - 2) for source in range(2, 12)} <= set(pairs)
    assert {source for source, _ in pairs} == set(range(2, 14))
    assert Closer(max_spans=0).span_pairs(MapView(run.views, run.solution, run.graph.edges)) == ()
    assert Closer(max_span_deg=40.0).span_pairs(MapView(run.views, run.solution, run.graph.edges[:11])) == ()
    rng = np.random.default_rng(1)
    for source, target in pairs:
        true = run.measured(target, source, rng, np.zeros(6))
        edge = Closer().judge_span(true, MapView(run.views, run.solution, run.graph.edges))
        assert edge.accepted
        assert edge.kind == ("closure" if source - target > 3 else "span")
        wrong = replace(true, pose=PoseGaussian(true.pose.mean @ turned(30.0), COVARIANCE))
        edge = Closer().judge_span(wrong, MapView(run.views, run.solution, run.graph.edges))
        assert not edge.accepted
        assert isinstance(edge.reason, Consistency)
        assert Closer().judge_span(witnessed(true, -1e9), MapView(run.views, run.solution, run.graph.edges)).accepted


def test_of_small_steps_the_widest_that_tells_most_is_tried() -> None:
    run = Run(list(3.0 * np.arange(30)))
    run.run(Closer(max_closures=0))
    pairs = Closer().span_pairs(MapView(run.views, run.solution, run.graph.edges))
    apart = [source - target for source, target in pairs if source > 20]
    assert len(apart) == 9
    assert min(apart) >= 4
    assert 3.0 * max(apart) <= 55.0
    assert len(set(pairs)) == len(pairs)


def test_closure_takes_the_place_of_failed_odometry() -> None:
    run = Run(list(REGULAR_DEG))
    run.run(Closer(), lambda p: replace(p, outcome=Outcome.NO_OVERLAP) if (p.source, p.target) == (13, 12) else p)
    odometry, closure, *rest = run.judged[13]
    assert not odometry.accepted
    assert closure.accepted
    assert all(edge.accepted for edge in rest)  # judged by way of the closure
    np.testing.assert_allclose(run.solution.trajectory[13], run.truth[13], atol=0.05)


def test_wrong_closure_cannot_take_the_place_of_failed_odometry() -> None:
    def spoil(posterior: Posterior) -> Posterior:
        if (posterior.source, posterior.target) == (13, 12):
            return replace(posterior, outcome=Outcome.NO_OVERLAP)
        return _spoiled_closures(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))(posterior)

    run = Run(list(REGULAR_DEG))
    run.run(Closer(), spoil)
    assert not any(edge.accepted for edge in run.judged[13])
    assert 13 not in run.solution.trajectory
    assert all(explain(edge.reason) for edge in run.judged[13])
