"""What a new view is registered against besides the previous one, and the judgement of the results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from modeler import se3
from modeler.closure.consistency import Thresholds, flaw, modes, open_turn, thresholds_from
from modeler.closure.consistency_model import ConsistencyModel
from modeler.closure.extrapolation import came_back, composed
from modeler.closure.information_gain import InformationGain
from modeler.closure.map_view import MapView
from modeler.closure.paths import ShortestPaths
from modeler.closure.relocaliser import Relocaliser
from modeler.types import (
    Consistency,
    Edge,
    EdgeKind,
    NotPlaced,
    OpenRotation,
    PoseGaussian,
    Posterior,
    Reason,
    Solution,
)

_LEAST_CHANCE = 0.02  # that a view is in reach: one that comes back after a turn that nothing told tells very much
_NO_NEWS = 0.5  # of a sigma: who knows a turn better learns little of it, and what else an edge tells is welcome
_SPAN_POWER = 6.0  # an edge over 25° tells half as much as one over none, over 50° a fourteenth


@dataclass(frozen=True)
class Closer:
    """Chooses what a new view is registered against and judges the results, in words.

    Every view is registered against the previous one. Further views are tried where an edge to them would tell much:
    where the object comes back after having turned away, or where many small steps can be spanned by a large one. A
    result is accepted where it agrees with what the other edges predict.
    """

    max_angle_deg: float = 45.0
    """Largest rotation in degrees to an earlier view for it to be tried as a closure, as far as the graph can tell."""
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
    """How far the evidence of such an edge may lie below that of the others, a nat an effective point."""
    max_open_deg: float = 5.0
    """Largest standard deviation in degrees of the turn about any axis of such an edge, where the graph knows that turn
    as badly. What leaves a turn open, about the axis of a bottle, is bounded by the same limits as the edges that
    placed the frames, which hold these already; and where that axis lies it knows too badly for a wide turn about it
    not to contradict the others."""
    consistency_model: ConsistencyModel = field(default_factory=ConsistencyModel)
    """In covariances that edges state."""

    def closure_targets(
        self,
        base: Posterior,
        map_view: MapView,
        *,
        last: bool = False,
    ) -> tuple[int, ...]:
        """Return the views to register a frame against besides the one that places it, best first.

        Args:
            base: the registration that places the frame.
            map_view: what is known so far.
            last: whether this is the last frame: it is tried against the first wherever that is in reach.
        """
        frames = map_view.frames
        if self.max_closures == 0 or len(frames) < 2:
            return ()
        expected = map_view.solution.trajectory[base.target] @ modes(base)[0][1].mean
        angle_deg = np.degrees(se3.rotation_angle(se3.inverse(map_view.all_poses) @ expected))
        own = self.consistency_model.systematic(1, map_view.views[base.target].centroid_m)
        information_gain = InformationGain(map_view, base.target, expected, own, self.max_angle_deg)
        in_reach = information_gain.within(frames, angle_deg) >= _LEAST_CHANCE
        near = [int(number) for number in np.flatnonzero(in_reach) if frames[number] != base.target]
        chosen, spanned = [], False
        for candidate in information_gain.candidates(
            [frames[number] for number in near], angle_deg[near], self.min_gain_nats
        ):
            if candidate.overlap >= self.min_overlap:
                back = self._back(candidate.frame, base.source, information_gain.reach, map_view)
                if back or not spanned:  # one large step over many small ones is enough
                    chosen.append(candidate.frame)
                spanned = spanned or not back
        first = frames[0]
        if first in chosen or (last and 0 in near and self._back(first, base.source, information_gain.reach, map_view)):
            chosen = [first, *(frame for frame in chosen if frame != first)]  # to close on the first is best
        return tuple(chosen[: self.max_closures])

    def span_pairs(self, map_view: MapView) -> tuple[tuple[int, int], ...]:
        """Return pairs (source, target) of views to register once all are in: for each view those that tell most."""
        frames = sorted(map_view.frames)
        poses = map_view.poses(frames)
        tried = {frozenset((edge.source, edge.target)) for edge in map_view.edges}
        pairs: list[tuple[int, int]] = []
        limit_deg = self.max_span_deg
        for number, source in enumerate(frames if self.max_spans else ()):
            angle_deg = np.degrees(se3.rotation_angle(se3.inverse(poses[:number]) @ poses[number]))
            near = [k for k in np.flatnonzero(angle_deg <= limit_deg) if {source, frames[k]} not in tried]
            own = self.consistency_model.systematic(1, map_view.views[source].centroid_m)
            information_gain = InformationGain(
                map_view, source, poses[number], own, limit_deg, hangs=False, power=_SPAN_POWER
            )
            found = information_gain.candidates([frames[k] for k in near], angle_deg[near], self.min_span_gain_nats)
            telling = [(source, candidate.frame) for candidate in found if candidate.overlap >= self.min_overlap]
            pairs += telling[: self.max_spans]
        return tuple(pairs)

    def predicted_motion(self, base: Posterior, target: int, solution: Solution) -> PoseGaussian:
        """Return target_from_source of the frame that a registration places and a view, as all edges tell it."""
        return composed(solution.relative_gaussian(target, base.target), modes(base)[0][1])

    def relocalisation_target(self, posteriors: Sequence[Posterior], map_view: MapView) -> int | None:
        """Return the earlier view to register a lost frame against next; None: it is given up. See `Relocaliser.next`.

        Args:
            posteriors: what was tried for the frame, the previous view first.
            map_view: what is known so far.
        """
        if len(posteriors) > self.max_relocations:
            return None
        return self._placing(map_view).next(posteriors)

    def placement(
        self, posteriors: Sequence[Posterior], map_view: MapView, *, steps: int = 1
    ) -> tuple[Posterior | None, Reason]:
        """Return the posterior that places a frame, and why: the previous view's, or else another's. See `Relocaliser`.

        Args:
            posteriors: registrations of the frame, the previous view first.
            map_view: what is known so far.
            steps: how many frames lie between the previous view and this frame, this one counted.
        """
        return self._placing(map_view, steps=steps).base(posteriors)

    def judge(self, posteriors: Sequence[Posterior], map_view: MapView, *, steps: int = 1) -> tuple[Edge, ...]:
        """Return one judged edge per posterior, in their order. The frame joins the graph if any is accepted.

        Edges to views that the object had turned away from are closures; of the others the one that places the frame,
        or was to, is odometry, and the rest are spans.

        Args:
            posteriors: registrations of one new frame, against the previous view first.
            map_view: what is known so far.
            steps: how many frames lie between the previous view and this frame, this one counted.
        """
        base, base_reason = self.placement(posteriors, map_view, steps=steps)
        reach = map_view.shortest_paths(base.target) if base is not None and len(posteriors) > 1 else ShortestPaths()
        edges, thresholds = [], self._thresholds(map_view)
        for number, posterior in enumerate(posteriors):
            back = number > 0 and self._back(posterior.target, posterior.source, reach, map_view)
            places = number == 0 or base is None or posterior is base
            kind: EdgeKind = "closure" if back else "odometry" if places else "span"
            if posterior is base:
                edge = Edge(posterior, kind, accepted=True, reason=base_reason)
            elif (found := flaw(posterior, thresholds if number or steps > 1 else None)) is not None:
                edge = Edge(posterior, kind, accepted=False, reason=found)
            elif base is None:
                edge = Edge(posterior, kind, accepted=False, reason=NotPlaced())
            elif (
                found := self._open(posterior, self.predicted_motion(base, posterior.target, map_view.solution))
            ) is not None:
                edge = Edge(posterior, kind, accepted=False, reason=found)
            else:
                edge = _judged(
                    posterior, kind, self.consistency_model.consistency_through(base, posterior, map_view, reach)
                )
            edges.append(edge)
        return tuple(edges)

    def judge_span(self, posterior: Posterior, map_view: MapView) -> Edge:
        """Return the judged edge between two views of the graph, from a registration that it does not hold yet."""
        reach = map_view.shortest_paths(posterior.source)
        kind = "closure" if self._back(posterior.target, posterior.source, reach, map_view) else "span"
        foretold = map_view.solution.relative_gaussian(posterior.target, posterior.source)
        if (found := flaw(posterior, self._thresholds(map_view)) or self._open(posterior, foretold)) is not None:
            return Edge(posterior, kind, accepted=False, reason=found)
        length, centroid_m = reach[posterior.target].edges, map_view.views[posterior.source].centroid_m
        agreed = self.consistency_model.agreement(posterior, [(1.0, foretold)], length=length, centroid_m=centroid_m)
        return _judged(posterior, kind, agreed)

    def _open(self, posterior: Posterior, foretold: PoseGaussian) -> Reason | None:
        """Return what keeps a registration out that tells too little of a turn nobody else tells of; None: nothing."""
        sigma_rad, axis = open_turn(posterior)
        known_rad = float(np.sqrt(axis @ foretold.covariance[:3, :3] @ axis))
        if np.degrees(sigma_rad) <= self.max_open_deg or known_rad <= _NO_NEWS * sigma_rad:
            return None
        return OpenRotation(float(np.degrees(sigma_rad)))

    def _back(self, target: int, source: int, reach: ShortestPaths, map_view: MapView) -> bool:
        return came_back(target, source, reach, map_view, away_deg=self.away_deg)

    def _placing(self, map_view: MapView, *, steps: int = 1) -> Relocaliser:
        return Relocaliser(map_view, self._thresholds(map_view), self.consistency_model, self.max_angle_deg, steps)

    def _thresholds(self, map_view: MapView) -> Thresholds:
        return thresholds_from(
            map_view.edges, map_view.solution, min_overlap=self.min_overlap, drop_nats=self.max_evidence_drop_nats
        )


def _judged(posterior: Posterior, kind: EdgeKind, found: Consistency) -> Edge:
    """Return an edge that is accepted where it agrees with the others."""
    return Edge(posterior, kind, found.consistent, found)
