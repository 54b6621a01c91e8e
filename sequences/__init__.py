"""Readers of depth-camera sequences, and the renderer that makes synthetic ones."""

from pathlib import Path

from sequences.base import AbstractSequence as AbstractSequence
from sequences.base import frame_range as frame_range
from sequences.bop import BopSequence as BopSequence
from sequences.bop_writer import write_bop as write_bop


def open_sequence(path: str | Path) -> AbstractSequence:
    """Open the sequence in a folder.

    Raises:
        InputError: where the folder does not hold a readable sequence.
    """
    return BopSequence(Path(path))
