"""What to do next, said while a run goes on."""

import io
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
from rerun_recordings import read
from rich.console import Console as Terminal

from modeler.cli.console import Console
from modeler.pipeline import Modeler
from modeler.priors import TablePrior
from modeler.runs.live_advice import advising, summary_of
from modeler.sequences import bundled, open_sequence
from modeler.suggestion import Belief, Candidate, Suggestions, suggest
from modeler.types import Failed, Outcome, Step
from modeler.views import Sensor
from modeler.viz import model_view
from modeler.viz.stream import open_stream


@pytest.fixture(scope="module")
def modeler() -> Modeler:
    return Modeler(sensor=Sensor(), prior=TablePrior())


@pytest.fixture(scope="module")
def steps(modeler: Modeler) -> list[Step]:
    """Return the steps of two frames of a box."""
    frames = list(open_sequence(bundled("box")).select(frames=slice(0, 2)))
    run = modeler.start(modeler.segmenter.scene(frames))
    return [event for event in run.track(frames) if isinstance(event, Step)]


class Slow:
    """A modeler whose first prediction waits until it is let go."""

    def __init__(self, modeler: Modeler) -> None:
        self.modeler, self.begun, self.go = modeler, threading.Event(), threading.Event()

    def belief(self, *known: Any) -> Any:
        self.begun.set()
        assert self.go.wait(60.0)
        return self.modeler.belief(*known)


def test_steps_that_come_while_it_predicts_are_passed_over_but_the_newest(modeler: Modeler, steps: list[Step]) -> None:
    slow, given = Slow(modeler), []
    done = threading.Event()

    def tell(step: Step, *_: Any) -> None:
        given.append(step.frame.index)
        if len(given) == 2:
            done.set()

    with advising(cast("Modeler", slow), tell) as advise:
        advise(steps[0])
        assert slow.begun.wait(60.0)
        for step in (steps[0], steps[0], steps[1]):
            advise(step)
        slow.go.set()
        assert done.wait(60.0)
    assert given == [0, 1]


def test_what_has_not_begun_when_the_run_ends_is_not_reported(modeler: Modeler, steps: list[Step]) -> None:
    slow, given = Slow(modeler), []
    with advising(cast("Modeler", slow), lambda step, *_: given.append(step.frame.index)) as advise:
        advise(steps[0])
        assert slow.begun.wait(60.0)
        advise(steps[1])
        threading.Timer(0.2, slow.go.set).start()
    assert given == [0]


def test_frames_left_out_ask_for_no_advice(modeler: Modeler, steps: list[Step]) -> None:
    slow = Slow(modeler)
    with advising(cast("Modeler", slow), lambda *_: None) as advise:
        advise(replace(steps[1], left_out=Failed(Outcome.NO_OVERLAP)))
    assert not slow.begun.is_set()


def test_what_goes_wrong_is_raised_at_the_end(modeler: Modeler, steps: list[Step]) -> None:
    began = threading.Event()

    def tell(*_: Any) -> None:
        began.set()
        raise RuntimeError("no room")

    def advised() -> None:
        with advising(modeler, tell) as advise:
            advise(steps[0])
            assert began.wait(60.0)

    with pytest.raises(RuntimeError, match="no room"):
        advised()


def test_the_bar_says_the_next_turn_and_no_poke_that_the_run_is_not_given(modeler: Modeler, steps: list[Step]) -> None:
    step = steps[1]
    belief = modeler.belief(step.views, step.solution, step.edges_so_far)
    found = suggest(belief)
    assert summary_of(found).startswith("next: turn by ")
    pokes = [each for each in found.ranked if each.prediction.candidate.action == "poke"]
    assert pokes
    assert summary_of(replace(found, ranked=(*pokes, *found.ranked))) == summary_of(found)
    assert summary_of(found) in said_at_last(step, belief, [found])


def test_that_nothing_is_to_be_gained_is_said_once(modeler: Modeler, steps: list[Step]) -> None:
    belief = modeler.belief(steps[1].views, steps[1].solution, steps[1].edges_so_far)
    enough = replace(suggest(belief, []), reached=True, summary="all is seen")
    assert said_at_last(steps[1], belief, [enough, enough]).count("all is seen") == 1


def said_at_last(step: Step, belief: Belief, found: Sequence[Suggestions]) -> str:
    """Return what a terminal shows of a step and what is suggested after it."""
    said, console = io.StringIO(), Console(2, None)
    assert not console.watched
    console._bar.disable = False
    console._bar.live.console = Terminal(file=said, force_terminal=True, width=200)
    with console:
        console(step)
        for each in found:
            console.advise(step, belief, each)
    return said.getvalue()


def test_the_recording_holds_what_to_do_next_at_its_frame(modeler: Modeler, steps: list[Step], tmp_path: Path) -> None:
    step = steps[1]
    belief = modeler.belief(step.views, step.solution, step.edges_so_far)
    found = suggest(belief, [Candidate("turn", turn_deg=30.0)])
    stream = open_stream("box", save=tmp_path / "r.rrd", advised=True)
    stream(step)
    advice = threading.Thread(target=stream.advise, args=(step, belief, found))  # which has times of its own
    advice.start()
    advice.join()
    stream.close()
    recording = read(tmp_path / "r.rrd")
    assert found.ranked[0].words in recording[model_view.WORDS][step.frame.index]["text"][0]
    assert step.frame.index in recording[model_view.SEEN_CELLS]


def test_where_nothing_can_be_done_nothing_is_to_be_gained(modeler: Modeler, steps: list[Step]) -> None:
    belief = modeler.belief(steps[0].views, steps[0].solution, steps[0].edges_so_far)
    assert "next: turn" in summary_of(suggest(belief, [Candidate("turn", turn_deg=30.0)]))
    assert summary_of(suggest(belief, [])) == "nothing more to gain"
