"""Which pairs of views a run registers, with which prior, and which of two registrations counts.

An object with sides alike matches as well a quarter turn on. That a mode lies beyond the prior's limits is no reason to
accept that the object turned so far: it must match better by as much as motions beyond the limits are rare.
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
from modeler.beside import each
from modeler.closure import Closer
from modeler.pipeline.pairs import anywhere
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

_BEYOND = (Outcome.AT_LIMIT, Outcome.NO_OVERLAP, Outcome.DEGENERATE)  # how a motion beyond the prior may end
_PATIENCE = 1  # frames searched for in vain, from which on further ones are glanced at first
_SPAN_STEPS = 2.0  # steps for which limits hold where the graph predicts a motion, so that they do not cut it off
_GLANCE_SHARE = 0.25  # of the starts of a search and of the samples drawn at most
_SURPRISE_NATS = 7.0  # one motion of a thousand exceeds the prior's limits
_MORE_OVERLAP = 0.15  # sides that are alike match about as much; the right mode shows more than the end of the limits
_ELSEWHERE_RAD = 0.26  # two registrations turned against each other by more are two modes
_MIN_MODE_WEIGHT = 0.01


@final
@dataclass(frozen=True, eq=False)
class Tracker:
    """Registers a new view against earlier ones, and views of the graph with each other."""

    state: State
    """What is known so far."""
    prior: AbstractPrior
    """What is known of motions before the images are compared."""
    closer: Closer
    """Chooses the pairs."""
    sensor: Sensor
    """Makes again what registration needs of a view, where it is no longer in memory."""
    register: Callable[[RayImage, RayImage, AbstractPrior], Posterior]
    """Of a source and a target."""
    glance: Callable[[RayImage, RayImage, AbstractPrior], Posterior] | None = None
    """As `register`, but gives hopeless pairs up early; None: the method has no such mode."""
    refusals: dict[tuple[int, int], PriorRefused] = field(default_factory=dict)
    """Why the prior does not apply to a pair, by (source, target): filled as pairs are registered."""
    made: dict[int, RayImage] = field(default_factory=dict)
    """The views made ready again last, by frame number: pairs registered one after the other share them."""
    _lock: Lock = field(default_factory=Lock)

    @cached_property
    def known(self) -> AbstractPrior:
        """The prior with what the sequence taught it so far."""
        return self.prior.learned(self.state.solution, self.state.graph.edges)

    def locate(
        self, view: RayImage, previous: int, *, again: bool
    ) -> Generator[Searching, None, tuple[Posterior, ...]]:
        """Register a new view with the previous one, and where that does not place it, with others.

        Args:
            view: the new view.
            previous: the view to register it to first.
            again: whether it was lost before: then only that one is tried.

        Yields:
            That the previous view does not place it, before others are tried.

        Returns:
            The posteriors, that of the previous view first.
        """
        steps = self.state.steps(view.index, previous)
        prior = self.known
        wary = self.glance is not None and self.state.vain >= _PATIENCE
        if wary and (steps > 1 or again):
            glances = yield from self._glances(view, previous, again=again)
            if not _promising(glances[-1]):
                return glances
        odometry = self._pair(view, previous, prior.relaxed(steps) if steps > 1 else prior)
        if self._placed([odometry]):
            return (odometry,)
        if wary and steps == 1 and not again and not odometry.matches:
            glances = yield from self._glances(view, previous, again=again)
            if not _promising(glances[-1]):
                return (odometry, *glances[1:])
        yield Searching(view.index)
        return self._relocalised(view, odometry, again=again)

    def closures(
        self, view: RayImage, posteriors: Sequence[Posterior], *, last: bool, again: bool
    ) -> tuple[Posterior, ...]:
        """Register a new view with earlier ones that the object seems to have come back to; none where it is lost.

        Args:
            view: the new view.
            posteriors: of `locate`.
            last: whether it is the last of the sequence.
            again: whether it was lost before.
        """
        steps = self.state.steps(view.index, posteriors[0].target)
        base, _ = self.closer.placement(posteriors, self.state.map_view, steps=steps)
        if base is None:
            return ()
        tried = {posterior.target for posterior in posteriors}
        tried |= {edge.target for edge in self.state.graph.edges if edge.source == view.index} if again else set()
        targets = self.closer.closure_targets(base, self.state.map_view, last=last)
        targets = [target for target in targets if target not in tried]
        predicted = [
            self._predicted(self.closer.predicted_motion(base, target, self.state.solution)) for target in targets
        ]
        return tuple(self._pairs([(view, target) for target in targets], predicted))

    def _predicted(self, motion: PoseGaussian) -> PredictedProposal:
        """Return the prior of a closure whose motion the graph predicts."""
        far = np.degrees(se3.rotation_angle(motion.mean)) > self.closer.max_angle_deg
        return PredictedProposal(self.known.relaxed(_SPAN_STEPS) if far else self.known, motion)

    def spans(self, pairs: Sequence[tuple[int, int]]) -> Iterator[Posterior]:
        """Yield posteriors of pairs (source, target) of views of the graph that were not registered yet."""
        priors = self.known.relaxed(_SPAN_STEPS), self.known.unlimited()
        predicted = [
            PredictedProposal(self._holding(*priors, s, t), self.state.solution.relative_gaussian(t, s))
            for s, t in pairs
        ]
        yield from self._pairs([(self.state.views[source], target) for source, target in pairs], predicted)

    def _holding(
        self, prior: AbstractPrior, unlimited: AbstractPrior | None, source: int, target: int
    ) -> AbstractPrior:
        """Return a prior of a pair of the graph, or that without limits if they were assumed and exclude its motion."""
        if unlimited is not None:
            with suppress(InputError):
                known = prior.between(self.state.views[source], self.state.views[target])
                motion = self.state.solution.relative(target, source)
                return prior if _inside(known, motion[None])[0] else unlimited
        return prior

    def explained(self, edges: Iterable[Edge]) -> tuple[Edge, ...]:
        """Return judged edges, those to which the prior does not apply with the reason."""
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
            with self._lock:
                known = self.made.pop(view.index, None)
            known = known or self.sensor.ray_image(view.frame, view.plane)
            with self._lock:
                self.made[view.index] = known
                for frame in set(self.made) - set(newest_ready(self.made)):
                    del self.made[frame]
        return known

    def _glances(
        self, view: RayImage, previous: int, *, again: bool
    ) -> Generator[Searching, None, tuple[Posterior, ...]]:
        """Return glances at the previous view and at others till surface matches or none is left.

        After frames that were searched for in vain (a hand hides the object), the next is probably hidden too.
        """
        relaxed = self.known.relaxed(max(self.state.steps(view.index, previous), 2))
        glances, target = (), previous
        while target is not None:
            glances = (*glances, self._pair(view, target, relaxed, briefly=True))
            if again or _promising(glances[-1]):
                break
            yield Searching(view.index)
            target = self.closer.relocalisation_target(glances, self.state.map_view)
        return glances

    def _relocalised(self, view: RayImage, odometry: Posterior, *, again: bool) -> tuple[Posterior, ...]:
        """Return posteriors of a view that the previous one does not place: with a wider prior, and of other views."""
        steps, prior = self.state.steps(view.index, odometry.target), self.known
        relaxed = prior.relaxed(max(steps, 2))
        if steps == 1 and odometry.outcome in _BEYOND:  # the motion may be larger than the prior allows for one step
            wider = self._pair(view, odometry.target, relaxed)
            seconds = odometry.seconds + wider.seconds
            known = prior.between(view, self.state.views[odometry.target])
            odometry = replace(preferred(odometry, wider, known), seconds=seconds)
        if not again:
            odometry = anywhere(odometry, prior, partial(self._pair, view, odometry.target))
        posteriors = (odometry,)
        while not again and not self._placed(posteriors):
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
        """Yield the posteriors of pairs, in their order."""
        yield from each(lambda asked: self._pair(*asked[0], asked[1]), zip(pairs, priors, strict=True))

    def _pair(self, source: RayImage, target: int, prior: AbstractPrior, *, briefly: bool = False) -> Posterior:
        """Register a view against an accepted one; where the prior does not apply, that is the outcome."""
        view = self.ready(self.state.views[target])
        register = self.glance if briefly and self.glance is not None else self.register
        try:
            return register(self.ready(source), view, prior)
        except InputError as error:
            self.refusals[source.index, target] = PriorRefused(str(error))
            return failed(source, view, Outcome.NOT_KNOWN)


def _promising(glance: Posterior) -> bool:
    """Return whether a search may place a frame that was glanced at; a match cut off by the limits does not."""
    return glance.matches and glance.outcome is not Outcome.AT_LIMIT


def glancing(registrar: AbstractRegistrar) -> AbstractRegistrar | None:
    """Return a registrar that gives up a hopeless pair at a small part of the cost; None where its method has none.

    Views without common surface cost most of all: every mode that the search finds is sampled. A glance samples the
    best mode alone.
    """
    if not isinstance(registrar, VisibilityRegistrar):
        return None
    sampler = replace(registrar.sampler, max_draws=int(_GLANCE_SHARE * registrar.sampler.max_draws))
    return replace(registrar, search=registrar.search.scaled(_GLANCE_SHARE), sampler=sampler, max_modes=1)


def preferred(within: Posterior, wider: Posterior, known: AbstractPoseDensity) -> Posterior:
    """Return which registration counts for a view that a prior's limits seemed to cut off.

    Args:
        within: its registration in the limits.
        wider: that in wider ones.
        known: the motion that is known, with its limits.
    """
    if within.outcome is Outcome.AT_LIMIT and within.matches and wider.usable:
        elsewhere = se3.rotation_angle(se3.inverse(within.pose.mean) @ wider.pose.mean) > _ELSEWHERE_RAD
        # Unless it has one mode: a mean between modes may lie inside, and is at none of them.
        possible = wider.outcome is Outcome.CONVERGED and _inside(known, wider.pose.mean[None])[0]
        better_nats = wider.log_evidence - within.log_evidence
        alike = wider.overlap < within.overlap + _MORE_OVERLAP
        if elsewhere and not possible and alike and better_nats < _SURPRISE_NATS:
            return replace(within, outcome=Outcome.AMBIGUOUS)
    return _discounted(wider, known)


def _discounted(posterior: Posterior, known: AbstractPoseDensity) -> Posterior:
    """Return a posterior with modes beyond the limits as unlikely as such motions are."""
    if not are_separate(posterior.modes):
        return posterior
    inside = _inside(known, np.stack([mode.pose.mean for mode in posterior.modes]))
    if inside.all() or not inside.any():
        return posterior
    weights = np.array([mode.weight for mode in posterior.modes]) * np.where(inside, 1.0, np.exp(-_SURPRISE_NATS))
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
    """Return which motions (n, 4, 4) are within the limits."""
    return np.isfinite(known.log_density(motions))
