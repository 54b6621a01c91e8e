"""What a new view is registered against besides the previous one, and the judgement of the results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.closure.prospects import Outlook
from modeler.closure.reckoning import came_back, continued, onwards
from modeler.closure.verdict import Agreement, Standard, agreement, flaw, modes, standard, stands
from modeler.closure.ways import Way, ways
from modeler.types import Array, Edge, PoseGaussian, Posterior, RayImage, Solution

_SPAN_POWER = 6.0  # an edge over 25° tells half as much as one over none, over 50° a fourteenth


@dataclass(frozen=True)
class Closer:
    """Chooses what a new view is registered against and judges the results, in words.

    Every view is registered against the previous one. Further views are tried where an edge to them would tell much:
    where the object comes back after having turned away, or where many small steps can be spanned by a large one. A
    result is accepted where it agrees with what the other edges predict. Pairwise covariances hold no systematic
    error, which adds up along a chain instead of averaging out, so the test is wider than they say; see the fields.
    """

    max_angle_deg: float = 45.0
    """Largest predicted rotation in degrees to an earlier view for it to be tried as a closure."""
    away_deg: float = 90.0
    """How far in degrees the object must have turned away from an earlier view before it counts as coming back."""
    max_closures: int = 2
    """At most so many views besides the previous one are tried for a frame; 0 = never close."""
    min_gain_nats: float = 4.16
    """Least information that an edge must promise: the default makes six directions twice as sure, 6 log 2."""
    max_spans: int = 1
    """Once all frames are in, at most so many more views are tried for each of them; 0 = none."""
    max_span_deg: float = 55.0
    """Largest rotation in degrees to such a view: two steps of the usual 25°."""
    min_span_gain_nats: float = 0.1
    """Least information that it must promise: an edge over two steps of 25° does."""
    max_relocations: int = 4
    """At most so many earlier views are tried for a frame that the previous view does not place."""
    min_overlap: float = 0.4
    """Smallest overlap (0..1) of an edge to any but the previous view, predicted and found."""
    max_evidence_drop_nats: float = 40.0
    """How far the evidence of such an edge may lie below that of the others, half a nat an effective point."""
    sigma_scale: float = 2.0
    """How many times the standard deviations of edges may understate their random errors."""
    drift_deg: float = 0.15
    """Systematic rotation error of an edge in degrees; along a chain it adds up."""
    drift_m: float = 0.00025
    """Systematic translation error of an edge in m, at the object; along a chain it adds up."""

    def closures(
        self,
        base: Posterior,
        views: Mapping[int, RayImage],
        solution: Solution,
        known: Sequence[Edge],
        *,
        last: bool = False,
    ) -> tuple[int, ...]:
        """Return the views to register a frame against besides the one that places it, best first.

        Args:
            base: the registration that places the frame.
            views: the accepted views, in order of acceptance.
            solution: the poses so far.
            known: every edge judged so far.
            last: whether this is the last frame: it is tried against the first wherever that is in reach.
        """
        frames = [frame for frame in views if frame in solution.trajectory]
        if self.max_closures == 0 or len(frames) < 2:
            return ()
        poses = np.stack([solution.trajectory[frame] for frame in frames])
        expected = solution.trajectory[base.target] @ modes(base)[0][1].mean
        angle_deg = np.degrees(se3.rotation_angle(se3.inverse(poses) @ expected))
        near = [number for number in np.flatnonzero(angle_deg <= self.max_angle_deg) if frames[number] != base.target]
        outlook = Outlook(
            solution, views, known, base.target, expected, self._systematic(1, views[base.target].centroid_m)
        )
        chosen, spanned = [], False
        for prospect in outlook.prospects([frames[number] for number in near], angle_deg[near], self.min_gain_nats):
            if prospect.overlap >= self.min_overlap:
                back = self._back(prospect.frame, base.source, outlook.reach, solution)
                if back or not spanned:  # one large step over many small ones is enough
                    chosen.append(prospect.frame)
                spanned = spanned or not back
        first = frames[0]
        if first in chosen or (last and 0 in near and self._back(first, base.source, outlook.reach, solution)):
            chosen = [first, *(frame for frame in chosen if frame != first)]  # to close on the first is best
        return tuple(chosen[: self.max_closures])

    def spans(
        self, views: Mapping[int, RayImage], solution: Solution, known: Sequence[Edge]
    ) -> tuple[tuple[int, int], ...]:
        """Return pairs (source, target) of views to register once all are in: for each view those that tell most."""
        frames = sorted(frame for frame in views if frame in solution.trajectory)
        poses = np.stack([solution.trajectory[frame] for frame in frames]) if frames else np.zeros((0, 4, 4))
        tried = {frozenset((edge.source, edge.target)) for edge in known}
        pairs: list[tuple[int, int]] = []
        for number, source in enumerate(frames if self.max_spans else ()):
            angle_deg = np.degrees(se3.rotation_angle(se3.inverse(poses[:number]) @ poses[number]))
            near = [k for k in np.flatnonzero(angle_deg <= self.max_span_deg) if {source, frames[k]} not in tried]
            own = self._systematic(1, views[source].centroid_m)
            outlook = Outlook(solution, views, known, source, poses[number], own, hangs=False, power=_SPAN_POWER)
            found = outlook.prospects([frames[k] for k in near], angle_deg[near], self.min_span_gain_nats)
            telling = [(source, prospect.frame) for prospect in found if prospect.overlap >= self.min_overlap]
            pairs += telling[: self.max_spans]
        return tuple(pairs)

    def foreseen(self, base: Posterior, target: int, solution: Solution) -> PoseGaussian:
        """Return target_from_source of the frame that a registration places and a view, as all edges tell it."""
        return onwards(solution.relative_gaussian(target, base.target), modes(base)[0][1])

    def relocation(
        self,
        posteriors: Sequence[Posterior],
        views: Mapping[int, RayImage],
        solution: Solution,
        known: Sequence[Edge] = (),
    ) -> int | None:
        """Return the earlier view to register a lost frame against next; None: it is given up.

        A posterior that stands alone wants a witness: the view nearest to where it puts the frame. Otherwise the view
        nearest to where the motion leads comes first, then those farthest from all views tried.

        Args:
            posteriors: what was tried for the frame, the previous view first.
            views: the accepted views, in order of acceptance.
            solution: the poses so far.
            known: every edge judged so far.
        """
        asked = self._asked(known)
        tried = [posterior.target for posterior in posteriors]
        frames = [frame for frame in views if frame in solution.trajectory]
        left = [frame for frame in frames if frame not in tried]
        if not left or len(tried) > self.max_relocations:
            return None
        poses = np.stack([solution.trajectory[frame] for frame in left])
        for posterior in (posterior for posterior in posteriors if stands(posterior, asked)):
            placed = solution.trajectory[posterior.target] @ posterior.pose.mean
            angle_deg = np.degrees(se3.rotation_angle(se3.inverse(poses) @ placed))
            if angle_deg.min() <= self.max_angle_deg:
                return left[int(np.argmin(angle_deg))]
        if len(tried) == 1:
            expected = continued(solution, frames, posteriors[0].source)
            return left[int(np.argmin(se3.rotation_angle(se3.inverse(poses) @ expected)))]
        apart = [se3.rotation_angle(se3.inverse(solution.trajectory[frame]) @ poses) for frame in tried]
        return left[int(np.argmax(np.min(apart, axis=0)))]

    def base(
        self,
        posteriors: Sequence[Posterior],
        views: Mapping[int, RayImage],
        solution: Solution,
        known: Sequence[Edge] = (),
        *,
        steps: int = 1,
    ) -> tuple[Posterior | None, str]:
        """Return the posterior that places a frame, and why: the previous view's, or else another's.

        Another view's places the frame where the motion going on would, roughly, have taken it, if the turn between the
        two is not too large; with a witness also beyond, the farther the more frames were lost. After lost frames the
        previous view is believed as far as that.

        Args:
            posteriors: registrations of the frame, the previous view first.
            views: the accepted views, in order of acceptance.
            solution: the poses so far.
            known: every edge judged so far.
            steps: how many frames lie between the previous view and this frame, this one counted.
        """
        if not posteriors:
            return None, ""
        odometry, *others = posteriors
        frames = [frame for frame in views if frame in solution.trajectory]
        expected = continued(solution, frames, odometry.source)
        # A pace that changes at random from step to step goes astray with the root of their number.
        reach_deg = float(np.sqrt(steps)) * self.max_angle_deg
        believed = steps == 1 or len(frames) == 1 or self._off_deg(odometry, expected, solution) <= reach_deg
        asked = self._asked(known)
        contradicted = steps > 1 and odometry.log_evidence < asked.least_nats
        if flaw(odometry) is None and believed and not contradicted:
            return odometry, f"joins the previous view: {odometry.outcome.label}, overlap {odometry.overlap:.2f}"
        standing = sorted((other for other in others if stands(other, asked)), key=lambda other: -other.overlap)
        for posterior in standing:
            reason = f"joins in place of the failed previous view: overlap {posterior.overlap:.2f}"
            off_deg = self._off_deg(posterior, expected, solution)
            # Near the end of what views can be registered across, one alone may be cut off there.
            turned_deg = float(np.degrees(se3.rotation_angle(posterior.pose.mean)))
            if max(off_deg, turned_deg) <= self.max_angle_deg:
                return posterior, f"{reason}, {off_deg:.0f}° from the motion going on"
            reach = ways(known, posterior.target)
            for witness in standing if off_deg <= reach_deg else ():
                if witness is not posterior and self._agreement(witness, posterior, views, solution, reach).agrees:
                    return posterior, f"{reason}, frame {witness.target} agrees"
        return None, ""

    def edges(
        self,
        posteriors: Sequence[Posterior],
        views: Mapping[int, RayImage],
        solution: Solution,
        known: Sequence[Edge] = (),
        *,
        steps: int = 1,
    ) -> tuple[Edge, ...]:
        """Return one judged edge per posterior, in their order. The frame joins the graph if any is accepted.

        Edges to views that the object had turned away from are closures, the others odometry.

        Args:
            posteriors: registrations of one new frame, against the previous view first.
            views: the accepted views, in order of acceptance.
            solution: the poses so far.
            known: every edge judged so far.
            steps: how many frames lie between the previous view and this frame, this one counted.
        """
        base, base_reason = self.base(posteriors, views, solution, known, steps=steps)
        reach = ways(known, base.target) if base is not None and len(posteriors) > 1 else {}
        edges, asked = [], self._asked(known)
        for number, posterior in enumerate(posteriors):
            back = number > 0 and self._back(posterior.target, posterior.source, reach, solution)
            if posterior is base:
                accepted, reason = True, base_reason
            elif (found := flaw(posterior, asked if number or steps > 1 else None)) is not None:
                accepted, reason = False, found
            elif base is None:
                accepted, reason = False, "neither the previous view nor another one places the frame with certainty"
            else:
                agreed = self._agreement(posterior, base, views, solution, reach)
                agreeing = "closes the loop" if back else "spans several steps"
                verdict = agreeing if agreed.agrees else "contradicts the chain"
                accepted, reason = agreed.agrees, f"{verdict}: {agreed.words}"
            edges.append(Edge(posterior, "closure" if back else "odometry", accepted, reason))
        return tuple(edges)

    def spanning(
        self, posterior: Posterior, views: Mapping[int, RayImage], solution: Solution, known: Sequence[Edge]
    ) -> Edge:
        """Return the judged edge between two views of the graph, from a registration that it does not hold yet."""
        reach, centroid_m = ways(known, posterior.source), views[posterior.source].centroid_m
        kind = "closure" if self._back(posterior.target, posterior.source, reach, solution) else "odometry"
        if (found := flaw(posterior, self._asked(known))) is not None:
            return Edge(posterior, kind, accepted=False, reason=found)
        agreed = agreement(
            posterior,
            [(1.0, solution.relative_gaussian(posterior.target, posterior.source))],
            systematic=self._systematic(reach[posterior.target].edges, centroid_m),
            scale=self.sigma_scale,
            centroid_m=centroid_m,
        )
        agreeing = "closes the loop" if kind == "closure" else "spans several steps"
        verdict = agreeing if agreed.agrees else "contradicts the chain"
        return Edge(posterior, kind, agreed.agrees, f"{verdict}: {agreed.words}")

    def _back(self, target: int, source: int, reach: Mapping[int, Way], solution: Solution) -> bool:
        return came_back(target, source, reach, solution, away_deg=self.away_deg)

    def _off_deg(self, posterior: Posterior, expected: Array, solution: Solution) -> float:
        """Return the angle between where a registration puts a frame and an object_from_camera (4, 4)."""
        placed = solution.trajectory[posterior.target] @ modes(posterior)[0][1].mean
        return float(np.degrees(se3.rotation_angle(se3.inverse(expected) @ placed)))

    def _asked(self, known: Sequence[Edge]) -> Standard:
        return standard(known, min_overlap=self.min_overlap, drop_nats=self.max_evidence_drop_nats)

    def _agreement(
        self,
        posterior: Posterior,
        base: Posterior,
        views: Mapping[int, RayImage],
        solution: Solution,
        reach: Mapping[int, Way],
    ) -> Agreement:
        """Return how well a registration agrees with the way through the graph and along `base`."""
        way = solution.relative_gaussian(posterior.target, base.target)
        predictions = [(weight, onwards(way, pose)) for weight, pose in modes(base)]
        centroid_m = se3.transform(se3.inverse(modes(base)[0][1].mean), views[base.target].centroid_m[None])[0]
        surest = reach.get(posterior.target)
        length = abs(list(views).index(base.target) - list(views).index(posterior.target))
        length = length if surest is None else surest.edges
        return agreement(
            posterior,
            predictions,
            systematic=self._systematic(1 + length, centroid_m),
            scale=self.sigma_scale,
            centroid_m=centroid_m,
        )

    def _systematic(self, length: int, centroid_m: Array) -> Array:
        """Return the covariance (6, 6) of the systematic error of a chain of `length` edges, seen from its end."""
        sigmas = length * np.repeat([np.radians(self.drift_deg), self.drift_m], 3)
        camera_from_object = se3.adjoint(se3.translation(centroid_m))
        return camera_from_object @ np.diag(sigmas**2) @ camera_from_object.T
