"""Build models of real captures changed in the ways that people change theirs: `python -m studies multiplied`.

The pairs of capture and way are split into two halves: limits may be tuned on the tuning half; the other is for a
single evaluation at the end. The whole capture as it is stands in for the truth where there is none. Every
run is written as it ends (runs.jsonl), and an interrupted study continues. The table goes to stdout, progress to
stderr.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import Final

from studies.multiplied.judged import counts, judged, text
from studies.multiplied.study import AS_IT_IS, DATA, Run, captures, finished, half_of
from studies.multiplied.ways import WAYS
from studies.results.tables import FOLDER, record
from studies.results_file import earlier_results
from studies.side_by_side import results

HALVES: Final = ("tuning", "held-out", "both", "none")


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies multiplied", description=__doc__)
    parser.add_argument("--half", choices=HALVES, default="tuning", help="which pairs; none: captures as they are")
    parser.add_argument("--captures", nargs="+", metavar="NAME", help="only these")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of captures")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="runs side by side")
    parser.add_argument("--seed", type=int, default=0, help="of the registration")
    parser.add_argument("--out", type=Path, default=Path("runs/multiplied"), help="folder of the results")
    parser.add_argument("--record", action="store_true", help="put the counts by capture into the results")
    options = parser.parse_args()
    if options.record and (options.half != "held-out" or options.captures or options.seed):
        parser.error("the results are of all captures of the held-out half with seed 0")
    options.out.mkdir(parents=True, exist_ok=True)
    names = [name for name in captures(options.data) if options.captures is None or name in options.captures]
    # References first: they are what the others are compared with.
    wanted = [(name, AS_IT_IS) for name in names] + [
        (name, way)
        for name in names
        for way in WAYS
        if way != AS_IT_IS and options.half in ("both", half_of(name, way))
    ]
    path = options.out / "runs.jsonl"
    runs = {(run.capture, run.way): run for run in map(Run.of, map(json.loads, earlier_results(path)))}
    missing = [pair for pair in wanted if pair not in runs]
    work = [partial(finished, options.data, *pair, options.seed) for pair in missing]
    began = time.perf_counter()
    with path.open("a") as stream:
        for number, run in enumerate(results(work, options.jobs), 1):
            runs[run.capture, run.way] = run
            print(json.dumps(run.values()), file=stream, flush=True)
            print(
                f"{number} of {len(missing)}: {run.capture}, {run.way}: {len(run.poses)} of {run.frames} frames, "
                f"status {run.status} {' '.join(run.codes)}, {time.perf_counter() - began:.0f} s",
                file=sys.stderr,
                flush=True,
            )
    pairs = [pair for pair in wanted if runs[pair].frames >= WAYS[pair[1]].least_frames]
    found = [judged(runs[pair], runs[pair[0], AS_IT_IS], options.data) for pair in pairs]
    print(text(found))
    if options.record:
        record(FOLDER / "multiplied.json", counts(found, [one.run.capture for one in found]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
