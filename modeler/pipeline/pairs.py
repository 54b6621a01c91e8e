"""A frame prepared for registration, and a pair of them registered: the same for runs, experiments and joins."""

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
    """A frame, the object in it, and what registration needs of it."""

    frame: Frame
    """As read."""
    segmentation: Segmentation
    """What of it is the object."""
    view: RayImage | None
    """None where the object was not found."""
    left_out: Reason | None = None
    """Why the frame is no part of the model, once that is known."""

    @property
    def flaw(self) -> Outcome:
        """What is wrong with a frame that has no view."""
        found = self.segmentation.outcome
        return Outcome.TOO_FEW_POINTS if found is Outcome.CONVERGED else found

    @property
    def accepted(self) -> bool:
        """Whether the frame is part of the model, once that is known."""
        return self.view is not None and self.left_out is None


def prepare(frame: Frame, scene: Scene, segmenter: Segmenter, sensor: Sensor) -> Prepared:
    """Segment a frame and prepare it for registration.

    Args:
        frame: as read.
        scene: what the segmenter learnt from the sequence.
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
        density: of target_from_source before the images are compared.
        seed: with the two frame numbers it makes the pair's own random generator.
    """
    rng = np.random.default_rng([seed, source.index, target.index])
    return registrar.register(source, target, density, rng=rng)


def anywhere(within: Posterior, prior: AbstractPrior, attempt: Callable[[AbstractPrior], Posterior]) -> Posterior:
    """Return a registration, or that of any motion where it does not convince and limits of its prior were assumed.

    Of several places, none within the usual limits, none is known to be right.

    Args:
        within: the registration with the prior.
        prior: what is known of the motion.
        attempt: registers the same pair with another prior.
    """
    unlimited = None if within.convincing else prior.unlimited()
    if unlimited is None:
        return within
    other = attempt(unlimited)
    found = other if other.outcome is Outcome.CONVERGED else within
    return replace(found, seconds=within.seconds + other.seconds)
