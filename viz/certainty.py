"""How sure a motion is, in numbers that a person can picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.types import Array, PoseGaussian, Posterior


@dataclass(frozen=True)
class Sd:
    """Standard deviations of a motion along its worst axes."""

    rotation_deg: float
    """Of the rotation."""
    translation_mm: float
    """Of the object's centre: that of the camera's own origin is mostly the rotation times the object's distance."""


def sd_of(pose: PoseGaussian, centre_m: Array) -> Sd:
    """Return how sure a motion is; NaN where its covariance is not finite.

    Args:
        pose: with ξ in the coordinates in which `centre_m` is given.
        centre_m: (3,) the object's centre.
    """
    if not np.isfinite(pose.covariance).all():
        return Sd(math.nan, math.nan)
    covariance = se3.covariance_about(pose.covariance, centre_m)
    return Sd(math.degrees(worst_axis_sd(covariance[:3, :3])), 1000.0 * worst_axis_sd(covariance[3:, 3:]))


def worst_axis_sd(covariance: Array) -> float:
    """Return the sd along the least certain axis of a covariance (3, 3)."""
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))


def words(posterior: Posterior, centre_m: Array) -> list[str]:
    """Say how sure a registration is, a few words a reading, without those that its method does not give.

    Args:
        posterior: of target_from_source.
        centre_m: (3,) the object's centre in the source camera's frame.
    """
    sd = sd_of(posterior.pose, centre_m)
    samples = f"{posterior.effective_samples:.0f}"
    readings = (
        (sd.rotation_deg, f"rotation sd {_short(sd.rotation_deg)}°"),
        (sd.translation_mm, f"translation sd {_short(sd.translation_mm)} mm"),
        (posterior.overlap, f"overlap {100.0 * posterior.overlap:.0f} %"),
        (posterior.effective_samples, f"{samples} effective sample" + "s" * (samples != "1")),
        (posterior.seconds, f"{posterior.seconds:.2g} s"),
    )
    return [said for value, said in readings if math.isfinite(value)]


def _short(value: float) -> str:
    """Return a number of two digits, none of which lie beyond what anybody measures."""
    return "<0.01" if 0.0 < value < 0.01 else f"{value:.2g}"
