"""Registers views of a run: until the gate places a new one, and further pairs that the graph predicts."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import Lock

from modeler.closure import Closer, Placement
from modeler.pipeline.attempts import Attempt, Search, Stage
from modeler.pipeline.pairs import Registrations
from modeler.pipeline.state import State, newest_ready
from modeler.registration.posterior import failed
from modeler.system.disk_arrays import release
from modeler.system.processes import parallel_map
from modeler.types import (
    FULL_EFFORT,
    AbstractPrior,
    Edge,
    InputError,
    Outcome,
    Posterior,
    PriorRefused,
    RayImage,
    Searching,
)
from modeler.views import Sensor


@dataclass(frozen=True, eq=False)
class Tracker:
    """Registers a new view against earlier ones, and views of the graph with each other."""

    state: State
    """The state of the run."""
    prior: AbstractPrior
    """Prior on the motion between two frames."""
    closer: Closer
    """Selects pairs, and places views."""
    sensor: Sensor
    """Recomputes the images of views that are no longer in memory."""
    registrations: Registrations
    """Registers pairs."""
    refusals: dict[tuple[int, int], PriorRefused] = field(default_factory=dict)
    """Why the prior does not apply to a pair, by (source, target); filled as pairs are registered."""
    cache: dict[int, RayImage] = field(default_factory=dict)
    """The views recomputed last, by frame number, which successive pairs share."""
    _lock: Lock = field(default_factory=Lock)

    @cached_property
    def learned_prior(self) -> AbstractPrior:
        """The prior with what was learned from the sequence so far."""
        return self.prior.learned(self.state.solution, self.state.graph.edges)

    def place(
        self, view: RayImage, first: int, stage: Stage
    ) -> Generator[Searching, None, tuple[tuple[Posterior, ...], Placement]]:
        """Register a new view against views of the graph until the gate places it, or no attempt is left.

        A registration that places it although the images contradict it has to stand against wider limits, too.

        Args:
            view: the new view.
            first: number of the view to register it against first.
            stage: whose attempts are made.

        Yields:
            An event before each further search.

        Returns:
            The posteriors, that of the first view first, and the placement.
        """
        search = self._search(view, first)
        placement, effort = Placement(), 0.0
        for attempt in search.attempts(stage):
            if placement.base is not None and attempt.target != first:
                break
            if search.made and attempt.effort <= effort:
                yield Searching(view.index)
            search.add(attempt, self._registered(attempt))
            effort = attempt.effort
            placement = self.closer.placement(search.candidates, self.state.map_view, steps=search.steps)
            if placement.base is not None and placement.base.convincing and effort == FULL_EFFORT:
                break
        return search.posteriors, placement

    def closures(
        self, view: RayImage, posteriors: Sequence[Posterior], base: Posterior, *, last: bool
    ) -> tuple[Posterior, ...]:
        """Register a placed view against earlier ones to which the object seems to have returned.

        Args:
            view: the view.
            posteriors: its registrations so far.
            base: the one that places it.
            last: whether it is the last of the sequence.
        """
        found = {posterior.target: posterior for posterior in posteriors}
        search = replace(self._search(view, base.target), base=base, last=last, found=found)
        return tuple(parallel_map(self._registered, [*search.attempts("close")]))

    def between_views(self, pairs: Iterable[tuple[int, int]]) -> Iterator[Posterior]:
        """Yield posteriors of pairs (source, target) of views of the graph, in order."""
        searches = [self._search(self.state.views[source], target) for source, target in pairs]
        yield from parallel_map(self._registered, [one for search in searches for one in search.attempts("refine")])

    def again(self, edges: Iterable[Edge]) -> Iterator[Posterior]:
        """Yield posteriors of edges of the graph whose views have changed a little, in order: of their modes alone."""
        known = [(edge.posterior.pose.mean, self._search(self.state.views[edge.source], edge.target)) for edge in edges]
        attempts = [replace(one, near=near) for near, search in known for one in search.attempts("refine")]
        yield from parallel_map(self._registered, attempts)

    def explained(self, edges: Iterable[Edge]) -> tuple[Edge, ...]:
        """Return edges, with the reason for those to which the prior does not apply."""
        return tuple(
            replace(edge, reason=self.refusals.get((edge.source, edge.target), edge.reason))
            if edge.posterior.outcome is Outcome.NOT_APPLICABLE
            else edge
            for edge in edges
        )

    def ready(self, view: RayImage) -> RayImage:
        """Return a view with the images that a likelihood looks up."""
        known = view if view.layers else self.state.ready.get(view.index)
        if known is None:
            known = self.cache.get(view.index)
            if known is None:
                known = self.sensor.ray_image(view.frame, view.plane)
                release(view.frame.depth_m)  # or all views that are registered again would stay in memory
            with self._lock:
                self.cache.pop(view.index, None)  # inserted anew, as the newest
                self.cache[view.index] = known
                for frame in set(self.cache) - set(newest_ready(self.cache)):
                    del self.cache[frame]
        return known

    def _search(self, view: RayImage, first: int) -> Search:
        least_effort = self.registrations.registrar.least_effort
        return Search(self.state, self.learned_prior, self.closer, view, first, least_effort)

    def _registered(self, attempt: Attempt) -> Posterior:
        """Return the posterior of an attempt; its outcome is `NOT_APPLICABLE` if the prior does not apply."""
        source, target = self.ready(attempt.source), self.ready(self.state.views[attempt.target])
        try:
            density = attempt.prior.between(source, target)
        except InputError as error:
            self.refusals[source.index, target.index] = PriorRefused(str(error))
            return failed(source, target, Outcome.NOT_APPLICABLE)
        return self.registrations.register(source, target, density, effort=attempt.effort, near=attempt.near)
