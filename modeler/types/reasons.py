"""Reasons why frames and edges take part or are left out: values, and their texts."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final, TypeAlias

from modeler.types.base import Outcome

ACCEPTED: Final = "accepted"  # outcome in a report of a frame that is part of the model


@dataclass(frozen=True)
class NearExtrapolation:
    """The pose is near the extrapolated motion."""

    angle_deg: float


@dataclass(frozen=True)
class ConfirmedBy:
    """The registration with another view agrees."""

    frame: int


@dataclass(frozen=True)
class JoinsPrevious:
    """The edge to the previous view places the frame."""

    outcome: Outcome
    overlap: float
    support: NearExtrapolation | ConfirmedBy | None = None
    """Further support; None: not needed."""


@dataclass(frozen=True)
class Relocalised:
    """The edge to an earlier view places the frame; the one to the previous view failed."""

    overlap: float
    support: NearExtrapolation | ConfirmedBy


@dataclass(frozen=True)
class JoinsSegments:
    """The edge joins two segments, between which there is no motion prior."""

    share: float
    """Probability (0..1) of this alignment of the segments among all that were found."""
    rival_deg: float
    """Rotation in degrees to the likeliest alternative."""


@dataclass(frozen=True)
class ElsewhereThanSegments:
    """The registration contradicts the alignment of the segments."""

    angle_deg: float
    """Rotation between the two."""


@dataclass(frozen=True)
class NotJoined:
    """The frame belongs to a segment that nothing joins with the rest."""

    views: int
    """Number of views of the segment."""


@dataclass(frozen=True)
class Failed:
    """The attempt ended without a usable posterior or view."""

    outcome: Outcome
    overlap: float | None = field(default=None, compare=False)
    """That was measured; None: none was."""


@dataclass(frozen=True)
class PriorRefused:
    """The prior does not apply to the pair."""

    message: str
    """Of the `InputError`: what is missing; what to do."""


@dataclass(frozen=True)
class Degenerate:
    """The posterior is no Gaussian that a graph can take."""

    finite: bool


@dataclass(frozen=True)
class LowOverlap:
    """The views share too little surface."""

    overlap: float
    min_overlap: float


@dataclass(frozen=True)
class LowLikelihood:
    """The images match far worse than those of other edges."""

    log_marginal_likelihood: float
    median_nats: float


@dataclass(frozen=True)
class LowCorrelation:
    """Print on the surface that matches is not the same, as it is in other edges."""

    correlation: float
    median: float


@dataclass(frozen=True)
class NotPlaced:
    """No registration of the frame is certain enough to place it."""


@dataclass(frozen=True)
class OpenRotation:
    """The rotation of the edge about an axis is uncertain, and the graph does not reduce this."""

    sigma_deg: float


@dataclass(frozen=True)
class Consistency:
    """Distance of a registration from the graph's prediction."""

    distance: float
    """Mahalanobis distance, of the nearest modes if there are several."""
    max_distance: float
    angle_deg: float
    """Angle between the two."""
    offset_m: float
    """Distance between the two at the object."""
    weight: float
    """Share (0..1) of the posterior's mass in modes that agree."""
    min_weight: float

    @property
    def consistent(self) -> bool:
        """Whether the registration may be true if the prediction is."""
        return self.distance <= self.max_distance and self.weight >= self.min_weight


@dataclass(frozen=True)
class OptimisationOutlier:
    """The edge was accepted, and the optimisation left it out later."""


@dataclass(frozen=True)
class Stated:
    """A reason of which only the text is known, as from a report."""

    words: str


Reason: TypeAlias = (
    JoinsPrevious
    | Relocalised
    | JoinsSegments
    | ElsewhereThanSegments
    | NotJoined
    | Failed
    | PriorRefused
    | Degenerate
    | LowOverlap
    | LowLikelihood
    | LowCorrelation
    | NotPlaced
    | OpenRotation
    | Consistency
    | OptimisationOutlier
    | Stated
)
"""Why an edge was accepted or rejected, or a frame left out."""


def code(reason: Reason) -> str:
    """Return the kind of a reason for programs that read reports: an outcome's label, or the class in snake case."""
    if isinstance(reason, Failed):
        return reason.outcome.label
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", type(reason).__name__).lower()


def explain(reason: Reason) -> str:
    """Return a reason in words, with advice."""
    match reason:
        case Failed(outcome):
            return f"{summary(reason)}: {outcome.advice}"
        case PriorRefused(message):
            return message
        case _:
            return summary(reason)


def advice(reason: Reason) -> str:
    """Return the advice for a reason; "" if there is none."""
    match reason:
        case Failed(outcome):
            return outcome.advice
        case PriorRefused(message):
            return message.partition("; ")[2]
        case _:
            return ""


def summary(reason: Reason) -> str:
    """Return a reason in words, without advice."""
    match reason:
        case JoinsPrevious(outcome, overlap, support):
            return f"joins the previous view: {outcome.label}, overlap {overlap:.2f}{_supported(support)}"
        case Relocalised(overlap, support):
            return f"joins in place of the failed previous view: overlap {overlap:.2f}{_supported(support)}"
        case JoinsSegments(share, rival_deg):
            rival = f", otherwise turned by {rival_deg:.0f}°" if share < 1.0 else ""
            return f"joins two segments, with a probability of {100.0 * share:.3g} %{rival}"
        case NotJoined(views):
            others = f"registered with {views - 1} other frames that were left out"
            return f"{others}, but their alignment with the rest is undetermined"
        case ElsewhereThanSegments(angle_deg):
            return f"contradicts the alignment of the two segments by {angle_deg:.0f}°"
        case Failed(Outcome.NO_OVERLAP, float(overlap)):
            return f"too little surface matches, overlap {overlap:.2f}"
        case Failed(outcome):
            return outcome.label
        case PriorRefused(message):
            return message.partition("; ")[0]
        case Degenerate(finite=False):
            return "the posterior is not finite: the registration broke down"
        case Degenerate():
            return "the covariance is not positive definite: the registration is degenerate"
        case LowOverlap(overlap, min_overlap):
            return f"the overlap {overlap:.2f} is below {min_overlap:.2f}"
        case LowLikelihood(nats, median_nats):
            return f"the images contradict it: log likelihood {nats:.0f}, median of other edges {median_nats:.0f}"
        case LowCorrelation(correlation, median):
            return f"print contradicts it: a correlation of {correlation:.2f}, median of other edges {median:.2f}"
        case NotPlaced():
            return "neither the previous view nor another one places the frame reliably"
        case OpenRotation(sigma_deg):
            return f"the rotation about an axis is uncertain by ±{sigma_deg:.0f}°, and the graph does not reduce this"
        case Consistency():
            return _agreement(reason)
        case OptimisationOutlier():
            return "the optimisation rejected it: all other edges contradict it"
        case Stated(words):
            return words


def _supported(support: NearExtrapolation | ConfirmedBy | None) -> str:
    match support:
        case NearExtrapolation(angle_deg):
            return f", {angle_deg:.0f}° from the extrapolated motion"
        case ConfirmedBy(frame):
            return f", frame {frame} agrees"
        case None:
            return ""


def _agreement(found: Consistency) -> str:
    words = (
        f"{'agrees with' if found.consistent else 'contradicts'} the chain: {found.angle_deg:.1f}° and "
        f"{1000.0 * found.offset_m:.1f} mm from its prediction, distance {found.distance:.1f} of "
        f"{found.max_distance:.1f} allowed"
    )
    return words if found.weight == 1.0 else f"{words}, {100.0 * found.weight:.0f} % of the modes' mass agrees"
