"""Segments of views without a motion prior in between, joined by alignment of their models.

If an object is laid down differently or regrasped, the motion prior does not hold across the gap: its bottom has
changed, and single views before and after may share little surface. So the models fused from the views before and
after are aligned from all initial rotations, and alignments are scored by all pairs of views (docs/method/segments.md).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from scipy.special import chdtri

from modeler import se3
from modeler.closure.consistency import Thresholds, widest_rotation
from modeler.fusion import Fuser, FusionVolume, Matcher, conditional_covariances
from modeler.fusion.meshing import COARSE_VOXELS
from modeler.graph import PoseGraph, solve
from modeler.pipeline.pairs import Registrations
from modeler.priors.general import AnyMotion
from modeler.priors.mixtures import KernelMixture
from modeler.registration import VisibilityRegistrar
from modeler.registration.visibility.likelihood import PairLikelihood
from modeler.registration.visibility.search import Search
from modeler.significance import UNLIKELY
from modeler.types import (
    SOME_VIEWS,
    Array,
    Edge,
    ElsewhereThanSegments,
    Failed,
    JoinsSegments,
    OpenRotation,
    Outcome,
    Posterior,
    RayImage,
    Solution,
    spread,
)

ALIGNMENT_SIGMA_RAD = 0.12
"""Standard deviation of the alignment of a model with another, or with a frame: half of `SEPARATE_RAD`."""
ALIGNMENT_SIGMA = 0.15  # of its shift, in units of the object's size
_MAX_DEVIATION_RAD = 0.5  # of a posterior from the alignment, four standard deviations; beyond, it is at another mode
_MIN_ALIGNMENTS: Final = 4  # about which pairs of views are registered: in as many ways does a box match its shape
_MAX_ALIGNMENTS: Final = 24  # as many ways has a cube to match its shape, of which print singles out one
_CLOSE_NATS: Final = 10.0  # to the likeliest: registering gains a right alignment up to 5, and others are 50 below
MIN_JOINS: Final = 2
"""Pairs of views that must agree on an alignment: nothing confirms a single one."""


@dataclass(frozen=True, eq=False)
class Segment:
    """Views with their poses relative to each other."""

    views: Mapping[int, RayImage]
    """By frame number."""
    solution: Solution
    """Their poses in the object frame of the segment."""
    edges: Sequence[Edge]
    """Edges of the solution."""

    def volume(self, fuser: Fuser) -> FusionVolume:
        """Return the volume of the fused views."""
        conditional = conditional_covariances(self.solution, self.edges)
        return fuser.volume(self.views, self.solution.trajectory, conditional)

    @property
    def frames(self) -> list[int]:
        """Numbers of the views that have a pose, in order."""
        return sorted(frame for frame in self.views if frame in self.solution.trajectory)


@dataclass(frozen=True, eq=False)
class Alignment:
    """A hypothesis about the relative pose of two segments."""

    target_from_source: Array
    """(4, 4) object frame of the source segment to that of the target segment."""
    log_likelihood: float = 0.0
    """Mean log-likelihood in nats over all pairs of views, one of each segment."""
    share: float = 0.0
    """Probability (0..1), given that one of the alignments found is right, once they are weighted."""
    edges: tuple[Edge, ...] = ()
    """Pairs of views registered about it, accepted or rejected."""
    trajectory: Mapping[int, Array] | None = None
    """Poses (4, 4) of all cameras in that of the first view, by frame number, as the graph with its edges has them.
    None: as each segment has them."""

    @property
    def accepted(self) -> int:
        """Number of pairs that agree with it."""
        return sum(edge.accepted for edge in self.edges)


@dataclass(frozen=True)
class Joiner:
    """Joins segments: aligns their models, scores alignments by all views, and registers pairs of views."""

    registrations: Registrations = field(default_factory=lambda: Registrations(VisibilityRegistrar()))
    """Registers the pairs."""
    ready: Callable[[RayImage], RayImage] = lambda view: view
    """Returns a view with the images that a likelihood looks up."""
    pairs: int = 6
    """Number of pairs of views to register, one of each segment: `MIN_JOINS` of them must agree, and some fail."""
    sigma_rad: float = ALIGNMENT_SIGMA_RAD
    """Standard deviation of the rotation of an alignment about which pairs are registered."""

    def join(self, target: Segment, source: Segment) -> list[Alignment]:
        """Return the possible alignments of two segments, likeliest first.

        Candidates come from aligning the models, which must have most of their surface in common; if none is
        consistent, also from registering pairs of views without limits. If still none is, the edges of the first are
        rejected.
        """
        found: list[Alignment] = []
        for propose in (self._by_models, self._by_views):
            found = self._refined(target, source, propose(target, source), found)
            if found and found[0].accepted >= MIN_JOINS and self.is_consistent(target, source, found[0]):
                return found
        if not found:
            return []
        edges = tuple(  # the segments contradict each other
            replace(edge, accepted=False, reason=Failed(Outcome.NO_OVERLAP, edge.posterior.overlap))
            if edge.accepted
            else edge
            for edge in found[0].edges
        )
        return [replace(found[0], edges=edges), *found[1:]]

    def is_consistent(self, target: Segment, source: Segment, alignment: Alignment) -> bool:
        """Return whether views of two segments fit each other as well as those of one segment that share as much do.

        Surface and colours must each do so: print that agrees does not make up for surface that does not. The tolerance
        is the chance deviation of the misfits of independent measurements, as many as a pair has for each view of the
        smaller segment (method, eq. 11.2).
        """
        count = min(SOME_VIEWS, len(target.frames), len(source.frames))
        freedom = count * self._independent(target, source)
        allowed = 0.5 * (float(chdtri(freedom, UNLIKELY)) - freedom) / count
        *found, shared = self._across(target, source, [alignment])[..., 0]
        *within, own = self._within(target, source)
        order = np.argsort(own, kind="stable")
        # Without common surface nothing is gained.
        alike = [np.interp(shared, [0.0, *own[order]], [0.0, *part[order]]) for part in within]
        return bool(np.mean(np.subtract(found, alike), axis=1).min() >= -allowed)

    def likelihoods(self, target: Segment, source: Segment, alignments: Sequence[Alignment]) -> Array:
        """Return the log-likelihoods (n,) in nats of alignments, means over pairs of views (eq. 11.1).

        Poses within a segment err, too, so that surface of right pairs of views costs, the more the more they share.
        Pairs that share none pay nothing: without that price an alignment would gain by sharing less. What print gains
        within segments is no part of the price: where it does not agree, nothing is gained.
        """
        surface, colours, shared = self._across(target, source, alignments).mean(axis=1)
        within, _, own = self._within(target, source).mean(axis=1)
        return np.asarray(surface + colours - (min(within / own, 0.0) if own > 0.0 else 0.0) * shared)

    def weighted(self, target: Segment, source: Segment, alignments: Sequence[Alignment]) -> list[Alignment]:
        """Return alignments with their likelihoods and probabilities, likeliest first.

        Views of one segment see the same surface, so that pairs are not independent: each view counts as if compared
        with one view of the other segment, not with all. Beside alignments on which pairs agree, others are impossible.
        """
        if not alignments:
            return []
        scores = self.likelihoods(target, source, alignments)
        agreed = np.array([alignment.accepted >= MIN_JOINS for alignment in alignments])
        ranks = np.where(agreed | ~agreed.any(), scores, -np.inf)
        shares = np.exp(min(SOME_VIEWS, len(target.frames), len(source.frames)) * (ranks - ranks.max()))
        shares /= shares.sum()
        order = np.argsort(-ranks, kind="stable")
        return [replace(alignments[k], log_likelihood=float(scores[k]), share=float(shares[k])) for k in order]

    def _refined(
        self, target: Segment, source: Segment, proposed: Sequence[Array], known: Sequence[Alignment]
    ) -> list[Alignment]:
        """Return the known alignments and the likeliest of the proposed (4, 4), refined by registering pairs of views.

        Proposals near known alignments are not registered again.
        """
        found = [*known]
        candidates = self.weighted(target, source, [Alignment(pose) for pose in proposed])
        for alignment in candidates:
            close = alignment.log_likelihood >= candidates[0].log_likelihood - _CLOSE_NATS
            most = len(known) + (_MAX_ALIGNMENTS if close else _MIN_ALIGNMENTS)
            if len(found) < most and not any(_near(alignment, other) for other in found):
                found.append(self._registered(target, source, alignment.target_from_source))
        distinct: list[Alignment] = []
        for alignment in self.weighted(target, source, found):
            if not any(_near(alignment, other) for other in distinct):
                distinct.append(alignment)
        distinct = self.weighted(target, source, distinct)
        if not distinct:
            return []
        rival_deg = 0.0 if len(distinct) == 1 else float(np.degrees(_angle(distinct[0], distinct[1])))
        reason = JoinsSegments(distinct[0].share, rival_deg)
        edges = tuple(replace(edge, reason=reason) if edge.accepted else edge for edge in distinct[0].edges)
        return [replace(distinct[0], edges=edges), *distinct[1:]]

    def _registered(self, target: Segment, source: Segment, target_from_source: Array) -> Alignment:
        """Return an alignment (4, 4), refined by registering pairs of views, and the poses of the graph with them.

        Segments are bent by errors that add up along them, within which right pairs agree and wrong ones do not.
        """
        edges = self._edges(target, source, target_from_source)
        found = Alignment(_mean_pose(target, source, edges, target_from_source), edges=edges)
        if not found.accepted:
            return found
        poses, first = _placed(target, source, found), target.frames[0]
        graph = PoseGraph((*target.edges, *source.edges, *edges), first=first)
        solved = solve(graph, {frame: se3.inverse(poses[first]) @ pose for frame, pose in poses.items()}).trajectory
        return replace(found, trajectory=solved) if solved.keys() >= poses.keys() else found

    def _by_models(self, target: Segment, source: Segment) -> list[Array]:
        """Return alignments (4, 4) of the models of two segments."""
        fuser = Fuser(max_voxels=COARSE_VOXELS)
        volumes = target.volume(fuser), source.volume(fuser)
        models = volumes[0].model(), volumes[1].model()
        if not all(len(model.points_m) for model in models):
            return []
        return [match.target_from_source for match in Matcher().matches(*volumes, models)]

    def _by_views(self, target: Segment, source: Segment) -> list[Array]:
        """Return alignments (4, 4) from registering pairs of views, some of each segment, without limits."""
        least_effort, prior = self.registrations.registrar.least_effort, AnyMotion()
        some = [self._spread(segment, Joiner.pairs) for segment in (target, source)]
        found = []
        for view, other in itertools.product(some[0].values(), some[1].values()):
            posterior = self.registrations.register(other, view, prior.between(other, view), effort=least_effort)
            if posterior.usable:
                found.append(_aligned(target, source, posterior))
        return found

    def _edges(self, target: Segment, source: Segment, target_from_source: Array) -> tuple[Edge, ...]:
        """Return edges, accepted or rejected, between views of two segments from nearly the same side."""
        return self.between(target, source, facing(target, source, target_from_source, self.pairs), target_from_source)

    def between(
        self, target: Segment, source: Segment, pairs: Sequence[tuple[int, int]], target_from_source: Array
    ) -> tuple[Edge, ...]:
        """Return edges, accepted or rejected, between pairs of views of two segments that are aligned roughly.

        Args:
            target: segment of the first views.
            source: segment of the second.
            pairs: frame numbers of the views.
            target_from_source: (4, 4) the rough alignment.
        """
        edges = []
        for t, s in pairs:
            views = self.ready(source.views[s]), self.ready(target.views[t])
            guess = se3.inverse(target.solution.trajectory[t]) @ target_from_source @ source.solution.trajectory[s]
            density = KernelMixture.about(guess, views[0], self.sigma_rad, ALIGNMENT_SIGMA * views[0].size_m)
            posterior = self.registrations.register(*views, density).without_samples()
            edges.append(self._judged(posterior, views, guess))
        return tuple(edges)

    def _judged(self, posterior: Posterior, views: tuple[RayImage, RayImage], guess: Array) -> Edge:
        """Return the posterior as an edge, accepted if it is usable, near the guess, and passes eq. 6.5.

        The guess is one of very many alignments, some of which match by chance: the images must not contradict it.
        """
        away_rad = float(se3.rotation_angle(se3.inverse(guess) @ posterior.pose.mean))
        if not posterior.usable:
            return Edge(posterior, "join", False, Failed(posterior.outcome, posterior.overlap))
        if away_rad > _MAX_DEVIATION_RAD:
            return Edge(posterior, "join", False, ElsewhereThanSegments(float(np.degrees(away_rad))))
        pair = self._pair(*views)
        sigma_rad, _ = widest_rotation(posterior)
        if sigma_rad > Thresholds.known_share * self.sigma_rad:  # the images add too little to the alignment
            return Edge(posterior, "join", False, OpenRotation(float(np.degrees(sigma_rad))))
        if not pair.fits(posterior.pose.mean, self._search.fine_m(pair)):  # method, eq. 6.5
            return Edge(posterior, "join", False, Failed(Outcome.NO_OVERLAP, posterior.overlap))
        return Edge(posterior, "join", True, JoinsSegments(1.0, 0.0))

    def _nats(self, source: RayImage, target: RayImage, poses: Array) -> Array:
        """Return log-likelihoods of surface and colours at poses (n, 4, 4) of a pair of views, and the shares E (0..1).

        (3, n). Without the cost of no overlap, because views from opposite sides have none.
        """
        pair = self._pair(source, target)
        found = pair.scores(poses, self._search.fine_m(pair), stride=1)
        return np.stack([pair.temper * found.surface, found.colours, found.explained])

    def _across(self, target: Segment, source: Segment, alignments: Sequence[Alignment]) -> Array:
        """Return as `_nats` (3, m, n) the m pairs of views, one of each segment, for n alignments."""
        targets, sources = self._spread(target, SOME_VIEWS), self._spread(source, SOME_VIEWS)
        placed = [_placed(target, source, alignment) for alignment in alignments]
        found = [
            self._nats(other, view, np.stack([se3.inverse(poses[t]) @ poses[s] for poses in placed]))
            for t, view in targets.items()
            for s, other in sources.items()
        ]
        return np.stack(found, axis=1)

    def _within(self, *segments: Segment) -> Array:
        """Return as `_nats` (3, m) the m pairs of views within segments; one of zeros if there are none."""
        own = [
            self._nats(views[s], views[t], (se3.inverse(poses[t]) @ poses[s])[None])[:, 0]
            for views, poses in ((self._spread(one, SOME_VIEWS), one.solution.trajectory) for one in segments)
            for t, s in itertools.combinations(views, 2)
        ]
        return np.stack(own, axis=1) if own else np.zeros((3, 1))

    def _independent(self, target: Segment, source: Segment) -> float:
        """Return the median number of independent measurements of a pair of views, one of each segment."""
        pairs = itertools.product(self._spread(source, Joiner.pairs).values(), self._spread(target, 1).values())
        return float(np.median([pair.temper * pair.points for pair in (self._pair(*views) for views in pairs)]))

    def _spread(self, segment: Segment, count: int) -> dict[int, RayImage]:
        """Return up to `count` views, evenly spread over a segment."""
        return {frame: self.ready(segment.views[frame]) for frame in spread(segment.frames, count)}

    def _pair(self, source: RayImage, target: RayImage) -> PairLikelihood:
        """Return the likelihood of a pair of views."""
        return self._visibility.likelihood.between(
            source, target, np.random.default_rng([self.registrations.seed, source.index, target.index])
        )

    @property
    def _visibility(self) -> VisibilityRegistrar:
        method = self.registrations.registrar
        return method if isinstance(method, VisibilityRegistrar) else VisibilityRegistrar()

    @property
    def _search(self) -> Search:
        return self._visibility.search


def facing(target: Segment, source: Segment, target_from_source: Array, count: int) -> list[tuple[int, int]]:
    """Return pairs of views (target, source) with the most similar viewing directions.

    No view comes twice, but the only one of a segment.
    """
    centre_m = np.mean(
        [se3.transform(target.solution.trajectory[k], target.views[k].centroid_m[None])[0] for k in target.frames], 0
    )
    sides = []
    for segment, motion in ((target, np.eye(4)), (source, target_from_source)):
        rays = np.stack([(motion @ segment.solution.trajectory[frame])[:3, 3] for frame in segment.frames]) - centre_m
        sides.append(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    cosines = sides[0] @ sides[1].T
    pairs: list[tuple[int, int]] = []
    targets, sources = target.frames, source.frames
    for flat in np.argsort(-cosines, axis=None, kind="stable"):
        row, column = np.unravel_index(flat, cosines.shape)
        t, s = targets[int(row)], sources[int(column)]
        if all((t != pair[0] or len(targets) == 1) and (s != pair[1] or len(sources) == 1) for pair in pairs):
            pairs.append((t, s))
        if len(pairs) == count:
            break
    return pairs


def _aligned(target: Segment, source: Segment, posterior: Posterior) -> Array:
    """Return the alignment (4, 4) that the registration of a pair of views implies."""
    onto = target.solution.trajectory[posterior.target] @ posterior.pose.mean
    return onto @ se3.inverse(source.solution.trajectory[posterior.source])


def _placed(target: Segment, source: Segment, alignment: Alignment) -> Mapping[int, Array]:
    """Return the poses (4, 4) of the cameras of both segments in one frame, by frame number."""
    if alignment.trajectory is not None:
        return alignment.trajectory
    moved = {frame: alignment.target_from_source @ pose for frame, pose in source.solution.trajectory.items()}
    return {**target.solution.trajectory, **moved}


def _mean_pose(target: Segment, source: Segment, edges: Sequence[Edge], guess: Array) -> Array:
    """Return the mean alignment (4, 4) of the accepted pairs; the guess if there are none."""
    poses = [_aligned(target, source, edge.posterior) for edge in edges if edge.accepted]
    if not poses:
        return guess
    first = source.frames[0]
    centre_m = se3.transform(source.solution.trajectory[first], source.views[first].centroid_m[None])[0]
    return se3.mean(np.stack(poses), np.full(len(poses), 1.0 / len(poses)), about_m=centre_m)[0]


def _angle(one: Alignment, other: Alignment) -> float:
    """Return the angle in rad between two alignments."""
    return float(se3.rotation_angle(se3.inverse(one.target_from_source) @ other.target_from_source))


def _near(one: Alignment, other: Alignment) -> bool:
    """Return whether two alignments are the same within their errors."""
    return _angle(one, other) < Matcher().apart_rad


def rejected_elsewhere(edge: Edge, solution: Solution) -> Edge:
    """Return an edge, rejected because it contradicts how a solution aligns the segments of its views."""
    motion = se3.inverse(edge.posterior.pose.mean) @ solution.relative(edge.target, edge.source)
    reason = ElsewhereThanSegments(float(np.degrees(se3.rotation_angle(motion))))
    return replace(edge, accepted=False, reason=reason)
