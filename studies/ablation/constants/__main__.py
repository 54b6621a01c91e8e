"""Halve and double each named number of the rooms that make a model, on captures and renderings.

    python -m studies ablation.constants                    what is not measured yet, hours on one core
    python -m studies ablation.constants --condense         what has been measured, into the result file of the page
    python -m studies ablation.constants --table            the tables of the result file
    python -m studies ablation.constants --page docs/ablation.md

Inputs of a stage are tried in order until one shows a difference; then the number has an effect. What stays the same to
the last bit on all inputs has none here.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numba

from studies.ablation.constants import source, sweep
from studies.ablation.constants.tables import RESULTS, condense, on_page, table


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study, condense its results, or print its tables."""
    parser = argparse.ArgumentParser(
        prog="ablation.constants", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rooms", nargs="+", choices=sweep.ROOMS, default=sweep.ROOMS)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="captures")
    parser.add_argument("--out", type=Path, default=Path("runs/ablation.constants.jsonl"), help="a line a measurement")
    parser.add_argument("--few", action="store_true", help="one input of each stage")
    parser.add_argument("--every-input", action="store_true", help="measure all inputs, also after a difference")
    parser.add_argument("--condense", action="store_true", help="write the result file from what has been measured")
    parser.add_argument("--page", type=Path, help="write the tables of the result file into this page")
    parser.add_argument("--table", action="store_true", help="print the tables of the result file")
    options = parser.parse_args(arguments)
    if options.condense:
        condense(options.out, RESULTS)
    if options.page is not None:
        options.page.write_text(on_page(options.page.read_text(), table(RESULTS)))
    if options.table:
        print(table(RESULTS))
    if not (options.condense or options.page or options.table):
        os.environ["NUMBA_NUM_THREADS"] = "1"  # a forked process has none of its parent's threads
        numba.set_num_threads(1)
        bundled = source.PACKAGE.parent / "sequences" / "bundled"
        found = sweep.cases(options.data, bundled, options.rooms, few=options.few)
        numbers = [number for room in options.rooms for number in sweep.numbers_of([room])]
        sweep.run(found, numbers, options.out, every_input=options.every_input)
    return 0


if __name__ == "__main__":
    sys.exit(main())
