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
MULTIWAY = (sys.executable, "-m", "studies", "bench.multiway")
BOX = str(Path(__file__).parents[2] / "sequences" / "bundled" / "box")


@dataclass(frozen=True)
class Process:
    """One run of a command."""

    seconds: float
    peak_bytes: int
    """Largest resident memory of the process."""


def run(*arguments: str, program: tuple[str, ...] = (MODELER,)) -> Process:
    """Run a program, `modeler` unless another is named, and wait for it.

    Call it before the caller has loaded much itself: the kernel counts what a process held before it became another.

    Raises:
        RuntimeError: where the command fails.
    """
    began = time.perf_counter()
    process = subprocess.Popen([*program, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    assert process.stderr is not None
    said = process.stderr.read().decode(errors="replace")
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - began
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 3):
        raise RuntimeError(
            f"{Path(program[-1]).name} {' '.join(arguments)} ended with {process.returncode}: {said[-500:]}"
        )
    return Process(seconds, usage.ru_maxrss * 1024)


def figures(repeats: int = 3) -> dict[str, float]:
    """Return seconds of `--help` and of a warm `register`, and those and peak bytes of a build of 14 frames."""
    commands = {"help_s": ["--help"], "register_warm_s": ["register", BOX, "1", "0", "--prior", "table"]}
    result = {}
    for name, arguments in commands.items():
        run(*arguments)  # warms the caches of compiled code and of the disk
        result[name] = median(run(*arguments).seconds for _ in range(repeats))
    with tempfile.TemporaryDirectory() as folder:
        builds, others = [], []
        for turn in range(repeats):  # in turns, so that a busy machine slows both
            builds.append(run("build", BOX, "--prior", "table", "--out", str(Path(folder) / f"box{turn}")))
            others.append(run(BOX, str(Path(folder) / "box.ply"), program=MULTIWAY).seconds)
    build_s = median(build.seconds for build in builds)
    return result | {
        "build_s": build_s,
        "build / Open3D multiway and TSDF": build_s / median(others),
        "build_peak_gb": max(build.peak_bytes for build in builds) / 1e9,
    }
