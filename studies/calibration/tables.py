"""Trials as tables: how far posteriors are from what they say, by half, prior and method."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Final, final

import numpy as np

from modeler.evaluation import LEVELS, coverage
from studies.calibration.study import MEASURES, OURS, OUTSIDE, Study, Trial

GROUPINGS: Final[Mapping[str, Callable[[Trial], str]]] = {
    "all": lambda _: "all shapes",
    "symmetry": lambda trial: trial.symmetry,
    "shape": lambda trial: trial.shape,
    "condition": lambda trial: trial.condition,
}
"""How trials are pooled, by name."""


@final
@dataclass(frozen=True)
class Measured:
    """How one part of ξ is calibrated."""

    mean_nees: float
    """Per degree of freedom; 1 where covariances are true."""
    median_nees: float
    """Per degree of freedom; where covariances are true 0.89 for six, 0.79 for three, 0.45 for one."""
    coverage: Mapping[float, float]
    """Share of truths inside, by nominal probability of the region."""


@final
@dataclass(frozen=True)
class Row:
    """Trials pooled. What is judged is over those that the method stands by."""

    half: str
    prior: str
    method: str
    grouping: str
    group: str
    pairs: int
    """All of them."""
    outside: int
    """Left out, since the prior rules the true motion out."""
    refused: int
    """Registered, but the method does not stand by the answer."""
    rotation_error_deg: float
    """Median."""
    sigma_deg: float
    """Median of what the covariances predict, root mean square."""
    measures: Mapping[str, Measured]
    """By name."""

    @property
    def judged(self) -> int:
        """Number of answers judged."""
        return self.pairs - self.outside - self.refused


def rows(trials: Sequence[Trial], grouping: str) -> list[Row]:
    """Return a row for each half, prior, method and group, in the order in which they appear."""
    key = GROUPINGS[grouping]
    cells: dict[tuple[str, str, str, str], list[Trial]] = {}
    for trial in trials:
        cells.setdefault((trial.half, trial.prior, trial.method, key(trial)), []).append(trial)
    return [_row(cell, grouping, members) for cell, members in cells.items()]


def _row(cell: tuple[str, str, str, str], grouping: str, trials: Sequence[Trial]) -> Row:
    half, prior, method, group = cell
    usable = [trial for trial in trials if trial.usable]
    outside = sum(trial.outcome == OUTSIDE for trial in trials)
    return Row(
        half=half,
        prior=prior,
        method=method,
        grouping=grouping,
        group=group,
        pairs=len(trials),
        outside=outside,
        refused=len(trials) - outside - len(usable),
        rotation_error_deg=_median(trial.rotation_error_deg for trial in usable),
        sigma_deg=_median(trial.sigma_deg for trial in usable),
        measures={name: _measured([trial.nees[name] for trial in usable], degrees(name)) for name in MEASURES},
    )


def _measured(squares: Sequence[float], degrees: int) -> Measured:
    mean = float(np.mean(squares)) / degrees if squares else math.nan
    return Measured(mean, _median(squares) / degrees, coverage(squares, degrees))


def _median(values: Iterable[float]) -> float:
    known = list(values)
    return float(np.median(known)) if known else math.nan


def degrees(measure: str) -> int:
    """Return the degrees of freedom of a measure."""
    return MEASURES[measure].stop - MEASURES[measure].start


def text(trials: Sequence[Trial]) -> str:
    """Return what a person reads: the halves apart, coverage in percent."""
    lines = []
    for half in dict.fromkeys(trial.half for trial in trials):
        members = [trial for trial in trials if trial.half == half]
        lines += [f"{half.upper()} HALF", "", *_by_group(members), "", *_by_axis(members), ""]
    return "\n".join(lines)


def _by_group(trials: Sequence[Trial]) -> Iterator[str]:
    shares = "".join(f"{part:>16}" for part in ("pose", "rotation", "translation"))
    levels = "".join(f"{100 * level:>4g}" for level in LEVELS)
    yield f"{'':<45}{'pairs':>6}{'out-':>6}{'re-':>6}{'error':>8}{'stated':>8}{'NEES/6':>18}{shares}"
    yield f"{'':<45}{'':>6}{'side':>6}{'fused':>6}{'deg':>8}{'deg':>8}{'mean':>10}{'median':>8}" + f"    {levels}" * 3
    ours = [trial for trial in trials if trial.method == OURS]
    tables = [rows(trials, "all"), rows(trials, "symmetry"), rows(ours, "shape"), rows(ours, "condition")]
    for row in (row for table in tables for row in table):
        pose = row.measures["pose"]
        yield (
            f"{row.prior:<9}{row.method:<12}{row.group:<24}{row.pairs:>6}{row.outside:>6}{row.refused:>6}"
            f"{_number(row.rotation_error_deg):>8}{_number(row.sigma_deg):>8}"
            f"{_number(pose.mean_nees):>10}{_number(pose.median_nees):>8}"
            + "".join(_percent(row.measures[part]) for part in ("pose", "rotation", "translation"))
        )


def _by_axis(trials: Sequence[Trial]) -> Iterator[str]:
    axes = [name for name in MEASURES if degrees(name) == 1]
    levels = "".join(f"{100 * level:>4g}" for level in LEVELS)
    yield f"{'by axis, all shapes':<21}" + "".join(f"{axis:>26}" for axis in axes)
    yield f"{'':<21}" + f"{'NEES':>10}    {levels}" * len(axes)
    for row in rows(trials, "all"):
        measures = [row.measures[axis] for axis in axes]
        yield f"{row.prior:<9}{row.method:<12}" + "".join(f"{_number(m.mean_nees):>10}{_percent(m)}" for m in measures)


def _percent(measured: Measured) -> str:
    shares = (measured.coverage[level] for level in LEVELS)
    return "    " + "".join(f"{'-' if math.isnan(share) else f'{100 * share:.0f}':>4}" for share in shares)


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}" if value < 100.0 else f"{value:.3g}"


def results_json(study: Study, trials: Sequence[Trial]) -> str:
    """Return the study and its tables as JSON; what does not exist is null."""
    results = {
        "schema": 2,
        "seed": study.seed,
        "frames": study.frames,
        "pairs": study.pairs,
        "specimens": [asdict(specimen) for specimen in study.specimens],
        "conditions": [asdict(condition) for condition in study.conditions],
        "priors": {name: repr(prior) for name, prior in study.priors.items()},
        "methods": {name: repr(method) for name, method in study.methods.items()},
        "rows": [_finite({**asdict(row), "judged": row.judged}) for name in GROUPINGS for row in rows(trials, name)],
    }
    return json.dumps(results, indent=1, allow_nan=False) + "\n"


def results_csv(trials: Sequence[Trial]) -> str:
    """Return the trials as CSV, the NEES of each measure a column; what does not exist is empty."""
    names = [f.name for f in fields(Trial) if f.name != "nees"]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*names, *(f"nees_{measure}" for measure in MEASURES)])
    for trial in trials:
        values = [getattr(trial, name) for name in names] + [trial.nees.get(measure, math.nan) for measure in MEASURES]
        writer.writerow(_finite(value) for value in values)
    return stream.getvalue()


def _finite(value: object) -> object:
    if isinstance(value, dict):
        return {str(key): _finite(entry) for key, entry in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
