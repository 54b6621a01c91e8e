"""What `build` remarks on at its end, and how Ctrl-C brings that about."""

from __future__ import annotations

import signal

import numpy as np
import pytest
from commanded import BOX

from modeler import priors, se3
from modeler.cli import compose
from modeler.cli.advice import comes_back, ends_without, other_step, sense_in_doubt
from modeler.cli.console import Interrupt
from modeler.cli.options import PriorOptions
from modeler.types import ACCEPTED, Outcome
from sequences import open_sequence


def test_a_step_between_numbers_that_leave_some_out_is_told_as_a_step_between_frames() -> None:
    options, whole = PriorOptions(prior="turntable", step_deg=-10.0), open_sequence(BOX)
    assert compose.told(options, whole) == ("turntable", "")
    _, remark = compose.told(options, whole.select(every=3))
    assert remark == "frame numbers go up by 3: -10° from one number to the next is -30° from frame to frame"
    assert compose.told(PriorOptions(prior="table"), whole.select(every=3)) == ("table", "")


@pytest.mark.parametrize(
    ("frames", "given_deg", "expected"),
    [
        (slice(0, 14), None, False),  # 13 steps of 25°, as sequence.json says, and 35° to go
        (slice(0, 14), 27.0, True),
        (slice(0, 14), -27.0, True),
        (slice(0, 8), 50.0, True),
        (slice(0, 8), 25.0, False),
    ],
)
def test_a_turn_that_is_told_by_hand_counts_more(frames: slice, given_deg: float | None, *, expected: bool) -> None:
    assert comes_back(open_sequence(BOX).select(frames=frames), given_deg, reach_deg=20.0) is expected


def test_a_table_that_turns_the_other_way_is_asked_about() -> None:
    lost = {"frames": [{"cause": ""}, {"cause": Outcome.NO_OVERLAP.label}], "reason_codes": ["left_out"]}
    known, unknown = (priors.TurntablePrior(-25.0, 3.0, step_sign=sign) for sign in ("known", "unknown"))
    assert sense_in_doubt(lost, known)
    assert sense_in_doubt({"frames": [], "reason_codes": ["little_overlap"]}, known)
    assert not sense_in_doubt(lost, unknown)
    assert not sense_in_doubt(lost, priors.TablePrior())
    assert not sense_in_doubt({"frames": [], "reason_codes": ["interrupted"]}, known)


def test_a_step_that_the_views_contradict_is_told() -> None:
    def steps(turn_deg: float, count: int = 4, gap: int = 1) -> list[dict]:
        turn = se3.exp(np.array([0.0, np.radians(turn_deg), 0.0, 0.0, 0.0, 0.0]))
        edge = {"accepted": True, "kind": "odometry", "target_from_source": turn.ravel().tolist()}
        return [edge | {"source": gap * (k + 1), "target": gap * k} for k in range(count)]

    prior = priors.TurntablePrior(-30.0, 2.0)
    said = other_step(steps(15.0), prior)
    assert "turned by 15.0° from one frame number to the next, not by the 30° ± 2° that was told" in said
    assert said.endswith("is --step-deg -15.0 meant?")
    assert "turned by 15.0°" in other_step(steps(45.0, gap=3), prior)
    again = [edge | {"source": edge["target"], "target": edge["source"]} for edge in steps(-29.0)[:1]]
    assert other_step(steps(29.0) + again, prior) == ""  # a frame that was tried again lies before its target
    assert "turned by 15.0°" in other_step(steps(15.0) + again, prior)
    lost = {"accepted": False, "kind": "odometry", "source": 9, "target": 8, "target_from_source": np.eye(4).tolist()}
    for edges in (steps(25.0), steps(90.0, gap=3), steps(15.0, count=2), [lost] * 5, []):
        assert other_step(edges, prior) == ""
    assert other_step(steps(15.0), priors.TablePrior()) == ""


def test_frames_before_the_object_came_are_told() -> None:
    few, lost = Outcome.TOO_FEW_POINTS.label, Outcome.NO_OVERLAP.label

    def said(*outcomes: str) -> str:
        return ends_without([{"id": 2 * place, "cause": cause} for place, cause in enumerate(outcomes)])

    assert said(few, few, ACCEPTED, lost, ACCEPTED) == (
        "the object is seen from frame 4 on; --frames 4: takes those frames alone"
    )
    assert "seen up to frame 6; --frames :7 takes" in said(ACCEPTED, few, lost, ACCEPTED, few)
    assert "seen from frame 2 on, up to frame 4; --frames 2:5 takes" in said(few, ACCEPTED, ACCEPTED, few)
    for whole in ((ACCEPTED, few, ACCEPTED), (lost, ACCEPTED, lost), (few, few, few), (few, ACCEPTED), ()):
        assert said(*whole) == ""


def test_ctrl_c_ends_the_frames_and_a_second_one_the_program() -> None:
    before = signal.getsignal(signal.SIGINT)
    seen = []
    with Interrupt() as interrupt:
        for item in interrupt.until(range(5)):
            seen.append(item)
            if item == 1:
                signal.raise_signal(signal.SIGINT)
        assert (seen, interrupt.ended_early) == ([0, 1], True)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_after_the_last_frame_changes_nothing() -> None:
    with Interrupt() as interrupt:
        for item in interrupt.until(range(2)):
            if item == 1:
                signal.raise_signal(signal.SIGINT)
    assert not interrupt.ended_early
