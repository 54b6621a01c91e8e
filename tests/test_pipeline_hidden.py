"""Frames in which something hides the object: what is spent on them, and that those after them join as ever."""

from __future__ import annotations

import numpy as np
from test_pipeline import FRAMES, Oracle, modeler, run, trajectory_error

from modeler.pipeline import glancing
from modeler.registration import IcpRegistrar, VisibilityRegistrar
from modeler.registration.visibility import VisibilityLikelihood
from modeler.segmentation import Scene
from modeler.types import Reason, Searching, Step

HIDDEN = frozenset({2, 3, 4, 5})


def outcomes(steps: list[Step]) -> list[tuple[int, bool, Reason | None]]:
    return [(step.frame.index, step.accepted, step.left_out) for step in steps]


def test_after_one_frame_searched_for_in_vain_others_that_are_hidden_are_only_glanced_at() -> None:
    registrar, glance = Oracle(blind=HIDDEN), Oracle(blind=HIDDEN)
    steps = run(registrar=registrar, glance=glance)
    assert {source for source, _ in registrar.asked} & HIDDEN == {2}
    assert {source for source, _ in glance.asked} >= {3, 4, 5}
    whole = run(registrar=Oracle(blind=HIDDEN))
    assert outcomes(steps) == outcomes(whole)
    assert sorted(steps[-1].solution.trajectory) == [0, 1, 6, 7, 8]
    for frame, pose in whole[-1].solution.trajectory.items():
        np.testing.assert_array_equal(steps[-1].solution.trajectory[frame], pose)


def test_a_frame_hidden_now_and_then_is_searched_for_at_the_previous_view_alone() -> None:
    hidden = frozenset({2, 4, 6})
    registrar = Oracle(blind=hidden)
    steps = run(registrar=registrar, glance=Oracle(blind=hidden))
    assert [target for source, target in registrar.asked if source == 6] == [5]
    assert sorted(steps[-1].solution.trajectory) == [0, 1, 3, 5, 7, 8]


def test_a_glance_never_joins_frames_itself() -> None:
    """What it takes for surface is searched for as ever: false hopes change nothing but the cost."""
    registrar, hopeful = Oracle(blind=HIDDEN), Oracle(noise=100.0)
    steps = run(registrar=registrar, glance=hopeful)
    whole = Oracle(blind=HIDDEN)
    assert outcomes(steps) == outcomes(run(registrar=whole))
    assert registrar.asked == whole.asked
    assert trajectory_error(steps[-1]) < 1e-6


def test_lost_frames_are_found_from_far_round_by_way_of_glances() -> None:
    early = frozenset((source, target) for source in (3, 4, 5, 6) for target in range(source) if target < 3)
    parts = Oracle(apart=early, reach=9.0), Oracle(apart=early, reach=9.0)
    last = run(registrar=parts[0], glance=parts[1])[-1]
    assert parts[1].asked
    assert set(last.solution.trajectory) == set(range(9))
    assert trajectory_error(last) < 1e-6


def test_a_search_is_announced_for_lost_frames_and_no_others() -> None:
    maker = modeler(registrar=Oracle(blind=HIDDEN), glance=Oracle(blind=HIDDEN))
    assert {event.frame for event in maker.run(FRAMES, Scene()) if isinstance(event, Searching)} == HIDDEN
    assert not any(isinstance(event, Searching) for event in modeler().run(FRAMES, Scene()))


def test_a_glance_is_a_smaller_search_of_the_same_likelihood() -> None:
    registrar = VisibilityRegistrar(likelihood=VisibilityLikelihood(points=500), min_overlap=0.3)
    glance = glancing(registrar)
    assert isinstance(glance, VisibilityRegistrar)
    assert (glance.likelihood.points, glance.min_overlap) == (500, 0.3)
    assert glance.search.starts.max_starts < registrar.search.starts.max_starts
    assert (glance.max_modes, glance.sampler.max_rounds) == (1, 1)
    assert glancing(IcpRegistrar()) is None
