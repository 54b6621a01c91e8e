"""Whether a recording was written to its end."""

from __future__ import annotations

import os
from pathlib import Path

from modeler.regular_files import open_regular

_BEGINS, _ENDS = b"RRF2", b"FOOT"
_LAST = 64  # bytes in which the end is told


def ends_whole(recording: Path) -> bool:
    """Return whether a recording has its end, which one lacks that was cut off by a kill or a full disk.

    Of other formats than today's nothing is known: they count as whole.
    """
    with open_regular(recording) as file:
        if file.read(len(_BEGINS)) != _BEGINS:
            return True
        file.seek(max(0, os.fstat(file.fileno()).st_size - _LAST))
        return _ENDS in file.read()
