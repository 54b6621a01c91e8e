"""Register the same pairs by variants of the default method, each without one stage or with other constants.

    make ablation                                        all of it, many hours
    python -m studies ablation --table          the table of what has been registered

Variants run block by block of the pairs. Every registration is written as it is made, and a study that was stopped goes
on where it was.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numba
import numpy as np

from modeler import se3
from modeler.evaluation import about_point, nees, rotation_error_deg
from studies.ablation.pairs import BLOCKS, Case, cases
from studies.ablation.tables import table
from studies.ablation.variants import VARIANTS, Variant

_TIMED = 6  # every sixth case is registered by the default too, so that times compare


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study, or print its table."""
    parser = argparse.ArgumentParser(
        prog="python -m studies ablation", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--blocks", nargs="+", choices=BLOCKS, default=BLOCKS, help="of pairs (all of them)")
    parser.add_argument(
        "--variants",
        nargs=2,
        type=int,
        default=(0, len(VARIANTS)),
        metavar=("FIRST", "END"),
        help="which, by number, the most informative first (all)",
    )
    parser.add_argument("--out", type=Path, default=Path("runs/ablation.jsonl"), help="one line a registration")
    parser.add_argument("--table", action="store_true", help="print the table of what has been registered")
    options = parser.parse_args(arguments)
    if not options.table:
        run(options.blocks, VARIANTS[slice(*options.variants)], options.out)
    print(table(options.out))
    return 0


def run(blocks: Sequence[str], variants: Sequence[Variant], out: Path) -> None:
    """Register what is not registered yet, and append it to a file."""
    numba.set_num_threads(1)  # so that processor time is the time of a registration
    out.parent.mkdir(parents=True, exist_ok=True)
    lines = out.read_text().splitlines() if out.exists() else []
    done = {(one["variant"], one["kind"], one["case"]) for one in map(json.loads, lines)}
    with out.open("a") as stream:
        for block in blocks:
            members = list(cases(block))
            print(f"block {block}: {len(members)} cases", file=sys.stderr, flush=True)
            registered(VARIANTS[0], members[0])  # compiles
            for variant in variants:
                began = time.perf_counter()
                for number, case in enumerate(members):
                    if (variant.name, variant.kind, case.key) in done:
                        continue
                    record = {"block": block, **registered(variant, case)}
                    if number % _TIMED == 0:
                        record["default_seconds"] = registered(VARIANTS[0], case)["seconds"]
                    print(json.dumps(record), file=stream, flush=True)
                spent = time.perf_counter() - began
                print(f"  {variant.name}, {variant.kind}: {spent:.0f} s", file=sys.stderr, flush=True)


def registered(variant: Variant, case: Case) -> dict[str, object]:
    """Return what a variant makes of a case."""
    record = {"variant": variant.name, "kind": variant.kind, "case": case.key, "group": case.group}
    record["symmetry"] = case.symmetry
    rng = np.random.default_rng([case.seed, case.source.index, case.target.index, variant.seed])
    began = time.process_time()
    try:
        with variant.patched():
            posterior = variant.method.register(case.source, case.target, case.density, rng=rng)
    except (ArithmeticError, ValueError, IndexError, np.linalg.LinAlgError) as error:  # of constants out of range
        return {**record, "outcome": f"{type(error).__name__}: {error}", "seconds": time.process_time() - began}
    seconds = time.process_time() - began
    centroid_m = case.source.centroid_m
    estimate, there = about_point(posterior.pose, centroid_m), case.truth @ se3.translation(centroid_m)
    return {
        **record,
        "outcome": posterior.outcome.label,
        "usable": bool(posterior.usable),
        "error_deg": float(rotation_error_deg(posterior.pose.mean, case.truth)),
        "sigma_deg": float(np.degrees(np.sqrt(np.trace(estimate.covariance[:3, :3])))),
        "nees": float(nees(estimate, there)),
        "seconds": seconds,
    }


if __name__ == "__main__":
    sys.exit(main())
