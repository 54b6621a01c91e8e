"""An experiment from sequences to files: everything as JSON, the trials as CSV and as a plot."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path

from modeler.experiment.experiment import Experiment, Quantiles, Recorded, Summary, Trial, summaries
from modeler.export import write_atomically
from modeler.types import InputError


def evaluate(
    sequences: Sequence[Recorded],
    experiment: Experiment,
    out: Path,
    *,
    draw: Callable[[Sequence[Trial]], bytes],
    report: Callable[[Trial], None],
) -> list[Summary]:
    """Run an experiment and write `results.json`, `results.csv` and `rotation_errors.png` into a folder.

    Args:
        sequences: with ground truth, or such as are a closed turn where that is the pairing.
        experiment: what to do with each.
        out: folder, made where there is none; the three files of an earlier experiment are replaced at the end.
        draw: makes a PNG of the trials.
        report: called with every trial as soon as it is done, `experiment.size(sequence)` times for each sequence.

    Raises:
        InputError: where a sequence has nothing to be judged by or cannot be read, or `out` cannot be written.
    """
    names = [recorded.name for recorded in sequences]
    for recorded in sequences:
        if names.count(recorded.name) > 1:
            raise InputError(f"two sequences are called {recorded.name!r}; give each a name in its sequence.json.")
        experiment.size(recorded)  # refuses what cannot be judged, before hours are spent on the others
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made ({error.strerror}); choose another folder with --out") from error
    trials: list[Trial] = []
    for recorded in sequences:
        for trial in experiment.trials(recorded):
            trials.append(trial)
            report(trial)
    rows = summaries(trials, experiment.success_deg, loops=experiment.pairing.loops)
    write_atomically(out / "results.json", results_json(experiment, trials, rows))
    write_atomically(out / "results.csv", results_csv(trials))
    write_atomically(out / "rotation_errors.png", draw(trials))
    return rows


def results_json(experiment: Experiment, trials: Sequence[Trial], rows: Sequence[Summary]) -> str:
    """Return an experiment, its trials and their summaries as JSON; numbers that are not finite are null."""
    results = {
        "schema": 1,
        "learn": experiment.learn,
        "seed": experiment.seed,
        "prior": repr(experiment.prior),
        "methods": {name: repr(method) for name, method in experiment.methods.items()},
        "pairing": asdict(experiment.pairing),
        "points": experiment.points,
        "success_deg": experiment.success_deg,
        "summaries": [_finite(asdict(row)) for row in rows],
        "trials": [_finite(asdict(trial)) for trial in trials],
    }
    return json.dumps(results, indent=1, allow_nan=False) + "\n"


def results_csv(trials: Sequence[Trial]) -> str:
    """Return the trials as CSV, a field a column but for the estimate; numbers that are not finite are empty."""
    text = io.StringIO()
    names = [f.name for f in fields(Trial) if f.name != "target_from_source"]
    writer = csv.DictWriter(text, names, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(_finite(asdict(trial)) for trial in trials)
    return text.getvalue()


def _finite(record: Mapping[str, object]) -> dict[str, object]:
    """Return a record whose numbers JSON can hold: None for what is not finite."""

    def plain(value: object) -> object:
        if isinstance(value, Quantiles):
            return _finite(value._asdict())
        if isinstance(value, tuple):
            return [plain(entry) for entry in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {name: plain(value) for name, value in record.items()}
