"""Build models of real captures changed in the ways that people change theirs: `python -m studies multiplied`.

The pairs of capture and way are split into two halves: limits may be tuned on the tuning half; the other is for a
single evaluation at the end. The whole capture as it is, under the first seed, stands in for the truth where there is
none. With `--half none --seeds 0 1 2 ...`, captures are modelled as they are under each seed. Every run is written as
it ends (runs.jsonl), and an interrupted study continues. The table goes to stdout, progress to stderr.
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
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N", help="of the registration, each")
    parser.add_argument("--out", type=Path, default=Path("runs/multiplied"), help="folder of the results")
    parser.add_argument("--record", action="store_true", help="put the counts by capture into the results")
    options = parser.parse_args()
    over_seeds = options.half == "none" and len(options.seeds) > 1
    if options.record and not over_seeds and (options.half, options.seeds) != ("held-out", [0]):
        parser.error(
            "the results are of the held-out half with seed 0, and of captures as they are under several seeds"
        )
    options.out.mkdir(parents=True, exist_ok=True)
    names = [name for name in captures(options.data) if options.captures is None or name in options.captures]
    # References first: they are what the others are compared with.
    wanted = [(name, AS_IT_IS, seed) for seed in options.seeds for name in names] + [
        (name, way, seed)
        for seed in options.seeds
        for name in names
        for way in WAYS
        if way != AS_IT_IS and options.half in ("both", half_of(name, way))
    ]
    path = options.out / "runs.jsonl"
    runs = {(run.capture, run.way, run.seed): run for run in map(Run.of, map(json.loads, earlier_results(path)))}
    missing = [each for each in wanted if each not in runs]
    work = [partial(finished, options.data, *each) for each in missing]
    began = time.perf_counter()
    with path.open("a") as stream:
        for number, run in enumerate(results(work, options.jobs), 1):
            runs[run.capture, run.way, run.seed] = run
            print(json.dumps(run.values()), file=stream, flush=True)
            print(
                f"{number} of {len(missing)}: {run.capture}, {run.way}, seed {run.seed}: {len(run.poses)} of "
                f"{run.frames} frames, status {run.status} {' '.join(run.codes)}, {time.perf_counter() - began:.0f} s",
                file=sys.stderr,
                flush=True,
            )
    shown = [runs[each] for each in wanted if runs[each].frames >= WAYS[each[1]].least_frames]
    found = [judged(run, runs[run.capture, AS_IT_IS, options.seeds[0]], options.data) for run in shown]
    print(text(found))
    if options.record:
        record(
            FOLDER / ("seeds.json" if over_seeds else "multiplied.json"),
            counts(found, [one.run.capture for one in found]),
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
