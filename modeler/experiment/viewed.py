"""Pairs of frames with their views, of which no more are kept than are needed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from typing import TypeVar

from modeler.experiment.pairing import Pair

_View = TypeVar("_View")


def viewed(pairs: Iterable[Pair], view: Callable[[int], _View]) -> Iterator[tuple[Pair, _View, _View]]:
    """Yield pairs with the views of source and target.

    A view is made when it is first asked for and let go after the last pair of the same offset that has it, so that of
    a sequence however long about as many are kept as the offset counts frames; of a closed one, twice as many.

    Args:
        pairs: offset by offset.
        view: makes the view of a frame number.
    """
    for _, group in groupby(pairs, key=lambda pair: pair.offset):
        together = list(group)
        last = {frame: number for number, pair in enumerate(together) for frame in (pair.source, pair.target)}
        kept: dict[int, _View] = {}
        for number, pair in enumerate(together):
            for frame in sorted((pair.source, pair.target)):
                if frame not in kept:
                    kept[frame] = view(frame)
            yield pair, kept[pair.source], kept[pair.target]
            for frame in (pair.source, pair.target):
                if last[frame] == number:
                    del kept[frame]
