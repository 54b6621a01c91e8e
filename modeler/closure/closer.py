"""Selection of the pairs of views to register besides consecutive ones, and of the registrations to accept.

`map_view` is the map so far; `posteriors` are the registrations of one frame so far, against the previous view first,
from which it is `steps` frames away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modeler import se3
from modeler.closure.consistency import ConsistencyModel, Thresholds, Usual, modes
from modeler.closure.information_gain import InformationGain
from modeler.closure.map_view import MapView, ShortestPaths, composed
from modeler.priors.general import LARGE_DEG
from modeler.significance import UNLIKELY
from modeler.types import (
    AWAY_DEG,
    NEAR_DEG,
    ConfirmedBy,
    Edge,
    EdgeKind,
    Failed,
    JoinsPrevious,
    NearExtrapolation,
    NotPlaced,
    PoseGaussian,
    Posterior,
    Reason,
    Relocalised,
    Solution,
    loops_closed,
    segments,
)

_SPAN_POWER = 6.0  # an edge over 25° adds half the information of one over none, over 50° a fourteenth


@dataclass(frozen=True)
class Closer:
    """Selects the views against which a new one is registered, and accepts or rejects the results.

    Every view is registered against the previous one. Further pairs are registered if their edge is expected to be
    informative: if the object returns after turning away, or if one edge spans many small steps. A result is accepted
    if it is consistent with the other edges (docs/method/closure.md).
    """

    max_angle_deg: float = NEAR_DEG
    """Largest predicted rotation in degrees to an earlier view: views are registered unless they are unlikely to be
    within it, as returns after uncertain turns add much information."""
    away_deg: float = AWAY_DEG
    """Rotation in degrees by which the object must have turned away from an earlier view for an edge to it to be a
    closure."""
    keyframe_deg: float = 10.0
    """Least rotation in degrees between keyframes. Closures only lead to keyframes, so that the graph of many turns is
    one map with chains along it, and each further turn costs the same. The edge to the nearest keyframe has at least
    97 % of the information of one over no rotation (method, eq. 9.1)."""
    max_closures: int = 2
    """Largest number of views, besides the previous one, to register a frame against; 0 = none. Halved or doubled,
    builds of the dragon and of cap are the same."""
    min_gain_nats: float = 4.16
    """Least expected information gain of a closure: 6 log 2 halves all six standard deviations."""
    max_spans: int = 1
    """Largest number of further views to register each frame against once all are in; 0 = none. With 2, the dragon's
    poses have a standard deviation of 0.108° for 0.115°."""
    max_span_deg: float = 55.0
    """Largest rotation in degrees to such a view: two steps of the usual 25°."""
    min_span_gain_nats: float = 0.1
    """Least expected information gain of such an edge: that of one over two steps of 25°."""
    max_relocations: int = 4
    """Largest number of earlier views to register a frame against that the previous view does not place: a pair without
    common surface takes half a second."""
    thresholds: Thresholds = field(default_factory=Thresholds)
    """Requirements on all edges other than that to the previous view."""
    consistency: ConsistencyModel = field(default_factory=ConsistencyModel)
    """Limits on their deviation from the graph's prediction."""

    def closure_targets(self, base: Posterior, map_view: MapView, *, last: bool = False) -> tuple[int, ...]:
        """Return the views to register a frame against besides the one that places it, best first.

        Args:
            base: the registration that places the frame.
            map_view: the map so far.
            last: whether this is the last frame, which is registered against the first if that is within reach.
        """
        frames = map_view.targets
        if self.max_closures == 0 or len(map_view.frames) < 2:
            return ()
        expected = map_view.solution.trajectory[base.target] @ modes(base)[0][1].mean
        angle_deg = np.degrees(se3.rotation_angle(se3.inverse(map_view.poses(frames)) @ expected))
        systematic = self.consistency.systematic(1, map_view.views[base.target].centroid_m)
        gain = InformationGain(map_view, base.target, expected, systematic, self.max_angle_deg)
        in_reach = gain.probability_within(frames, angle_deg) >= UNLIKELY
        near = [int(k) for k in np.flatnonzero(in_reach) if frames[k] != base.target]
        chosen, spanned = [], False
        for candidate in gain.candidates([frames[k] for k in near], angle_deg[near], self.min_gain_nats):
            if candidate.overlap >= self.thresholds.min_overlap:
                closes = map_view.came_back(candidate.frame, base.source, gain.paths, away_deg=self.away_deg)
                if closes or not spanned:  # one span per frame is enough
                    chosen.append(candidate.frame)
                spanned = spanned or not closes
        first = frames[0]  # a closure with the first view is preferred
        wanted = last and first != base.target and self._returns(gain, base.source, first, float(angle_deg[0]))
        if wanted or first in chosen:
            chosen = [first, *(frame for frame in chosen if frame != first)]
        return tuple(chosen[: self.max_closures])

    def _returns(self, gain: InformationGain, last: int, first: int, angle_deg: float) -> bool:
        """Return whether the object came back to the first view, within reach, at a predicted rotation `angle_deg`."""
        known = gain.map_view
        closed = loops_closed([edge for edge in known.edges if known.solution.takes_part(edge)])
        # A turn of few large steps ends one step before its start.
        reach_deg = self.max_angle_deg if closed else max(self.max_angle_deg, LARGE_DEG)
        probability = replace(gain, max_angle_deg=reach_deg).probability_within([first], np.array([angle_deg]))
        within = bool(probability[0] >= UNLIKELY)
        return within and known.came_back(first, last, gain.paths, away_deg=self.away_deg)

    def span_pairs(self, map_view: MapView) -> tuple[tuple[int, int], ...]:
        """Return the most informative pairs (source, target) of each view to register once all are in.

        Both are of one segment, as there is no motion prior between segments. The last view of a segment is paired with
        the first if that is within reach, and each with the one before if their registration failed: now the graph
        predicts the motion, which exceeded the prior's limits or was not found.
        """
        segment_of = segments([edge for edge in map_view.edges if map_view.solution.takes_part(edge)])
        frames, targets = sorted(map_view.frames), np.array(sorted(map_view.targets))
        poses = map_view.poses(targets.tolist())
        tried = {frozenset((edge.source, edge.target)) for edge in map_view.edges}
        failed = {
            frozenset((edge.source, edge.target))
            for edge in map_view.edges
            if edge.kind == "odometry" and isinstance(edge.reason, Failed)
        }
        ends = {*{segment_of.get(frame): frame for frame in frames}.values()}
        segment = np.array([segment_of.get(int(target), -1) for target in targets], dtype=np.int64)
        pairs: list[tuple[int, int]] = []
        for source in frames if self.max_spans else ():
            pose, number = map_view.solution.trajectory[source], int(np.searchsorted(targets, source))
            own = np.flatnonzero(segment[:number] == segment_of.get(source, -1))
            earlier = targets[own].tolist()
            angle_deg = np.degrees(se3.rotation_angle(se3.inverse(poses[own]) @ pose))
            systematic = self.consistency.systematic(1, map_view.views[source].centroid_m)
            gain = InformationGain(
                map_view, source, pose, systematic, self.max_span_deg, has_own_edge=False, power=_SPAN_POWER
            )
            near = [k for k in np.flatnonzero(angle_deg <= self.max_span_deg) if {source, earlier[k]} not in tried]
            found = gain.candidates([earlier[k] for k in near], angle_deg[near], self.min_span_gain_nats)
            chosen = [one.frame for one in found if one.overlap >= self.thresholds.min_overlap]
            chosen = [frame for frame in earlier[-1:] if {source, frame} in failed] + chosen
            untried = source in ends and len(earlier) > 0 and {source, earlier[0]} not in tried
            if untried and self._returns(gain, source, earlier[0], float(angle_deg[0])):
                chosen = [earlier[0], *chosen]
            pairs += [(source, target) for target in chosen[: self.max_spans]]
        return tuple(pairs)

    def is_keyframe(self, frame: int, map_view: MapView) -> bool:
        """Return whether a view becomes a keyframe: no other one is near."""
        keyframes = map_view.poses(map_view.targets)
        angle_rad = se3.rotation_angle(se3.inverse(keyframes) @ map_view.solution.trajectory[frame])
        return bool(angle_rad.min(initial=np.inf) >= np.radians(self.keyframe_deg))

    def relocalisation_target(self, posteriors: Sequence[Posterior], map_view: MapView) -> int | None:
        """Return the earlier view to register a lost frame against next; None to give up."""
        if len(posteriors) > self.max_relocations:
            return None
        return self._relocaliser(map_view, self._usual(map_view)).next_target(posteriors)

    def placement(self, posteriors: Sequence[Posterior], map_view: MapView, *, steps: int = 1) -> Placement:
        """Return the posterior that places a frame, and why: that of the previous view, or else of another."""
        return self._relocaliser(map_view, self._usual(map_view), steps=steps).placement(posteriors)

    def predicted_motion(self, base: Posterior, target: int, solution: Solution) -> PoseGaussian:
        """Return the prediction of target_from_source between a frame, placed by a registration, and a view."""
        return composed(modes(base)[0][1], solution.relative_gaussian(target, base.target))

    def judge(
        self, posteriors: Sequence[Posterior], placement: Placement, map_view: MapView, *, steps: int = 1
    ) -> tuple[Edge, ...]:
        """Return an edge, accepted or rejected, per posterior. The frame joins the graph if any is accepted.

        Edges to views from which the object had turned away are closures; of the others, the one that places the frame,
        or was meant to, is odometry, and the rest are spans.
        """
        base = placement.base
        paths = map_view.shortest_paths(base.target) if base is not None and len(posteriors) > 1 else ShortestPaths()
        usual, edges = self._usual(map_view), []
        for number, posterior in enumerate(posteriors):
            consecutive = number == 0 and steps == 1
            closes = number > 0 and self._came_back(posterior, map_view, paths)
            is_base = base is not None and posterior.target == base.target
            places = number == 0 or base is None or is_base
            kind: EdgeKind = "closure" if closes else "odometry" if places else "span"
            if is_base:
                edges.append(Edge(posterior, kind, True, placement.reason))
            elif reason := self.thresholds.failed(posterior, usual, consecutive=consecutive):
                edges.append(Edge(posterior, kind, False, reason))
            elif base is None:
                edges.append(Edge(posterior, kind, False, NotPlaced()))
            elif reason := self.thresholds.open_rotation(
                posterior, self.predicted_motion(base, posterior.target, map_view.solution)
            ):
                edges.append(Edge(posterior, kind, False, reason))
            else:
                found = self.consistency.consistency_through(base, posterior, map_view, paths)
                edges.append(Edge(posterior, kind, found.consistent, found))
        return tuple(edges)

    def judge_span(self, posterior: Posterior, map_view: MapView) -> Edge:
        """Return the edge, accepted or rejected, of a further registration between two views of the graph."""
        paths = map_view.shortest_paths(posterior.source)
        kind = "closure" if self._came_back(posterior, map_view, paths) else "span"
        predicted = map_view.solution.relative_gaussian(posterior.target, posterior.source)
        defect = self.thresholds.defect(posterior, self._usual(map_view))
        if reason := defect or self.thresholds.open_rotation(posterior, predicted):
            return Edge(posterior, kind, False, reason)
        length, centroid_m = paths[posterior.target].edges, map_view.views[posterior.source].centroid_m
        found = self.consistency.consistency(posterior, [(1.0, predicted)], length=length, centroid_m=centroid_m)
        return Edge(posterior, kind, found.consistent, found)

    def _came_back(self, posterior: Posterior, map_view: MapView, paths: ShortestPaths) -> bool:
        return map_view.came_back(posterior.target, posterior.source, paths, away_deg=self.away_deg)

    def _usual(self, map_view: MapView) -> Usual:
        return self.thresholds.usual(map_view.edges, map_view.solution)

    def _relocaliser(self, map_view: MapView, usual: Usual, *, steps: int = 1) -> Relocaliser:
        return Relocaliser(map_view, self.thresholds, usual, self.consistency, self.max_angle_deg, steps)


@dataclass(frozen=True, eq=False)
class Placement:
    """Which registration places a frame, if one does, and why."""

    base: Posterior | None = None
    """The registration; None: none does."""
    reason: Reason = field(default_factory=NotPlaced)
    """Why."""


@dataclass(frozen=True, eq=False)
class Relocaliser:
    """Selects which of a frame's registrations places it.

    Usually it is that of the previous view. After lost frames, or if another view has to replace it, one side of the
    object may match another: such a registration is accepted alone only near the extrapolated motion, and farther away
    if that of another view is consistent with it.
    """

    map_view: MapView
    """The map so far."""
    thresholds: Thresholds
    """Requirements on registrations."""
    usual: Usual
    """How well images match in the run's edges."""
    consistency: ConsistencyModel
    """Test of registrations against each other."""
    max_angle_deg: float
    """Largest rotation in degrees from the extrapolated motion at which a registration is accepted alone."""
    steps: int
    """Number of frames from the previous view to this one."""

    def placement(self, posteriors: Sequence[Posterior]) -> Placement:
        """Return the posterior that places a frame, and why."""
        if not posteriors:
            return Placement()
        odometry = posteriors[0]
        if self._continues(odometry) and (self.steps == 1 or self._angle_off_deg(odometry) <= self.max_angle_deg):
            return Placement(odometry, JoinsPrevious(odometry.outcome, odometry.overlap))
        candidates = [posterior for posterior in posteriors if self.thresholds.places_alone(posterior, self.usual)]
        for posterior in sorted(candidates, key=lambda posterior: -posterior.overlap):
            off_deg = self._angle_off_deg(posterior)
            # At the largest rotation that can be registered, the posterior may be truncated.
            rotation_deg = float(np.degrees(se3.rotation_angle(posterior.pose.mean)))
            support: NearExtrapolation | ConfirmedBy | None = NearExtrapolation(off_deg)
            if max(off_deg, rotation_deg) > self.max_angle_deg:
                support = self._confirmation(posterior, candidates)
            if support is None:
                continue
            if posterior is odometry:
                return Placement(posterior, JoinsPrevious(posterior.outcome, posterior.overlap, support))
            return Placement(posterior, Relocalised(posterior.overlap, support))
        return Placement()

    def next_target(self, posteriors: Sequence[Posterior]) -> int | None:
        """Return the earlier view to register a lost frame against next; None if none is left.

        A single acceptable posterior needs confirmation by the view nearest to its pose. Otherwise the view nearest to
        the extrapolated motion comes first, then those farthest from all views tried.
        """
        tried = [posterior.target for posterior in posteriors]
        untried = [frame for frame in self.map_view.frames if frame not in tried]
        if not untried:
            return None
        poses = self.map_view.poses(untried)
        for posterior in posteriors:
            if self.thresholds.places_alone(posterior, self.usual):
                placed = self.map_view.solution.trajectory[posterior.target] @ posterior.pose.mean
                angle_deg = np.degrees(se3.rotation_angle(se3.inverse(poses) @ placed))
                if angle_deg.min() <= self.max_angle_deg:
                    return untried[int(np.argmin(angle_deg))]
        if len(tried) == 1:
            expected = self.map_view.extrapolated(posteriors[0].source)
            return untried[int(np.argmin(se3.rotation_angle(se3.inverse(poses) @ expected)))]
        distances = [se3.rotation_angle(se3.inverse(pose) @ poses) for pose in self.map_view.poses(tried)]
        return untried[int(np.argmax(np.min(distances, axis=0)))]

    def _continues(self, odometry: Posterior) -> bool:
        """Return whether the previous view's registration is valid and, after lost frames, has enough evidence."""
        matches = self.steps == 1 or not odometry.log_marginal_likelihood < self.usual.min_nats
        return matches and self.thresholds.failed(odometry, self.usual, consecutive=True) is None

    def _confirmation(self, posterior: Posterior, candidates: Sequence[Posterior]) -> ConfirmedBy | None:
        """Return a consistent registration of another view, if this one is near the extrapolated motion; else None."""
        # The error of extrapolating a random walk grows with the root of the number of steps.
        if self._angle_off_deg(posterior) > float(np.sqrt(self.steps)) * self.max_angle_deg:
            return None
        paths = self.map_view.shortest_paths(posterior.target)
        for other in candidates:
            if other is not posterior:
                if self.consistency.consistency_through(posterior, other, self.map_view, paths).consistent:
                    return ConfirmedBy(other.target)
        return None

    def _angle_off_deg(self, posterior: Posterior) -> float:
        """Return the angle between a registration's pose of the frame and the extrapolated motion's."""
        if len(self.map_view.frames) == 1:
            return 0.0
        expected = self.map_view.extrapolated(posterior.source)
        placed = self.map_view.solution.trajectory[posterior.target] @ modes(posterior)[0][1].mean
        return float(np.degrees(se3.rotation_angle(se3.inverse(expected) @ placed)))
