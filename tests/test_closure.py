"""Which pairs are tried on the kinds of sequence people take, and that only closures that agree are accepted."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from closure_runs import (
    ABOUT_OBJECT,
    COVARIANCE,
    REGULAR_DEG,
    Run,
    judged,
    posterior_of,
    stated,
    turned,
    view,
    weighed,
)

from modeler import se3
from modeler.closure import Closer, MapView
from modeler.graph import PoseGraph, Smoother
from modeler.pipeline.state import State
from modeler.types import (
    Array,
    ConfirmedBy,
    Consistency,
    Degenerate,
    Failed,
    JoinsPrevious,
    LowCorrelation,
    LowLikelihood,
    Mode,
    NotPlaced,
    OpenRotation,
    Outcome,
    PoseGaussian,
    Posterior,
    Solution,
    explain,
)


def test_first_frame_has_nothing_to_be_registered_against() -> None:
    nothing = Closer().placement([], MapView({}, Solution()))
    assert (nothing.base, nothing.reason) == (None, NotPlaced())
    assert judged(Closer(), [], MapView({}, Solution())) == ()


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
    run = Run(list(angles_deg)).run(Closer())
    assert any(0 in run.tried[frame][1:] for frame in run.numbers[-2:]), name
    closures = run.closures()
    assert closures
    assert all(edge.accepted for edge in closures)
    for edge in closures:
        between_deg = np.degrees(se3.rotation_angle(run.truth_between(edge.target, edge.source)))
        assert between_deg < 48.0, name


@pytest.mark.parametrize(
    ("angles_deg", "tried"),
    [
        (50.0 * np.arange(7), True),  # ends at 300°, one large step before its start
        (45.0 * np.arange(7), False),  # at 270°: views so far apart are not registered
        ([*(40.0 * np.arange(10)), 390.0, 420.0], False),  # a loop was closed at 360°
    ],
)
def test_a_turn_of_few_large_steps_closes_from_where_it_ends(angles_deg: Sequence[float], *, tried: bool) -> None:
    run = Run(list(angles_deg)).run(Closer())
    last = run.numbers[-1]
    assert (0 in run.tried[last]) is tried
    if tried:
        assert [edge.accepted for edge in run.judged[last] if edge.target == 0] == [True]


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

    run = Run(list(REGULAR_DEG)).run(Closer(), spoil)
    closed = [edge.accepted for edge in run.judged[13] if edge.target == 0]
    assert closed == ([True] if sigma_deg > 10.0 else [])
    open_turn = Run(list(REGULAR_DEG)).run(
        Closer(max_closures=0), spoil
    )  # as in a recording that goes on with the object on its side
    assert ((13, 0) in Closer().span_pairs(open_turn.map_view)) == (sigma_deg > 10.0)


def test_previous_view_comes_first_and_recent_neighbours_are_no_closures() -> None:
    run = Run(list(REGULAR_DEG)).run(Closer())
    for frame in run.numbers[1:]:
        assert len(run.tried[frame]) <= 3
        assert len(set(run.tried[frame])) == len(run.tried[frame])
    assert all(run.tried[frame] == (frame - 1,) for frame in range(1, 12))
    assert run.tried[13] == (12, 0, 1)[: len(run.tried[13])]


def test_no_closure_without_coming_back() -> None:
    for angles_deg in (20.0 * np.arange(9), 4.0 * np.arange(20), np.tile([0.0, 30.0], 8)):
        run = Run(list(angles_deg)).run(Closer())
        assert run.closures() == []


@pytest.mark.parametrize("angles_deg", [4.0 * np.arange(25), np.tile([0.0, 30.0], 9), [*range(0, 150, 15)] * 2])
def test_many_small_steps_are_spanned_where_that_adds_information(angles_deg: Sequence[float]) -> None:
    run = Run(list(angles_deg)).run(Closer())
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
        run = Run(angles_deg).run(Closer(max_closures=count))
        assert max(len(targets) for targets in run.tried.values()) == 1 + count


def test_second_turn_meets_the_first_turn_again_and_again() -> None:
    run = Run(list(20.0 * np.arange(36))).run(Closer())
    met = [frame for frame in range(18, 36) if any(target < 18 for target in run.tried[frame][1:])]
    assert len(met) >= 3
    assert max(np.diff(met)) <= 6
    assert all(edge.accepted for edge in run.closures())
    assert _largest_deg(run, run.solution.trajectory) < 0.6 * _largest_deg(run, run.solution.odometry)


def test_frame_numbers_need_not_start_at_zero_nor_be_dense() -> None:
    dense = Run(list(REGULAR_DEG)).run(Closer())
    sparse = Run(list(REGULAR_DEG), list(range(7, 7 + 5 * 14, 5))).run(Closer())
    renamed = {7 + 5 * k: tuple(7 + 5 * t for t in targets) for k, targets in dense.tried.items()}
    assert sparse.tried == renamed


def test_odometry_is_accepted_where_usable_and_refused_with_advice() -> None:
    closer = Closer()
    start = Solution({0: np.eye(4)})
    for outcome in Outcome:
        (edge,) = judged(closer, [posterior_of(1, 0, np.eye(4), outcome)], MapView({0: view(0)}, start))
        assert edge.kind == "odometry"
        assert edge.accepted == (outcome in (Outcome.CONVERGED, Outcome.AMBIGUOUS))
        assert edge.accepted or edge.reason == Failed(outcome)


@pytest.mark.parametrize(
    "covariance", [np.zeros((6, 6)), np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-9]), np.full((6, 6), np.nan)]
)
def test_invalid_covariance_is_rejected(covariance: Array) -> None:
    posterior = replace(posterior_of(1, 0, np.eye(4)), pose=PoseGaussian(np.eye(4), covariance))
    (edge,) = judged(Closer(), [posterior], MapView({0: view(0)}, Solution({0: np.eye(4)})))
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
    run = Run(list(REGULAR_DEG)).run(Closer(), _spoiled_closures(change))
    assert run.closures()
    for edge in run.closures():
        assert not edge.accepted
        assert isinstance(edge.reason, Consistency)


def test_closure_survives_a_chain_whose_small_errors_all_point_one_way() -> None:
    """Each edge turns 0.3° too far (1.7 of its own sigmas); over 14 edges that is far outside its stated covariance."""
    run = Run(list(REGULAR_DEG)).run(Closer(), bias=np.array([0.0, np.radians(0.3), 0.0, 0.0, 0.0, 0.0]))
    assert run.closures()
    assert all(edge.accepted for edge in run.closures())
    assert run.solution.outliers == ()
    drift_deg = np.degrees(se3.rotation_angle(se3.inverse(run.truth[13]) @ run.solution.odometry[13]))
    left_deg = np.degrees(se3.rotation_angle(se3.inverse(run.truth[13]) @ run.solution.trajectory[13]))
    assert left_deg < 0.5 * drift_deg


def test_reason_states_how_far_off_a_closure_is_at_the_object() -> None:
    run = Run(list(REGULAR_DEG)).run(
        Closer(max_closures=1), _spoiled_closures(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))
    )
    reason = run.closures()[-1].reason
    assert isinstance(reason, Consistency)
    assert reason.angle_deg == pytest.approx(90.0, abs=3.0)
    assert reason.offset_m < 0.015  # turned about its own centroid, not about the camera: that would be a metre


def test_closures_need_overlap_and_a_usable_outcome() -> None:
    for spoiled in ({"overlap": 0.1}, {"overlap": float("nan")}, {"outcome": Outcome.DEGENERATE}):
        run = Run(list(REGULAR_DEG)).run(
            Closer(), lambda p, s=spoiled: p if p.source - p.target == 1 else replace(p, **s)
        )
        assert run.closures()
        assert not any(edge.accepted for edge in run.closures())


def test_closure_that_the_images_contradict_is_refused_though_it_agrees() -> None:
    run = Run(list(REGULAR_DEG)).run(Closer(), stated(13))
    (closure,) = [edge for edge in run.judged[13] if edge.target == 0]
    assert not closure.accepted
    assert isinstance(closure.reason, LowLikelihood)
    assert closure.reason.log_marginal_likelihood == -90.0
    assert -30.0 < closure.reason.median_nats <= -20.0
    taken = Run(list(REGULAR_DEG)).run(Closer(), stated(13, wrong=-45.0))
    assert all(edge.accepted for edge in taken.judged[13])


def test_scattered_or_missing_evidence_rejects_nothing() -> None:
    for spoil in (stated(13, scatter=15.0), lambda posterior: weighed(posterior, np.nan)):
        run = Run(list(REGULAR_DEG)).run(Closer(), spoil)
        assert all(edge.accepted for edge in run.judged[13])


@pytest.mark.parametrize(
    ("usual", "step_deg", "correlation", "colours", "refused"),
    [
        (0.8, 25.0, 0.05, 80.0, True),
        (0.8, 25.0, -0.4, 80.0, True),
        (0.8, 25.0, 0.35, 80.0, False),  # right ones have as little in other light or seen obliquely
        (0.8, 25.0, 0.05, 5.0, False),  # nor do a few colours tell
        (0.4, 25.0, 0.0, 80.0, False),  # where print agrees hardly anywhere
        (0.8, 3.0, 0.0, 80.0, False),  # or stays where it was, as highlights do
        (np.nan, 25.0, 0.0, 80.0, False),
    ],
)
def test_registrations_whose_print_disagrees_are_refused(
    usual: float, step_deg: float, correlation: float, colours: float, refused: bool
) -> None:
    def printed(posterior: Posterior) -> Posterior:
        found = correlation if posterior.source == 6 else usual
        return replace(posterior, colour_correlation=found, independent_colours=colours)

    run = Run([step_deg * k for k in range(9)]).run(Closer(), printed)
    assert all(isinstance(edge.reason, LowCorrelation) for edge in run.judged[6]) is refused
    assert (6 in run.views) is not refused
    assert {7, 8} <= set(run.views)


def test_what_was_found_of_a_frame_before_it_was_placed_is_judged_in_the_end() -> None:
    run = Run(list(REGULAR_DEG)).run(Closer())
    refused = [replace(edge, accepted=False, reason=NotPlaced()) for edge in run.closures()]
    wrong = replace(refused[0].posterior, pose=PoseGaussian(turned(90.0), COVARIANCE))
    edges = [edge for edge in run.graph.edges if edge.kind != "closure"]
    for early, accepted in ((refused, True), ([replace(refused[0], posterior=wrong)], False)):
        graph = PoseGraph((*early, *edges), first=0)
        state = State(graph, Smoother().to(graph), run.views, run.keyframes)
        found = state.rejudged(Closer().judge_span)
        assert [edge.accepted for edge in found.graph.edges[-len(early) :]] == [accepted] * len(early)
        assert [edge for edge in found.graph.edges if edge in edges] == edges
    assert replace(state, graph=run.graph).rejudged(Closer().judge_span).graph is run.graph


def test_once_all_frames_are_in_each_is_tried_over_two_steps() -> None:
    run = Run(list(REGULAR_DEG)).run(Closer(max_closures=0))
    pairs = Closer().span_pairs(run.map_view)
    assert {(source, source - 2) for source in range(2, 12)} <= set(pairs)
    assert {source for source, _ in pairs} == set(range(2, 14))
    assert Closer(max_spans=0).span_pairs(run.map_view) == ()
    assert Closer(max_span_deg=40.0).span_pairs(MapView(run.views, run.solution, run.graph.edges[:11])) == ()
    rng = np.random.default_rng(1)
    for source, target in pairs:
        true = run.measured(target, source, rng, np.zeros(6))
        edge = Closer().judge_span(true, run.map_view)
        assert edge.accepted
        assert edge.kind == ("closure" if source - target > 3 else "span")
        wrong = replace(true, pose=PoseGaussian(true.pose.mean @ turned(30.0), COVARIANCE))
        edge = Closer().judge_span(wrong, run.map_view)
        assert not edge.accepted
        assert isinstance(edge.reason, Consistency)
        assert Closer().judge_span(weighed(true, -1e9), run.map_view).accepted


def test_views_that_failed_to_join_the_previous_one_are_tried_again_once_the_graph_predicts_their_motion() -> None:
    run = Run(list(REGULAR_DEG)).run(Closer(max_closures=0))
    joined = run.judged[6][0]
    assert (6, 5) not in Closer().span_pairs(run.map_view)
    for reason, tried in ((Failed(Outcome.AT_LIMIT), True), (NotPlaced(), False)):
        rejected = replace(joined, accepted=False, reason=reason)
        pairs = Closer().span_pairs(replace(run.map_view, edges=(*run.graph.edges, rejected)))
        assert ((6, 5) in pairs) == tried


def test_frames_lost_at_the_end_do_not_keep_spans_from_being_tried() -> None:
    run = Run(list(REGULAR_DEG)).run(Closer(max_closures=0))
    lost = [replace(run.graph.edges[0], accepted=False) for _ in range(20)]
    pairs = Closer().span_pairs(replace(run.map_view, edges=(*run.graph.edges, *lost)))
    assert pairs == Closer().span_pairs(run.map_view) != ()


def test_of_small_steps_the_most_informative_span_is_tried() -> None:
    run = Run(list(3.0 * np.arange(30))).run(Closer(max_closures=0))
    pairs = Closer().span_pairs(run.map_view)
    apart = [source - target for source, target in pairs if source > 20]
    assert len(apart) == 9
    assert min(apart) >= 4
    assert 3.0 * max(apart) <= 55.0
    assert len(set(pairs)) == len(pairs)


def test_closure_takes_the_place_of_failed_odometry() -> None:
    run = Run(list(REGULAR_DEG)).run(
        Closer(), lambda p: replace(p, outcome=Outcome.NO_OVERLAP) if (p.source, p.target) == (13, 12) else p
    )
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

    run = Run(list(REGULAR_DEG)).run(Closer(), spoil)
    assert not any(edge.accepted for edge in run.judged[13])
    assert 13 not in run.solution.trajectory
    assert all(explain(edge.reason) for edge in run.judged[13])


# Registrations that leave a turn open place frames, and close no loop.


def _turn_open(posterior: Posterior, sigma_deg: float) -> Posterior:
    """The same registration of a bottle: all but the turn about its axis, of which only limits tell."""
    spread = se3.adjoint(ABOUT_OBJECT)
    wide = spread @ np.diag([0.0, np.radians(sigma_deg) ** 2, 0.0, 0.0, 0.0, 0.0]) @ spread.T
    return replace(posterior, pose=PoseGaussian(posterior.pose.mean, posterior.pose.covariance + wide))


@pytest.mark.parametrize(("sigma_deg", "takes_part"), [(1.0, True), (20.0, False)])
def test_what_leaves_a_turn_open_places_frames_and_tells_nothing_more(sigma_deg: float, *, takes_part: bool) -> None:
    """The limits of a turn count once, in the edges that place the frames."""
    run, closer = Run(list(REGULAR_DEG)), Closer()
    run.run(closer, lambda posterior: _turn_open(posterior, sigma_deg))
    assert all(run.judged[frame][0].accepted for frame in run.numbers[1:])
    assert run.closures()
    assert all(edge.accepted == takes_part for edge in run.closures())
    span = closer.judge_span(_turn_open(posterior_of(3, 1, run.truth_between(1, 3)), sigma_deg), run.map_view)
    assert (span.kind, span.accepted) == ("span", takes_part)
    if not takes_part:
        assert isinstance(span.reason, OpenRotation)
        assert span.reason.sigma_deg == pytest.approx(20.0, abs=0.5)


@pytest.mark.parametrize(
    ("chain_deg", "span_deg", "takes_part"),
    [
        (0.0, 20.0, True),
        (0.0, 40.0, False),  # farther than a Gaussian holds
        (3.0, 20.0, True),  # a bottle on a turntable, whose step is known: what else the edge tells is welcome
        (12.0, 20.0, False),
    ],
)
def test_a_turn_may_be_open_where_the_graph_determines_it_better(
    chain_deg: float, span_deg: float, *, takes_part: bool
) -> None:
    run, closer = Run(list(REGULAR_DEG)), Closer()
    run.run(closer, lambda posterior: _turn_open(posterior, chain_deg))
    span = closer.judge_span(_turn_open(posterior_of(3, 1, run.truth_between(1, 3)), span_deg), run.map_view)
    assert span.accepted is takes_part


def test_a_view_that_never_determined_the_rotation_adds_little() -> None:
    """The object comes back to views some of which left the turn open, and to others that did not."""

    def first_open(posterior: Posterior) -> Posterior:
        return _turn_open(posterior, 20.0) if posterior.target < 2 else posterior

    tried = {}
    for opened in (False, True):
        run = Run(list(12.0 * np.arange(44))).run(Closer(), first_open if opened else lambda posterior: posterior)
        tried[opened] = {target for frame in run.numbers[24:-1] for target in run.tried[frame][1:]}
    assert {0, 1, 3} <= tried[False]
    assert {2, 3} <= tried[True]
    assert not {0, 1} & tried[True]


def test_vaguest_of_several_modes_tells_whether_a_turn_is_open() -> None:
    run, closer = Run(list(REGULAR_DEG)), Closer()
    run.run(closer, lambda posterior: _turn_open(posterior, 20.0))
    sure = posterior_of(3, 1, run.truth_between(1, 3))
    vague = replace(sure, modes=(Mode(0.6, sure.pose), Mode(0.4, _turn_open(sure, 20.0).pose)))
    assert closer.judge_span(sure, run.map_view).accepted
    assert isinstance(closer.judge_span(vague, run.map_view).reason, OpenRotation)


# Frames that nothing places, and the first one after them: what is accepted of its registrations.


def test_registration_against_the_previous_view_is_rejected_after_lost_frames_where_the_images_contradict_it() -> None:
    run = Run(list(REGULAR_DEG[:9])).run(Closer(), stated(-1))
    truth, solution = run.measured(4, 8, np.random.default_rng(0), np.zeros(6)), run.solution  # as far as four steps
    doubtful = weighed(replace(truth, source=12, target=8), -90.0)
    map_view = MapView(run.views, solution, run.graph.edges)
    assert Closer().placement([doubtful], map_view, steps=1).base is doubtful
    assert Closer().placement([doubtful], map_view, steps=4).base is None
    assert isinstance(judged(Closer(), [doubtful], map_view, steps=4)[0].reason, LowLikelihood)
    assert Closer().placement([weighed(doubtful, -30.0)], map_view, steps=4).base is not None


@pytest.mark.parametrize("lost", [1, 16])
def test_lost_frames_are_found_again_from_any_earlier_view(lost: int) -> None:
    """The object comes back to a view of long ago; nothing connects it with the newest one."""
    run = Run([*(20.0 * np.arange(9)), *[0.0] * lost, 42.0])
    gone = range(9, 9 + lost)

    def spoil(posterior: Posterior) -> Posterior:
        apart_deg = np.degrees(se3.rotation_angle(posterior.pose.mean))
        failed = posterior.source in gone or apart_deg > 50.0
        return replace(posterior, outcome=Outcome.NO_OVERLAP) if failed else posterior

    run.run(Closer(), spoil)
    back = 9 + lost
    assert not any(edge.accepted for frame in gone for edge in run.judged[frame])
    assert len(run.tried[back]) <= 1 + Closer().max_relocations
    if lost == 1:  # so far from where it was, so soon, is not accepted
        assert not any(edge.accepted for edge in run.judged[back])
    else:
        np.testing.assert_allclose(run.solution.trajectory[back], run.truth[back], atol=0.02)
        assert sum(edge.accepted for edge in run.judged[back]) >= 2  # a confirmation
        assert run.judged[back][0].kind == "odometry"  # that failed, though the object had turned away


def test_after_lost_frames_the_previous_view_is_accepted_only_near_where_the_motion_led() -> None:
    """A box looks the same from behind: after a gap its other side matches the last view."""
    run = Run([*(23.0 * np.arange(7)), *[0.0] * 4, 253.0])

    def spoil(posterior: Posterior) -> Posterior:
        if posterior.source != 11:
            return replace(posterior, outcome=Outcome.TOO_FEW_POINTS) if posterior.source > 6 else posterior
        behind = ABOUT_OBJECT @ se3.exp(np.array([*np.radians([0.0, 180.0, 0.0]), 0, 0, 0])) @ se3.inverse(ABOUT_OBJECT)
        return replace(posterior, pose=PoseGaussian(posterior.pose.mean @ behind, COVARIANCE))

    run.run(Closer(), spoil)
    assert run.tried[11][0] == 6
    assert not any(edge.accepted for edge in run.judged[11])


@pytest.mark.parametrize(("outcome", "confirmations"), [("converged", ()), ("converged", (5,)), ("ambiguous", (5,))])
def test_far_from_where_the_motion_led_the_previous_view_is_accepted_only_with_a_confirmation(
    outcome: str, confirmations: tuple[int, ...]
) -> None:
    """A box's broad side matches its narrow one, a quarter turn away: by itself such a match says nothing."""
    run = Run([*(20.0 * np.arange(7)), *[0.0] * 4, 140.0])

    def spoil(posterior: Posterior) -> Posterior:
        gone = 6 < posterior.source < 11
        if gone or (posterior.source == 11 and posterior.target not in (6, *confirmations)):
            return replace(posterior, outcome=Outcome.NO_OVERLAP)
        vague = posterior.source == 11 and posterior.target == 6 and outcome == "ambiguous"
        return replace(posterior, outcome=Outcome.AMBIGUOUS) if vague else posterior

    run.run(Closer(), spoil)
    accepted = outcome == "converged" and bool(confirmations)  # what is vague agrees with anything
    assert [edge.accepted for edge in run.judged[11]].count(True) == (2 if accepted else 0)
    if accepted:
        assert run.tried[11][:2] == (6, 5)  # the nearest to where the previous view puts it
        assert run.judged[11][0].reason == JoinsPrevious(Outcome.CONVERGED, 0.8, ConfirmedBy(5))


def test_a_view_seen_from_far_round_places_a_frame_only_with_a_confirmation() -> None:
    run = Run([*(20.0 * np.arange(9)), *[0.0] * 6, 300.0, 320.0])

    def spoil(posterior: Posterior) -> Posterior:
        apart_deg = np.degrees(se3.rotation_angle(posterior.pose.mean))
        failed = posterior.source in range(9, 15) or apart_deg > 65.0
        return replace(posterior, outcome=Outcome.NO_OVERLAP) if failed else posterior

    run.run(Closer(), spoil)
    assert not any(edge.accepted for edge in run.judged[15])  # 60° from the first view, and no other in reach
    assert any(edge.accepted for edge in run.judged[16])
    np.testing.assert_allclose(run.solution.trajectory[16], run.truth[16], atol=0.02)
