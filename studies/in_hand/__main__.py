"""Build models of objects in a hand: `python -m studies in_hand`.

A robot's gripper, whose poses have errors of 2° and 5 mm, carries eight shapes and regrasps each halfway (`robot`) or
not (`steady`); a person's hand turns them in front of the camera at 60° a second, at 15 frames a second. Results are
kept in the folder, and an interrupted study continues.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from studies.in_hand.study import GIVEN, HOLDERS, SHAPES, Outcome, outcome, table
from studies.results_file import earlier_results


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies in_hand", description=__doc__)
    parser.add_argument("--holder", nargs="+", choices=HOLDERS, default=HOLDERS, help="whose hand")
    parser.add_argument("--shape", nargs="+", choices=SHAPES, default=SHAPES, help="which shapes")
    parser.add_argument("--given", choices=GIVEN, default="masks", help="given masks or shape of the hand")
    parser.add_argument("--out", type=Path, default=Path("runs/in_hand"), help="folder of the results")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "in_hand.jsonl"
    lines = earlier_results(path)
    found = [Outcome(**{**json.loads(line), "reasons": tuple(json.loads(line)["reasons"])}) for line in lines]
    for holder in options.holder:
        for shape in options.shape:
            if any((one.holder, one.shape, one.given) == (holder, shape, options.given) for one in found):
                continue
            found.append(outcome(shape, holder, options.given))
            with path.open("a") as stream:
                print(json.dumps(asdict(found[-1])), file=stream)
            print(found[-1], file=sys.stderr, flush=True)
    print(table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
