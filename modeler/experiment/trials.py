"""One pair of frames registered by one method, and how far that is from the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from modeler.evaluation import nees, rotation_error_deg, translation_error_m
from modeler.types import Array, Posterior


@final
@dataclass(frozen=True)
class Trial:
    """One pair registered by one method. What does not exist is NaN: a failed view has no error."""

    sequence: str
    """Name of the sequence."""
    method: str
    """Name of the method."""
    offset: int
    """Frames from one to the other."""
    source: int
    """Frame number of the source."""
    target: int
    """Frame number of the target."""
    outcome: str
    """How the registration ended, or why there was none."""
    usable: bool
    """Whether the method stands by its answer."""
    rotation_deg: float = math.nan
    """True rotation between the frames, where it is known."""
    rotation_error_deg: float = math.nan
    """Angle between estimate and truth."""
    translation_error_mm: float = math.nan
    """Distance at the object's centroid between estimate and truth."""
    nees: float = math.nan
    """Squared error in units of the covariance stated; 6 on average where that is true."""
    sigma_deg: float = math.nan
    """Root mean square rotation error that the covariance predicts."""
    overlap: float = math.nan
    """Share of surface seen in both views, as the method has it."""
    seconds: float = math.nan
    """Wall time of the registration."""
    target_from_source: tuple[float, ...] = ()
    """The estimate, 16 numbers by row; empty where there is none."""

    def answered(self, posterior: Posterior, truth: Array | None, centroid_m: Array) -> Trial:
        """Return the trial with a method's answer, and its errors where the truth is known.

        Args:
            posterior: the answer.
            truth: target_from_source (4, 4).
            centroid_m: (3,) of the object in the source's camera frame, where shifts are measured.
        """
        trial = replace(
            self,
            outcome=posterior.outcome.label,
            usable=posterior.usable,
            sigma_deg=float(np.degrees(np.sqrt(np.trace(posterior.pose.covariance[:3, :3])))),
            overlap=posterior.overlap,
            seconds=posterior.seconds,
            target_from_source=tuple(posterior.pose.mean.ravel().tolist()),
        )
        if truth is None:
            return trial
        return replace(
            trial,
            rotation_error_deg=rotation_error_deg(posterior.pose.mean, truth),
            translation_error_mm=1e3 * translation_error_m(posterior.pose.mean, truth, centroid_m),
            nees=nees(posterior.pose, truth),
        )
