"""What the images determine: runs that did not end right with 0, with what a run has to find given.

`python -m studies whole.ceiling --things FILE --out FOLDER` repeats those of FOLDER/HALF.jsonl twice: with every pair
asked for the mode near its true motion alone, where the prior allows it; and with true masks beside. What is still
wrong or refused then, no better search and no better mask can mend: noise and likeness leave it open.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final, final

import numpy as np

from modeler import se3
from modeler.types import AbstractRegistrar, Array, Posterior, ViewPair
from studies.results.tables import FOLDER, markdown, record
from studies.side_by_side import results
from studies.whole.capture import Capture
from studies.whole.plan import HALVES, Plan
from studies.whole.study import Outcome, earlier, outcome

GIVEN: Final[Mapping[str, bool]] = {"motions": False, "motions and masks": True}
"""What is given, and whether masks are."""


@final
@dataclass(frozen=True, eq=False)
class NearTruth(AbstractRegistrar):
    """Registers pairs near their true motion, where the prior allows it."""

    registrar: AbstractRegistrar
    """The method."""
    truth: Mapping[int, Array]
    """camera_from_object (4, 4) by frame number."""

    def posterior_of(self, pair: ViewPair) -> Posterior:
        motion = self.truth[pair.target.index] @ se3.inverse(self.truth[pair.source.index])
        if not np.isfinite(pair.density.log_density(motion[None])[0]):
            return self.registrar.posterior_of(pair)
        return self.registrar.posterior_of(replace(pair, near=motion, effort=1.0))


def near_truth(capture: Capture, registrar: AbstractRegistrar) -> AbstractRegistrar:
    """Return the method with the true motions of a capture given."""
    return NearTruth(registrar, capture.truth())


def ceiling(path: Path, plan: Plan, *, masks: bool) -> Outcome:
    """Return what a capture comes to with its true motions given, and perhaps true masks.

    Args:
        path: of the meshes and photographs.
        plan: of the capture.
        masks: whether masks are the true ones.
    """
    drawn = (lambda factors: replace(factors, masks="exact")) if masks else (lambda factors: factors)
    return outcome(path, plan, drawn=drawn, registrar=near_truth)


def row(name: str, outcomes: Sequence[Outcome]) -> tuple[str | float, ...]:
    """Return how many are right and wrong with 0 and 3."""
    ends = [(one.right, one.status) for one in outcomes]
    return name, *(ends.count(end) for end in ((True, 0), (True, 3), (False, 0), (False, 3)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(
        prog="python -m studies whole.ceiling",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--things", type=Path, required=True, help="file of meshes and photographs")
    parser.add_argument("--half", choices=HALVES, default="tuning", help="which meshes and draws")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="runs side by side")
    parser.add_argument("--out", type=Path, default=Path("runs/whole"), help="folder of the study's results")
    parser.add_argument("--record", action="store_true", help="put the counts into the results")
    options = parser.parse_args(arguments)
    if options.record and options.half != "tuning":
        parser.error("the results are of the tuning half")
    done = earlier(options.out / f"{options.half}.jsonl")
    if not done:
        parser.error(f"--out {options.out}: the study has not been run for this half")
    rows = [row("nothing", [*done.values()])]
    for given, masks in GIVEN.items():
        path = options.out / f"{options.half}, {given}.jsonl"
        again = earlier(path)
        plans = [Plan(options.half, one.number) for one in done.values() if not (one.right and one.status == 0)]
        work = [partial(ceiling, options.things, plan, masks=masks) for plan in plans if plan.number not in again]
        with path.open("a") as stream:
            for one in results(work, options.jobs):
                again[one.number] = one
                print(json.dumps(one.values()), file=stream, flush=True)
                print(f"{given}: {one.number}, {one.right} with {one.status}", file=sys.stderr, flush=True)
        done = {**done, **again}
        rows.append(row(given, [*done.values()]))
    print(markdown(("given", "right, status 0", "right, 3", "wrong, 0", "wrong, 3"), rows))
    if options.record:
        record(FOLDER / "whole_ceiling.json", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
