"""What is said of a registration before it joins the graph, in numbers and in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice, product

import numpy as np

from modeler import se3
from modeler.types import (
    Array,
    Consistency,
    Degenerate,
    Edge,
    Failed,
    LowEvidence,
    LowOverlap,
    Outcome,
    PoseGaussian,
    Posterior,
    Reason,
    Solution,
)

RADIUS = 4.7390  # √χ²₆(0.999): Mahalanobis distance that 1 of 1000 true closures exceeds
_RECENT, _FEWEST = 30, 5  # edges whose evidence tells what is usual
_LEAST_WEIGHT = 0.05  # modes that agree with the prediction must hold so much of the posterior's mass


@dataclass(frozen=True)
class Thresholds:
    """What is asked of a registration besides that it came to an end."""

    min_overlap: float
    """Smallest overlap (0..1)."""
    usual_nats: float = float("nan")
    """Median log evidence of the run's edges; NaN: not known yet."""
    least_nats: float = -float("inf")
    """Below it the images speak against any surface in common, and rather for none."""


def thresholds_from(edges: Sequence[Edge], solution: Solution, *, min_overlap: float, drop_nats: float) -> Thresholds:
    """Return what the edges of a run so far, between neighbours, ask of further ones.

    How well two views of one object match depends on its shape and on the sensor, so that evidence tells little by
    itself. Beside that of others it does: a wrong place matches by far worse than the edges of the run scatter.

    Args:
        edges: every edge judged so far.
        solution: the poses so far.
        min_overlap: smallest overlap (0..1).
        drop_nats: how far evidence may lie below the median; or eight times their scatter, if that is more.
    """
    joining = (edge for edge in reversed(edges) if edge.kind == "odometry" and solution.takes_part(edge))
    nats = [edge.posterior.log_evidence for edge in islice(joining, _RECENT)]
    told = np.array([evidence for evidence in nats if np.isfinite(evidence)])
    if len(told) < _FEWEST:
        return Thresholds(min_overlap)
    usual = float(np.median(told))
    scatter = 1.4826 * float(np.median(np.abs(told - usual)))
    return Thresholds(min_overlap, usual, usual - max(drop_nats, 8.0 * scatter))


def flaw(posterior: Posterior, thresholds: Thresholds | None = None) -> Reason | None:
    """Return what keeps a posterior out of the graph whatever the others say; None: nothing."""
    if not posterior.usable:
        return Failed(posterior.outcome)
    pose = posterior.pose
    if not (np.isfinite(pose.mean).all() and np.isfinite(pose.covariance).all()):
        return Degenerate(finite=False)
    variances = np.linalg.eigvalsh(pose.covariance)
    if variances[0] <= 1e-15 * variances[-1]:
        return Degenerate(finite=True)
    if thresholds is not None and not posterior.overlap >= thresholds.min_overlap:
        return LowOverlap(posterior.overlap, thresholds.min_overlap)
    if thresholds is not None and posterior.log_evidence < thresholds.least_nats:
        return LowEvidence(posterior.log_evidence, thresholds.usual_nats)
    return None


def open_turn(posterior: Posterior) -> tuple[float, Array]:
    """Return the standard deviation in rad of the turn that a registration knows least, and its axis (3,).

    The axis is told in the camera of the source. Of several modes the vaguest counts.
    """
    variances, axes = np.linalg.eigh(np.stack([pose.covariance[:3, :3] for _, pose in modes(posterior)]))
    vaguest = int(np.argmax(variances[:, -1]))
    return float(np.sqrt(variances[vaguest, -1])), axes[vaguest, :, -1]


def stands(posterior: Posterior, thresholds: Thresholds) -> bool:
    """Return whether a registration could place a frame without the previous view."""
    return posterior.outcome is Outcome.CONVERGED and flaw(posterior, thresholds) is None


def modes(posterior: Posterior) -> list[tuple[float, PoseGaussian]]:
    """Return the separate modes of a posterior with their weights, heaviest first; itself where it has but one."""
    return [(mode.weight, mode.pose) for mode in posterior.modes] or [(1.0, posterior.pose)]


def agreement(
    posterior: Posterior,
    predictions: Sequence[tuple[float, PoseGaussian]],
    *,
    systematic: Array,
    scale: float,
    centroid_m: Array,
) -> Consistency:
    """Compare a posterior, mode by mode, with predictions of the same target_from_source.

    Args:
        posterior: of the new registration.
        predictions: what other edges say, with weights that sum to 1.
        systematic: covariance (6, 6) of what neither covariance knows of.
        scale: how many times the standard deviations may understate the random errors.
        centroid_m: (3,) of the object in the source camera.
    """
    agreeing, nearest, difference = 0.0, np.inf, np.eye(4)
    for (weight, predicted), (own_weight, own) in product(predictions, modes(posterior)):
        apart = se3.inverse(predicted.mean) @ own.mean
        xi = se3.log(apart)
        spread = scale**2 * (predicted.covariance + own.covariance) + systematic
        distance = float(np.sqrt(xi @ np.linalg.solve(spread, xi)))
        agreeing += weight * own_weight if distance <= RADIUS else 0.0
        if distance < nearest:
            nearest, difference = distance, apart
    return Consistency(
        distance=nearest,
        max_distance=RADIUS,
        angle_deg=float(np.degrees(se3.rotation_angle(difference))),
        offset_m=float(np.linalg.norm(se3.transform(difference, centroid_m[None])[0] - centroid_m)),
        weight=1.0 if len(predictions) * len(modes(posterior)) == 1 else agreeing,
        min_weight=_LEAST_WEIGHT,
    )
