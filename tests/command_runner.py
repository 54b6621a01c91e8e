"""Commands run in this process, and what they say."""

from __future__ import annotations

import resource
from collections.abc import Callable
from typing import NamedTuple

import pytest

from modeler.cli import main
from modeler.sequences import bundled

BOX = str(bundled("box"))
QUICK = ("--prior", "table", "--method", "icp")
FILES = {
    "model.ply",
    "cloud.ply",
    "trajectory.txt",
    "odometry.txt",
    "graph.g2o",
    "recording.rrd",
    "report.json",
}


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


def with_files_of_at_most(size: int, *arguments: str) -> int:
    """Run a command that cannot write larger files: to it that is what a full disk is, in the middle of a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))  # Python ignores the signal that goes with it
    try:
        return main(list(arguments))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
