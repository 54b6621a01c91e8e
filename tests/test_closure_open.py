"""Registrations that leave a turn open place frames, and close no loop."""

from dataclasses import replace

import numpy as np
import pytest
from closing import ABOUT_OBJECT, REGULAR_DEG, Run, posterior_of

from modeler import se3
from modeler.closure import Closer, MapView
from modeler.types import Mode, OpenRotation, PoseGaussian, Posterior


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
    span = closer.judge_span(_turn_open(posterior_of(3, 1, run.truth_between(1, 3)), sigma_deg), _map_view(run))
    assert (span.kind, span.accepted) == ("span", takes_part)
    if not takes_part:
        assert isinstance(span.reason, OpenRotation)
        assert span.reason.sigma_deg == pytest.approx(20.0, abs=0.5)


def test_vaguest_of_several_modes_tells_whether_a_turn_is_open() -> None:
    run, closer = Run(list(REGULAR_DEG)), Closer()
    run.run(closer, lambda posterior: _turn_open(posterior, 20.0))
    sure = posterior_of(3, 1, run.truth_between(1, 3))
    vague = replace(sure, modes=(Mode(0.6, sure.pose), Mode(0.4, _turn_open(sure, 20.0).pose)))
    assert closer.judge_span(sure, _map_view(run)).accepted
    assert isinstance(closer.judge_span(vague, _map_view(run)).reason, OpenRotation)


@pytest.mark.parametrize(("sigma_deg", "takes_part"), [(3.0, True), (12.0, False)])
def test_an_open_turn_does_no_harm_where_the_graph_knows_it_better(sigma_deg: float, *, takes_part: bool) -> None:
    """A bottle on a turntable, whose step is known: what else the edge tells is welcome."""
    run, closer = Run(list(REGULAR_DEG)), Closer()
    run.run(closer, lambda posterior: _turn_open(posterior, sigma_deg))
    span = closer.judge_span(_turn_open(posterior_of(3, 1, run.truth_between(1, 3)), 20.0), _map_view(run))
    assert span.accepted == takes_part


def _map_view(run: Run) -> MapView:
    return MapView(run.views, run.solution, run.graph.edges)
