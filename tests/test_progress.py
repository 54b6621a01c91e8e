"""Bars where somebody watches, and silence where nobody does."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modeler.cli.advice import outcome_advice
from modeler.cli.console import Console
from modeler.cli.inputs import reading
from modeler.types import Failed, Outcome, PriorRefused, Searching, Segmentation, Solution, Stated, Step
from sequences import bundled, open_sequence

COMMAND = [sys.executable, "-m", "modeler", "info", str(bundled("tube"))]


def test_a_watched_sequence_is_the_same_sequence() -> None:
    whole = open_sequence(bundled("tube")).select(frames=slice(0, 2))
    with reading() as watched:
        same = watched(whole, "reading")
        assert same.indices == whole.indices
        assert same.name == whole.name
        assert same.sensor() == whole.sensor()
        for one, other in zip(same, whole, strict=True):
            np.testing.assert_array_equal(one.depth_m, other.depth_m)


def test_where_stderr_is_no_terminal_there_is_no_bar(capfd: pytest.CaptureFixture[str]) -> None:
    with reading() as watched:
        assert len(list(watched(open_sequence(bundled("tube")).select(frames=slice(0, 2)), "reading"))) == 2
    with Console(3, None):
        pass
    said = capfd.readouterr()
    assert said.out == ""
    assert said.err == ""


def test_a_frame_left_out_is_told_once_and_so_is_that_it_was_placed(capfd: pytest.CaptureFixture[str]) -> None:
    frame = next(iter(open_sequence(bundled("tube"))))
    lost = Step(
        frame=frame,
        segmentation=Segmentation(np.zeros_like(frame.depth_m, dtype=bool), None, Outcome.TOO_FEW_POINTS),
        view=None,
        posteriors=(),
        edges=(),
        left_out=Stated("too few points"),
        solution=Solution(),
        model=None,
    )
    with Console(2, None) as console:
        for step in (lost, lost, replace(lost, left_out=None)):
            console(step)
    assert (
        capfd.readouterr().err == "modeler: frame 0 is left out: too few points\nmodeler: frame 0 is placed after all\n"
    )


def test_what_to_do_about_frames_left_out_is_told_once(capfd: pytest.CaptureFixture[str]) -> None:
    frame = next(iter(open_sequence(bundled("tube"))))
    few, unsure = Outcome.TOO_FEW_POINTS, Outcome.UNSURE_MASK
    nothing = Segmentation(np.zeros_like(frame.depth_m, dtype=bool), None, few)
    lost = Step(frame, nothing, None, (), (), None, Solution(), None)
    outcomes = [
        Failed(few),
        Failed(few),
        Failed(unsure),
        PriorRefused("frames 3 and 2 show no plane; show it"),
        PriorRefused("frames 4 and 2 show no plane; show it"),
    ]
    with Console(5, None) as console:
        for number, outcome in enumerate(outcomes):
            console(replace(lost, frame=replace(frame, index=number), left_out=outcome))
    assert capfd.readouterr().err.splitlines() == [
        f"modeler: frame 0 is left out: {few.label}: {outcome_advice(few)}",
        f"modeler: frame 1 is left out: {few.label}",
        f"modeler: frame 2 is left out: {unsure.label}: {outcome_advice(unsure)}",
        "modeler: frame 3 is left out: frames 3 and 2 show no plane: show it",
        "modeler: frame 4 is left out: frames 4 and 2 show no plane",
    ]


def test_frames_that_are_left_out_in_a_row_are_told_together(capfd: pytest.CaptureFixture[str]) -> None:
    frame = next(iter(open_sequence(bundled("tube"))))
    few = Outcome.TOO_FEW_POINTS
    nothing = Segmentation(np.zeros_like(frame.depth_m, dtype=bool), None, few)
    lost = Step(frame, nothing, None, (), (), Failed(few), Solution(), None)
    with Console(12, None) as console:
        for number in range(12):
            outcome = None if number in (0, 9) else lost.left_out
            console(replace(lost, frame=replace(frame, index=number), left_out=outcome))
    assert capfd.readouterr().err.splitlines() == [
        f"modeler: frame 1 is left out: {few.label}: {outcome_advice(few)}",
        f"modeler: frame 2 is left out: {few.label}",
        f"modeler: frame 3 is left out: {few.label}",
        f"modeler: frame 4 is left out: {few.label}",
        f"modeler: frames 5 to 8 are left out: {few.label}",
        f"modeler: frame 10 is left out: {few.label}",
        f"modeler: frame 11 is left out: {few.label}",
    ]


def on_a_terminal(command: list[str]) -> str:
    """Return what a command writes to a terminal that is its stderr."""
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=theirs, env={**os.environ, "TERM": "xterm", "COLUMNS": "100"}
    ) as process:
        os.close(theirs)
        said = b""
        while True:
            ready, _, _ = select.select([ours], [], [], 60.0)
            assert ready, said
            try:
                piece = os.read(ours, 4096)
            except OSError:  # the other end is closed
                break
            if not piece:
                break
            said += piece
        os.close(ours)
        assert process.wait(10.0) == 0
    return said.decode()


ENDING = """
from modeler.cli.console import Console
from modeler.types import Fusing, Refining
with Console(3, None) as console:
    console(Fusing())
    for done in range(8):
        console(Refining(done, 7))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="a terminal of Linux")
def test_a_terminal_sees_what_is_done_after_the_last_frame() -> None:
    said = on_a_terminal([sys.executable, "-c", ENDING])
    assert "registering more pairs" in said
    assert "7/7" in said


@pytest.mark.skipif(sys.platform != "linux", reason="a terminal of Linux")
def test_a_terminal_sees_how_far_it_is_and_how_long_it_takes() -> None:
    said = on_a_terminal(COMMAND)
    assert "reading" in said
    assert "14/14" in said
    assert "0:00:0" in said  # gone by, and to go
    assert Path(COMMAND[-1]).name not in said  # data goes to stdout


# The bar tells of a frame that is being tried again; without a bar nothing is said of it.


_SEARCHING = """
from modeler.cli.console import Console
from modeler.types import Searching
with Console(25, None) as console: console(Searching(12))
"""


def test_somebody_who_watches_sees_which_frame_is_tried_again() -> None:
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "120"}
    with subprocess.Popen([sys.executable, "-c", _SEARCHING], stderr=theirs, env=environment) as process:
        os.close(theirs)
        said = b""
        while select.select([ours], [], [], 60.0)[0]:
            try:
                piece = os.read(ours, 4096)
            except OSError:  # the other end is closed
                break
            if not piece:
                break
            said += piece
    os.close(ours)
    assert process.returncode == 0
    assert b"trying frame 12 again" in said


def test_nobody_is_told_where_there_is_no_bar(capfd: pytest.CaptureFixture[str]) -> None:
    with Console(25, None) as console:
        console(Searching(12))
    said = capfd.readouterr()
    assert (said.out, said.err) == ("", "")
