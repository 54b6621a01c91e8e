"""Measure what colour tells: `python -m studies colour`.

    python -m studies colour --half held-out --jobs 16     # all parts, once
    python -m studies colour --parts pairs                 # neighbouring frames of balls, apples and tins

Parts: models of bodies whose colour is `aligned`; the same with `displaced` colour, as another camera or program has
it; `captures` with colour as it is, left out and displaced; and `pairs`. Bodies are drawn by Open3D's ray casting with
solid textures. Results are lines of JSON in a file of the folder, and an interrupted study continues.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Final

import numba

from studies.colour.study import PARTS, SEEDS, Case, cases, measured
from studies.colour.tables import text
from studies.results_file import earlier_results

_DATA: Final = Path(__file__).resolve().parents[3] / "shared" / "data"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(
        prog="python -m studies colour", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--half", choices=tuple(SEEDS), default="tuning", help="which draws")
    parser.add_argument("--parts", choices=PARTS, nargs="+", default=PARTS, help="what is measured")
    parser.add_argument("--data", type=Path, default=_DATA, help="folder of captures")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="cases side by side")
    parser.add_argument("--out", type=Path, default=Path("runs/colour"), help="folder of the results")
    options = parser.parse_args(arguments)
    if options.jobs < 1:
        parser.error("--jobs takes whole numbers from 1 on")
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{options.half}.jsonl"
    done = {one["key"]: one for one in map(json.loads, earlier_results(path))}
    wanted = cases(options.half, tuple(options.parts), options.data)
    with path.open("a") as stream:
        for one in _outcomes([case for case in wanted if case.key not in done], options.data, options.jobs):
            done[one["key"]] = one
            print(json.dumps(one), file=stream, flush=True)
            print(f"{len(done)}: {one['key']}, {one['seconds']} s", file=sys.stderr, flush=True)
    print(text([done[case.key] for case in wanted]))
    return 0


def _outcomes(wanted: Sequence[Case], data: Path, jobs: int) -> Iterator[dict[str, Any]]:
    """Yield outcomes as they come; each case has one thread."""
    if jobs == 1:
        numba.set_num_threads(1)
        for case in wanted:
            yield measured(case, data)
        return
    context = multiprocessing.get_context("spawn")  # kernels' threads do not survive a fork
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=numba.set_num_threads, initargs=(1,)) as pool:
        for future in as_completed([pool.submit(measured, case, data) for case in wanted]):
            yield future.result()


if __name__ == "__main__":
    sys.exit(main())
