"""Messages of commands: as many as one wants, all of them in a file, and how long work takes."""

import logging
import re
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from command_runner import QUICK, Run
from turning_box import steps

from modeler.cli import console, parsed
from modeler.cli.console import Console, say
from modeler.cli.messages import MESSAGES

LINE = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d (info|debug|error|warning): .+")


def test_each_step_some_or_errors_only(cli: Run, scene: Path, tmp_path: Path) -> None:
    words = {
        option: cli("build", scene, "--out", tmp_path / f"run{option}", *QUICK, *option.split()).err
        for option in ("", "-v", "-q")
    }
    assert words["-q"] == ""
    assert "can be trusted" in words[""]
    assert "joined" not in words[""]
    assert words["-v"].count("joined") >= 3
    assert "fusing the model" in words["-v"]
    assert "-q" in cli("-q", "build", tmp_path / "nowhere", "--out", tmp_path / "o", "-v").err
    assert cli("-q", "build", tmp_path / "nowhere", "--out", tmp_path / "o").err.count("\n") == 1
    assert (MESSAGES.least, MESSAGES.file) == (logging.INFO, None)


def test_a_log_keeps_every_message_of_each_command(cli: Run, scene: Path, tmp_path: Path) -> None:
    log = tmp_path / "a log"
    assert cli("build", scene, "--out", tmp_path / "run", "-q", *QUICK, "--log", log).err == ""
    cli("info", tmp_path / "nowhere", f"--log={log}")
    lines = log.read_text().splitlines()
    assert all(LINE.fullmatch(line) for line in lines)
    assert [line.split(" ", 4)[2:4] for line in lines if " $ " in line] == [["$", "modeler"], ["$", "modeler"]]
    text = log.read_text()
    for words in ("debug: frame 0: 1 joined", "info: the model can be trusted", "error: ", "ended after"):
        assert words in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--log",), "lacks its file"),
        (("--log", "FOLDER"), "no regular file"),
        (("--log", "FOLDER/input.json"), "is no log of modeler"),
        (("--log", "FOLDER/none/log"), "cannot be written"),
        (("-v", "--quiet"), "contradict"),
    ],
)
def test_messages_that_cannot_be_kept_are_said_and_harm_no_file(
    refusal: Callable[..., str], tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    (tmp_path / "input.json").write_text("{}")
    assert words in refusal("info", tmp_path, *(word.replace("FOLDER", str(tmp_path)) for word in arguments))
    assert (tmp_path / "input.json").read_text() == "{}"


def test_help_tells_of_messages_and_they_are_no_options_of_commands(cli: Run) -> None:
    for command in ((), ("build",), ("info",)):
        assert "--log FILE" in " ".join(cli(*command, "--help").out.split())
    assert parsed(("info", "S", "-v", "--log", "x")) == parsed(("info", "S"))


def test_long_work_tells_how_long_it_takes_and_that_it_goes_on(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    clock = iter(range(0, 100_000, 20))  # each look at the clock is 20 s later
    monkeypatch.setattr(time, "monotonic", lambda: float(next(clock)))
    with Console(8, None) as shown:
        for step in steps(8):
            shown(step)
    said = capfd.readouterr().err
    assert said.count("to register, close loops and fuse takes about") == 1
    assert re.search(r"8 frames: .* about \d+ min", said)
    assert "frame 6 of 8" in said


@pytest.mark.parametrize(("seconds", "words"), [(3.0, "10 s"), (44.0, "40 s"), (100.0, "2 min"), (700.0, "12 min")])
def test_durations_are_reported_to_about_a_tenth(seconds: float, words: str) -> None:
    assert console._rounded(seconds) == words


def test_debugging_is_not_printed_unasked(capfd: pytest.CaptureFixture[str]) -> None:
    say("a step", logging.DEBUG)
    say("a message")
    assert capfd.readouterr().err == "modeler: a message\n"
