"""Build models of objects that are turned over within one recording: `python -m studies turned_over`.

    python -m studies turned_over                          # ten recordings of five shapes
    python -m studies turned_over --half held-out          # ten of five others, for a single evaluation
    python -m studies turned_over --models cap.ply         # ten of models of captures (`modeler export`)

A recording is a full turn of an object as it stands and another as it lies. It is joined correctly if the frames of
both postures are in one model without a pose error above 3° or 5 mm. Results are lines of JSON in a file of the folder,
and an interrupted study continues.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from studies.results_file import earlier_results
from studies.trust.plan import HALVES
from studies.turned_over.plan import RECORDINGS, Plan
from studies.turned_over.study import Outcome, outcome, table


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; the status is 1 where a wrong model ends with status 0."""
    parser = argparse.ArgumentParser(
        prog="python -m studies turned_over", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--half", choices=HALVES, default="tuning", help="which shapes")
    parser.add_argument(
        "--models", type=Path, nargs="+", default=[], metavar="FILE", help="meshes of captures, instead of the shapes"
    )
    parser.add_argument("--only", type=int, nargs="+", default=range(RECORDINGS), metavar="N", help="which recordings")
    parser.add_argument("--out", type=Path, default=Path("runs/turned_over"), help="folder of the results")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{'models' if options.models else options.half}.jsonl"
    known = [Outcome.of(json.loads(line)) for line in earlier_results(path)]
    for number in options.only:
        if all(one.number != number for one in known):
            known.append(outcome(Plan(options.half, number, tuple(options.models)), options.out))
            with path.open("a") as stream:
                print(json.dumps(known[-1].values()), file=stream)
            print(known[-1], file=sys.stderr, flush=True)
    print(table(known))
    return int(any(one.wrong and one.status == 0 for one in known))


if __name__ == "__main__":
    sys.exit(main())
