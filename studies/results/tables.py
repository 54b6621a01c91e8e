"""Tables of figures: what a file holds, and its Markdown."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parent
NOT_KNOWN: Final = "not known"
"""In place of a commit or a study that was not noted."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of figures, with how to measure them."""

    study: str
    """Name under `python -m studies`, or the command of modeler that measures, or NOT_KNOWN."""
    command: tuple[str, ...]
    """Lines for a shell that measure the figures; none if the page has them, or no command measures them any more."""
    commit: str
    """Short hash of the commit that was measured, or NOT_KNOWN where none was noted; then those of single rows."""
    columns: tuple[str, ...]
    """Titles, in Markdown."""
    rows: tuple[tuple[str | float, ...], ...]
    """Cells of each row, in Markdown or as numbers."""
    note: tuple[str, ...]
    """What else was measured, and what the figures mean: one item of a list each, in Markdown."""

    def markdown(self) -> str:
        """Return the commands, the table, the commit where it is known, and the notes."""
        parts = ["```sh\n" + "\n".join(self.command) + "\n```"] if self.command else []
        parts.append(markdown(self.columns, self.rows))
        if self.commit != NOT_KNOWN:
            parts.append(f"*Commit: {self.commit.removeprefix(f'{NOT_KNOWN}; ')}.*")
        if self.note:
            parts.append("\n".join(f"- {item}" for item in self.note))
        return "\n\n".join(parts)

    def text(self) -> str:
        """Return what a file holds: a line a row, so that changes show as such."""
        parts = []
        for name, found in asdict(self).items():
            value = json.dumps(found, ensure_ascii=False)
            if name in ("command", "rows", "note") and found:
                lines = ",\n".join(f"  {json.dumps(one, ensure_ascii=False)}" for one in found)
                value = f"[\n{lines}\n ]"
            parts.append(f' "{name}": {value}')
        return "{\n" + ",\n".join(parts) + "\n}\n"


def record(path: Path, rows: Sequence[Sequence[str | float]]) -> None:
    """Put measured rows into a file in place of those with the same first cell, with the commit of this tree.

    Args:
        path: file of the table.
        rows: rows measured now, each with a cell a column.

    Raises:
        ValueError: the table has no row that begins as one of them.
    """
    table = read(path)
    measured = {row[0]: tuple(row) for row in rows}
    if unknown := set(measured) - {row[0] for row in table.rows}:
        raise ValueError(f"{path}: no row begins with {', '.join(map(str, sorted(unknown, key=str)))}")
    describe = ["git", "describe", "--always", "--dirty", "--exclude", "*", "--abbrev=7"]
    commit = subprocess.run(describe, cwd=FOLDER, capture_output=True, text=True, check=True).stdout.strip()
    if len(measured) < len(table.rows):
        names = " and ".join(map(str, measured))
        others = [part for part in table.commit.split("; ") if not part.startswith(f"{names}: ")]
        commit = "; ".join([*others, f"{names}: {commit}"])
    new = tuple(measured.get(row[0], row) for row in table.rows)
    path.write_text(replace(table, rows=new, commit=commit).text())


def read(path: Path) -> Table:
    """Return the table of a file.

    Raises:
        TypeError: the file has other keys than a table has fields.
        ValueError: a row has not as many cells as there are columns.
    """
    found = json.loads(path.read_text())
    rows = tuple(tuple(row) for row in found.pop("rows"))
    commit, study = found.pop("commit"), found.pop("study")
    table = Table(study=study, commit=commit, rows=rows, **{name: tuple(items) for name, items in found.items()})
    if any(len(row) != len(table.columns) for row in rows):
        raise ValueError(f"{path}: a row has not as many cells as there are columns")
    return table


def read_all() -> dict[str, Table]:
    """Return the tables of all files by name."""
    return {path.stem: read(path) for path in sorted(FOLDER.glob("*.json"))}


def markdown(columns: Sequence[str], rows: Sequence[Sequence[str | float]]) -> str:
    """Return a table of Markdown."""
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, row))} |" for row in rows)])
