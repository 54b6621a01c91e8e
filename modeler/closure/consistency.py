"""The closure gate: tests of a registration, among them consistency with the graph's prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice, product

import numpy as np

from modeler import se3
from modeler.closure.map_view import MapView, ShortestPaths, composed
from modeler.priors.proposals import INFLATION
from modeler.registration import VisibilityRegistrar
from modeler.significance import OUTSIDE, QUORUM, SELDOM, radius
from modeler.types import (
    SOME_VIEWS,
    Array,
    Consistency,
    Degenerate,
    Edge,
    Failed,
    LowCorrelation,
    LowLikelihood,
    LowOverlap,
    OpenRotation,
    Outcome,
    PoseGaussian,
    Posterior,
    Reason,
    Solution,
)

MIN_TURN_DEG = 6.0
"""Least rotation between views whose print is compared: what hardly moves is taken for light. Measured on 54 drawn
captures: turned by less than 4°, correlations of right edges go down to -1.3 of the run's median; by 6° and more, one
of 354 is below 0.35 of it."""
_CORRELATION_SPREAD = 0.2  # sd of that of right edges as a share of the median: measured on captures


@dataclass(frozen=True)
class Thresholds:
    """Requirements on edges, of which print alone holds for that to the previous view, too (docs/method/closure.md)."""

    min_overlap: float = VisibilityRegistrar.min_overlap
    """Least overlap (0..1), predicted and measured."""
    max_likelihood_drop_nats: float = 40.0
    """Largest difference of the log marginal likelihood from the median of the run's edges. Right edges of captures are
    up to 29 nats below it, wrong ones from 3 above to 32 below: what is refused matches next to nothing."""
    max_likelihood_drop_sigmas: float = 8.0
    """The same in robust standard deviations of the run's edges, where these scatter by more than 5 nats; the larger of
    both is used."""
    min_correlation: float = 0.5
    """Least correlation of colours in the run's edges from which it counts."""
    max_other_print_nats: float = 2.3
    """Largest difference of log likelihoods of a correlation, of other print and of the same: odds of ten to one."""
    max_open_deg: float = 5.0
    """Largest standard deviation in degrees of the rotation about any axis, unless the graph knows it better. An open
    rotation, such as that about the axis of a bottle, is bounded only by the prior's limits, which are already part of
    the edges that placed the frames; and as its axis is uncertain, wide rotations would contradict other edges."""
    known_share: float = 0.5
    """The graph knows a rotation better if its standard deviation is below this fraction of the edge's: the edge adds a
    quarter of the information that there is, at most."""
    max_gaussian_deg: float = 30.0
    """Largest standard deviation of such a rotation in degrees. The cosine of it is 0.87: a Gaussian about one mean is
    then wrong about the other axes, of which it is sure."""

    def usual(self, edges: Sequence[Edge], solution: Solution) -> Usual:
        """Return how well images match in a run's edges between neighbours so far.

        Log evidence depends on shape and sensor and is meaningful only in comparison; that of a wrong pose is far below
        the scatter of the run's edges. The correlation of colours depends on print and noise likewise.
        """
        joining = (edge for edge in reversed(edges) if edge.kind == "odometry" and solution.takes_part(edge))
        recent = [edge.posterior for edge in islice(joining, SOME_VIEWS)]
        nats = np.array([posterior.log_marginal_likelihood for posterior in recent])
        correlations = np.array([posterior.colour_correlation for posterior in recent])
        nats, correlations = nats[np.isfinite(nats)], correlations[np.isfinite(correlations)]
        correlation = float(np.median(correlations)) if len(correlations) >= QUORUM else float("nan")
        if len(nats) < QUORUM:
            return Usual(correlation=correlation)
        median = float(np.median(nats))
        scatter = 1.4826 * float(np.median(np.abs(nats - median)))
        drop_nats = max(self.max_likelihood_drop_nats, self.max_likelihood_drop_sigmas * scatter)  # method, eq. 9.5
        return Usual(median, median - drop_nats, correlation)

    def defect(self, posterior: Posterior, usual: Usual) -> Reason | None:
        """Return why a posterior is rejected independently of the other edges; None if it is not."""
        if (found := failure(posterior)) is not None:
            return found
        if not posterior.overlap >= self.min_overlap:
            return LowOverlap(posterior.overlap, self.min_overlap)
        if posterior.log_marginal_likelihood < usual.min_nats:
            return LowLikelihood(posterior.log_marginal_likelihood, usual.median_nats)
        return self.other_print(posterior, usual)

    def failed(self, posterior: Posterior, usual: Usual, *, consecutive: bool) -> Reason | None:
        """Return why a posterior is rejected, see `defect`; one of consecutive frames only where it cannot be right."""
        return (
            (failure(posterior) or self.other_print(posterior, usual)) if consecutive else self.defect(posterior, usual)
        )

    def other_print(self, posterior: Posterior, usual: Usual) -> LowCorrelation | None:
        """Return the reason if print on surface that matches disagrees, as it does not in the run's edges, or None."""
        found, expected = posterior.colour_correlation, usual.correlation
        turned_deg = np.degrees(se3.rotation_angle(posterior.pose.mean))
        if not (expected >= self.min_correlation and turned_deg >= MIN_TURN_DEG and found < expected):
            return None
        by_chance = 1.0 / max(posterior.independent_colours, 1.0)
        same = by_chance + (_CORRELATION_SPREAD * expected) ** 2
        nats = 0.5 * ((found - expected) ** 2 / same - found**2 / by_chance + np.log(same / by_chance))  # eq. 9.7
        return LowCorrelation(found, expected) if nats > self.max_other_print_nats else None

    def open_rotation(self, posterior: Posterior, predicted: PoseGaussian) -> OpenRotation | None:
        """Return the reason if a posterior leaves a rotation open that the prediction does not know better, or None."""
        sigma_rad, axis = widest_rotation(posterior)
        known_rad = float(np.sqrt(axis @ predicted.covariance[:3, :3] @ axis))
        known = known_rad <= self.known_share * sigma_rad and np.degrees(sigma_rad) <= self.max_gaussian_deg
        if np.degrees(sigma_rad) <= self.max_open_deg or known:  # eq. 9.6
            return None
        return OpenRotation(float(np.degrees(sigma_rad)))

    def places_alone(self, posterior: Posterior, usual: Usual) -> bool:
        """Return whether a registration may place a frame without that of the previous view."""
        return posterior.outcome is Outcome.CONVERGED and self.defect(posterior, usual) is None


@dataclass(frozen=True)
class Usual:
    """How well images match in the edges of a run."""

    median_nats: float = float("nan")
    """Median log marginal likelihood; NaN: not known yet."""
    min_nats: float = -float("inf")
    """Bound below which an edge is rejected."""
    correlation: float = float("nan")
    """Median correlation of colours; NaN: not known yet."""


def failure(posterior: Posterior) -> Reason | None:
    """Return why a posterior cannot be a factor of a graph; None if it can."""
    if not posterior.usable:
        return Failed(posterior.outcome, posterior.overlap)
    pose = posterior.pose
    if not (np.isfinite(pose.mean).all() and np.isfinite(pose.covariance).all()):
        return Degenerate(finite=False)
    variances = np.linalg.eigvalsh(pose.covariance)
    if variances[0] <= 1e-15 * variances[-1]:
        return Degenerate(finite=True)
    return None


def modes(posterior: Posterior) -> list[tuple[float, PoseGaussian]]:
    """Return the separate modes of a posterior with their weights, heaviest first; its Gaussian if it has only one."""
    return [(mode.weight, mode.pose) for mode in posterior.modes] or [(1.0, posterior.pose)]


def widest_rotation(posterior: Posterior) -> tuple[float, Array]:
    """Return the largest standard deviation in rad of the rotation about any axis, and that axis (3,).

    The axis is in source camera coordinates. Of several modes, the widest counts.
    """
    variances, axes = np.linalg.eigh(np.stack([pose.covariance[:3, :3] for _, pose in modes(posterior)]))
    widest = int(np.argmax(variances[:, -1]))
    return float(np.sqrt(variances[widest, -1])), axes[widest, :, -1]


@dataclass(frozen=True)
class ConsistencyModel:
    """Test of a registration against the prediction by a chain of edges.

    Pairwise covariances do not include systematic errors, which accumulate along a chain instead of averaging out. So
    covariances are inflated for the comparison.
    """

    sigma_scale: float = INFLATION
    """Factor on the standard deviations of edges."""
    drift_deg: float = 0.15
    """Systematic rotation error of an edge in degrees; it accumulates along a chain. Halved or doubled, builds of the
    dragon and of cap are the same."""
    drift: float = 0.0004
    """Systematic translation error of an edge as a share of the object's distance; it accumulates along a chain."""
    max_distance: float = radius(SELDOM)
    """Largest Mahalanobis distance: √χ²₆(0.999), which 1 of 1000 true closures exceeds."""
    min_weight: float = OUTSIDE
    """Least fraction (0..1) of the posterior's mass in consistent modes."""

    def systematic(self, length: int, centroid_m: Array) -> Array:
        """Return the covariance (6, 6) of the systematic error of a chain of `length` edges, in the camera at its end.

        Args:
            length: number of edges.
            centroid_m: (3,) of the object in that camera.
        """
        drift_m = self.drift * float(np.linalg.norm(centroid_m))
        sigmas = length * np.repeat([np.radians(self.drift_deg), drift_m], 3)  # method, eq. 9.3
        return se3.covariance_about(np.diag(sigmas**2), -centroid_m)

    def consistency(
        self,
        posterior: Posterior,
        predictions: Sequence[tuple[float, PoseGaussian]],
        *,
        length: int,
        centroid_m: Array,
    ) -> Consistency:
        """Compare a registration, mode by mode, with the prediction of target_from_source by a chain of edges.

        Args:
            posterior: the registration.
            predictions: modes of the prediction, with weights that sum to 1.
            length: number of edges of the chain.
            centroid_m: (3,) of the object in the source camera.
        """
        systematic = self.systematic(length, centroid_m)
        agreeing, nearest, difference = 0.0, np.inf, np.eye(4)
        for (weight, predicted), (own_weight, own) in product(predictions, modes(posterior)):
            apart = se3.inverse(predicted.mean) @ own.mean
            xi = se3.log(apart)
            spread = self.sigma_scale**2 * (predicted.covariance + own.covariance) + systematic
            distance = float(np.sqrt(xi @ np.linalg.solve(spread, xi)))  # method, eq. 9.4
            agreeing += weight * own_weight if distance <= self.max_distance else 0.0
            if distance < nearest:
                nearest, difference = distance, apart
        return Consistency(
            distance=nearest,
            max_distance=self.max_distance,
            angle_deg=float(np.degrees(se3.rotation_angle(difference))),
            offset_m=float(np.linalg.norm(se3.transform(difference, centroid_m[None])[0] - centroid_m)),
            weight=1.0 if len(predictions) * len(modes(posterior)) == 1 else agreeing,
            min_weight=self.min_weight,
        )

    def consistency_through(
        self, base: Posterior, posterior: Posterior, map_view: MapView, paths: ShortestPaths
    ) -> Consistency:
        """Compare a registration of a frame with the prediction by another one and the graph.

        Args:
            base: the other registration, which places the frame.
            posterior: target_from_source of the frame and some view.
            map_view: the map so far.
            paths: from the view of `base`.
        """
        through = map_view.solution.relative_gaussian(posterior.target, base.target)
        predictions = [(weight, composed(pose, through)) for weight, pose in modes(base)]
        centroid_m = se3.transform(se3.inverse(modes(base)[0][1].mean), map_view.views[base.target].centroid_m[None])[0]
        path = paths.get(posterior.target)
        order = list(map_view.views)
        length = abs(order.index(base.target) - order.index(posterior.target)) if path is None else path.edges
        return self.consistency(posterior, predictions, length=1 + length, centroid_m=centroid_m)
