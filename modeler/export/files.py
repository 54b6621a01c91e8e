"""Files that are either there and whole, or not there."""

from __future__ import annotations

import os
from pathlib import Path

from modeler.types import InputError

PART = ".part"  # ending of a file that is still being written


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file so that whoever looks at any moment, also after a kill, finds the old one or the new one whole.

    Raises:
        InputError: where the file cannot be written.
    """
    data = content.encode() if isinstance(content, str) else content
    part = path.with_name(f".{path.name}.{os.getpid()}{PART}")
    try:
        try:
            part.write_bytes(data)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place with --out") from error
