"""The table of the study: how each variant does, and which figures differ from the default's by more than chance."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

import numpy as np
from scipy import stats

FAILURE_DEG: Final = 5.0
"""An answer whose rotation is off by more is a failure."""
SIGNIFICANT: Final = 3.0
"""Standard errors beyond which a difference is marked: 1 of 400 is by chance."""
_REGION: Final = float(stats.chi2.ppf(0.95, 6))
_MOST_NEES = 10.0  # of a degree of freedom: beyond, one wrong answer would outweigh all others
_LEAST_DEG = 1e-3

Record = Mapping[str, Any]


def _failed(record: Record) -> float:
    """Whether the rotation is wrong; a body of revolution has none."""
    return np.nan if record["symmetry"] == "revolution" else float(record.get("error_deg", 180.0) > FAILURE_DEG)


def _refused(record: Record) -> float:
    return float(not record.get("usable", False))


def _log_error(record: Record) -> float:
    known = record["symmetry"] != "revolution"
    return float(np.log(max(record.get("error_deg", 180.0), _LEAST_DEG))) if known else np.nan


def _judged(record: Record) -> bool:
    """Whether a record is a usable answer under a truth that is exact: rendered."""
    return record.get("usable", False) and record["group"] in ("shapes", "hard")


def _nees(record: Record) -> float:
    return min(record["nees"] / 6.0, _MOST_NEES) if _judged(record) else np.nan


def _covered(record: Record) -> float:
    return float(record["nees"] < _REGION) if _judged(record) else np.nan


@final
@dataclass(frozen=True)
class Measure:
    """One figure of a variant, of a number for each registration (NaN where it has none)."""

    title: str
    number: Callable[[Record], float]
    shown: Callable[[np.ndarray], str]
    """Of the numbers that are not NaN."""
    is_share: bool = False

    def values(self, records: Sequence[Record]) -> np.ndarray:
        """Return the numbers (n,)."""
        return np.array([self.number(record) for record in records])

    def cell(self, own: Sequence[Record], defaults: Sequence[Sequence[Record]]) -> str:
        """Return the figure, bold where it differs from the default's mean over seeds by more than chance.

        Chance is the scatter of the difference from case to case, but no less than that of the default between seeds,
        and no less than that of one case for a share.
        """
        mine, others = self.values(own), np.array([self.values(one) for one in defaults])
        text = self.shown(mine[np.isfinite(mine)])
        away = mine - others.mean(axis=0)
        away = away[np.isfinite(away)]
        paired = others[:, np.isfinite(others).all(axis=0)]
        seeds = float(np.mean(np.var(paired, axis=0, ddof=1))) * (1.0 + 1.0 / len(others)) if len(others) > 1 else 0.0
        least = 1.0 / max(len(away), 1) if self.is_share else 1e-9
        error = np.sqrt(max(float(np.var(away)), seeds, least) / max(len(away), 1))
        return f"**{text}**" if len(away) and abs(away.mean()) > SIGNIFICANT * error else text


def _percent(values: np.ndarray) -> str:
    return f"{100.0 * values.mean():.1f}"


MEASURES: Final = (
    Measure("failures %", _failed, _percent, is_share=True),
    Measure("refused %", _refused, _percent, is_share=True),
    Measure("error °", _log_error, lambda values: f"{np.exp(np.median(values)):.2f}"),
    Measure("NEES/6", _nees, lambda values: f"{values.mean():.2f}"),
    Measure("in 95 % region, %", _covered, _percent, is_share=True),
)


def table(file: Path) -> str:
    """Return the tables in Markdown, of ordinary and of hard blocks: cases that the default has with every seed."""
    records = [json.loads(line) for line in file.read_text().splitlines()]
    parts = {
        "Ordinary pairs": [record for record in records if record["block"] != "hard"],
        "Little overlap": [record for record in records if record["block"] == "hard"],
    }
    return "\n\n".join(f"### {title}\n\n{_table(part)}" for title, part in parts.items() if part)


def _table(records: Sequence[Record]) -> str:
    variants: dict[tuple[str, str], dict[str, Record]] = {}
    for record in records:
        variants.setdefault((record["variant"], record["kind"]), {})[record["case"]] = record
    defaults = [cases for (_, kind), cases in variants.items() if kind == "default"]
    if not defaults:
        return "no seed of the default is registered yet, to compare with: --variants 0 3"
    titles = ["variant", "", "pairs", *(measure.title for measure in MEASURES), "new / mended", "time"]
    lines = [" | ".join(["", *titles, ""]).strip(), "|" + "---|" * len(titles)]
    for (name, kind), own in variants.items():
        keys = [key for key in own if all(key in one for one in defaults)]
        rows = [own[key] for key in keys]
        others = [[one[key] for key in keys] for one in defaults]
        cells = [measure.cell(rows, others) for measure in MEASURES]
        lines.append(
            " | ".join(["", name, kind, str(len(keys)), *cells, _changed(rows, others), _time(rows, others), ""])
        )
    return "\n".join(line.strip() for line in lines)


def _changed(own: Sequence[Record], defaults: Sequence[Sequence[Record]]) -> str:
    """Return how many cases fail with no seed of the default, and how many with every seed but not here."""
    bad = [{one["case"] for one in run if _failed(one) == 1.0} for run in defaults]
    mine = {one["case"] for one in own if _failed(one) == 1.0}
    return f"{len(mine - set.union(*bad))} / {len(set.intersection(*bad) - mine)}"


def _time(own: Sequence[Record], defaults: Sequence[Sequence[Record]]) -> str:
    """Return the processor time relative to the default's: that measured together with it, if any."""
    timed = [one for one in own if "default_seconds" in one]
    if timed:
        return f"{sum(one['seconds'] for one in timed) / sum(one['default_seconds'] for one in timed):.2f}"
    return (
        f"{sum(one['seconds'] for one in own) / np.mean([sum(one['seconds'] for one in run) for run in defaults]):.2f}"
    )
