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
from concurrent.futures import ThreadPoolExecutor
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
    parser.add_argument("--first", type=int, default=0, help="number of the first, where others were tried before")
    parser.add_argument("--jobs", type=int, default=1, help="how many builds, or commands, at a time")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no trial after so long")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sequence", default=str(bundled("tube")))
    parser.add_argument("--options", default="--prior table", help="further options of modeler build, as one word")
    parser.add_argument("--out", type=Path, default=Path("runs/kills"), help="folder of the runs, which is emptied")
    parser.add_argument("--commands", nargs="*", choices=COMMANDS, help="kill these other commands; all without a name")
    options = parser.parse_args()
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    if options.commands is not None:
        return _commands(options.commands or list(COMMANDS), options)
    trials = Trials((options.sequence, *shlex.split(options.options)), options.out)
    whole = trials.undisturbed()
    print(f"undisturbed: {whole.pairs} pairs, {whole.changes} changes of the folder, {whole.seconds:.1f} s", flush=True)
    began_s = time.monotonic()

    def tried(number: int) -> str | None:
        """Return what is wrong after a kill; None if there was no time for it."""
        rng, kind = np.random.default_rng([options.seed, number]), KINDS[number % len(KINDS)]
        while time.monotonic() - began_s <= options.seconds:
            when, fault = trials.fault(whole, kind, f"{number:03d}", rng)
            if fault != "it had ended before it was to be killed":
                print(f"{number:3d} {kind:9} {when:30} {fault or 'the same'}", flush=True)
                return fault
        return None

    with ThreadPoolExecutor(options.jobs) as pool:
        faults = [fault for fault in pool.map(tried, range(options.first, options.count)) if fault is not None]
    print(f"{faults.count('')} of {len(faults)} kills survived in {time.monotonic() - began_s:.0f} s")
    return 1 if any(faults) else 0


def _commands(names: list[str], options: argparse.Namespace) -> int:
    """Kill commands at changes of the disk spread over each, each with inputs of its own; return the exit status."""
    inputs, began_s = options.out / "inputs", time.monotonic()
    write_inputs(inputs)

    def tried(name: str) -> list[str]:
        """Return what is wrong after each kill of a command."""
        trials, faults = CommandTrials(shutil.copytree(inputs, options.out / name), name), []
        whole, changes = trials.undisturbed()
        for change in sorted({round(place) for place in np.linspace(1, changes, options.count)}):
            if time.monotonic() - began_s > options.seconds:
                break
            faults.append(trials.fault(change, whole))
            print(f"{name:16} before change {change:3d} of {changes:3d}   {faults[-1] or 'the same'}", flush=True)
        return faults

    with ThreadPoolExecutor(options.jobs) as pool:
        faults = [fault for found in pool.map(tried, names) for fault in found]
    print(f"{faults.count('')} of {len(faults)} kills survived in {time.monotonic() - began_s:.0f} s")
    return 1 if any(faults) else 0


if __name__ == "__main__":
    sys.exit(main())
