"""Segments of views between which nothing is known of the motion: joined by the models that they make.

An object that is put down otherwise, or that a hand takes anew, leaves what was known of its motion behind: where it
stood is no longer its bottom, and its views before and after may share little. What the views before tell of it
together is laid on what those after tell, from every side, and every view compared with every other one.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, final

import numpy as np
from scipy.special import chdtri

from modeler import se3
from modeler.fusion import Fuser, FusionVolume, Matcher, conditional_covariances
from modeler.pipeline.pairs import register
from modeler.pipeline.tracking import glancing
from modeler.priors.general import AnyMotion
from modeler.priors.mixtures import KernelMixture
from modeler.registration import VisibilityRegistrar
from modeler.registration.visibility.likelihood import PairLikelihood
from modeler.registration.visibility.search import Search
from modeler.types import (
    AbstractRegistrar,
    Array,
    Edge,
    ElsewhereThanSegments,
    Failed,
    JoinsSegments,
    Outcome,
    Posterior,
    RayImage,
    Solution,
)

_SIGMA_RAD, _SIGMA_M = 0.12, 0.01  # error of the models' alignment
_FARTHEST_RAD = 0.5  # a posterior farther from the alignment than this is another place
_MAX_VIEWS: Final = 20  # of a segment, compared with as many of the other
_COARSE_VOXELS: Final = 64**3  # of models that are laid on each other
_MAX_ALIGNMENTS: Final = 4  # that pairs of views are registered about
_CONTRADICTED: Final = 0.01  # probability that a right alignment is refused
_ASKED_VIEWS: Final = 6  # of each segment, whose pairs are registered without limits
LEAST_JOINS: Final = 2
"""Pairs of views that must agree on how segments lie on each other: a single one is checked by nothing."""


@final
@dataclass(frozen=True, eq=False)
class Segment:
    """Views and their poses among each other."""

    views: Mapping[int, RayImage]
    """By frame number."""
    solution: Solution
    """Their poses in the object frame of the segment."""
    edges: Sequence[Edge]
    """From which these come."""

    def volume(self, fuser: Fuser) -> FusionVolume:
        """Return the fused views."""
        sure = conditional_covariances(self.solution, self.edges)
        return fuser.volume(self.views, self.solution.trajectory, sure)

    @property
    def frames(self) -> list[int]:
        """Numbers of the views that have a pose, in order."""
        return sorted(frame for frame in self.views if frame in self.solution.trajectory)


@final
@dataclass(frozen=True, eq=False)
class Alignment:
    """A way in which two segments may lie on each other."""

    target_from_source: Array
    """(4, 4) object frame of the source segment to that of the target segment."""
    nats: float = 0.0
    """Log-likelihood of a pair of views, one of each segment: the mean of all pairs."""
    share: float = 1.0
    """Probability (0..1), if one of the alignments found is right."""
    edges: tuple[Edge, ...] = ()
    """Pairs of views that were registered about it, judged."""

    @property
    def accepted(self) -> int:
        """Number of pairs that agree with it."""
        return sum(edge.accepted for edge in self.edges)


@final
@dataclass(frozen=True)
class Joiner:
    """Joins segments: lays their models on each other, lets all views judge, and registers pairs of them."""

    registrar: AbstractRegistrar = field(default_factory=VisibilityRegistrar)
    """Registers the pairs."""
    ready: Callable[[RayImage], RayImage] = lambda view: view
    """Returns a view with the images that a likelihood looks up."""
    pairs: int = 6
    """Pairs of views that are registered, one of each segment."""
    seed: int = 0
    """Each pair draws from a generator of its own."""

    def join(self, target: Segment, source: Segment) -> list[Alignment]:
        """Return the ways in which segments may lie on each other, likeliest first.

        Models that have most of their surface in common are laid on each other. Where nothing comes of that, views of
        both are registered without limits; what they tell is judged by all others alike. Without an alignment that
        stands, no edge of the first is accepted.
        """
        proposed: list[Array] = []
        found: list[Alignment] = []
        for propose in (self._by_models, self._by_views):
            proposed += propose(target, source)
            found = self._refined(target, source, proposed)
            if found and found[0].accepted >= LEAST_JOINS and self.stands(target, source, found[0]):
                return found
        return [replace(found[0], edges=tuple(map(_refused, found[0].edges))), *found[1:]] if found else []

    def stands(self, target: Segment, source: Segment, alignment: Alignment) -> bool:
        """Return whether views of two segments contradict each other no more than those of one do.

        They may by as much as misfits of independent measurements do by chance, as many as a pair has for each view
        of the smaller segment (method.md, eq. 22).
        """
        own = [self._own_nats(segment) for segment in (target, source) if len(segment.frames) > 1]
        count = min(_MAX_VIEWS, len(target.frames), len(source.frames))
        freedom = count * self._independent(target, source)
        allowed = 0.5 * (float(chdtri(freedom, _CONTRADICTED)) - freedom) / count
        return alignment.nats >= float(np.mean(own or [0.0])) - allowed

    def likelihoods(self, target: Segment, source: Segment, poses: Array) -> Array:
        """Return the log-likelihoods (n,), means of all pairs of views, of alignments (n, 4, 4), in nats."""
        targets, sources = self._spread(target, _MAX_VIEWS), self._spread(source, _MAX_VIEWS)
        nats = [
            self._nats(other, view, se3.inverse(target.solution.trajectory[t]) @ poses @ source.solution.trajectory[s])
            for t, view in targets.items()
            for s, other in sources.items()
        ]
        return np.mean(nats, axis=0)

    def weighed(self, target: Segment, source: Segment, alignments: Sequence[Alignment]) -> list[Alignment]:
        """Return alignments with their likelihoods, likeliest first.

        Views of one segment see the same surface, so that pairs are not independent: each view counts as if it was
        compared with one of the other segment, and not with all of them.
        """
        if not alignments:
            return []
        poses = np.stack([alignment.target_from_source for alignment in alignments])
        nats = self.likelihoods(target, source, poses)
        shares = np.exp(min(_MAX_VIEWS, len(target.frames), len(source.frames)) * (nats - nats.max()))
        shares /= shares.sum()
        order = np.argsort(-nats, kind="stable")
        return [replace(alignments[k], nats=float(nats[k]), share=float(shares[k])) for k in order]

    def _refined(self, target: Segment, source: Segment, proposed: Sequence[Array]) -> list[Alignment]:
        """Return the likeliest of some alignments (4, 4), each where the pairs of views that it leads to put it."""
        found: list[Alignment] = []
        for alignment in self.weighed(target, source, [Alignment(pose) for pose in proposed]):
            if len(found) < _MAX_ALIGNMENTS and not any(_near(alignment, other) for other in found):
                edges = self._edges(target, source, alignment.target_from_source)
                found.append(Alignment(_mean_pose(target, source, edges, alignment.target_from_source), edges=edges))
        distinct: list[Alignment] = []
        for alignment in self.weighed(target, source, found):
            if not any(_near(alignment, other) for other in distinct):
                distinct.append(alignment)
        distinct = self.weighed(target, source, distinct)
        if not distinct:
            return []
        rival_deg = 0.0 if len(distinct) == 1 else float(np.degrees(_angle(distinct[0], distinct[1])))
        why = JoinsSegments(distinct[0].share, rival_deg)
        edges = tuple(replace(edge, reason=why) if edge.accepted else edge for edge in distinct[0].edges)
        return [replace(distinct[0], edges=edges), *distinct[1:]]

    def _by_models(self, target: Segment, source: Segment) -> list[Array]:
        """Return alignments (4, 4) of the models of two segments."""
        fuser = Fuser(max_voxels=_COARSE_VOXELS)
        volumes = target.volume(fuser), source.volume(fuser)
        models = volumes[0].model(), volumes[1].model()
        if not all(len(model.points_m) for model in models):
            return []
        return [match.target_from_source for match in Matcher().matches(*volumes, models)]

    def _by_views(self, target: Segment, source: Segment) -> list[Array]:
        """Return alignments (4, 4) of which single pairs of views tell, some of each segment."""
        registrar, prior = glancing(self.registrar) or self.registrar, AnyMotion()
        some = [self._spread(segment, _ASKED_VIEWS) for segment in (target, source)]
        found = []
        for view, other in itertools.product(some[0].values(), some[1].values()):
            posterior = register(registrar, other, view, prior.between(other, view), seed=self.seed)
            if posterior.usable:
                found.append(_aligned(target, source, posterior))
        return found

    def _edges(self, target: Segment, source: Segment, target_from_source: Array) -> tuple[Edge, ...]:
        """Return the judged edges between views of two segments that look from nearly the same side."""
        edges = []
        for t, s in facing(target, source, target_from_source, self.pairs):
            views = self.ready(source.views[s]), self.ready(target.views[t])
            guess = se3.inverse(target.solution.trajectory[t]) @ target_from_source @ source.solution.trajectory[s]
            density = KernelMixture(
                guess[None],
                np.ones(1),
                centre_m=views[0].centroid_m,
                sigma_rad=_SIGMA_RAD,
                sigma_m=_SIGMA_M,
                evidence=False,
            )
            posterior = register(self.registrar, *views, density, seed=self.seed).without_samples()
            edges.append(self._judged(posterior, views, guess))
        return tuple(edges)

    def _judged(self, posterior: Posterior, views: tuple[RayImage, RayImage], guess: Array) -> Edge:
        """Return the posterior as an edge that takes part where it is usable and in the place that was looked at.

        That place is one of very many, some of which match by chance: the images must not contradict it either.
        """
        away_rad = float(se3.rotation_angle(se3.inverse(guess) @ posterior.pose.mean))
        if not posterior.usable:
            return Edge(posterior, "join", False, Failed(posterior.outcome))
        if away_rad > _FARTHEST_RAD:
            return Edge(posterior, "join", False, ElsewhereThanSegments(float(np.degrees(away_rad))))
        pair = self._pair(*views)
        if not pair.fits(posterior.pose.mean, self._search.fine_m(pair)):  # method.md, eq. 22
            return Edge(posterior, "join", False, Failed(Outcome.NO_OVERLAP))
        return Edge(posterior, "join", True, JoinsSegments(1.0, 0.0))

    def _nats(self, source: RayImage, target: RayImage, poses: Array) -> Array:
        """Return the log-likelihoods (n,) of poses (n, 4, 4) of a pair of views.

        Without the cost of having no surface in common: views from opposite sides have none.
        """
        pair = self._pair(source, target)
        found = pair.scores(poses, self._search.fine_m(pair), stride=1)
        return pair.temper * found.surface + found.colours

    def _own_nats(self, segment: Segment) -> float:
        """Return the log-likelihood of a pair of views of one segment: the mean of all pairs."""
        views, poses = self._spread(segment, _MAX_VIEWS), segment.solution.trajectory
        return float(
            np.mean(
                [
                    self._nats(views[s], views[t], (se3.inverse(poses[t]) @ poses[s])[None])[0]
                    for t, s in itertools.combinations(views, 2)
                ]
            )
        )

    def _independent(self, target: Segment, source: Segment) -> float:
        """Return the number of independent measurements of a pair of views, one of each segment: the median."""
        pairs = itertools.product(self._spread(source, _ASKED_VIEWS).values(), self._spread(target, 1).values())
        return float(np.median([pair.temper * pair.points for pair in (self._pair(*views) for views in pairs)]))

    def _spread(self, segment: Segment, count: int) -> dict[int, RayImage]:
        """Return some views of a segment, spread over it."""
        frames = segment.frames
        chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), count)).astype(int))
        return {frames[k]: self.ready(segment.views[frames[k]]) for k in chosen}

    def _pair(self, source: RayImage, target: RayImage) -> PairLikelihood:
        """Return the likelihood of a pair of views."""
        return self._visibility.likelihood.between(
            source, target, np.random.default_rng([self.seed, source.index, target.index])
        )

    @property
    def _visibility(self) -> VisibilityRegistrar:
        method = self.registrar.method
        return method if isinstance(method, VisibilityRegistrar) else VisibilityRegistrar()

    @property
    def _search(self) -> Search:
        return self._visibility.search


def facing(target: Segment, source: Segment, target_from_source: Array, count: int) -> list[tuple[int, int]]:
    """Return pairs of views, target and source, that look at the object from the nearest sides, no view twice."""
    centre_m = np.mean(
        [se3.transform(target.solution.trajectory[k], target.views[k].centroid_m[None])[0] for k in target.frames], 0
    )
    sides = []
    for segment, motion in ((target, np.eye(4)), (source, target_from_source)):
        rays = np.stack([(motion @ segment.solution.trajectory[frame])[:3, 3] for frame in segment.frames]) - centre_m
        sides.append(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    cosines = sides[0] @ sides[1].T
    pairs: list[tuple[int, int]] = []
    for flat in np.argsort(-cosines, axis=None, kind="stable"):
        row, column = np.unravel_index(flat, cosines.shape)
        t, s = target.frames[int(row)], source.frames[int(column)]
        if len(pairs) < count and all(t != pair[0] and s != pair[1] for pair in pairs):
            pairs.append((t, s))
    return pairs


def _aligned(target: Segment, source: Segment, posterior: Posterior) -> Array:
    """Return the alignment (4, 4) of which the registration of a pair of views tells."""
    onto = target.solution.trajectory[posterior.target] @ posterior.pose.mean
    return onto @ se3.inverse(source.solution.trajectory[posterior.source])


def _mean_pose(target: Segment, source: Segment, edges: Sequence[Edge], guess: Array) -> Array:
    """Return the mean alignment (4, 4) of the pairs that agree; the guess without any."""
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
    """Return whether two alignments are the same but for their errors."""
    return _angle(one, other) < Matcher().apart_rad


def _refused(edge: Edge) -> Edge:
    """Return an edge of segments that contradict each other."""
    return replace(edge, accepted=False, reason=Failed(Outcome.NO_OVERLAP)) if edge.accepted else edge
