"""Which frames of a sequence are registered with each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, final


class Pair(NamedTuple):
    """Two frames, one to be registered to the other."""

    source: int
    """Frame number of the source."""
    target: int
    """Frame number of the target."""
    offset: int
    """Frames from one to the other, in the order of the sequence."""


@final
@dataclass(frozen=True)
class Pairing:
    """Which frames are registered with each other."""

    offsets: tuple[int, ...] = (1,)
    """How many frames source and target are apart, in the order of the sequence; each offset is a table."""
    both_ways: bool = False
    """Register each pair in both directions, not only the later frame to the earlier."""
    closed: bool = False
    """The sequence is a full turn: its last frame is followed by its first."""

    @property
    def loops(self) -> bool:
        """Whether each frame is registered to the one before it all the way round: together they should do nothing."""
        return self.closed and not self.both_ways and self.offsets == (1,)

    def pairs(self, indices: Sequence[int]) -> Iterator[Pair]:
        """Yield every pair of these frame numbers, offset by offset."""
        count = len(indices)
        for offset in self.offsets:
            for position in range(count if self.closed else count - offset):
                earlier, later = indices[position], indices[(position + offset) % count]
                if earlier != later:
                    yield Pair(later, earlier, offset)
                    if self.both_ways:
                        yield Pair(earlier, later, offset)
