"""Build whole sequences and report the error before and after loop closure: `python -m studies loops`.

The table goes to stdout, progress to stderr, and loops.json into a folder, for a long sequence also costs.png. Errors
of one run are largely chance: with several seeds the last lines are means by case. The status is 1 if, on a rendered
case, the mean error after is above 1°, or more than 0.6 of that before if a loop spans all frames.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from modeler.closure import Closer
from modeler.export import write_atomically
from modeler.types import Step, explain
from studies.loops.cases import Case, bundled, real, rendered, turned
from studies.loops.costs import Cost, drawn
from studies.loops.study import Result, modeler, run

_WIDTHS = (19, 8, 6, 6, 6, 7, 9, 8, 10, 9, 7, 7, 9, 10, 8, 6)
_OF_CLOSER: dict[str, Any] = {"max_closures": int, "min_gain_nats": float, "max_spans": int, "keyframe_deg": float}
_HEADS = (
    *("case", "joined", "regs", "close", "span", "reject", "before°", "after°", "before mm", "after mm"),
    *("NEES", "after", "turned°", "residual°", "after°", "s"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies loops", description=__doc__)
    parser.add_argument("--cases", nargs="+", metavar="NAME", help="only these")
    parser.add_argument("--shape", default="figurine", help="recipe of the rendered object")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of noise and registration, a run each")
    parser.add_argument("--lies", type=float, default=0.0, metavar="SHARE", help="of closures that come out wrong")
    parser.add_argument("--long", type=int, metavar="N", help="instead: N small frames at 3°, and what each costs")
    parser.add_argument("--true-motions", action="store_true", help="register by the truth: what all else costs")
    parser.add_argument("--out", type=Path, default=Path("runs/loops"), help="folder of the results")
    for field, kind in _OF_CLOSER.items():
        parser.add_argument(f"--{field.replace('_', '-')}", type=kind, default=getattr(Closer, field), help="of Closer")
    options = parser.parse_args(arguments)
    closer = Closer(**{field: getattr(options, field) for field in _OF_CLOSER})
    cases = [(case, seed) for seed in options.seeds for case in _cases(options, seed)]
    if not cases:
        parser.error("no case is left; check --cases")
    options.out.mkdir(parents=True, exist_ok=True)
    print(_row(_HEADS), flush=True)
    results: dict[str, list[Result]] = {}
    for case, seed in cases:
        maker = modeler(case, closer, seed, true_motions=options.true_motions, lies=options.lies)
        progress = _Progress(case.name, every=20 if options.long else 0)
        result = run(maker, case, progress)
        results.setdefault(case.name, []).append(result)
        print(_row(_cells(result)), flush=True)
        if options.long:
            costs = [cost.values() for cost in progress.costs]
            write_atomically(options.out / "costs.json", json.dumps(costs, indent=1) + "\n")
            write_atomically(options.out / "costs.png", drawn(progress.costs))
    means = {name: _mean(some) for name, some in results.items()}
    if len(options.seeds) > 1:
        print(f"\nmeans of {len(options.seeds)} seeds", *(_row(_cells(mean)) for mean in means.values()), sep="\n")
    written = [result.values() for some in results.values() for result in some]
    write_atomically(options.out / "loops.json", json.dumps(written, indent=1) + "\n")
    closes = {case.name: case.closes for case in rendered(options.shape, 0)}
    return 1 if any(_fails(mean, closes=closes[name]) for name, mean in means.items() if name in closes) else 0


def _cases(options: argparse.Namespace, seed: int) -> list[Case]:
    """Return the cases asked for; those that are not rendered are the same for every seed."""
    if options.long:
        angles_deg = 3.0 * np.arange(options.long)
        return [Case(f"{options.long}-at-3deg", turned(angles_deg, shape=options.shape, width=320, seed=seed))]
    cases = [*rendered(options.shape, seed), *bundled(), *real()]
    return [case for case in cases if not options.cases or case.name in options.cases]


def _mean(results: Sequence[Result]) -> Result:
    """Return the mean of a case's results, over those that have each figure."""
    columns: dict[str, Any] = {}
    for name in results[0].values():
        values = [value for result in results if isinstance(value := result.values()[name], int | float)]
        columns[name] = float(np.mean(values)) if values else None
    for name in ("frames", "joined", "registrations", "closures", "spanning", "rejected"):
        columns[name] = round(columns[name])
    columns["name"] = results[0].name
    return Result(**columns)


def _fails(result: Result, *, closes: bool) -> bool:
    if result.before_deg is None or result.after_deg is None:
        return True
    return result.after_deg > 1.0 or (closes and result.after_deg > 0.6 * result.before_deg)


def _cells(result: Result) -> list[str]:
    counts = (result.registrations, result.closures, result.spanning, result.rejected)
    figures = (result.before_deg, result.after_deg, result.before_mm, result.after_mm)
    figures += (result.nees_before, result.nees_after)
    residuals = (result.turned_deg, result.residual_before_deg, result.residual_after_deg)
    numbers = ["-" if number is None else f"{number:.2f}" for number in (*figures, *residuals)]
    return [result.name, f"{result.joined}/{result.frames}", *map(str, counts), *numbers, f"{result.seconds:.0f}"]


def _row(cells: Sequence[str]) -> str:
    return "".join(
        cell.ljust(width) if number == 0 else cell.rjust(width)
        for number, (cell, width) in enumerate(zip(cells, _WIDTHS, strict=True))
    )


class _Progress:
    """Tells on stderr what frames cost, `every` so many; 0: only of frames left out."""

    def __init__(self, name: str, *, every: int) -> None:
        self._name, self._every = name, every
        self.costs: list[Cost] = []

    def __call__(self, step: Step, seconds: float, memory_mib: float) -> None:
        self.costs.append(Cost(step.frame.index, seconds, len(step.posteriors), memory_mib))
        if step.left_out is not None:
            print(f"{self._name}: frame {step.frame.index}: {explain(step.left_out)}", file=sys.stderr, flush=True)
        if self._every and len(self.costs) % self._every == 0:
            spent = [cost.seconds for cost in self.costs[-self._every :]]
            figures = f"{np.median(spent):.2f} s a frame (mean {np.mean(spent):.2f}), {memory_mib:.0f} MiB"
            print(f"{self._name}: to frame {step.frame.index}: {figures}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
