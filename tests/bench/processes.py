"""Whole processes: how long a command takes from start to end, and the most memory it holds."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

MODELER = shutil.which("modeler", path=str(Path(sys.executable).parent)) or "modeler"
BOX = str(Path(__file__).parents[2] / "sequences" / "bundled" / "box")


@dataclass(frozen=True)
class Process:
    """One run of a command."""

    seconds: float
    peak_bytes: int
    """Largest resident memory of the process."""


def run(*arguments: str) -> Process:
    """Run `modeler` and wait for it.

    Call it before the caller has loaded much itself: the kernel counts what a process held before it became another.

    Raises:
        RuntimeError: where the command fails.
    """
    began = time.perf_counter()
    process = subprocess.Popen([MODELER, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    assert process.stderr is not None
    said = process.stderr.read().decode(errors="replace")
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - began
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 3):
        raise RuntimeError(f"modeler {' '.join(arguments)} ended with {process.returncode}: {said[-500:]}")
    return Process(seconds, usage.ru_maxrss * 1024)


def figures(repeats: int = 3) -> dict[str, float]:
    """Return seconds of `--help` and of a warm `register`, and seconds and peak bytes of a build of 14 frames."""
    commands = {"help_s": ["--help"], "register_warm_s": ["register", BOX, "1", "0", "--prior", "table"]}
    result = {}
    for name, arguments in commands.items():
        run(*arguments)  # warms the caches of compiled code and of the disk
        result[name] = median(run(*arguments).seconds for _ in range(repeats))
    with tempfile.TemporaryDirectory() as folder:
        build = run("build", BOX, "--prior", "table", "--out", str(Path(folder) / "box"))
    return result | {"build_s": build.seconds, "build_peak_gb": build.peak_bytes / 1e9}
