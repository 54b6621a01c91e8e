"""Everything that can lie where a regular file is expected: each must be refused in one line, never waited for."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

HUGE_BYTES: Final = 1 << 40


def _fifo(path: Path) -> None:
    os.mkfifo(path)


def _socket(path: Path) -> None:
    here = Path.cwd()
    with socket.socket(socket.AF_UNIX) as listening:
        os.chdir(path.parent)  # addresses are short
        try:
            listening.bind(path.name)
        finally:
            os.chdir(here)


def _huge(path: Path) -> None:
    """Write an empty file of a size that no memory holds; it takes no room on the disk."""
    with path.open("wb") as file:
        file.truncate(HUGE_BYTES)


SPECIAL: Final[Mapping[str, Callable[[Path], object]]] = {
    "FIFO": _fifo,
    "socket": _socket,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "terminal": lambda path: path.symlink_to("/dev/tty"),
    "folder": lambda path: path.mkdir(),
    "link to nothing": lambda path: path.symlink_to("nowhere"),
    "loop of links": lambda path: path.symlink_to(path.name),
    "empty file": lambda path: path.write_bytes(b""),
    "huge sparse file": _huge,
}
"""What makes each of them at a path where nothing is."""


def replace_by(kind: str, path: Path) -> None:
    """Put one of them where something else is."""
    remove(path)
    SPECIAL[kind](path)


def lengthen(path: Path) -> None:
    """Let a file end in a hole that no memory holds."""
    os.truncate(path, HUGE_BYTES)


def remove(path: Path) -> None:
    """Remove whatever is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
