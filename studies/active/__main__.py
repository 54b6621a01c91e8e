"""Runs trials and prints what they show.

    .venv/bin/python -m studies active --shapes 12 --out runs/active.jsonl
    .venv/bin/python -m studies active --out runs/active.jsonl --shapes 0    # the tables of existing trials

Trials already in the file are not run again.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from studies.active.tables import printed
from studies.active.trial import Trial, ran
from studies.calibration.specimens import SPECIMENS, Symmetry
from studies.results_file import earlier_results

CLASSES: tuple[Symmetry, ...] = ("asymmetric", "near-symmetric", "n-fold", "revolution")


def chosen(half: str, count: int, classes: Sequence[str], skip: int = 0) -> list[str]:
    """Return names of shapes, of each class as many, without the first few of each."""
    by_class = [[s.recipe for s in SPECIMENS if s.half == half and s.symmetry == kind][skip:] for kind in classes]
    longest = max(map(len, by_class))
    mixed = [names[k] for k in range(longest) for names in by_class if k < len(names)]
    return mixed[:count]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies active")
    parser.add_argument("--half", choices=("tuning", "held-out"), default="held-out")
    parser.add_argument("--shapes", type=int, default=12, help="how many; 0 = only the tables")
    parser.add_argument("--skip", type=int, default=0, help="shapes of each class that are left out")
    parser.add_argument("--classes", default=",".join(CLASSES))
    parser.add_argument("--policies", default="suggest,random,even")
    parser.add_argument("--actions", type=int, default=5, help="most of a trial")
    parser.add_argument("--until-done", action="store_true", help="end a trial once all is known and seen")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="processes; give each a thread by NUMBA_NUM_THREADS=1")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    shapes = chosen(options.half, options.shapes, options.classes.split(","), options.skip)
    done = {(r["shape"], r["policy"], r["seed"]) for r in records(options.out)}
    missing = [
        [
            Trial(shape, policy, options.seed, options.actions, until_done=options.until_done)
            for policy in options.policies.split(",")
            if (shape, policy, options.seed) not in done
        ]
        for shape in shapes
    ]
    with ProcessPoolExecutor(options.workers, multiprocessing.get_context("spawn")) as pool:
        for found in pool.map(ran, missing):
            with options.out.open("a") as file:
                file.writelines(json.dumps(record, default=float) + "\n" for record in found)
    printed(records(options.out))


def records(path: Path) -> list[dict]:
    return [json.loads(line) for line in earlier_results(path)]


if __name__ == "__main__":
    main()
