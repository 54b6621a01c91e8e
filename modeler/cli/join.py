"""`modeler join`: two runs of one object to one model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.options import SEED


@dataclass(frozen=True)
class Join:
    """Join two runs of the same object in different postures, so that the model has what each of them hides.

    The models are laid on each other from every side, pairs of their views registered as in a build, and the frames of
    both fused into one model in the object frame of RUN_A.
    """

    run_a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_A")]
    """Run folder of one posture (upright, say)."""
    run_b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_B")]
    """Run folder of the other (lying, say)."""
    out: Annotated[Path, tyro.conf.arg(metavar="RUN")]
    """Run folder to make. Frames of RUN_B are numbered on from those of RUN_A."""
    overwrite: bool = False
    """Replace the results of an earlier run in the folder."""
    pairs: Annotated[int, tyro.conf.arg(metavar="N")] = 6
    """Pairs of views, one of each run, that are registered."""
    seed: Annotated[int, SEED] = 0
    """Same seed, same machine, same result, to the bit."""

    def run(self) -> int:
        """Join the runs; status 3 where the result is not to be trusted, as report.json then says."""
        from modeler.cli.joining import join

        return join(self)
