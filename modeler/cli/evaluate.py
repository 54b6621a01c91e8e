"""`modeler evaluate`: methods and models against ground truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, get_args

import tyro

from modeler.cli.options import SEED, FrameOptions, Method, ObjectOptions, PriorOptions, default


@dataclass(frozen=True)
class Evaluate:
    """Register pairs of frames whose true motion is known, by several methods, and tell how far off they are.

    Writes results.json, results.csv and rotation_errors.png (box plots), and prints a table. Of run folders, the model
    is compared with the true surface instead (model.ply of a rendered sequence, BOP's models folder), and so is one
    made of the same frames with their true poses: models.json, models.csv and a table. Runs for which that is not known
    are left out, and the status is 2.
    """

    sequences: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="SEQUENCE|RUN...", help_behavior_hint="(at least one)"),
    ]
    """Sequences with ground truth (scene_gt.json; none is needed with --closed), or run folders made of such."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results; those of an earlier evaluation are replaced at the end."""
    methods: Annotated[str, tyro.conf.arg(metavar="NAME,...")] = ",".join(get_args(Method))
    """Methods to compare."""
    offsets: Annotated[str, tyro.conf.arg(metavar="N,...")] = "1"
    """Compare frames so many apart; each is a table of its own."""
    both_ways: bool = False
    """Register each pair in both directions, not only the later frame to the earlier."""
    closed: bool = False
    """Take the sequence for a full turn, its last frame followed by its first.
    What all its steps together leave, of how much they turn one by one, is told too: that needs no ground truth."""
    learn: bool = False
    """The prior learns from the pairs before, as in `build`: the axis and sense of a turntable that nobody tells."""
    points: Annotated[int | None, tyro.conf.arg(metavar="N"), default("all")] = None
    """Keep so many of the object's surface points a view, drawn at random: very sparse clouds."""
    seed: Annotated[int, SEED] = 0
    """Same seed, same machine, same errors."""
    prior: PriorOptions = field(default_factory=PriorOptions)
    selection: FrameOptions = field(default_factory=FrameOptions)
    where: ObjectOptions = field(default_factory=ObjectOptions)

    def run(self) -> int:
        """Run the experiment."""
        from modeler.cli.evaluating import evaluate

        return evaluate(self)
