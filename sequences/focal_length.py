"""Sequences with a corrected focal length and depth scale, as estimated by `modeler calibrate-camera`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Literal, final

import numpy as np

from modeler.sequences.base import AbstractDerived
from modeler.sequences.input_files import read_tree
from modeler.types import Frame, InputError, SensorNoise

_ALIKE = 1e-3  # relative: files have rounded values


@final
@dataclass(frozen=True)
class FocalFactor:
    """The focal length and the depth scale of a camera, relative to those in its sequences."""

    factor: float
    """True focal length relative to the given one, the same for fx and fy."""
    stated_px: float
    """Given fx of the sequence."""
    depth_scale: float = 1.0
    """True depth relative to the given one: scales the model and the distances of its poses alike."""
    depth_scale_sigma: float = 0.0
    """Standard deviation of the depth scale's logarithm; 0 = known, or not asked about."""
    factor_sigma: float = 0.0
    """Standard deviation of the factor's logarithm; 0 = not estimated."""
    told_by: Literal["loop", "prior"] = "prior"
    """Whether loops determined the factor."""

    def values(self) -> dict[str, float | str]:
        """Return its values, under the names of its file and of report.json."""
        return {
            "focal_factor": self.factor,
            "focal_factor_sigma": self.factor_sigma,
            "depth_scale": self.depth_scale,
            "depth_scale_sigma": self.depth_scale_sigma,
            "told_by": self.told_by,
        }

    def text(self, facts: Mapping[str, object]) -> str:
        """Return the file of the factor, with further values; null for unknown numbers."""
        said = {"schema": 1, "stated_fx_px": self.stated_px, **self.values()}
        known = {name: None if isinstance(fact, float) and not isfinite(fact) else fact for name, fact in facts.items()}
        return json.dumps(said | known, indent=1, allow_nan=False) + "\n"


def read_focal_factor(path: Path) -> FocalFactor:
    """Read a factor that `modeler calibrate-camera` has stored.

    Raises:
        InputError: if the file is missing or says something else.
    """
    node = read_tree(path)
    return FocalFactor(
        node.need("focal_factor").number(0.5, 2.0),
        node.need("stated_fx_px").number(1.0, 1e6),
        1.0 if (scale := node.get("depth_scale")) is None else scale.number(0.5, 2.0),
        0.0 if (sigma := node.get("depth_scale_sigma")) is None else sigma.number(0.0, 1.0),
        0.0 if (error := node.get("focal_factor_sigma")) is None else error.number(0.0, 1.0),
        "loop" if (teller := node.get("told_by")) is not None and teller.text() == "loop" else "prior",
    )


@final
@dataclass(frozen=True)
class RefocusedSequence(AbstractDerived):
    """Another sequence, whose camera has this focal length and depth scale."""

    focal: FocalFactor
    """The focal length."""

    def sensor(self) -> SensorNoise | None:
        """Return the noise of its camera, with the uncertainty of its focal length; None if unknown."""
        noise = self.whole.sensor()
        if self.focal.told_by != "loop" or self.focal.factor_sigma == 0.0:
            return noise
        return (SensorNoise() if noise is None else noise)._replace(sigma_focal=self.focal.factor_sigma)

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`.

        Raises:
            InputError: if its camera is not the one that the focal length is of.
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
                f"{self.name}: frame {frame.index} has fx {camera.fx:g} px where the calibrated camera has "
                f"{focal.stated_px:g}; give the calibration of this camera"
            )
        refocused = replace(camera, fx=camera.fx * focal.factor, fy=camera.fy * focal.factor)
        return replace(frame, camera=refocused, depth_m=frame.depth_m * np.float32(focal.depth_scale))
