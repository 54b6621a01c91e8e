"""Builds that are killed and resumed, compared with one that nobody disturbed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SAME = ("trajectory.txt", "odometry.txt", "graph.g2o", "model.ply", "cloud.ply")
"""Files that must not tell whether a run was killed."""
KINDS = ("moment", "end", "change", "overwrite", "twice")
"""A kill at any moment; behind the last pair; before a change of the run folder; of a build with --overwrite into a
finished run; and of the resumed build as well."""
_AT_ONCE = 2  # pairs under way at most
_LIMIT_S = 400


@dataclass(frozen=True)
class Undisturbed:
    """A run to compare with."""

    folder: Path
    """Its run folder."""
    pairs: int
    """How many registrations it took."""
    changes: int
    """How often it changed the run folder."""
    seconds: float
    """How long it took."""
    registered_s: float
    """When the last registration began, in s from its start."""


@dataclass(frozen=True)
class Trials:
    """Kills one build after the other."""

    arguments: tuple[str, ...]
    """SEQUENCE and options of `modeler build`, without --out."""
    folder: Path
    """Where the runs lie."""

    def undisturbed(self) -> Undisturbed:
        """Run one to its end, twice, behind one that warms up, and check that both say the same.

        The one that warms up is not compared: where it is the first on a machine it compiles the kernels, and what was
        just compiled rounds otherwise, by some 1e-11 of a log-likelihood, than the same kernel read from the cache.
        """
        shutil.rmtree(self._whole("warm-up").folder)
        first, second = self._whole("first"), self._whole("undisturbed")
        for file in SAME:
            assert (first.folder / file).read_bytes() == (second.folder / file).read_bytes(), file
        return second

    def _whole(self, name: str) -> Undisturbed:
        """Run one to its end."""
        folder, log = self.folder / name, self.folder / f"{name}.log"
        began, registered_s = time.monotonic(), 0.0
        process = self._started(folder, log, 0)
        seen = 0
        while process.poll() is None:
            now = _pairs(log)
            if now > seen:
                seen, registered_s = now, time.monotonic() - began
            time.sleep(0.05)
            if time.monotonic() - began > _LIMIT_S:
                process.kill()
        _, said = process.communicate()
        assert process.returncode in (0, 3), said
        changes = sum(line.startswith("change") for line in log.read_text().splitlines())
        return Undisturbed(folder, _pairs(log), changes, time.monotonic() - began, registered_s)

    def fault(self, whole: Undisturbed, kind: str, name: str, rng: np.random.Generator) -> tuple[str, str]:
        """Kill a build and resume it; return when it was killed and what is wrong then: nothing is "".

        Args:
            whole: what it must become.
            kind: one of `KINDS`.
            name: of its run folder, which is removed where nothing is wrong.
            rng: draws the moment.
        """
        folder, log = self.folder / name, self.folder / f"{name}.log"
        if kind == "overwrite":
            shutil.copytree(whole.folder, folder)
        flags = ("--overwrite",) if kind == "overwrite" else ()
        kills, when = 0, "never"
        for _ in range(2 if kind == "twice" else 1):
            when, killed = self._kill(whole, kind, (folder, log, flags), rng)
            kills, flags = kills + killed, ("--resume",)
        process = self._started(folder, log, 0, "--resume")
        _, said = process.communicate(timeout=_LIMIT_S)
        if process.returncode not in (0, 3):
            return when, f"resuming ended with status {process.returncode}: {said}"
        if kind != "overwrite" and _pairs(log) > whole.pairs + _AT_ONCE * kills:
            return when, f"{_pairs(log) - whole.pairs} pairs were registered again after {kills} kills"
        for file in SAME:
            if (folder / file).read_bytes() != (whole.folder / file).read_bytes():
                return when, f"{file} differs from the undisturbed run's"
        theirs, ours = ({path.name for path in place.iterdir()} for place in (whole.folder, folder))
        if theirs != ours:
            return when, f"holds {', '.join(sorted(theirs ^ ours))}, or lacks it"
        shutil.rmtree(folder)
        log.unlink()
        return when, "" if kills else "it had ended before it was to be killed"

    def _kill(
        self, whole: Undisturbed, kind: str, run: tuple[Path, Path, tuple[str, ...]], rng: np.random.Generator
    ) -> tuple[str, bool]:
        """Start a build, kill it, and return when, and whether it was still alive then."""
        folder, log, flags = run
        if kind == "change" or (kind == "overwrite" and rng.random() < 0.5):
            first = whole.changes if kind == "change" else 24  # among them the removal of what was there
            change = int(rng.integers(1, first + 1))
            process = self._started(folder, log, change, *flags)
            process.communicate(timeout=_LIMIT_S)
            return f"before change {change}", process.returncode == -signal.SIGKILL
        process = self._started(folder, log, 0, *flags)
        if kind == "end":
            while process.poll() is None and _pairs(log) < whole.pairs:
                time.sleep(0.02)
            wait_s = rng.uniform(0.0, whole.seconds - whole.registered_s)
        else:
            wait_s = rng.uniform(0.0, whole.seconds)
        try:
            process.communicate(timeout=wait_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
        return f"after {wait_s:.2f} s{' from the last pair' * (kind == 'end')}", process.returncode == -signal.SIGKILL

    def _started(self, folder: Path, log: Path, change: int, *flags: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "studies.kills.child", str(log), str(change), "build", *self.arguments]
        log.touch()
        return subprocess.Popen(
            [*command, "--out", str(folder), *flags],
            env=environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )


def environment() -> dict[str, str]:
    """Return the environment in which a child finds the modules of this process."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(place for place in sys.path if place)}


def _pairs(log: Path) -> int:
    """Return how many registrations have begun."""
    return sum(line.startswith("pair") for line in log.read_text().splitlines())
