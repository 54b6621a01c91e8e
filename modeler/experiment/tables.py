"""Trials as tables: one row a pair, one row a method."""

from __future__ import annotations

import csv
import functools
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import NamedTuple, final

import numpy as np

from modeler.evaluation import coverage, rotation_error_deg
from modeler.experiment.trials import Experiment, Trial
from modeler.types import Array


class Quantiles(NamedTuple):
    """How errors are spread; NaN where there is none."""

    lower_quartile: float
    median: float
    upper_quartile: float
    ninth_decile: float
    largest: float

    @staticmethod
    def of(values: Array) -> Quantiles:
        """Return the quantiles of numbers (n,)."""
        shares = (0.25, 0.5, 0.75, 0.9, 1.0)
        return Quantiles(*(float(np.quantile(values, share)) if len(values) else math.nan for share in shares))


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
    successes: int | None
    """How many rotation errors are below the limit of success, whether the method stands by them or not; None where
    the truth is not known."""
    rotation_error_deg: Quantiles
    """Of the angle between estimate and truth."""
    translation_error_mm: Quantiles
    """Of the distance at the object's centroid between estimate and truth."""
    nees: float
    """Mean; 6 where covariances are true."""
    median_nees: float
    """Median; 5.3 where covariances are true."""
    inside_95: float
    """Share of truths inside the region of 95 %."""
    seconds: float
    """Median."""
    loop_deg: float = math.nan
    """Rotation that is left of all steps round a closed turn; 0 where they are right. NaN where that was not asked."""
    turned_deg: float = math.nan
    """Rotation of those steps one by one, summed up: 360 where a steady turn was followed, much less where steps stuck,
    much more where some were flipped."""


def summaries(trials: Iterable[Trial], success_deg: float, *, loops: bool = False) -> list[Summary]:
    """Return a row for each sequence, offset and method, in the order in which they appear.

    Args:
        trials: to summarise.
        success_deg: rotation error below which one counts as right.
        loops: whether the trials of a row are the steps round a closed turn, in order.
    """
    groups: dict[tuple[str, int, str], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.sequence, trial.offset, trial.method), []).append(trial)
    return [_summary(members, success_deg, loops) for members in groups.values()]


def _summary(trials: Sequence[Trial], success_deg: float, loops: bool) -> Summary:
    def known(values: Iterable[float]) -> Array:
        return np.array([value for value in values if math.isfinite(value)])

    rotation, squares = known(t.rotation_error_deg for t in trials), known(t.nees for t in trials)
    return Summary(
        sequence=trials[0].sequence,
        method=trials[0].method,
        offset=trials[0].offset,
        pairs=len(trials),
        usable=sum(trial.usable for trial in trials),
        successes=None if math.isnan(trials[0].rotation_deg) else int(np.sum(rotation < success_deg)),
        rotation_error_deg=Quantiles.of(rotation),
        translation_error_mm=Quantiles.of(known(t.translation_error_mm for t in trials)),
        nees=float(np.mean(squares)) if len(squares) else math.nan,
        median_nees=Quantiles.of(squares).median,
        inside_95=coverage(squares)[0.95],
        seconds=Quantiles.of(known(t.seconds for t in trials)).median,
        **(_round(trials) if loops else {}),
    )


def _round(trials: Sequence[Trial]) -> dict[str, float]:
    """Return how much all steps turn, together and one by one; nothing where one is missing."""
    if not all(trial.target_from_source for trial in trials):
        return {}
    steps = [np.array(trial.target_from_source).reshape(4, 4) for trial in trials]
    return {
        "loop_deg": rotation_error_deg(functools.reduce(np.matmul, steps), np.eye(4)),
        "turned_deg": sum(rotation_error_deg(step, np.eye(4)) for step in steps),
    }


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
