"""What lies in a folder. Nothing outside it is read: links that lead out are refused."""

from __future__ import annotations

import os
from pathlib import Path

from modeler.types import InputError


def entries(folder: Path) -> list[Path]:
    """Return what lies in a folder by name; nothing where there is no such folder.

    Raises:
        InputError: where it may not be read.
    """
    try:
        return sorted(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror}); check its permissions.") from None


def pictures(folder: Path, suffixes: tuple[str, ...], root: Path) -> dict[str, Path]:
    """Return the pictures of a folder by name without ending; hidden files are none.

    Args:
        folder: where; a folder that is not there has none.
        suffixes: endings in small letters, such as `.png`.
        root: the sequence that the folder belongs to.

    Raises:
        InputError: where the folder may not be read, two pictures share a name, or a link leads out of the sequence.
    """
    found: dict[str, Path] = {}
    for path in entries(inside(folder, root)):
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        if path.stem in found:
            raise InputError(f"{path}: there is {found[path.stem].name} too; remove one of them.")
        found[path.stem] = inside(path, root) if path.is_symlink() else path
    return found


def first_folder(root: Path, names: tuple[str, ...]) -> Path | None:
    """Return the first of some folders that is there."""
    return next((root / name for name in names if (root / name).is_dir()), None)


def inside(path: Path, root: Path) -> Path:
    """Return the path, which must stay in its sequence.

    Raises:
        InputError: where it does not, by a link or by `..`.
    """
    target, home = os.path.realpath(path), os.path.realpath(root)
    if os.path.commonpath([target, home]) != home:
        raise InputError(f"{path}: leads out of the sequence, to {target}; put the file itself there.")
    return path


def frame_number(stem: str) -> int | None:
    """Return the frame number that a name is; None where it is none, or too long to be one."""
    return int(stem) if stem.isascii() and stem.isdigit() and len(stem) <= 9 else None
