"""Output paths of commands: never inside or over an input, and over an earlier result only with `overwrite`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from modeler.types import InputError


def check_folder(out: Path, inputs: Iterable[Path]) -> None:
    """Reject a folder that is, or is inside, an input of the command."""
    found = {name: path for path in inputs for name in _identities(path)}
    place = Path(os.path.realpath(out))
    for part in (place, *place.parents):
        identity = _identity(part)
        source = None if identity is None else found.get(identity)
        if source is not None:
            where = "is" if part == place else "lies in"
            raise InputError(f"{out}: {where} {source}, which is only read; choose another `out`")


def check_files(outs: Sequence[Path], inputs: Sequence[Path], *, overwrite: bool) -> None:
    """Reject files that would change an input, and existing files unless `overwrite` is set."""
    for out in outs:
        check_folder(out, inputs)
        if not os.path.lexists(out):
            continue
        if not out.is_file():
            what = "a folder" if out.is_dir() else "not a regular file"
            raise InputError(f"{out}: is {what}; choose another `out`")
        if _identity(out) in {_identity(file) for file in _files(inputs)}:  # by a hard link, or by a link there
            raise InputError(f"{out}: is a file that is only read; choose another `out`")
        if not overwrite:
            raise InputError(f"{out}: exists already; choose another `out`, or give `overwrite`")


def check_run_folder(out: Path, inputs: Iterable[Path], *, overwrite: bool, resume: bool | None = None) -> None:
    """Reject a run folder with other contents or, unless requested, with another run.

    Args:
        out: folder of the run that the command is about to make.
        inputs: files and folders that it reads.
        overwrite: whether a run may be replaced.
        resume: whether it may be continued; None if the command cannot.
    """
    from modeler.export import RunFolder

    check_folder(out, inputs)
    folder = RunFolder(out)
    folder.check(overwrite=True)
    if not (overwrite or resume or folder.is_empty):
        options = "`overwrite`" if resume is None else "`overwrite` or `resume`"
        raise InputError(f"{out}: not empty; choose another `out`, or give {options}")


def run_inputs(runs: Iterable[Path], moved: Iterable[Path] = ()) -> tuple[Path, ...]:
    """Return run folders with all their inputs: sequences, calibrations, and joined runs."""
    from modeler.export import RunFolder

    found: dict[Path, None] = {}
    waiting = list(runs)
    while waiting:
        run = waiting.pop()
        if run in found:
            continue
        found[run] = None
        try:
            folder = RunFolder(run)
            report = folder.report()
        except InputError:
            continue
        settings = report.get("settings")
        settings = settings if isinstance(settings, dict) else {}
        if isinstance(settings.get("joined"), list):
            waiting += [folder.located(part) for part in settings["joined"] if isinstance(part, str)]
            continue
        if isinstance(settings.get("continues"), str):
            waiting.append(folder.located(settings["continues"]))
        own = str(report.get("sequence")).split(" + ")[-1] if "continues" in settings else report.get("sequence")
        files = (own, settings.get("sensor"), settings.get("camera"))
        found |= {folder.located(file): None for file in files if isinstance(file, str)}
    return (*found, *moved)


def _identities(path: Path) -> Iterator[tuple[int, int]]:
    """Yield identifiers of a file or folder and of the targets of links in it."""
    try:
        places = [path, *(entry for entry in (path.iterdir() if path.is_dir() else ()) if entry.is_symlink())]
    except (OSError, ValueError):  # ValueError: a NUL in the name
        return
    for place in places:
        identity = _identity(place)
        if identity is not None:
            yield identity


def _identity(path: Path) -> tuple[int, int] | None:
    """Return an identifier common to all names of a file or folder; None if it does not exist."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def _files(inputs: Iterable[Path]) -> Iterator[Path]:
    for path in inputs:
        yield path
        for folder, _, names in os.walk(path):
            yield from (Path(folder) / name for name in names)
