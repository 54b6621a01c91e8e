"""Commands run in this process, and what they say."""

import os
import re
import resource
import subprocess
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from modeler.cli import main
from modeler.sequences import bundled

BOX = str(bundled("box"))
QUICK = ("--prior", "table", "--method", "icp")
FILES = {"model.ply", "cloud.ply", "trajectory.txt", "odometry.txt", "graph.g2o", "recording.rrd", "report.json"}


class Ended(NamedTuple):
    status: int
    out: str
    err: str


Run = Callable[..., Ended]


def runner(capfd: pytest.CaptureFixture[str]) -> Run:
    """Return what runs a command in this process, and tells how it ended and what it said."""

    def run(*arguments: object) -> Ended:
        capfd.readouterr()
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as ending:
            status = ending.code if isinstance(ending.code, int) else 1
        said = capfd.readouterr()
        return Ended(status, str(said.out), str(said.err))

    return run


def refusal_of(ended: Ended) -> str:
    """Return the line with which a command refused what it was given: status 2, and nothing on stdout."""
    assert (ended.status, ended.out) == (2, "")
    assert re.fullmatch(r"modeler: .+\n", ended.err)
    return ended.err


def spawned(*arguments: object, shell: str = "exec", after: str = "", settings: Any = None, **how: Any) -> Ended:
    """Run a command in a process of its own.

    Args:
        arguments: of `modeler`; or of Python, where they begin with `-`.
        shell: words before the command, such as `ulimit -n 8; exec`.
        after: words behind it, such as `2>&-`.
        settings: variables of the environment, beside those of this process.
        how: further arguments of `subprocess.run`.
    """
    words = [] if str(arguments[0]).startswith("-") else ["-m", "modeler"]
    command = [sys.executable, *words, *map(str, arguments)]
    given = {"env": {**os.environ, **(settings or {})}, "timeout": 200.0} | how
    ended = subprocess.run(
        ["bash", "-c", f'{shell} "$@" {after}', "-", *command], capture_output=True, text=True, check=False, **given
    )
    return Ended(ended.returncode, ended.stdout, ended.stderr)


def with_files_of_at_most(size: int, *arguments: str) -> int:
    """Run a command that cannot write larger files: to it that is what a full disk is, in the middle of a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))  # Python ignores the signal that goes with it
    try:
        return main(list(arguments))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
