"""Sequences with another focal length than they say: as `modeler calibrate-camera` estimated it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import final

from modeler.types import Frame, InputError
from sequences.base import AbstractDerived
from sequences.input_files import read_tree

_ALIKE = 1e-3  # relative: files round what they say


@final
@dataclass(frozen=True)
class FocalFactor:
    """The focal length of a camera, relative to what its sequences say."""

    factor: float
    """True focal length relative to the stated one, the same for fx and fy."""
    stated_px: float
    """fx as the sequence states it."""

    def text(self, facts: Mapping[str, object]) -> str:
        """Return the file of the factor, with what else is known; null for numbers that are not."""
        said = {"schema": 1, "focal_factor": self.factor, "stated_fx_px": self.stated_px}
        known = {name: None if isinstance(fact, float) and not isfinite(fact) else fact for name, fact in facts.items()}
        return json.dumps(said | known, indent=1, allow_nan=False) + "\n"


def read_focal_factor(path: Path) -> FocalFactor:
    """Read a factor that `modeler calibrate-camera` has stored.

    Raises:
        InputError: where the file is missing or says something else.
    """
    node = read_tree(path)
    return FocalFactor(node.need("focal_factor").number(0.5, 2.0), node.need("stated_fx_px").number(1.0, 1e6))


@final
@dataclass(frozen=True)
class RefocusedSequence(AbstractDerived):
    """Another sequence, whose camera has this focal length."""

    focal: FocalFactor
    """The focal length."""

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`.

        Raises:
            InputError: where its camera is not the one that the focal length is of.
        """
        return self._refocused(self.whole.frame(index))

    def __iter__(self) -> Iterator[Frame]:
        """Read the frames in order."""
        return map(self._refocused, self.whole)

    def select(self, every: int = 1, frames: slice | None = None) -> RefocusedSequence:
        """Return a part of the sequence."""
        return replace(self, whole=self.whole.select(every, frames))

    def _refocused(self, frame: Frame) -> Frame:
        camera, focal = frame.camera, self.focal
        if abs(camera.fx / focal.stated_px - 1.0) > _ALIKE:
            raise InputError(
                f"{self.name}: frame {frame.index} has fx {camera.fx:g} px where the calibrated camera states "
                f"{focal.stated_px:g}; give the calibration of this camera"
            )
        return replace(frame, camera=replace(camera, fx=camera.fx * focal.factor, fy=camera.fy * focal.factor))
