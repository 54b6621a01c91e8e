"""Build sequences without a fault and with one fault each, and count wrong models that end with 0: `make trust`.

Shapes and draws are split into two halves: limits may be tuned on the tuning half; the other is for a single evaluation
at the end. Every run is written as it ends (HALF.jsonl), and an interrupted study continues. The
table goes to stdout, progress to stderr.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

from studies.results.tables import FOLDER, record
from studies.results_file import earlier_results
from studies.side_by_side import results
from studies.trust.plan import HALVES, SOUND, Half, Plan
from studies.trust.study import Outcome, outcome
from studies.trust.tables import counts, text

RUNS: Final = 150
"""Of a half."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies trust", description=__doc__)
    parser.add_argument("--half", choices=HALVES, default="tuning", help="which shapes and draws")
    parser.add_argument("--runs", type=int, default=RUNS, metavar="N", help="of the half, every other one sound")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="runs side by side")
    parser.add_argument("--out", type=Path, default=Path("runs/trust"), help="folder of the results")
    parser.add_argument("--record", action="store_true", help="put the counts of all 150 runs into the results")
    options = parser.parse_args(arguments)
    if options.runs < 1 or options.jobs < 1:
        parser.error("--runs and --jobs take whole numbers from 1 on")
    if options.record and options.runs != RUNS:
        parser.error(f"the results are of all {RUNS} runs of a half: --record goes without --runs")
    options.out.mkdir(parents=True, exist_ok=True)
    outcomes = run(options.half, options.runs, options.jobs, options.out / f"{options.half}.jsonl")
    print(text(outcomes))
    if options.record:
        sound, faulty = ([one for one in outcomes if (one.fault == SOUND) is wanted] for wanted in (True, False))
        rows = [
            (f"{options.half} half, {name}", *counts(part)) for name, part in ((SOUND, sound), ("with a fault", faulty))
        ]
        record(FOLDER / "trust.json", rows)
    return 0


def run(half: Half, runs: int, jobs: int, path: Path) -> list[Outcome]:
    """Build what has not been built yet, append it to a file, and return all outcomes by number."""
    lines = earlier_results(path)
    done = {one.number: one for one in (Outcome.of(json.loads(line)) for line in lines) if one.number < runs}
    began = time.perf_counter()
    with path.open("a") as stream:
        for one in results([partial(outcome, Plan(half, k)) for k in range(runs) if k not in done], jobs):
            done[one.number] = one
            print(json.dumps(one.values()), file=stream, flush=True)
            ended = f"{'wrong' if one.wrong else 'right'} with {one.status}"
            print(
                f"{len(done)} of {runs}: {one.number} {one.fault}, {one.shape}: {ended}, "
                f"{time.perf_counter() - began:.0f} s",
                file=sys.stderr,
                flush=True,
            )
    return [done[number] for number in sorted(done)]


if __name__ == "__main__":
    sys.exit(main())
