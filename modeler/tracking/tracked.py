"""What a tracker says of an object in one frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from modeler.types import Mode, PoseGaussian, RayImage

Presence = Literal["found", "followed", "unsure", "not there", "too few points"]

USABLE_RAD, USABLE_M = np.radians(3.0), 0.005
"""Largest standard deviations, of a rotation and of the object's place, with which a pose is of use."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """The object in one frame."""

    frame: int
    """Number of the frame."""
    time_s: float
    """Time of the frame."""
    outcome: Presence
    """`found` without knowledge of the frames before, `followed` from these, or neither.

    It is `unsure` if other objects may match as well: too little is seen, another place matches, or the images leave a
    rotation open that is no symmetry of the model.
    """
    pose: PoseGaussian | None = None
    """camera_from_model, its covariance with the errors of model and camera; None where the object is not there."""
    modes: tuple[Mode, ...] = ()
    """The separate modes of camera_from_model, heaviest first; empty for a single one."""
    overlap: float = 0.0
    """Share (0..1) of the surface that frame and model should both show, at the pose, that both do show."""
    usable: bool = False
    """Whether there is one mode, but for the model's symmetries, with an sd of at most `USABLE_RAD` and `USABLE_M`.

    Both are given the camera, whose focal length and depth scale move all poses alike."""
    reason: str = ""
    """Why the object is not there, or the pose not usable."""
    seconds: float = 0.0
    """Wall time in s."""
    view: RayImage | None = field(default=None, repr=False)
    """The frame, or the part of it around a followed object, prepared for registration."""
