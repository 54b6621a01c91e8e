"""What `modeler evaluate` does once it is understood."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

from modeler import experiment
from modeler.cli import compose, nonvisual
from modeler.cli.console import bar
from modeler.cli.evaluate import Evaluate
from modeler.cli.evaluating_models import evaluate_models, is_run, models_table
from modeler.cli.options import Method
from modeler.cli.saying import say
from modeler.experiment import Experiment, Pairing, Summary
from modeler.types import AbstractRegistrar, InputError
from sequences import AbstractSequence, frame_range, open_sequence
from viz import figures


def evaluate(options: Evaluate) -> int:
    """Run the experiment, write its results, print a table and return the exit status.

    Of several runs those that cannot be judged are left out, each with a line on stderr, and the status is 2.

    Raises:
        InputError: where an option, a sequence or the folder cannot be used.
    """
    if not options.sequences:
        raise InputError("no sequence to evaluate; name at least one folder")
    if options.points is not None and options.points < 1:
        raise InputError(f"--points {options.points} leaves nothing; give a whole number from 1 on")
    runs = [path for path in options.sequences if is_run(path)]
    if runs:
        if len(runs) < len(options.sequences):
            lacking = next((path for path in options.sequences if not path.exists()), None)
            if lacking is not None:
                raise InputError(f"{lacking}: no such folder; give folders of runs")
            raise InputError("sequences and run folders are evaluated apart; give one kind at a time")
        scores, left_out = evaluate_models(runs, options.out, options.seed)
        print(columns(models_table(scores), left=3))
        for line in left_out:
            say(line)
        return 2 if left_out else 0
    kept = frame_range(options.selection.frames)
    recorded = [open_sequence(path).select(options.selection.every, kept) for path in options.sequences]
    for sequence in recorded:
        compose.check_region(options.where, sequence)
    # Tables are compared with each other: all sequences have the same prior, `general` if none is asked for.
    prior = replace(options.prior, prior=options.prior.prior or "general")
    plan = Experiment(
        methods=_methods(options.methods),
        prior=nonvisual.prior(prior, recorded[0] if len(recorded) == 1 else None),
        pairing=Pairing(_offsets(options.offsets), both_ways=options.both_ways, closed=options.closed),
        segmenter=compose.segmenter(options.where),
        points=options.points,
        learn=options.learn,
        seed=options.seed,
    )
    _check_offsets(plan.pairing, recorded)
    with bar() as progress:
        task = progress.add_task("", total=sum(plan.size(sequence) for sequence in recorded))
        rows = experiment.evaluate(
            recorded,
            plan,
            options.out,
            draw=figures.rotation_errors,
            told=lambda trial: progress.update(task, advance=1, description=f"{trial.sequence}, {trial.method}"),
        )
    print(table(rows))
    return 0


def table(rows: Sequence[Summary]) -> str:
    """Return summaries as text in columns; what nothing is known of is left out."""
    measured = tuple(f"{what} {share}" for what in ("deg", "mm") for share in ("50 %", "90 %", "max"))
    heading = ("sequence", "method", "apart", "pairs", "usable", "right", *measured)
    cells = [
        (
            row.sequence,
            row.method,
            str(row.offset),
            str(row.pairs),
            str(row.usable),
            "" if row.successes is None else str(row.successes),
            *(
                _number(value, 2)
                for errors in (row.rotation_error_deg, row.translation_error_mm)
                for value in (errors.median, errors.ninth_decile, errors.largest)
            ),
            _number(row.median_nees, 1),
            _number(row.loop_deg, 2),
            _number(row.turned_deg, 0),
            _number(row.seconds, 2),
        )
        for row in rows
    ]
    lines = [(*heading, "NEES", "loop deg", "of", "s"), *cells]
    told = [number for number, column in enumerate(zip(*lines, strict=True)) if any(column[1:])]
    return columns([tuple(line[number] for number in told) for line in lines], left=2)


def _number(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def columns(lines: Sequence[tuple[str, ...]], *, left: int) -> str:
    """Return lines of cells as text in columns, the first `left` of them flush left, the others right."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            f"{cell:<{width}}" if number < left else f"{cell:>{width}}" for number, (cell, width) in enumerate(pairs)
        )
        for pairs in (list(zip(line, widths, strict=True)) for line in lines)
    )


def _methods(names: str) -> dict[str, AbstractRegistrar]:
    """Return registrars by name from a list with commas."""
    known: dict[str, Method] = {name: name for name in get_args(Method)}
    chosen = [name.strip() for name in names.split(",")]
    for name in chosen:
        if name not in known:
            raise InputError(f"--methods {names}: there is no method {name!r}; there are {', '.join(known)}")
    return {name: compose.registrar(known[name]) for name in chosen}


def _check_offsets(pairing: Pairing, recorded: Sequence[AbstractSequence]) -> None:
    """Refuse frames so far apart that no sequence has two of them.

    Raises:
        InputError: where they are.
    """
    for offset in pairing.offsets:
        alone = replace(pairing, offsets=(offset,))
        if not any(True for sequence in recorded for _ in alone.pairs(sequence.indices)):
            most = max(map(len, recorded))
            raise InputError(f"--offsets {offset}: no pair of frames is so far apart in {most} frames; give less")


def _offsets(text: str) -> tuple[int, ...]:
    """Return whole numbers from a list with commas."""
    offsets = text.split(",")
    if not all(offset.strip().isdecimal() and int(offset) > 0 for offset in offsets):
        raise InputError(f"--offsets {text} is no list of whole numbers from 1 on; write for instance 1,2,3")
    return tuple(dict.fromkeys(int(offset) for offset in offsets))
