"""Build models of captures drawn with every factor at random: `python -m studies whole --things FILE`.

Another renderer (rays cast by Open3D, depth cameras of their own) shows meshes and photographs that packages ship;
`python -m studies whole.things` gathers these into the file. Meshes, photographs and draws are split into two halves:
anything may be mended by the tuning half; the other is for a single evaluation at the end. Every run is written as it
ends (HALF.jsonl), and an interrupted study continues. The table goes to stdout, progress to stderr.
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
from studies.side_by_side import results
from studies.whole.plan import HALVES, Plan, led_round
from studies.whole.study import earlier, outcome
from studies.whole.tables import counts, text

CAPTURES: Final = 160
"""Of a half."""
LED_ROUND: Final = 24
"""Of a half, of cameras that are led round the object."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(
        prog="python -m studies whole", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--things", type=Path, required=True, help="file of meshes and photographs")
    parser.add_argument("--half", choices=HALVES, default="tuning", help="which meshes and draws")
    parser.add_argument("--captures", type=int, default=CAPTURES, metavar="N", help="of the half")
    parser.add_argument("--only", type=int, nargs="+", metavar="NUMBER", help="only these captures")
    parser.add_argument("--led-round", action="store_true", help="the camera is led round the object, without masks")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="runs side by side")
    parser.add_argument("--out", type=Path, default=Path("runs/whole"), help="folder of the results")
    parser.add_argument("--record", action="store_true", help="put the counts by factor into the results")
    options = parser.parse_args(arguments)
    if options.captures < 1 or options.jobs < 1:
        parser.error("--captures and --jobs take whole numbers from 1 on")
    most = LED_ROUND if options.led_round else CAPTURES
    if options.record and (options.half != "held-out" or options.captures != most or options.only):
        parser.error(f"the results are of {most} captures of the held-out half")
    options.out.mkdir(parents=True, exist_ok=True)
    plans = [
        Plan(options.half, number)
        for number in range(options.captures)
        if options.only is None or number in options.only
    ]
    path = options.out / f"{options.half}{'-led-round' if options.led_round else ''}.jsonl"
    done = earlier(path)
    missing = [plan for plan in plans if plan.number not in done]
    drawn = {"drawn": led_round} if options.led_round else {}
    work = [partial(outcome, options.things, plan, **drawn) for plan in missing]
    began = time.perf_counter()
    with path.open("a") as stream:
        for number, one in enumerate(results(work, options.jobs), 1):
            done[one.number] = one
            print(json.dumps(one.values()), file=stream, flush=True)
            ended = f"{'right' if one.right else 'wrong'} with {one.status} {' '.join(one.codes)}"
            print(
                f"{number} of {len(missing)}: {one.number} {one.factors.thing}: {one.placed} of {one.factors.frames} "
                f"frames, {ended}, {one.seconds:.0f} s; {time.perf_counter() - began:.0f} s",
                file=sys.stderr,
                flush=True,
            )
    outcomes = [done[plan.number] for plan in plans]
    print(text(outcomes))
    if options.record:
        if options.led_round:
            record(
                FOLDER / "led_round.json",
                [row for row in counts(outcomes) if str(row[0]).startswith(("all", "camera", "colour"))],
            )
        else:
            record(FOLDER / "whole.json", counts(outcomes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
