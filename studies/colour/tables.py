"""Tables of the study of colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from studies.colour.study import ALIGNED
from studies.results.tables import markdown

Outcome = Mapping[str, Any]
_CODE = "colour_misaligned"


def text(outcomes: Sequence[Outcome]) -> str:
    """Return the tables of what was measured, in Markdown."""
    parts = []
    built = [one for one in outcomes if one["part"] in ("aligned", "displaced") and "codes" in one]
    if built:
        columns = ("bodies, colour", "sequences", "named by edges before", "named by the run", "by either", "status 0")
        names = dict.fromkeys(
            (one["part"], one["texture"] if one["part"] == "aligned" else one["way"]) for one in built
        )
        rows = [(f"{part}, {kind}", *counts(_of(built, part, kind))) for part, kind in names]
        rows += [(f"{part}, all", *counts([one for one in built if one["part"] == part])) for part in dict(names)]
        parts.append(markdown(columns, rows))
    captures = [one for one in outcomes if one["part"] == "captures" and "codes" in one]
    if captures:
        columns = ("capture, colour", "placed", "status", "reasons", "loop", "error, median / largest", "built in")
        parts.append(markdown(columns, [capture(one) for one in captures]))
    if pairs := [one for one in outcomes if one["part"] == "pairs"]:
        columns = ("pairs, 24°", "prior", "pairs", "error, median / largest", "NEES/6, mean / largest", "seconds")
        names = dict.fromkeys((one["body"], one["texture"]) for one in pairs)
        rows = [
            (
                f"{body}, {texture}",
                prior,
                *chain([one for one in pairs if (one["body"], one["texture"]) == (body, texture)], prior),
            )
            for body, texture in names
            for prior in ("table", "general")
        ]
        parts.append(markdown(columns, rows))
    return "\n\n".join(parts)


def _of(built: Sequence[Outcome], part: str, kind: str) -> list[Outcome]:
    return [one for one in built if one["part"] == part and kind in (one["texture"], one["way"])]


def counts(outcomes: Sequence[Outcome]) -> tuple[int, ...]:
    """Return numbers of sequences, and of those named by edges, by the run, by either, and with status 0."""
    before = [bool(one["before"]) for one in outcomes]
    run = [_CODE in one["codes"] for one in outcomes]
    either = sum(a or b for a, b in zip(before, run, strict=True))
    return len(outcomes), sum(before), sum(run), either, sum(one["status"] == 0 for one in outcomes)


def capture(one: Outcome) -> tuple[str, ...]:
    """Return the row of a build of a capture."""
    loop, errors = one["loop_sd"], one["errors_deg"]
    return (
        f"`{one['body']}`" if one["way"] == ALIGNED else f"`{one['body']}`, {one['way']}",
        one["placed"],
        str(one["status"]),
        ", ".join(one["codes"]) + (" (edges)" if one["before"] else ""),
        "-" if loop is None else f"{loop:.1f} sd",
        "-" if errors is None else f"{errors[0]:.2f}° / {errors[1]:.2f}°",
        f"{one['built_s']:.0f} s",
    )


def chain(outcomes: Sequence[Outcome], prior: str) -> tuple[str | int, ...]:
    """Return number, errors, NEES and seconds of pairs under a prior."""
    found = [pair for one in outcomes for pair in one["pairs"] if pair["prior"] == prior]
    errors, squares = ([pair[name] for pair in found] for name in ("error_deg", "nees"))
    return (
        len(found),
        f"{np.median(errors):.2f}° / {max(errors):.1f}°",
        f"{np.mean(squares) / 6.0:.2f} / {max(squares) / 6.0:.1f}",
        f"{np.mean([pair['seconds'] for pair in found]):.1f}",
    )
