"""Tables of the study of colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from studies.colour.study import ALIGNED, PRIORS, RIGHT_DEG
from studies.results.tables import markdown

Outcome = Mapping[str, Any]
_CODE = "colour_misaligned"
_SIGMAS: Final = 3.0  # of a wide result that is right


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
        rows += [
            (f"{part}, all", *counts([one for one in built if one["part"] == part]))
            for part in dict.fromkeys(part for part, _ in names)
        ]
        parts.append(markdown(columns, rows))
        aligned = [one for one in built if one["part"] == "aligned"]
        textures = tuple(dict.fromkeys(one["texture"] for one in aligned))
        if aligned:
            parts.append(markdown(("body", *textures), models(aligned, textures)))
    captures = [one for one in outcomes if one["part"] == "captures" and "codes" in one]
    if captures:
        columns = ("capture, colour", "placed", "status", "reasons", "loop", "error, median / largest", "built in")
        parts.append(markdown(columns, [capture(one) for one in captures]))
    if pairs := [one for one in outcomes if one["part"] == "pairs"]:
        parts += [markdown(EFFECTS, effects(pairs)), markdown(BODIES, bodies(pairs))]
    return "\n\n".join(parts)


def _of(built: Sequence[Outcome], part: str, kind: str) -> list[Outcome]:
    return [one for one in built if one["part"] == part and kind in (one["texture"], one["way"])]


def counts(outcomes: Sequence[Outcome]) -> tuple[int, ...]:
    """Return numbers of sequences, and of those named by edges, by the run, by either, and with status 0."""
    before = [bool(one["before"]) for one in outcomes]
    run = [_CODE in one["codes"] for one in outcomes]
    either = sum(a or b for a, b in zip(before, run, strict=True))
    return len(outcomes), sum(before), sum(run), either, sum(one["status"] == 0 for one in outcomes)


def models(outcomes: Sequence[Outcome], textures: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the errors and exit statuses of models, a row a body with a cell a texture."""
    rows = []
    for body in dict.fromkeys(one["body"] for one in outcomes):
        cells = []
        for texture in textures:
            some = [one for one in outcomes if (one["body"], one["texture"]) == (body, texture)]
            cells.append("; ".join(f"{_pose_errors(one)}, {one['status']}" for one in some))
        rows.append((body, *cells))
    return rows


def _pose_errors(one: Outcome) -> str:
    """Return the median and the largest rotation error of a build."""
    errors = one["errors_deg"]
    return "-" if errors is None else f"{errors[0]:.2f}° / {errors[1]:.2f}°"


def capture(one: Outcome) -> tuple[str, ...]:
    """Return the row of a build of a capture."""
    loop = one["loop_sd"]
    return (
        f"`{one['body']}`" if one["way"] == ALIGNED else f"`{one['body']}`, {one['way']}",
        one["placed"],
        str(one["status"]),
        ", ".join(one["codes"]) + (" (edges)" if one["before"] else ""),
        "-" if loop is None else f"{loop:.1f} sd",
        _pose_errors(one),
        f"{one['built_s']:.0f} s",
    )


EFFECTS: Final = ("light and camera", "usable: error", "NEES/6", "right", "plain: sd", "NEES/6", "right")
BODIES: Final = ("body", *(f"{prior} prior: {what}" for prior in PRIORS for what in ("error", "sd", "NEES/6", "right")))


def effects(outcomes: Sequence[Outcome]) -> list[tuple[str, ...]]:
    """Return the rows of usable pairs by what is wrong with light or camera, and prior."""
    rows = []
    for effect in dict.fromkeys(one["way"] for one in outcomes):
        for prior in PRIORS:
            some = [one for one in outcomes if one["way"] == effect]
            printed, plain = (
                usable([one for one in some if (one["texture"] == "plain") == bare], prior) for bare in (False, True)
            )
            rows.append((f"{effect}, {prior} prior", errors(printed), *trust(printed), width(plain), *trust(plain)))
    return rows


def bodies(outcomes: Sequence[Outcome]) -> list[tuple[str, ...]]:
    """Return the rows of usable pairs by body, under all lights and by all cameras."""
    rows = []
    for body, texture in dict.fromkeys((one["body"], one["texture"]) for one in outcomes):
        some = [one for one in outcomes if (one["body"], one["texture"]) == (body, texture)]
        parts = [usable(some, prior) for prior in PRIORS]
        rows.append(
            (f"{body}, {texture}", *(cell for part in parts for cell in (errors(part), width(part), *trust(part))))
        )
    return rows


def usable(outcomes: Sequence[Outcome], prior: str) -> list[Outcome]:
    """Return the usable pairs under a prior."""
    return [pair for one in outcomes for pair in one["pairs"] if pair["prior"] == prior and pair["usable"]]


def errors(pairs: Sequence[Outcome]) -> str:
    """Return the median and the largest rotation error."""
    found = [pair["error_deg"] for pair in pairs]
    return f"{np.median(found):.2f}° / {max(found):.1f}°"


def width(pairs: Sequence[Outcome]) -> str:
    """Return the median of the standard deviations of rotations."""
    return f"{np.median([pair['sd_deg'] for pair in pairs]):.1f}°"


def trust(pairs: Sequence[Outcome]) -> tuple[str, str]:
    """Return how large squared errors are for their covariances, mean and largest, and how many pairs are right."""
    squares = [pair["nees"] / 6.0 for pair in pairs]
    right = [pair["error_deg"] <= max(RIGHT_DEG, _SIGMAS * pair["sd_deg"]) for pair in pairs]
    return f"{np.mean(squares):.2f} / {max(squares):.1f}", f"{sum(right)} of {len(right)}"
