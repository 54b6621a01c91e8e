"""`modeler join`: two runs of one object to one model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.console import say
from modeler.composition.options import SEED


@dataclass(frozen=True)
class Join:
    """Join two runs of the same object in different postures, so that the model has no hidden side.

    They are joined like the segments of a build before and after the object was laid down differently: the models are
    aligned from many initial rotations, pairs of their views registered, and the frames of both fused into one model in
    the object frame of RUN_A.
    """

    run_a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_A")]
    """Run folder of one posture (upright, say)."""
    run_b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_B")]
    """Run folder of the other (lying, say)."""
    out: Annotated[Path, tyro.conf.arg(metavar="RUN")]
    """Run folder to create. Frame numbers of RUN_B continue those of RUN_A."""
    overwrite: bool = False
    """Replace the results of an earlier run in the folder."""
    pairs: Annotated[int, tyro.conf.arg(metavar="N")] = 6
    """Number of pairs of views, one of each run, to register."""
    seed: Annotated[int, SEED] = 0
    """Same seed, same machine, same result, to the bit."""

    def run(self) -> int:
        """Join the runs; status 3 if the result cannot be trusted; report.json has the reasons.

        Raises:
            InputError: if a run cannot be read, or no pair of their views can be registered.
        """
        from modeler.runs.joining import join

        _check(self)
        joined = join(self.run_a, self.run_b, self.out, pairs=self.pairs, seed=self.seed, overwrite=self.overwrite)
        best, *others = joined.alignments
        ways = f", of {len(others) + 1} ways" if others else ""
        say(f"models aligned: {100.0 * best.share:.3g} % likely{ways}")
        frames = len(joined.report["poses"])
        say(f"{best.accepted} of {len(best.edges)} pairs registered, {frames} frames joined: {self.out}")
        if joined.verdict.reasons:
            say(f"not to be trusted: {joined.verdict.reasons[0]}")
        return 0 if joined.verdict.trustworthy else 3


def _check(options: Join) -> None:
    """Refuse options out of range, and a folder that holds something."""
    from modeler.export import locked
    from modeler.runs.outputs import check_run_folder, run_inputs
    from modeler.types import InputError

    if options.pairs < 1:
        raise InputError(f"--pairs {options.pairs} is out of range; give at least 1")
    if options.run_a.resolve() == options.run_b.resolve():
        raise InputError(f"RUN_A and RUN_B are both {options.run_a}; name two runs")
    check_run_folder(options.out, run_inputs([options.run_a, options.run_b]), overwrite=options.overwrite)
    if options.out.is_dir():
        with locked(options.out):  # asked now, not only when the work is done
            pass
