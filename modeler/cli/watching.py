"""Input that is still being written."""

from __future__ import annotations

import math
from pathlib import Path

import sequences
from modeler.cli.saying import say
from modeler.types import InputError
from sequences import AbstractSequence


def watched(path: Path, idle_s: float) -> AbstractSequence:
    """Return the sequence that another program is writing at a path, once it has begun.

    Args:
        path: where it writes.
        idle_s: the sequence is over after so many seconds in which nothing came.

    Raises:
        InputError: where nothing readable comes.
    """
    if not 0.0 < idle_s < math.inf:
        raise InputError(f"--idle-s {idle_s:g} is out of range; give a positive number of seconds")
    say(f"waiting for frames in {path}")
    return sequences.watch(path, patience=sequences.Patience(idle_s))
