"""The noise of a depth camera from a few frames of a scene that stands still (the paper asks for it: its L)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import final

import numpy as np

from modeler.types import InputError
from sequences.base import AbstractSequence
from sequences.noise import along
from sequences.noise.across import Border, borders, pooled_px
from sequences.noise.along import Class
from sequences.noise.model import NoiseModel

MOST_FRAMES = 40
"""More frames of a still scene add little."""
MAX_MOVING = 0.02
"""Share of the pixels that may change by more than noise."""


@final
@dataclass(frozen=True)
class Calibration:
    """What a still scene says of its camera."""

    model: NoiseModel
    """The noise."""
    classes: tuple[Class, ...]
    """What was measured along the ray, by distance and angle."""
    borders: tuple[Border, ...]
    """What was measured across it."""
    frames: int
    """From how many frames."""


def calibrate(sequence: AbstractSequence) -> Calibration:
    """Measure the noise of the camera that took a sequence.

    Raises:
        InputError: where the scene moves, or shows too little: fewer than 3 frames, no smooth surface, no border.
    """
    indices = sequence.indices[:MOST_FRAMES]
    if len(indices) < 3:
        raise InputError(f"{sequence.name}: has {len(indices)} frames; record at least 3, better 10, of a still scene.")
    frames = [sequence.frame(index) for index in indices]
    for frame in frames:
        if frame.camera != frames[0].camera:
            raise InputError(
                f"{sequence.name}: frame {frame.index} has other intrinsics; a still scene needs one camera."
            )
    depth_m = np.stack([frame.depth_m.astype(np.float64) for frame in frames])
    seen = np.isfinite(depth_m).mean(axis=0) > 0.5
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels without any measurement
        middle_m = np.where(seen, np.nanmedian(depth_m, axis=0), np.nan)
    moving = along.moving_share(depth_m, middle_m)
    if moving > MAX_MOVING:
        raise InputError(
            f"{sequence.name}: {moving:.0%} of the image moves; record a scene in which camera and things stand still."
        )
    found = borders(depth_m, middle_m)
    lateral_px = pooled_px(found)
    if lateral_px is None:
        raise InputError(
            f"{sequence.name}: shows no border of a near thing before a far one; put a box in front of the background."
        )
    camera = frames[0].camera
    classes = along.classes(depth_m, middle_m, camera, lateral_px)
    if not classes:
        raise InputError(f"{sequence.name}: shows no smooth surface; put flat things at several distances and angles.")
    floor_m, growth = along.fitted(classes)
    # A border that never wavers still lies somewhere within its pixel.
    lateral_px = max(lateral_px, float(np.sqrt(1.0 / 12.0)))
    model = NoiseModel(lateral_px, 0.5 * (camera.fx + camera.fy), floor_m, growth)
    return Calibration(model, tuple(classes), tuple(found), len(frames))
