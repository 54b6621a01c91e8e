"""Experiments as files: everything as JSON, the trials as CSV."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields

from modeler.experiment.experiment import Experiment
from modeler.experiment.summaries import Quantiles, Summary
from modeler.experiment.trials import Trial


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
        "pixels": experiment.pixels,
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
