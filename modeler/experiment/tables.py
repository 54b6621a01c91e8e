"""Trials as tables: one row a pair, one row a method."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import final

import numpy as np

from modeler.evaluation import coverage
from modeler.experiment.trials import Experiment, Trial
from modeler.types import Array


@final
@dataclass(frozen=True)
class Summary:
    """The trials of one method on one sequence at one offset. Quantiles are over those that have an error."""

    sequence: str
    """Name of the sequence."""
    method: str
    """Name of the method."""
    offset: int
    """Frames from one to the other."""
    pairs: int
    """Number of trials."""
    usable: int
    """How many the method stands by."""
    successes: int
    """How many rotation errors are below the limit of success, whether the method stands by them or not."""
    rotation_error_deg: tuple[float, float, float, float]
    """Lower quartile, median, upper quartile and maximum."""
    translation_error_mm: float
    """Median."""
    nees: float
    """Mean; 6 where covariances are true."""
    median_nees: float
    """Median; 5.3 where covariances are true."""
    inside_95: float
    """Share of truths inside the region of 95 %."""
    seconds: float
    """Median."""


def summaries(trials: Iterable[Trial], success_deg: float) -> list[Summary]:
    """Return a row for each sequence, offset and method, in the order in which they appear."""
    groups: dict[tuple[str, int, str], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.sequence, trial.offset, trial.method), []).append(trial)
    return [_summary(members, success_deg) for members in groups.values()]


def _summary(trials: Sequence[Trial], success_deg: float) -> Summary:
    def known(values: Iterable[float]) -> Array:
        return np.array([value for value in values if math.isfinite(value)])

    def quantile(values: Array, share: float) -> float:
        return float(np.quantile(values, share)) if len(values) else math.nan

    rotation, squares = known(t.rotation_error_deg for t in trials), known(t.nees for t in trials)
    low, median, high, most = (quantile(rotation, share) for share in (0.25, 0.5, 0.75, 1.0))
    return Summary(
        sequence=trials[0].sequence,
        method=trials[0].method,
        offset=trials[0].offset,
        pairs=len(trials),
        usable=sum(trial.usable for trial in trials),
        successes=int(np.sum(rotation < success_deg)),
        rotation_error_deg=(low, median, high, most),
        translation_error_mm=quantile(known(t.translation_error_mm for t in trials), 0.5),
        nees=float(np.mean(squares)) if len(squares) else math.nan,
        median_nees=quantile(squares, 0.5),
        inside_95=coverage(squares)[0.95],
        seconds=quantile(known(t.seconds for t in trials), 0.5),
    )


def results_json(experiment: Experiment, trials: Sequence[Trial], rows: Sequence[Summary]) -> str:
    """Return an experiment, its trials and their summaries as JSON; numbers that are not finite are null."""
    results = {
        "schema": 1,
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
    """Return the trials as CSV, a field a column; numbers that are not finite are empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [f.name for f in fields(Trial)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(_finite(asdict(trial)) for trial in trials)
    return text.getvalue()


def _finite(record: Mapping[str, object]) -> dict[str, object]:
    """Return a record whose numbers JSON can hold: None for what is not finite."""

    def plain(value: object) -> object:
        if isinstance(value, tuple):
            return [plain(entry) for entry in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {name: plain(value) for name, value in record.items()}
