"""The poses of a robot's hand by time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from modeler import se3
from modeler.types.base import Array, InputError
from modeler.types.views import Frame

_SAME_TIME_S = 1e-3  # largest time difference of simultaneous poses and frames


@dataclass(frozen=True, eq=False)
class HandPoses:
    """The poses of a hand by time, interpolated in between."""

    times_s: Array = field(repr=False)
    """(n,) increasing, on the clock of the frames."""
    camera_from_hand: Array = field(repr=False)
    """(n, 4, 4) poses of the hand in camera coordinates."""
    max_gap_s: float = 1.0
    """Poses farther apart in time than this are not interpolated."""
    name: str = "the hand's trajectory"
    """Source of the poses, for messages."""

    def at(self, frame: Frame) -> tuple[Array, Array]:
        """Return the hand's pose (4, 4) at a frame, and its standard deviation (2,) from interpolation: rad, m.

        Raises:
            InputError: if there are no poses near enough in time.
        """
        after = int(np.searchsorted(self.times_s, frame.time_s))
        for number in (after - 1, after):
            if 0 <= number < len(self.times_s) and abs(self.times_s[number] - frame.time_s) <= _SAME_TIME_S:
                return self.camera_from_hand[number], np.zeros(2)
        if not 0 < after < len(self.times_s):
            raise InputError(
                f"{self.name}: has no pose for frame {frame.index} at {frame.time_s:g} s, its times are "
                f"{self.times_s[0]:g} to {self.times_s[-1]:g} s; leave the frame out or complete the file"
            )
        gap_s = float(self.times_s[after] - self.times_s[after - 1])
        if gap_s > self.max_gap_s + _SAME_TIME_S:
            raise InputError(
                f"{self.name}: has no pose for frame {frame.index} at {frame.time_s:g} s, those around it are "
                f"{gap_s:g} s apart; complete the file, or allow larger gaps (max_gap_s)"
            )
        before, behind = self.camera_from_hand[after - 1], self.camera_from_hand[after]
        share = (frame.time_s - self.times_s[after - 1]) / gap_s
        way = se3.log(se3.inverse(before) @ behind)
        # At the middle, the standard deviation is a quarter of the way, for a hand with uneven speed.
        error = share * (1.0 - share) * np.array([np.linalg.norm(way[:3]), np.linalg.norm(way[3:])])
        return before @ se3.exp(share * way), error
