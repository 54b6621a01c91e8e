"""The tables of the study: captures by factor, and those that end otherwise than they should."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Final

import numpy as np

from studies.results.tables import markdown
from studies.whole.plan import Factors
from studies.whole.study import Outcome

COLUMNS: Final = ("captures", "frames placed", "right, status 0", "right, 3", "wrong, 0", "wrong, 3", "refused")
"""Of `counts`."""


def _steps_of(edges: Sequence[float], unit: str, scale: float = 1.0) -> Callable[[float], str]:
    """Return a function that names the range of a number, the unit being that of scale times it."""

    def name(value: float) -> str:
        above = [edge for edge in edges if value >= edge]
        low, high = f"{scale * above[-1]:g}", next((f"{scale * edge:g}" for edge in edges if value < edge), None)
        return f"{low} to {high} {unit}" if high else f"from {low} {unit}"

    return name


_SIZE = _steps_of((0.02, 0.1, 0.4, 2.0), "cm", 100.0)
_SHARE = _steps_of((0.0, 0.45, 0.65), "of the height")
_NOISE = _steps_of((0.0, 0.0005, 0.001, 0.002), "% of the distance", 100.0)
_STEP = _steps_of((5.0, 15.0, 30.0, 50.0, 90.0), "°")
_FOCAL = _steps_of((0.0, 0.01, 0.02), "%", 100.0)
FACTORS: Final[Mapping[str, Callable[[Factors], str]]] = MappingProxyType(
    {
        "mesh": lambda f: f.thing.split(" ")[0] if f.thing.startswith("own/") else f.thing.split("/")[0],
        "size": lambda f: _SIZE(min(f.size_m, 1.999)),
        "in the image": lambda f: "cut off" if f.cut else _SHARE(f.share),
        "width": lambda f: f"{f.width_px} px",
        "camera": lambda f: f"{f.camera}, kind given" if f.kind_told and f.camera == "time of flight" else f.camera,
        "noise": lambda f: _NOISE(f.noise),
        "support": lambda f: f.support,
        "wall": lambda f: "none" if not f.wall else "close behind" if f.wall < 0.5 else "far behind",
        "steps": lambda f: f.steps,
        "step": lambda f: _STEP(min(f.step_deg, 89.9)),
        "order": lambda f: f.order,
        "masks": lambda f: f.masks,
        "colour": lambda f: f.colour,
        "motion": lambda f: "given" if f.told else "not given",
        "intrinsics": lambda f: f.intrinsics,
        "focal length, error": lambda f: _FOCAL(abs(f.focal_error)),
    }
)
"""Names a capture's value of each factor."""


def text(outcomes: Sequence[Outcome]) -> str:
    """Return a table, and a line for each right model that is refused and each wrong one that is not."""
    parts = [markdown(("factor", *COLUMNS), counts(outcomes))]
    for one in outcomes:
        if (one.status == 0) is not one.right:
            errors = "" if one.error_deg is None else f", {one.error_deg:.1f}°, {1e3 * (one.error_m or 0.0):.2f} mm"
            parts.append(
                f"{one.number} {one.factors.thing}: {one.placed} of {one.factors.frames}, "
                f"{'right' if one.right else 'wrong'}{errors} of {1e3 * one.tolerance_m:.2f}; "
                f"status {one.status}: {'; '.join(one.words)}"
            )
    return "\n\n".join(parts)


def counts(outcomes: Sequence[Outcome]) -> list[tuple[str | int, ...]]:
    """Return rows of `COLUMNS`: all captures, and those of every value of every factor."""
    rows = [("all", *_row(outcomes))]
    for factor, name in FACTORS.items():
        for value in sorted({name(one.factors) for one in outcomes}, key=_by_number):
            rows.append((f"{factor}: {value}", *_row([one for one in outcomes if name(one.factors) == value])))
    return rows


def _by_number(text: str) -> tuple[float, str]:
    """Return a key that sorts ranges by their numbers, and what has none behind them."""
    found = re.search(r"[\d.]+", text)
    return (float(found[0]) if found else np.inf), text


def _row(outcomes: Sequence[Outcome]) -> tuple[str | int, ...]:
    placed = sum(one.placed for one in outcomes) / max(1, sum(one.factors.frames for one in outcomes))
    kinds = [
        sum(one.right is right and one.status == status for one in outcomes)
        for right in (True, False)
        for status in (0, 3)
    ]
    refused = sum(one.status == 2 for one in outcomes)
    return (len(outcomes), f"{100.0 * placed:.0f} %", *kinds, refused)
