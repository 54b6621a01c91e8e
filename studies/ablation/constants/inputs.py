"""What the stages of the study are given: frames, segmentations, poses and registered pairs, computed once.

Nothing here depends on a number that is varied: changed packages are imported again (`source`), this module is not.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

from modeler.types import (
    AbstractRegistrar,
    Array,
    BoolArray,
    Frame,
    Posterior,
    RayImage,
    Segmentation,
    ViewPair,
)

Figures = dict[str, float | str]
"""What a stage measures, and a digest of all of it."""
REGISTERED: dict[bytes, Posterior] = {}
"""Posteriors of pairs, by views and prior."""


@final
@dataclass(frozen=True, eq=False)
class Footage:
    """Frames of one capture or rendering."""

    name: str
    frames: Sequence[Frame]
    true_masks: Sequence[BoolArray] | None = None
    """(h, w) of each frame, where they are known."""
    truth: Mapping[int, Array] | None = None
    """camera_from_object (4, 4) by frame number, where it is known."""
    is_focal_exact: bool = False
    step_deg: float | None = None
    """Of a turntable about an unknown axis; None: any motion."""
    found: list[Segmentation] = field(default_factory=list)
    """With the default numbers."""

    @property
    def masked(self) -> list[Frame]:
        """The frames with the masks found, as given ones."""
        return [replace(frame, mask=one.mask) for frame, one in zip(self.frames, self.found, strict=True)]


@final
@dataclass(frozen=True, eq=False)
class Posed:
    """Views with the poses of a run."""

    name: str
    views: Mapping[int, RayImage]
    trajectory: Mapping[int, Array]
    covariances: Mapping[int, Array]


@final
@dataclass(frozen=True)
class Recalling(AbstractRegistrar):
    """A registrar that registers the same views with the same prior once."""

    registers: AbstractRegistrar
    """The method."""

    @property
    def least_effort(self) -> float:
        """That of the method."""
        return self.registers.least_effort

    def posterior_of(self, pair: ViewPair) -> Posterior:
        """Return the posterior of target_from_source."""
        state = pair.rng.bit_generator.state
        key = digest((self.registers, pair.source.points_m, pair.target.points_m, pair.density, state, pair.effort))
        if key not in REGISTERED:
            REGISTERED[key] = self.registers.posterior_of(pair)
        return REGISTERED[key]


def digest(value: Any) -> bytes:
    """Return a hash of a value's bytes."""
    return hashlib.sha1(pickle.dumps(value), usedforsecurity=False).digest()
