"""Preparation of frames and registration of pairs: the same for runs, experiments and joins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from modeler.rays import Sensor
from modeler.segmentation import Scene, Segmenter
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    AbstractRegistrar,
    Frame,
    Outcome,
    Posterior,
    RayImage,
    Reason,
    Segmentation,
)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A frame, its segmentation, and its view for registration."""

    frame: Frame
    """As read."""
    segmentation: Segmentation
    """The object in it."""
    view: RayImage | None
    """None if the object was not found."""
    left_out: Reason | None = None
    """Why the frame is not part of the model, once known."""

    @property
    def failure(self) -> Outcome:
        """Why a frame has no view."""
        found = self.segmentation.outcome
        return Outcome.TOO_FEW_POINTS if found is Outcome.CONVERGED else found

    @property
    def accepted(self) -> bool:
        """Whether the frame is part of the model, once known."""
        return self.view is not None and self.left_out is None


def prepare(frame: Frame, scene: Scene, segmenter: Segmenter, sensor: Sensor) -> Prepared:
    """Segment a frame and prepare it for registration.

    Args:
        frame: as read.
        scene: as the segmenter estimated it from the sequence.
        segmenter: finds the object.
        sensor: of the camera.
    """
    segmentation = segmenter.segment(frame, scene)
    if segmentation.outcome not in (Outcome.CONVERGED, Outcome.UNSURE_MASK):
        return Prepared(frame, segmentation, None)
    view = sensor.ray_image(replace(frame, mask=segmentation.mask), segmentation.plane)
    return Prepared(frame, segmentation, view if len(view.points_m) else None)


def register(
    registrar: AbstractRegistrar, source: RayImage, target: RayImage, density: AbstractPoseDensity, *, seed: int
) -> Posterior:
    """Return the posterior of target_from_source.

    Args:
        registrar: the method.
        source: one view.
        target: another.
        density: prior density of target_from_source.
        seed: of the pair's random generator, together with the two frame numbers.
    """
    rng = np.random.default_rng([seed, source.index, target.index])
    return registrar.register(source, target, density, rng=rng)


def retry_unlimited(
    within: Posterior, prior: AbstractPrior, attempt: Callable[[AbstractPrior], Posterior]
) -> Posterior:
    """Return a registration, or one without limits if it is not convincing and the prior's limits are defaults.

    If several modes are found, none within the usual limits, none can be trusted: only a converged result counts.

    Args:
        within: the registration with the prior.
        prior: of the motion.
        attempt: registers the same pair with another prior.
    """
    unlimited = None if within.convincing else prior.unlimited()
    if unlimited is None:
        return within
    other = attempt(unlimited)
    found = other if other.outcome is Outcome.CONVERGED else within
    return replace(found, seconds=within.seconds + other.seconds)
