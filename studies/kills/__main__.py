"""Kill `modeler build` with SIGKILL at random moments, resume it, and compare with a run that nobody disturbed.

    python -m studies kills --count 50 --seed 0
    python -m studies kills --commands --count 10      every other command that writes, 10 times each

Trajectory, graph, mesh and cloud must be the same to the byte, and each kill may cost two pairs at most. What fails is
kept in the folder of --out, and the status is 1.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
import time
from pathlib import Path

import numpy as np

from modeler.sequences import bundled
from studies.kills.commands import COMMANDS, CommandTrials, write_inputs
from studies.kills.trials import KINDS, Trials


def main() -> int:
    """Run the trials and return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m studies kills", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--count", type=int, default=50, help="how many kills")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sequence", default=str(bundled("tube")))
    parser.add_argument("--options", default="--prior table", help="further options of modeler build, as one word")
    parser.add_argument("--out", type=Path, default=Path("runs/kills"), help="folder of the runs, which is emptied")
    parser.add_argument("--commands", nargs="*", choices=COMMANDS, help="kill these other commands; all without a name")
    options = parser.parse_args()
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    if options.commands is not None:
        return _commands(options.commands or list(COMMANDS), options.count, options.out)
    trials = Trials((options.sequence, *shlex.split(options.options)), options.out)
    whole = trials.undisturbed()
    print(f"undisturbed: {whole.pairs} pairs, {whole.changes} changes of the folder, {whole.seconds:.1f} s", flush=True)
    rng, began, survived, failed = np.random.default_rng(options.seed), time.monotonic(), 0, 0
    while survived + failed < options.count:
        kind = KINDS[(survived + failed) % len(KINDS)]
        when, fault = trials.fault(whole, kind, f"{survived + failed:03d}", rng)
        if fault == "it had ended before it was to be killed":
            continue
        survived, failed = survived + (not fault), failed + bool(fault)
        print(f"{survived + failed:3d} {kind:9} {when:30} {fault or 'the same'}", flush=True)
    print(f"{survived} of {options.count} kills survived in {time.monotonic() - began:.0f} s")
    return 1 if failed else 0


def _commands(names: list[str], count: int, out: Path) -> int:
    """Kill commands at changes of the disk spread over each, and return the exit status."""
    write_inputs(out)
    failed = 0
    for name in names:
        trials = CommandTrials(out, name)
        whole, changes = trials.undisturbed()
        for change in sorted({round(place) for place in np.linspace(1, changes, count)}):
            fault = trials.fault(change, whole)
            failed += bool(fault)
            print(f"{name:16} before change {change:3d} of {changes:3d}   {fault or 'the same'}", flush=True)
    print(f"{failed} faults")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
