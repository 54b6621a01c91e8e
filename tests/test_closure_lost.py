"""Frames that nothing places, and the first one after them: what is believed of its registrations."""

from dataclasses import replace

import numpy as np
import pytest
from closing import ABOUT_OBJECT, COVARIANCE, REGULAR_DEG, Run, told, witnessed

from modeler import se3
from modeler.closure import Closer, MapView
from modeler.types import ConfirmedBy, JoinsPrevious, LowEvidence, Outcome, PoseGaussian, Posterior


def test_previous_view_is_not_believed_after_lost_frames_where_the_images_contradict_it() -> None:
    run = Run(list(REGULAR_DEG[:9]))
    run.run(Closer(), told(-1))
    truth, solution = run.measured(4, 8, np.random.default_rng(0), np.zeros(6)), run.solution  # as far as four steps
    doubtful = witnessed(replace(truth, source=12, target=8), -90.0)
    map_view = MapView(run.views, solution, run.graph.edges)
    assert Closer().placement([doubtful], map_view, steps=1)[0] is doubtful
    assert Closer().placement([doubtful], map_view, steps=4)[0] is None
    assert isinstance(Closer().judge([doubtful], map_view, steps=4)[0].reason, LowEvidence)
    assert Closer().placement([witnessed(doubtful, -30.0)], map_view, steps=4)[0] is not None


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
    if lost == 1:  # so far from where it was, so soon, is not believed
        assert not any(edge.accepted for edge in run.judged[back])
    else:
        np.testing.assert_allclose(run.solution.trajectory[back], run.truth[back], atol=0.02)
        assert sum(edge.accepted for edge in run.judged[back]) >= 2  # a witness
        assert run.judged[back][0].kind == "odometry"  # that failed, though the object had turned away


def test_lost_frame_is_bridged_from_the_last_accepted_one() -> None:
    run = Run(list(REGULAR_DEG))
    run.run(Closer(), lambda p: replace(p, outcome=Outcome.TOO_FEW_POINTS) if p.source == 5 else p)
    assert run.tried[6][0] == 4
    assert 5 not in run.solution.trajectory
    assert 0 in run.tried[13]


def test_after_lost_frames_the_previous_view_is_believed_only_near_where_the_motion_led() -> None:
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


@pytest.mark.parametrize(("outcome", "witnesses"), [("converged", ()), ("converged", (5,)), ("ambiguous", (5,))])
def test_far_from_where_the_motion_led_the_previous_view_is_believed_only_with_a_witness(
    outcome: str, witnesses: tuple[int, ...]
) -> None:
    """A box's broad side matches its narrow one, a quarter turn away: by itself such a match says nothing."""
    run = Run([*(20.0 * np.arange(7)), *[0.0] * 4, 140.0])

    def spoil(posterior: Posterior) -> Posterior:
        gone = 6 < posterior.source < 11
        if gone or (posterior.source == 11 and posterior.target not in (6, *witnesses)):
            return replace(posterior, outcome=Outcome.NO_OVERLAP)
        vague = posterior.source == 11 and posterior.target == 6 and outcome == "ambiguous"
        return replace(posterior, outcome=Outcome.AMBIGUOUS) if vague else posterior

    run.run(Closer(), spoil)
    believed = outcome == "converged" and bool(witnesses)  # what is vague agrees with anything
    assert [edge.accepted for edge in run.judged[11]].count(True) == (2 if believed else 0)
    if believed:
        assert run.tried[11][:2] == (6, 5)  # the nearest to where the previous view puts it
        assert run.judged[11][0].reason == JoinsPrevious(Outcome.CONVERGED, 0.8, ConfirmedBy(5))


def test_a_view_seen_from_far_round_places_a_frame_only_with_a_witness() -> None:
    run = Run([*(20.0 * np.arange(9)), *[0.0] * 6, 300.0, 320.0])

    def spoil(posterior: Posterior) -> Posterior:
        apart_deg = np.degrees(se3.rotation_angle(posterior.pose.mean))
        failed = posterior.source in range(9, 15) or apart_deg > 65.0
        return replace(posterior, outcome=Outcome.NO_OVERLAP) if failed else posterior

    run.run(Closer(), spoil)
    assert not any(edge.accepted for edge in run.judged[15])  # 60° from the first view, and no other in reach
    assert any(edge.accepted for edge in run.judged[16])
    np.testing.assert_allclose(run.solution.trajectory[16], run.truth[16], atol=0.02)
