"""A run whose first frames show something else than the object is told of early, and no other run."""

from __future__ import annotations

from collections.abc import Collection

import pytest
from test_pipeline import FRAMES, Oracle, blank, modeler, run

from modeler.segmentation import Scene
from modeler.types import ACCEPTED, Frame, Step


def parted(first: Collection[int]) -> frozenset[tuple[int, int]]:
    """Return the pairs (source, target) of a thing in the first frames and another in the others."""
    return frozenset((source, target) for source in range(9) for target in first if source not in first)


def remarks(registrar: Oracle, frames: list[Frame] = FRAMES) -> tuple[list[tuple[int, str]], list[Step]]:
    """Return what is told, each with how many frames had come before, and the steps."""
    told: list[str] = []
    when: list[tuple[int, str]] = []
    steps = []
    for step in modeler(registrar=registrar).run(frames, Scene(), remark=told.append):
        when += [(step.frame.index, words) for words in told]
        told.clear()
        steps.append(step)
    return when, steps


@pytest.mark.parametrize(("first", "joined"), [((0,), "frame 0"), ((0, 1, 2), "frames 0 to 2")])
def test_frames_that_match_each_other_but_not_the_first_are_told_of_once_and_early(
    first: tuple[int, ...], joined: str
) -> None:
    start, registrar = len(first), Oracle(apart=parted(first), reach=99.0)
    told, steps = remarks(registrar)
    assert told == [
        (
            start + 4,
            f"nothing from frame {start} on matches {joined}, yet frames {start + 3} and {start + 4} match each other: "
            f"if something else than the object was in view before, --frames {start}: leaves it out",
        )
    ]
    assert sorted(steps[-1].solution.trajectory) == list(first)
    assert all(step.outcome == ACCEPTED for step in run(FRAMES[start:], registrar=registrar))


def test_hidden_frames_say_nothing_against_the_first() -> None:
    hidden = frozenset(range(2, 8))
    assert remarks(Oracle(blind=hidden))[0] == []


def test_an_object_lost_after_more_frames_says_nothing_against_them() -> None:
    assert remarks(Oracle(apart=parted((0, 1, 2, 3)), reach=99.0))[0] == []


def test_only_neighbours_in_time_are_compared() -> None:
    frames = [blank(k) if k % 2 else FRAMES[k] for k in range(9)]
    assert remarks(Oracle(apart=parted((0,)), reach=99.0), frames)[0] == []
