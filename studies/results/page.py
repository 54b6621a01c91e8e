"""Pages whose figures come from files: docs/results.md, and the README's line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import Final

from studies.results.tables import Table, between

_ROOT: Final = Path(__file__).parents[2]
PAGE: Final = _ROOT / "docs" / "results.md"
README: Final = _ROOT / "README.md"
TEMPLATE: Final = Path(__file__).with_name("page.md")
"""The prose of PAGE, with `{{name}}` in place of each table."""
PLACE: Final = re.compile(r"^\{\{(\w+)\}\}$", re.MULTILINE)
_GENERATED: Final = "<!-- `make results` writes this page from studies/results/; change it there -->\n\n"
_BEGIN: Final = "<!-- figures: captures -->"
_END: Final = "<!-- /figures -->"
_NUMBERS: Final = "no one two three four five six seven eight nine ten eleven twelve".split()


def rendered(tables: Mapping[str, Table]) -> str:
    """Return the text of PAGE."""
    return _GENERATED + PLACE.sub(lambda place: tables[place[1]].markdown(), TEMPLATE.read_text())


def readme(text: str, tables: Mapping[str, Table]) -> str:
    """Return the text of the README with its line of figures as the files have them."""
    return between(text, _BEGIN, _END, fill(_captures(tables), 120))


def _captures(tables: Mapping[str, Table]) -> str:
    """Return a sentence on whole runs: frames placed, errors, statuses, time."""
    captures = tables["captures"]
    cells = dict(zip(captures.columns, zip(*captures.rows, strict=True), strict=True))
    frames = [tuple(map(int, str(one).split(" of "))) for one in cells["frames placed"]]
    placed, given = (sum(counts) for counts in zip(*frames, strict=True))
    share = "all" if placed == given else f"{placed} of {given}"
    errors = [found[0] for one in cells["largest error (median)"] if (found := re.match(r"[\d.]+", str(one)))]
    trusted = sum(one == 0 for one in cells["exit status"])
    build = next(row for row in tables["speed_builds"].rows if str(row[0]).startswith("cap,"))
    _, count, size, _ = str(build[0]).split(", ")
    return (
        f"**On {_NUMBERS[len(frames)]} real captures** (Kinect 1, D415, D435, laser; {min(n for _, n in frames)} to"
        f" {max(n for _, n in frames)} frames) {share} frames are placed,"
        f" largest rotation errors are {min(errors, key=float)}° to {max(errors, key=float)}° where truth is known,"
        f" {_NUMBERS[trusted]} models can be trusted, and {count} of {size} take {float(build[1]):.0f} s on two cores."
    )
