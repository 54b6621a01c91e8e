"""Which pairs of views to register, and which of their posteriors become edges of the graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.types import Array, Edge, Outcome, PoseGaussian, Posterior, RayImage, Solution

_RADIUS = 4.7390  # √χ²₆(0.999): Mahalanobis distance that 1 of 1000 true closures exceeds


@dataclass(frozen=True)
class Closer:
    """Chooses what a new view is registered against and judges the results, in words.

    A view is tried as a closure where the object seems to come back to it after having turned well away from it. The
    result is accepted where it agrees with what the chain of edges predicts. Pairwise covariances hold no systematic
    error, which adds up along a chain instead of averaging out, so the test is wider than they say; see the fields.
    """

    max_angle_deg: float = 45.0
    """Largest predicted rotation in degrees to an earlier view for it to be tried as a closure."""
    away_deg: float = 90.0
    """How far in degrees the object must have turned away from an earlier view before it counts as coming back."""
    max_closures: int = 2
    """At most so many closures are tried for one frame; 0 = never close."""
    max_relocations: int = 4
    """At most so many earlier views are tried for a frame that neither the previous view nor a closure places."""
    min_overlap: float = 0.4
    """Smallest overlap (0..1) of a closure."""
    sigma_scale: float = 2.0
    """How many times the standard deviations of edges may understate their random errors."""
    drift_deg: float = 0.15
    """Systematic rotation error of an edge in degrees; along a chain it adds up."""
    drift_m: float = 0.00025
    """Systematic translation error of an edge in m, at the object; along a chain it adds up."""

    def targets(
        self, solution: Solution, views: Mapping[int, RayImage], source: int, expected: Array | None = None
    ) -> tuple[int, ...]:
        """Return the frames to register `source` against: the previous accepted one, then closures, best first.

        Args:
            solution: the poses so far.
            views: the accepted views, in order of acceptance.
            source: number of the new frame.
            expected: its object_from_camera (4, 4), where odometry or a robot knows; None: the last motion goes on.
        """
        frames = [frame for frame in views if frame in solution.trajectory]
        if not frames:
            return ()
        poses = np.stack([solution.trajectory[frame] for frame in frames])
        expected = _continued(solution, frames, source) if expected is None else expected
        angle_deg = np.degrees(se3.rotation_angle(se3.inverse(poses) @ expected))
        candidates = [
            number
            for number in range(len(frames) - 1)
            if angle_deg[number] <= self.max_angle_deg and self._went_away(poses[number:])
        ]
        candidates.sort(key=lambda number: (number != 0, angle_deg[number]))  # to close on the first frame is best
        return (frames[-1], *(frames[number] for number in candidates[: self.max_closures]))

    def relocation(
        self, posteriors: Sequence[Posterior], views: Mapping[int, RayImage], solution: Solution
    ) -> int | None:
        """Return the earlier view to register a lost frame against next; None: it is given up.

        A posterior that stands alone wants a witness: the view nearest to where it puts the frame. Otherwise the view
        nearest to where the motion leads comes first, then those farthest from all views tried.

        Args:
            posteriors: what was tried for the frame, the previous view first.
            views: the accepted views, in order of acceptance.
            solution: the poses so far.
        """
        tried = [posterior.target for posterior in posteriors]
        frames = [frame for frame in views if frame in solution.trajectory]
        left = [frame for frame in frames if frame not in tried]
        if not left or len(tried) > self.max_relocations + self.max_closures:
            return None
        poses = np.stack([solution.trajectory[frame] for frame in left])
        for posterior in posteriors:
            if self._stands(posterior):
                placed = solution.trajectory[posterior.target] @ posterior.pose.mean
                angle_rad = se3.rotation_angle(se3.inverse(poses) @ placed)
                nearest = int(np.argmin(angle_rad))
                if np.degrees(angle_rad[nearest]) <= self.max_angle_deg:
                    return left[nearest]
        if len(tried) == 1:
            expected = _continued(solution, frames, posteriors[0].source)
            return left[int(np.argmin(se3.rotation_angle(se3.inverse(poses) @ expected)))]
        apart = [se3.rotation_angle(se3.inverse(solution.trajectory[frame]) @ poses) for frame in tried]
        return left[int(np.argmax(np.min(apart, axis=0)))]

    def edges(
        self, posteriors: Sequence[Posterior], views: Mapping[int, RayImage], solution: Solution
    ) -> tuple[Edge, ...]:
        """Return one judged edge per posterior, in their order. The frame joins the graph if any is accepted.

        Args:
            posteriors: registrations of one new frame against `targets`, in that order.
            views: the accepted views, in order of acceptance.
            solution: the poses so far.
        """
        if not posteriors:
            return ()
        base, base_reason = self._base(posteriors, views, solution)
        edges = []
        for number, posterior in enumerate(posteriors):
            kind = "closure" if number else "odometry"
            if posterior is base:
                accepted, reason = True, base_reason
            elif (flaw := _flaw(posterior, self.min_overlap if number else None)) is not None:
                accepted, reason = False, flaw
            elif base is None:
                accepted, reason = False, "neither the previous view nor another one places the frame with certainty"
            else:
                accepted, reason = self._agreement(posterior, base, views, solution)
            edges.append(Edge(posterior, kind, accepted, reason))
        return tuple(edges)

    def _went_away(self, poses: Array) -> bool:
        """Return whether the object has turned well away from the first of `poses` (n, 4, 4)."""
        return bool(se3.rotation_angle(se3.inverse(poses[0]) @ poses).max() >= np.radians(self.away_deg))

    def _base(
        self, posteriors: Sequence[Posterior], views: Mapping[int, RayImage], solution: Solution
    ) -> tuple[Posterior | None, str]:
        """Return the posterior that places the frame, and why: odometry, or else the best closure that stands alone."""
        odometry, *closures = posteriors
        if _flaw(odometry) is None:
            return odometry, f"joins the previous view: {odometry.outcome.label}, overlap {odometry.overlap:.2f}"
        frames = [frame for frame in views if frame in solution.trajectory]
        expected = _continued(solution, frames, odometry.source)
        standing = sorted(filter(self._stands, closures), key=lambda posterior: -posterior.overlap)
        for posterior in standing:
            reason = f"joins in place of the failed previous view: overlap {posterior.overlap:.2f}"
            for witness in standing:
                if witness is not posterior and self._agreement(witness, posterior, views, solution)[0]:
                    return posterior, f"{reason}, frame {witness.target} agrees"
            measured = solution.trajectory[posterior.target] @ posterior.pose.mean
            off_deg = float(np.degrees(se3.rotation_angle(se3.inverse(expected) @ measured)))
            if off_deg <= self.max_angle_deg:
                return posterior, f"{reason}, {off_deg:.0f}° from the motion going on"
        return None, ""

    def _stands(self, posterior: Posterior) -> bool:
        """Return whether a closure could place a frame without the previous view."""
        return posterior.outcome is Outcome.CONVERGED and _flaw(posterior, self.min_overlap) is None

    def _agreement(
        self, posterior: Posterior, base: Posterior, views: Mapping[int, RayImage], solution: Solution
    ) -> tuple[bool, str]:
        """Return whether a closure agrees with the way through the graph and along `base`, and how well, in words."""
        way = solution.relative_gaussian(posterior.target, base.target)
        predicted = PoseGaussian(
            way.mean @ base.pose.mean,
            se3.composed_covariance(way.covariance, base.pose.mean, base.pose.covariance),
        )
        difference = se3.inverse(predicted.mean) @ posterior.pose.mean
        centroid_m = se3.transform(se3.inverse(base.pose.mean), views[base.target].centroid_m[None])[0]
        frames = list(views)
        length = 1 + abs(frames.index(base.target) - frames.index(posterior.target))
        spread = self.sigma_scale**2 * (predicted.covariance + posterior.pose.covariance)
        spread = spread + self._drift_covariance(length, centroid_m)
        xi = se3.log(difference)
        distance = float(np.sqrt(xi @ np.linalg.solve(spread, xi)))
        off_deg = float(np.degrees(se3.rotation_angle(difference)))
        off_m = float(np.linalg.norm(se3.transform(difference, centroid_m[None])[0] - centroid_m))
        verdict = "closes the loop" if distance <= _RADIUS else "contradicts the chain"
        sizes = f"{off_deg:.1f}° and {1000.0 * off_m:.1f} mm from its prediction"
        return distance <= _RADIUS, f"{verdict}: {sizes}, distance {distance:.1f} of {_RADIUS:.1f} allowed"

    def _drift_covariance(self, length: int, centroid_m: Array) -> Array:
        """Return the covariance (6, 6) of the systematic error of a chain of `length` edges, seen from its end."""
        sigmas = length * np.repeat([np.radians(self.drift_deg), self.drift_m], 3)
        camera_from_object = se3.adjoint(se3.translation(centroid_m))
        return camera_from_object @ np.diag(sigmas**2) @ camera_from_object.T


def _continued(solution: Solution, frames: Sequence[int], source: int) -> Array:
    """Return object_from_camera (4, 4) of a new frame if the last motion between `frames` goes on at its pace."""
    last = frames[-1]
    if len(frames) < 2:
        return solution.trajectory[last]
    before = frames[-2]
    pace = min(max((source - last) / (last - before), 0.0), 3.0)  # beyond three steps it is anybody's guess
    return solution.trajectory[last] @ se3.exp(pace * se3.log(solution.relative(before, last)))


def _flaw(posterior: Posterior, min_overlap: float | None = None) -> str | None:
    """Return what keeps a posterior out of the graph whatever the others say; None: nothing."""
    if not posterior.usable:
        return f"{posterior.outcome.label}: {posterior.outcome.advice}"
    pose = posterior.pose
    if not (np.isfinite(pose.mean).all() and np.isfinite(pose.covariance).all()):
        return "the posterior is not finite: the registration broke down"
    variances = np.linalg.eigvalsh(pose.covariance)
    if variances[0] <= 1e-15 * variances[-1]:
        return "the covariance is not positive definite: the registration is degenerate"
    if min_overlap is not None and not posterior.overlap >= min_overlap:
        return f"the overlap {posterior.overlap:.2f} is below {min_overlap:.2f}"
    return None
