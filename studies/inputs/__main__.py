"""Build models of inputs as people have them, right and wrong, drawn at random: `python -m studies inputs`.

Each is a scene of its own (shape, print, lamps, camera, motion), saved in one of the ways of `ways.py`, of which
format, names, lens or offset are drawn too. It is well if the command ends with 0 and the model is right, or if what
it says names the cause; worst is a wrong model with 0. The tuning half is there to mend what falls; the held-out half,
other scenes and draws, for a single evaluation at the end. Every run is written as it ends (HALF.jsonl), and an
interrupted study continues.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import re
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from modeler.cli import main as modeler
from modeler.export import RunFolder, read_model
from modeler.types import Array
from studies.inputs.scene import Errors, Scene, drawn, errors
from studies.inputs.ways import WAYS, Given, put
from studies.results.tables import FOLDER, markdown, record
from studies.results_file import earlier_results

HALVES: Final = ("tuning", "held-out")
EACH: Final = 2
"""Runs of a way in a half."""
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


def counts(outcomes: Sequence[Outcome]) -> list[tuple[str | int, ...]]:
    """Return the number of runs by way and end, and of all."""
    rows = []
    for way in [*dict.fromkeys(one.way for one in outcomes), None]:
        part = [one for one in outcomes if way in (None, one.way)]
        rows.append((way or "all", len(part), *(sum(one.end == end for one in part) for end in ENDS)))
    return rows


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(
        prog="python -m studies inputs", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--half", choices=HALVES, default="tuning", help="which scenes and draws")
    parser.add_argument("--each", type=int, default=EACH, metavar="N", help="runs of a way")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=[*WAYS], metavar="NAME", help="only these")
    parser.add_argument("--out", type=Path, default=Path("runs/inputs"), help="folder of the results")
    parser.add_argument("--record", action="store_true", help="put the counts into the results")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{options.half}.jsonl"
    done: dict[tuple[str, int], Outcome] = {}
    for line in earlier_results(path):
        values: dict[str, Any] = json.loads(line)
        one = Outcome(**{**values, "errors": Errors(**values["errors"])})
        done[one.way, one.number] = one
    wanted = [(way, number) for number in range(options.each) for way in options.ways]
    with path.open("a") as stream:
        for way, number in wanted:
            if (way, number) in done:
                continue
            one = outcome(options.half, way, number, options.out / "work")
            done[way, number] = one
            print(json.dumps(asdict(one)), file=stream, flush=True)
            print(f"{way} {number} ({one.said}): {one.end}, {one.status}, {one.seconds:.0f} s", file=sys.stderr)
    rows = counts([done[way, number] for way in options.ways for number in range(options.each)])
    print(markdown(("way", "runs", *ENDS), rows))
    if options.record:
        record(FOLDER / "inputs.json", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
