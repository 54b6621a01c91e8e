"""The sequences of a batch: their names, and the table that lists them."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path

from modeler.batch.jobs import NOTES, read_note
from modeler.cli.options import AbstractBuild
from modeler.types import InputError

_YES, _NO = ("yes", "true", "1"), ("no", "false", "0")
_FLAGS = {"colour": ("--no-colour", _NO)}  # and the answers that give them
_FLAGS |= {name: (f"--{name}", _YES) for name in ("strict-paths", "along-ray", "despite-doubts")}
_LONGEST = 100  # characters of a name; with an ending, a file system takes 255 bytes


@dataclass(frozen=True)
class Row:
    """A sequence of a batch."""

    sequence: Path
    place: str
    """Where it is named, for messages."""
    name: str = ""
    """Of its run folder; "": after the sequence."""
    arguments: tuple[str, ...] = ()
    """Options of `modeler build` for it alone."""


def read_manifest(path: Path, common: tuple[str, ...] = ()) -> list[Row]:
    """Return the rows of a table in CSV.

    Args:
        path: the file; paths in it are taken as on the command line.
        common: default options for every row.
    """
    from modeler.sequences.input_files import read_text

    try:
        lines = csv.DictReader(io.StringIO(read_text(path, "CSV"), newline=""), strict=True)
        columns = {column: column.strip().replace("_", "-") for column in lines.fieldnames or ()}
        rows = list(lines)
    except csv.Error as error:
        raise InputError(f"{path}: is not a CSV table ({error}); correct it") from None
    groups = [group.default_factory() for group in fields(AbstractBuild) if callable(group.default_factory)]
    flags = [one.name.replace("_", "-") for group in groups for one in fields(group)]
    known = ("sequence", "name", *flags)
    if "sequence" not in columns.values():
        raise InputError(f"{path}: has no column sequence; write one line of names, and a row for each sequence")
    strange = [column for column in columns.values() if column not in known]
    if strange or len(set(columns.values())) < len(columns):
        wrong = f"column {strange[0]} is not an option of modeler build" if strange else "a column occurs twice"
        raise InputError(f"{path}: {wrong}; it takes {', '.join(known)}")
    found = []
    for number, cells in enumerate(rows, start=2):
        place = f"{path}: row {number}"
        if None in cells or None in cells.values():
            raise InputError(f"{place} has a different number of cells than columns; correct it")
        values = {columns[column]: cell.strip() for column, cell in cells.items()}
        if not values["sequence"]:
            raise InputError(f"{place} names no sequence; correct it")
        options = {column: cell for column, cell in values.items() if column in flags and cell}
        try:
            arguments = _arguments(tuple(options.items()), common)
        except InputError as error:
            raise InputError(f"{place}: {error}") from None
        found.append(Row(Path(values["sequence"]), place, values.get("name", ""), arguments))
    return found


@cache
def _arguments(options: tuple[tuple[str, str], ...], common: tuple[str, ...]) -> tuple[str, ...]:
    """Return the options of a row as `modeler build` takes them."""
    words: list[str] = []
    for column, cell in options:
        if column in _FLAGS:
            if cell.lower() not in (*_YES, *_NO):
                raise InputError(f"{column} is {cell}; write yes or no")
            flag, given = _FLAGS[column]
            words += [flag] * (cell.lower() in given)
        else:
            words += [f"--{column}", *([cell] if column in ("sensor", "camera") else cell.split())]
    return _checked(tuple(words), common)


def _checked(words: tuple[str, ...], common: tuple[str, ...]) -> tuple[str, ...]:
    """Return options in canonical form: files by absolute paths, defaults removed."""
    from modeler.cli import parsed
    from modeler.cli.build import Build

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            build = parsed(("build", "SEQUENCE", "--out", "RUN", *common, *words))
            alone = parsed(("build", "SEQUENCE", "--out", "RUN", *words)) if words else None
    except SystemExit:
        what = " ".join(said.getvalue().split()).removeprefix("modeler: ").removesuffix("; see modeler build --help")
        raise InputError(what) from None
    assert isinstance(build, Build)
    if alone is None:
        return ()
    assert isinstance(alone, Build)
    return alone.arguments()


def named(rows: Sequence[Row], out: Path) -> Mapping[str, Row]:
    """Return sequences by the names of their run folders, in order.

    A sequence that is in the folder keeps its name. Others are called as their file or folder, and where that name is
    taken, with a few digits more, which depend on nothing but their path.
    """
    notes = sorted((out / NOTES).glob("*.json")) if (out / NOTES).is_dir() else []
    known = {str(read_note(note).get("sequence", "")): note.stem for note in notes}
    taken = {name.casefold() for name in known.values()}
    given = {row.name.casefold() for row in rows if row.name}
    found: dict[str, Row] = {}
    used: set[str] = set()
    paths: dict[str, str] = {}
    for row in rows:
        path = str(row.sequence.absolute())
        if not row.name and path in paths:
            raise InputError(f"{row.place}: is the same sequence as {paths[path]}; leave it out, or give both a name")
        if not row.name:
            paths[path] = row.place
        name = row.name or known.get(path) or _free(row.sequence, path, taken | given | used)
        if name != _clean(name):
            raise InputError(f"{row.place}: {name} is not a valid folder name; use letters, digits, and - _ . + within")
        if name.casefold() in used:
            raise InputError(f"{row.place}: the name {name} is given twice; give each its own")
        used.add(name.casefold())
        found[name] = row
    return found


def _free(sequence: Path, path: str, taken: set[str]) -> str:
    """Return a name for a sequence that nothing else has."""
    name = _clean(Path(path).stem if sequence.is_file() else Path(path).name) or "sequence"
    if name.casefold() in taken:
        name = f"{name}-{hashlib.blake2b(path.encode(errors='surrogateescape'), digest_size=4).hexdigest()}"
    return name


def _clean(name: str) -> str:
    """Return the name reduced to portable characters, and different from our files."""
    kept = re.sub(r"[^\w.+-]+", "_", name)[:_LONGEST].strip(".")
    return f"{kept}_" if kept.casefold() in ("models.parquet", "gallery.html") else kept
