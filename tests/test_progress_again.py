"""The bar tells of a frame that is being tried again; without a bar nothing is said of it."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys

import pytest

from modeler.cli.console import Console
from modeler.types import Searching

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
