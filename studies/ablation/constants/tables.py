"""What changing each number changes: condensed results, and the tables of the page that states them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any, Final

from studies.results.tables import markdown

RESULTS: Final = Path(__file__).with_name("results.json")
"""What has been measured, in brief."""
_FIGURES: Final = {
    "iou": "IoU with the default's masks",
    "outcomes": "other outcomes",
    "planes": "support planes",
    "tilt_deg": "sd of their tilt, °",
    "offset_mm": "sd of their place, mm",
    "true_iou": "IoU with the truth",
    "apart_mm": "distance of left-out views, mm",
    "missing": "missing",
    "through": "in free space",
    "vertices": "vertices",
    "volume_cm3": "volume, cm³",
    "found": "symmetries",
    "matches": "alignments",
    "error_deg": "error, °",
    "sigma_deg": "sd, °",
    "placed": "frames placed",
    "edges": "edges",
    "taking_part": "that take part",
    "usable": "usable pairs",
    "largest_deg": "largest error, °",
    "nees": "NEES/3",
}
_NO_FIGURES: Final = ("number", "factor", "stage", "input", "digest", "seconds")
_TOLERANCE: Final = 1e-3  # relative, below which figures count as the same
_BEGIN: Final = "<!-- the tables of `python -m studies ablation.constants --table` -->"
_END: Final = "<!-- end of the tables -->"


def condense(measured: Path, results: Path) -> None:
    """Write, for each number, on how many inputs it was tried and the figures of the first that shows a difference.

    Args:
        measured: a line a measurement, of `sweep.run`.
        results: JSON file to write.
    """
    records = [json.loads(line) for line in measured.read_text().splitlines()]
    defaults = {(one["stage"], one["input"]): one for one in records if not one["number"]}
    numbers: dict[str, dict[str, Any]] = {}
    for one in records:
        if not one["number"]:
            continue
        case, way = (one["stage"], one["input"]), "halved" if one["factor"] < 1.0 else "doubled"
        mine = numbers.setdefault(one["number"], {}).setdefault(way, {"inputs": 0})
        mine["inputs"] += 1
        if one.get("digest") != defaults[case].get("digest") and "input" not in mine:
            mine |= {"stage": one["stage"], "input": one["input"], "figures": _changed(one, defaults[case])}
            numbers[one["number"]][way] = mine
    lines = ",\n".join(f" {json.dumps(name)}: {json.dumps(found)}" for name, found in numbers.items())
    results.write_text("{\n" + lines + "\n}\n")


def _changed(record: Mapping[str, Any], default: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of a record that differ from the default's, with both."""
    if "error" in record:
        return {"error": record["error"]}
    return {
        name: [_rounded(default[name]), _rounded(record[name])]
        for name in record
        if (name in _FIGURES or (record["stage"] == "densities" and name not in _NO_FIGURES))
        and _differ(record[name], default[name])
    }


def _differ(one: float | str, other: float | str) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return one != other
    return abs(one - other) > _TOLERANCE * abs(other)


def _rounded(value: float | str) -> float | str:
    return value if isinstance(value, str) else float(f"{value:.4g}")


def table(results: Path) -> str:
    """Return the tables in Markdown: the numbers of each room, and what halving and doubling each one changes."""
    found: dict[str, dict[str, Any]] = json.loads(results.read_text())
    rooms: dict[str, list[str]] = {}
    for name in found:
        rooms.setdefault(name.partition(".")[0], []).append(name)
    parts = [_summary(rooms, found)]
    for room, names in rooms.items():
        kinds = {name: _kind(found[name]) for name in names}
        rows = [
            (name.partition(".")[2], *(_words(found[name].get(way)) for way in ("halved", "doubled")))
            for name, kind in kinds.items()
            if kind != "none"
        ]
        parts.append(f"### {room.capitalize()}\n\n" + markdown(("number", "halved", "doubled"), rows))
        same = [f"`{name.partition('.')[2]}`" for name, kind in kinds.items() if kind == "none"]
        if same:
            parts.append(fill(f"The same on all inputs: {', '.join(same)}.", 120, break_on_hyphens=False))
    return "\n\n".join(parts)


def on_page(page: str, tables: str) -> str:
    """Return the text of the page with these tables between its two marks."""
    before, _, rest = page.partition(_BEGIN)
    _, _, after = rest.partition(_END)
    return f"{before}{_BEGIN}\n\n{tables}\n\n{_END}{after}"


def _summary(rooms: Mapping[str, Sequence[str]], found: Mapping[str, Mapping[str, Any]]) -> str:
    rows = []
    for room, names in rooms.items():
        kinds = [_kind(found[name]) for name in names]
        rows.append((room, str(len(names)), *(str(kinds.count(kind)) for kind in ("none", "bits", "figures"))))
    return markdown(("room", "numbers", "no effect", "effect below 0.1 %", "effect"), rows)


def _kind(ways: Mapping[str, Mapping[str, Any]]) -> str:
    """Return whether a number changes nothing, only bits, or figures."""
    if not any("input" in way for way in ways.values()):
        return "none"
    return "figures" if any(way.get("figures") for way in ways.values()) else "bits"


def _words(way: Mapping[str, Any] | None) -> str:
    if way is None:
        return ""
    if "input" not in way:
        return f"the same on {way['inputs']}"
    figures = way["figures"]
    if "error" in figures:
        return f"{way['input']}: {figures['error']}"
    changes = [
        f"{_FIGURES.get(name, f'log density of {name}')} {before} → {after}"
        for name, (before, after) in figures.items()
    ]
    return f"{way['input']}: {'; '.join(changes) or 'figures the same to 0.1 %'}"
