"""Build models of inputs as people have them, right and wrong, drawn at random: `python -m studies inputs`.

Each is a scene of its own (shape, print, lamps, camera, motion), saved in one of the ways of `ways.py`, of which
format, names, lens or offset are drawn too. It is well if the command ends with 0 and the model is right, or if what
it says names the cause; worst is a wrong model with 0. The tuning half is there to mend what falls; the held-out half,
other scenes and draws, for a single evaluation at the end. Every run is written as it ends (HALF.jsonl), and an
interrupted study continues.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

from studies.inputs.scene import Errors
from studies.inputs.study import ENDS, HALVES, Outcome, outcome
from studies.inputs.ways import WAYS
from studies.results.tables import FOLDER, markdown, record
from studies.results_file import earlier_results
from studies.side_by_side import results

EACH: Final = 2
"""Runs of a way in a half."""


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
    parser.add_argument(
        "--first", type=int, default=0, metavar="K", help="number of the first; others have other draws"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="runs side by side")
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
    wanted = [(way, options.first + number) for number in range(options.each) for way in options.ways]
    work = [
        partial(outcome, options.half, way, number, options.out / f"{way} {number}")
        for way, number in wanted
        if (way, number) not in done
    ]
    with path.open("a") as stream:
        for one in results(work, options.jobs):
            done[one.way, one.number] = one
            print(json.dumps(asdict(one)), file=stream, flush=True)
            print(f"{one.way} {one.number} ({one.said}): {one.end}, {one.status}, {one.seconds:.0f} s", file=sys.stderr)
    rows = counts([done[way, number] for way, number in sorted(wanted, key=lambda each: options.ways.index(each[0]))])
    print(markdown(("way", "runs", *ENDS), rows))
    if options.record:
        record(FOLDER / "inputs.json", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
