"""Pages whose figures come from files: the regions between `<!-- kind: name -->` and `<!-- /kind -->`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import Final

from studies.results.tables import Table

_ROOT: Final = Path(__file__).parents[2]
PAGES: Final = (
    *(_ROOT / "docs" / f"{name}.md" for name in ("results", "measurements", "ablation")),
    _ROOT / "README.md",
)
REGION: Final = re.compile(r"^<!-- (table|figures): (\w+) -->\n(.*?)^<!-- /\1 -->$", re.MULTILINE | re.DOTALL)
"""Kind, name and present text of what a file holds: a whole table, or a sentence made of it."""
_NUMBERS: Final = "no one two three four five six seven eight nine ten eleven twelve".split()


def rendered(page: str, tables: Mapping[str, Table]) -> str:
    """Return the text of a page with the tables, and sentences on them, as their files have them."""

    def region(found: re.Match[str]) -> str:
        kind, name = found[1], found[2]
        inner = f"\n{tables[name].markdown()}\n" if kind == "table" else fill(_SENTENCES[name](tables), 120)
        return f"<!-- {kind}: {name} -->\n{inner}\n<!-- /{kind} -->"

    return REGION.sub(region, page)


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
        f"**On {_NUMBERS[len(frames)]} real captures** (Kinect 1 and 2, Xtion, D415, D435, laser;"
        f" {min(n for _, n in frames)} to {max(n for _, n in frames)} frames) {share} frames are placed,"
        f" largest rotation errors are {min(errors, key=float)}° to {max(errors, key=float)}° where truth is known,"
        f" {_NUMBERS[trusted]} models can be trusted, and {count} of {size} take {float(build[1]):.0f} s on two cores."
    )


_SENTENCES: Final = {"captures": _captures}
