"""Measure what colour tells: `python -m studies colour`.

    python -m studies colour --half held-out --jobs 16 --things things.npz       # all parts, once
    python -m studies colour --half held-out --parts pairs --things things.npz   # neighbouring frames, a quarter hour

Parts: models of bodies whose colour is `aligned`; the same with `displaced` colour, as another camera or program has
it; `captures` with colour as it is, left out and displaced; and `pairs` under difficult light and by poor cameras.
Bodies are drawn by Open3D's ray casting with solid textures, and with photographs (`python -m studies whole.things`).
Results are lines of JSON in a file of the folder, and an interrupted study continues.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

from studies.colour.study import PARTS, SEEDS, cases, measured
from studies.colour.tables import text
from studies.results_file import earlier_results
from studies.side_by_side import results

_DATA: Final = Path(__file__).resolve().parents[3] / "shared" / "data"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(
        prog="python -m studies colour", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--half", choices=tuple(SEEDS), default="tuning", help="which draws")
    parser.add_argument("--parts", choices=PARTS, nargs="+", default=PARTS, help="what is measured")
    parser.add_argument("--data", type=Path, default=_DATA, help="folder of captures")
    parser.add_argument("--things", type=Path, default=Path("things.npz"), help="file with photographs, for pairs")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="cases side by side")
    parser.add_argument("--out", type=Path, default=Path("runs/colour"), help="folder of the results")
    options = parser.parse_args(arguments)
    if options.jobs < 1:
        parser.error("--jobs takes whole numbers from 1 on")
    if "pairs" in options.parts and not options.things.exists():
        parser.error(
            f"{options.things}: there is no such file; `python -m studies whole.things --help` tells how to make it"
        )
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{options.half}.jsonl"
    done = {one["key"]: one for one in map(json.loads, earlier_results(path))}
    wanted = cases(options.half, tuple(options.parts), options.data)
    work = [partial(measured, case, options.data, options.things) for case in wanted if case.key not in done]
    with path.open("a") as stream:
        for one in results(work, options.jobs):
            done[one["key"]] = one
            print(json.dumps(one), file=stream, flush=True)
            print(f"{len(done)}: {one['key']}, {one['seconds']} s", file=sys.stderr, flush=True)
    print(text([done[case.key] for case in wanted]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
