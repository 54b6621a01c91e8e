"""Preparation of frames and registration of pairs: the same for runs, experiments and joins."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from modeler import se3
from modeler.registration.visibility.search import SEPARATE_RAD
from modeler.segmentation import Scene, Segmenter
from modeler.significance import SELDOM, UNLIKELY
from modeler.types import (
    FULL_EFFORT,
    AbstractPairCache,
    AbstractPoseDensity,
    AbstractPrior,
    AbstractRegistrar,
    Array,
    Edge,
    Failed,
    Frame,
    Outcome,
    Posterior,
    RayImage,
    Reason,
    Segmentation,
    ViewPair,
)
from modeler.views import Sensor

BEYOND_LIMITS_NATS: Final = -math.log(SELDOM)
"""Prior log odds of a motion within the prior's limits: one in a thousand exceeds them."""
SEGMENTED: Final = (Outcome.CONVERGED, Outcome.UNSURE_MASK, Outcome.CUT_OFF)
"""Outcomes of a segmentation that has found an object."""
_CONTRADICTED_NATS: Final = -math.log(UNLIKELY)
"""Log odds against a match that the images contradict: they contradict one of 100 right ones (`Posterior`)."""


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

    def why_left_out(self, edges: Sequence[Edge], *, first: bool) -> Reason | None:
        """Return why the frame is left out, by its edges; None if it is not. The first frame has no edge."""
        if self.view is None:
            return Failed(self.failure)
        return None if first or any(edge.accepted for edge in edges) else edges[0].reason

    @property
    def accepted(self) -> bool:
        """Whether the frame is part of the model, once known."""
        return self.view is not None and self.left_out is None


def prepare(frame: Frame, scene: Scene, segmenter: Segmenter, sensor: Sensor) -> Prepared:
    """Segment a frame and prepare it for registration: the object, and what a moving camera sees beside it.

    Args:
        frame: as read.
        scene: as the segmenter estimated it from the sequence.
        segmenter: finds the object.
        sensor: of the camera.
    """
    segmentation = segmenter.segment(frame, scene)
    seen = segmenter.with_surroundings(frame, segmentation, scene)
    if seen.outcome not in SEGMENTED:
        return Prepared(frame, segmentation, None)
    view = sensor.ray_image(replace(frame, mask=seen.mask), seen.plane)
    return Prepared(frame, replace(seen, mask=segmentation.mask), view if len(view.points_m) else None)


@dataclass(frozen=True, eq=False)
class Registrations:
    """Registers pairs of views, each with a random generator of its own."""

    registrar: AbstractRegistrar
    """The method."""
    seed: int = 0
    """Seeds the generator of a pair, together with the two frame numbers."""
    cache: AbstractPairCache | None = None
    """Results of an interrupted run, if any."""

    def register(
        self,
        source: RayImage,
        target: RayImage,
        density: AbstractPoseDensity,
        *,
        effort: float = FULL_EFFORT,
        near: Array | None = None,
    ) -> Posterior:
        """Return the posterior of target_from_source.

        Args:
            source: one view.
            target: another.
            density: prior density of target_from_source.
            effort: share (0..1] of the usual effort.
            near: (4, 4) the only mode that is asked for, if it is known roughly.
        """
        rng = np.random.default_rng([self.seed, source.index, target.index])
        pair = ViewPair(source, target, density, rng, effort, near)
        if self.cache is None:
            return self.registrar.posterior_of(pair)
        return self.cache.posterior_of(self.registrar, pair)


def without_limits(within: Posterior, prior: AbstractPrior, attempt: Callable[[AbstractPrior], Posterior]) -> Posterior:
    """Return a registration, or one without limits if it is not convincing and the prior's limits are defaults.

    Args:
        within: the registration with the prior.
        prior: of the motion.
        attempt: registers the same pair with another prior.
    """
    unlimited = None if within.convincing else prior.unlimited()
    if unlimited is None:
        return within
    other = attempt(unlimited)
    return replace(converged_or(within, other), seconds=within.seconds + other.seconds)


def converged_or(within: Posterior, unlimited: Posterior) -> Posterior:
    """Return the registration without limits if it converged and is more probable, else the one within limits.

    If several modes are found, none within the usual limits, none can be trusted. A match within the limits is only
    replaced if the other one's likelihood outweighs that motions beyond them are rare; images that contradict the
    match speak against it as well. If they contradict both, the less probable one is no match.
    """
    better_nats = unlimited.log_marginal_likelihood - within.log_marginal_likelihood
    if unlimited.outcome is not Outcome.CONVERGED:
        return _beaten(within, unlimited) if within.contradicted and better_nats > BEYOND_LIMITS_NATS else within
    if not within.usable:
        return unlimited
    needed_nats = BEYOND_LIMITS_NATS - (_CONTRADICTED_NATS if within.contradicted else 0.0)
    return within if better_nats < needed_nats else unlimited


def _beaten(within: Posterior, unlimited: Posterior) -> Posterior:
    """Return a registration as one at the limits, if surface matches elsewhere without them."""
    matches = unlimited.overlap >= unlimited.least_overlap
    beaten = within.usable and matches and are_apart(within, unlimited)
    return replace(within, outcome=Outcome.AT_LIMIT) if beaten else within


def are_apart(one: Posterior, other: Posterior) -> bool:
    """Return whether two registrations of a pair are at different modes."""
    return bool(se3.rotation_angle(se3.inverse(one.pose.mean) @ other.pose.mean) > SEPARATE_RAD)
