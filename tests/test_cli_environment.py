"""Streams, signals and limits: what surrounds a command never becomes a traceback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commanded import BOX

COMMAND = [sys.executable, "-m", "modeler"]


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", "<&- >&- 2>&-"])
def test_a_stream_that_is_closed_changes_no_status(closed: str) -> None:
    for arguments, status in ((["info", BOX], 0), (["view", "/nowhere"], 2)):
        ended = subprocess.run(
            ["sh", "-c", f'"$@" {closed}', "sh", *COMMAND, *arguments], capture_output=True, text=True, check=False
        )
        assert ended.returncode == status
        assert "Traceback" not in ended.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_messages_that_cannot_be_written_change_no_status() -> None:
    for arguments, status in ((["info", BOX], 0), (["view", "/nowhere"], 2), (["biuld"], 2)):
        with Path("/dev/full").open("w") as full:
            ended = subprocess.run(
                [*COMMAND, *arguments], stdout=subprocess.DEVNULL, stderr=full, check=False, timeout=120
            )
        assert ended.returncode == status


@pytest.mark.parametrize(
    ("name", "value"), [("NUMBA_NUM_THREADS", "0"), ("NUMBA_NUM_THREADS", "many"), ("NUMBA_DISABLE_JIT", "1")]
)
def test_settings_under_which_nothing_can_be_computed_are_said(name: str, value: str) -> None:
    ended = subprocess.run(
        [*COMMAND, "info", BOX], env={**os.environ, name: value}, capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
    assert name in ended.stderr


@pytest.mark.parametrize("after_s", [0.05, 0.2, 0.4, 0.8])
def test_ctrl_c_during_imports_leaves_no_traceback(after_s: float) -> None:
    with subprocess.Popen([*COMMAND, "info", BOX], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        time.sleep(after_s)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=120)
    if process.returncode in (130, -signal.SIGINT, 0):
        assert said in (b"", b"modeler: interrupted\n")
    else:  # Python itself was not ready to be asked
        assert b"modeler/cli" not in said


@pytest.mark.parametrize("error", ["MemoryError()", 'RuntimeError("can\'t start new thread")', "OSError(12, 'x')"])
def test_exhausted_memory_or_threads_are_said_in_one_line(error: str) -> None:
    program = f"""
import sys
import modeler.cli.info
def run(self):
    raise {error}
modeler.cli.info.Info.run = run
sys.exit(modeler.cli.main(["info", "x"]))
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
    assert "memory or threads" in ended.stderr
