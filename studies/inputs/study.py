"""A run of the study: an input is drawn, the commands are run on it, and the end is judged."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import numpy as np

from modeler.cli import main as modeler
from modeler.export import RunFolder, read_model
from modeler.types import Array
from studies.inputs.scene import Errors, Scene, drawn, errors
from studies.inputs.ways import WAYS, Given, put

HALVES: Final = ("tuning", "held-out")
ENDS: Final = ("right", "named", "unnamed", "wrong with 0")
"""How a run ends: a right model with 0; refused or not trusted, with the cause named; the same without; else."""


@final
@dataclass(frozen=True)
class Outcome:
    """What an input came to."""

    way: str
    number: int
    """Within the way."""
    said: str
    """What was drawn, in words."""
    status: int
    """Of the last command."""
    end: str
    """One of `ENDS`."""
    errors: Errors
    """Of the model."""
    words: str
    """What the commands said, but for progress."""
    seconds: float
    """Wall time of the commands."""


def outcome(half: str, way: str, number: int, folder: Path) -> Outcome:
    """Draw an input, run the commands on it, and judge the end."""
    shutil.rmtree(folder, ignore_errors=True)
    rng = np.random.default_rng([HALVES.index(half), list(WAYS).index(way), number])
    scene = drawn(rng, sizes=way == "sizes")
    given = put(way, folder / "in", scene.frames, rng)
    (folder / "out").mkdir()
    began, words, status = time.monotonic(), "", 0
    for command in given.commands:
        words += _run(command, folder)[1]
    if given.later is not None:
        given.later()
    status, said = _run((*given.last, *given.options), folder)
    words, seconds = words + said, time.monotonic() - began
    found = _errors(scene, given, folder / "out" / "run") if status in (0, 3) else Errors(None, None, None)
    named = bool(given.cause) and re.search(given.cause, words, re.IGNORECASE) is not None
    clean = "Traceback" not in words and (status != 2 or said.count("\n") == 1)
    end = "unnamed"
    if status == 0:
        end = "right" if found.right else "wrong with 0"
    elif named and clean:
        end = "named"
    shutil.rmtree(folder)
    return Outcome(way, number, given.said, status, end, found, words, seconds)


def _run(command: Sequence[str], folder: Path) -> tuple[int, str]:
    """Run a command of `modeler` in this process and return its status and what it said."""
    places = {"in": folder / "in", "out": folder / "out"}
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        status = modeler([word.format(**places) for word in command])
    return status, said.getvalue().replace(f"{folder}/", "")


def _errors(scene: Scene, given: Given, run: Path) -> Errors:
    report = RunFolder(run).result()
    numbers = sorted(frame["id"] for frame in report["frames"])
    poses: dict[int, Array] = {
        numbers.index(pose["id"]): np.reshape(pose["object_from_camera"], (4, 4)) for pose in report["poses"]
    }
    model = read_model(run / "model.ply") if (run / "model.ply").exists() else None
    return errors(scene, model, poses, given.shown or scene.indices, report.get("tolerance_m") or 0.0)
