"""Selection of the pairs that a run registers, of their priors, and among repeated registrations.

An object with similar sides matches as well after a quarter turn. A mode beyond the prior's limits is therefore only
accepted if its evidence outweighs the small prior probability of such motions.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from threading import Lock
from typing import final

import numpy as np

from modeler import se3
from modeler.closure import Closer
from modeler.concurrency import parallel_map
from modeler.pipeline.pairs import retry_unlimited
from modeler.pipeline.state import State, newest_ready
from modeler.priors import PredictedProposal
from modeler.rays import Sensor
from modeler.registration import VisibilityRegistrar
from modeler.registration.posterior import failed
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    AbstractRegistrar,
    Array,
    BoolArray,
    Edge,
    InputError,
    Mode,
    Outcome,
    PoseGaussian,
    Posterior,
    PriorRefused,
    RayImage,
    Searching,
    are_separate,
    pooled,
)

_LIMIT_OUTCOMES = (Outcome.AT_LIMIT, Outcome.NO_OVERLAP, Outcome.DEGENERATE)  # possible for motions beyond the limits
_QUICK_AFTER = 1  # failed searches; further frames then get a quick registration first
_SPAN_STEPS = 2.0  # steps of the limits if the graph predicts the motion, so that they do not truncate it
_QUICK_FRACTION = 0.25  # of the starts of a search and of the largest number of samples
_BEYOND_LIMITS_NATS = 7.0  # one motion in a thousand exceeds the prior's limits
_MIN_OVERLAP_GAIN = 0.15  # similar sides have about the same overlap; the true mode has more than one at the limits
_SEPARATE_RAD = 0.26  # registrations that differ by a larger rotation are two modes
_MIN_MODE_WEIGHT = 0.01


@final
@dataclass(frozen=True, eq=False)
class Tracker:
    """Registers a new view against earlier ones, and views of the graph with each other."""

    state: State
    """The state of the run."""
    prior: AbstractPrior
    """Prior on the motion between two frames."""
    closer: Closer
    """Selects the pairs."""
    sensor: Sensor
    """Recomputes the images of views that are no longer in memory."""
    register: Callable[[RayImage, RayImage, AbstractPrior], Posterior]
    """Registers a source and a target."""
    quick_register: Callable[[RayImage, RayImage, AbstractPrior], Posterior] | None = None
    """As `register`, at lower cost, see `quick_registrar`; None if the method has no such mode."""
    refusals: dict[tuple[int, int], PriorRefused] = field(default_factory=dict)
    """Why the prior does not apply to a pair, by (source, target); filled as pairs are registered."""
    cache: dict[int, RayImage] = field(default_factory=dict)
    """The views recomputed last, by frame number, which successive pairs share."""
    _lock: Lock = field(default_factory=Lock)

    @cached_property
    def known(self) -> AbstractPrior:
        """The prior with what was learned from the sequence so far."""
        return self.prior.learned(self.state.solution, self.state.graph.edges)

    def locate(
        self, view: RayImage, previous: int, *, retry: bool
    ) -> Generator[Searching, None, tuple[Posterior, ...]]:
        """Register a new view against the previous one and, if that does not place it, against others.

        Args:
            view: the new view.
            previous: the view to register it against first.
            retry: whether it was lost before: then only that one is tried.

        Yields:
            An event before other views are tried.

        Returns:
            The posteriors, that of the previous view first.
        """
        steps = self.state.steps(view.index, previous)
        prior = self.known.following(previous)
        quick_first = self.quick_register is not None and self.state.failed_searches >= _QUICK_AFTER
        if quick_first and (steps > 1 or retry):
            attempts = yield from self._quick_attempts(view, previous, retry=retry)
            if not _promising(attempts[-1]):
                return attempts
        odometry = self._pair(view, previous, prior.relaxed(steps) if steps > 1 else prior)
        if self._placed([odometry]):
            return (odometry,)
        if quick_first and steps == 1 and not retry and not odometry.matches:
            attempts = yield from self._quick_attempts(view, previous, retry=retry)
            if not _promising(attempts[-1]):
                return (odometry, *attempts[1:])
        yield Searching(view.index)
        return self._relocalised(view, odometry, retry=retry)

    def between(self, view: RayImage) -> tuple[Posterior, ...]:
        """Register a view against the nearest in time; the motion is predicted from the poses of its two neighbours.

        Args:
            view: of a frame between, before or after those of the graph.

        Returns:
            The posterior; none without views in the graph.
        """
        known, solution = self.state.map_view, self.state.solution
        nearest = known.nearest_in_time(view.index)
        if not nearest:
            return ()
        target = nearest[0]
        prior, steps = self.known.following(target), self.state.steps(view.index, target)
        if len(nearest) == 1:
            return (self._pair(view, target, prior.relaxed(steps) if steps > 1 else prior),)
        motion = se3.inverse(solution.trajectory[target]) @ known.extrapolated(view.index)
        step = solution.relative(target, nearest[-1])
        way = (
            float(se3.rotation_angle(step)),
            float(np.linalg.norm(se3.transform(step, view.centroid_m) - view.centroid_m)),
        )
        # In the middle between two views, the standard deviation is a quarter of the way, if the speed is uneven.
        spread = np.diag(np.repeat(0.25 * np.array(way), 3) ** 2)
        expected = PoseGaussian(motion, se3.covariance_about(spread, -view.centroid_m))
        return (self._pair(view, target, self._predicted(view, target, expected, prior)),)

    def closures(
        self, view: RayImage, posteriors: Sequence[Posterior], *, last: bool, retry: bool
    ) -> tuple[Posterior, ...]:
        """Register a new view against earlier ones to which the object seems to have returned; none if it is lost.

        Args:
            view: the new view.
            posteriors: of `locate`.
            last: whether it is the last of the sequence.
            retry: whether it was lost before.
        """
        steps = self.state.steps(view.index, posteriors[0].target)
        base, _ = self.closer.placement(posteriors, self.state.map_view, steps=steps)
        if base is None:
            return ()
        tried = {posterior.target for posterior in posteriors}
        tried |= {edge.target for edge in self.state.graph.edges if edge.source == view.index} if retry else set()
        targets = self.closer.closure_targets(base, self.state.map_view, last=last)
        targets = [target for target in targets if target not in tried]
        known, solution = self.known.following(base.target), self.state.solution
        predicted = [
            self._predicted(view, target, self.closer.predicted_motion(base, target, solution), known)
            for target in targets
        ]
        return tuple(self._pairs([(view, target) for target in targets], predicted))

    def spans(self, pairs: Sequence[tuple[int, int]]) -> Iterator[Posterior]:
        """Yield posteriors of pairs (source, target) of views of the graph that were not registered yet."""
        views, relative = self.state.views, self.state.solution.relative_gaussian
        predicted = [self._predicted(views[s], t, relative(t, s), self.known, span=True) for s, t in pairs]
        yield from self._pairs([(views[source], target) for source, target in pairs], predicted)

    def _predicted(
        self, source: RayImage, target: int, motion: PoseGaussian, known: AbstractPrior, *, span: bool = False
    ) -> PredictedProposal:
        """Return the prior of a pair whose motion the graph predicts: without its limits if they exclude it.

        Args:
            source: a view.
            target: number of a view of the graph.
            motion: target_from_source.
            known: prior of the pair.
            span: whether limits are those of several steps also for small rotations.
        """
        far = span or np.degrees(se3.rotation_angle(motion.mean)) > self.closer.max_angle_deg
        prior, unlimited = known.relaxed(_SPAN_STEPS) if far else known, known.unlimited()
        if unlimited is not None:  # limits that are defaults
            with suppress(InputError):  # registering says so
                if not _inside(prior.between(source, self.state.views[target]), motion.mean[None])[0]:
                    prior = unlimited
        return PredictedProposal(prior, motion)

    def explained(self, edges: Iterable[Edge]) -> tuple[Edge, ...]:
        """Return edges, with the reason for those to which the prior does not apply."""
        return tuple(
            replace(edge, reason=self.refusals.get((edge.source, edge.target), edge.reason))
            if edge.posterior.outcome is Outcome.NOT_KNOWN
            else edge
            for edge in edges
        )

    def ready(self, view: RayImage) -> RayImage:
        """Return a view with the images that a likelihood looks up."""
        known = view if view.layers else self.state.ready.get(view.index)
        if known is None:
            known = self.cache.get(view.index) or self.sensor.ray_image(view.frame, view.plane)
            with self._lock:
                self.cache.pop(view.index, None)  # inserted anew, as the newest
                self.cache[view.index] = known
                for frame in set(self.cache) - set(newest_ready(self.cache)):
                    del self.cache[frame]
        return known

    def _quick_attempts(
        self, view: RayImage, previous: int, *, retry: bool
    ) -> Generator[Searching, None, tuple[Posterior, ...]]:
        """Return quick registrations against the previous view and others until one matches or none is left.

        After failed searches (a hand hides the object), the object is probably hidden in the next frame too.
        """
        relaxed = self.known.following(previous).relaxed(max(self.state.steps(view.index, previous), 2))
        attempts, target = (), previous
        while target is not None:
            attempts = (*attempts, self._pair(view, target, relaxed, quick=True))
            if retry or _promising(attempts[-1]):
                break
            yield Searching(view.index)
            target = self.closer.relocalisation_target(attempts, self.state.map_view)
        return attempts

    def _relocalised(self, view: RayImage, odometry: Posterior, *, retry: bool) -> tuple[Posterior, ...]:
        """Return posteriors of a view that the previous one does not place: with wider limits, then of other views."""
        steps = self.state.steps(view.index, odometry.target)
        prior = self.known.following(odometry.target)
        relaxed = prior.relaxed(max(steps, 2))
        if steps == 1 and odometry.outcome in _LIMIT_OUTCOMES:  # the motion may exceed the limits for one step
            wider = self._pair(view, odometry.target, relaxed)
            seconds = odometry.seconds + wider.seconds
            known = prior.between(view, self.state.views[odometry.target])
            odometry = replace(preferred(odometry, wider, known), seconds=seconds)
        if not retry:
            odometry = retry_unlimited(odometry, prior, partial(self._pair, view, odometry.target))
        posteriors = (odometry,)
        while not retry and not self._placed(posteriors):
            target = self.closer.relocalisation_target(posteriors, self.state.map_view)
            if target is None:
                break
            posteriors = (*posteriors, self._pair(view, target, relaxed))
        return posteriors

    def _placed(self, posteriors: Sequence[Posterior]) -> bool:
        """Return whether one of a view's posteriors places it."""
        steps = self.state.steps(posteriors[0].source, posteriors[0].target)
        return self.closer.placement(posteriors, self.state.map_view, steps=steps)[0] is not None

    def _pairs(self, pairs: Sequence[tuple[RayImage, int]], priors: Sequence[AbstractPrior]) -> Iterator[Posterior]:
        """Yield the posteriors of pairs, in order."""
        yield from parallel_map(lambda pair: self._pair(*pair[0], pair[1]), zip(pairs, priors, strict=True))

    def _pair(self, source: RayImage, target: int, prior: AbstractPrior, *, quick: bool = False) -> Posterior:
        """Register a view against an accepted one; the outcome is `NOT_KNOWN` if the prior does not apply."""
        view = self.ready(self.state.views[target])
        register = self.quick_register if quick and self.quick_register is not None else self.register
        try:
            return register(self.ready(source), view, prior)
        except InputError as error:
            self.refusals[source.index, target] = PriorRefused(str(error))
            return failed(source, view, Outcome.NOT_KNOWN)


def _promising(attempt: Posterior) -> bool:
    """Return whether a full search may place a frame after a quick registration: it matches, not at the limits."""
    return attempt.matches and attempt.outcome is not Outcome.AT_LIMIT


def quick_registrar(registrar: AbstractRegistrar) -> AbstractRegistrar | None:
    """Return a cheaper version of a registrar for pairs that may share no surface; None if its method has none.

    Such pairs are the most expensive: every mode that the search finds is sampled. Here only the best mode is.
    """
    if not isinstance(registrar, VisibilityRegistrar):
        return None
    sampler = replace(registrar.sampler, max_draws=int(_QUICK_FRACTION * registrar.sampler.max_draws))
    return replace(registrar, search=registrar.search.scaled(_QUICK_FRACTION), sampler=sampler, max_modes=1)


def preferred(within: Posterior, wider: Posterior, known: AbstractPoseDensity) -> Posterior:
    """Return the preferred registration of a view whose motion seemed to exceed the prior's limits.

    Args:
        within: its registration within the limits.
        wider: that within wider limits.
        known: the prior density, with the limits.
    """
    if within.outcome is Outcome.AT_LIMIT and within.matches and wider.usable:
        separate = se3.rotation_angle(se3.inverse(within.pose.mean) @ wider.pose.mean) > _SEPARATE_RAD
        # Only for one mode: the mean of several may lie inside without being near any of them.
        inside = wider.outcome is Outcome.CONVERGED and _inside(known, wider.pose.mean[None])[0]
        better_nats = wider.log_evidence - within.log_evidence
        similar_overlap = wider.overlap < within.overlap + _MIN_OVERLAP_GAIN
        if separate and not inside and similar_overlap and better_nats < _BEYOND_LIMITS_NATS:
            return replace(within, outcome=Outcome.AMBIGUOUS)
    return _discounted(wider, known)


def _discounted(posterior: Posterior, known: AbstractPoseDensity) -> Posterior:
    """Return a posterior whose modes beyond the limits are weighted by the prior probability of such motions."""
    if not are_separate(posterior.modes):
        return posterior
    inside = _inside(known, np.stack([mode.pose.mean for mode in posterior.modes]))
    if inside.all() or not inside.any():
        return posterior
    weights = np.array([mode.weight for mode in posterior.modes]) * np.where(inside, 1.0, np.exp(-_BEYOND_LIMITS_NATS))
    weights /= weights.sum()
    order = [int(place) for place in np.argsort(-weights, kind="stable") if weights[place] >= _MIN_MODE_WEIGHT]
    total = float(weights[order].sum())
    modes = tuple(Mode(float(weights[place]) / total, posterior.modes[place].pose) for place in order)
    kept = _inside(known, posterior.samples) if len(posterior.samples) else np.zeros(0, dtype=bool)
    shares = posterior.weights[kept]
    return replace(
        posterior,
        pose=pooled(modes),
        modes=modes if len(modes) > 1 else (),
        samples=posterior.samples[kept],
        weights=shares / shares.sum() if shares.sum() > 0.0 else shares,
    )


def _inside(known: AbstractPoseDensity, motions: Array) -> BoolArray:
    """Return whether motions (n, 4, 4) are within the limits, (n,)."""
    return np.isfinite(known.log_density(motions))
