"""Which pairs of views are registered in the loop, and with what known beforehand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

from modeler.closure import Closer
from modeler.pipeline.limits import believed
from modeler.pipeline.state import State
from modeler.priors import PredictedProposal
from modeler.registration.posterior import failed
from modeler.types import AbstractPrior, Edge, InputError, Outcome, Posterior, PriorRefused, RayImage

_BEYOND = (Outcome.AT_LIMIT, Outcome.NO_OVERLAP, Outcome.DEGENERATE)  # what a motion beyond the prior may look like
_PATIENCE = 1  # frames searched for in vain, from which on others are glanced at first
_ROOM = 2.0  # steps for which limits hold where the graph foretells a motion: they are not to cut it off


@dataclass(frozen=True, eq=False)
class Pairing:
    """Registers a new view against earlier ones, and views of the graph with each other."""

    prior: AbstractPrior
    """What is known of motions before the images are compared."""
    closer: Closer
    """Chooses the pairs."""
    register: Callable[[RayImage, RayImage, AbstractPrior], Posterior]
    """Of a source and a target."""
    ready: Callable[[State, RayImage], RayImage]
    """Makes a view ready for that."""
    executor: Executor | None
    """Where pairs are registered side by side; None: one after the other."""
    refusals: dict[tuple[int, int], PriorRefused] = field(default_factory=dict)
    """Why the prior does not apply to a pair, by (source, target): filled as pairs are registered."""
    glance: Callable[[RayImage, RayImage, AbstractPrior], Posterior] | None = None
    """As `register`, but gives hopeless pairs up soon; None: there is nothing of the kind."""
    seeking: Callable[[int], None] = lambda frame: None
    """Told the number of a frame before other views than the previous one are tried to place it."""

    def placed(self, state: State, view: RayImage, previous: int, *, last: bool, again: bool) -> tuple[Posterior, ...]:
        """Return the posteriors of a new view, against the previous one first.

        Args:
            state: what is known so far.
            view: the new view.
            previous: the view that it should hang on.
            last: whether it is the last.
            again: whether it was tried before: then no others are tried to place it.
        """
        steps, known = state.steps(view.index, previous), state.graph.edges
        prior = self.prior.learned(state.solution, known)
        wary = self.glance is not None and state.vain >= _PATIENCE
        if wary and (steps > 1 or again):
            glances = self._glances(state, view, previous, prior, again=again)
            if not _promising(glances[-1]):
                return glances
        odometry = self._pair(state, view, previous, prior.relaxed(steps) if steps > 1 else prior)
        posteriors = (odometry,)
        base, _ = self.closer.placement(posteriors, state.map_view, steps=steps)
        if base is None:
            if wary and steps == 1 and not again and not odometry.matches:
                glances = self._glances(state, view, previous, prior, again=again)
                if not _promising(glances[-1]):
                    return (odometry, *glances[1:])
            self.seeking(view.index)
            posteriors = self._relocalised(state, view, odometry, prior, again=again)
            base, _ = self.closer.placement(posteriors, state.map_view, steps=steps)
        if base is None:
            return posteriors
        tried = {previous, *(posterior.target for posterior in posteriors)}
        tried |= {edge.target for edge in known if edge.source == view.index} if again else set()
        targets = self.closer.closure_targets(base, state.map_view, last=last)
        targets = [target for target in targets if target not in tried]
        foreseen = [
            PredictedProposal(prior, self.closer.predicted_motion(base, target, state.solution)) for target in targets
        ]
        return (*posteriors, *self._pairs(state, [(view, target) for target in targets], foreseen))

    def spanning(self, state: State, pairs: Sequence[tuple[int, int]]) -> Iterator[Posterior]:
        """Yield posteriors of pairs (source, target) of views of the graph that were not registered yet."""
        prior = self.prior.learned(state.solution, state.graph.edges).relaxed(_ROOM)
        foreseen = [PredictedProposal(prior, state.solution.relative_gaussian(t, s)) for s, t in pairs]
        yield from self._pairs(state, [(state.views[source], target) for source, target in pairs], foreseen)

    def explained(self, edges: Sequence[Edge]) -> tuple[Edge, ...]:
        """Return judged edges, those to which the prior does not apply with the reason."""
        return tuple(
            replace(edge, reason=self.refusals.get((edge.source, edge.target), edge.reason))
            if edge.posterior.outcome is Outcome.NOT_KNOWN
            else edge
            for edge in edges
        )

    def _glances(
        self, state: State, view: RayImage, previous: int, prior: AbstractPrior, *, again: bool
    ) -> tuple[Posterior, ...]:
        """Return glances at the previous view and at others till surface matches or none is left.

        After frames that were searched for in vain (a hand hides the object), another is likely one more.
        """
        grown = prior.relaxed(max(state.steps(view.index, previous), 2))
        glances, target = (), previous
        while target is not None:
            glances = (*glances, self._pair(state, view, target, grown, briefly=True))
            if again or _promising(glances[-1]):
                break
            self.seeking(view.index)
            target = self.closer.relocalisation_target(glances, state.map_view)
        return glances

    def _relocalised(
        self, state: State, view: RayImage, odometry: Posterior, prior: AbstractPrior, *, again: bool
    ) -> tuple[Posterior, ...]:
        """Return posteriors of a view that the previous one does not place: in a grown prior, and of other views."""
        steps = state.steps(view.index, odometry.target)
        grown = prior.relaxed(max(steps, 2))
        if steps == 1 and odometry.outcome in _BEYOND:  # the motion may be larger than the prior allows for one step
            wider = self._pair(state, view, odometry.target, grown)
            seconds = odometry.seconds + wider.seconds
            known = prior.between(view, state.views[odometry.target])
            odometry = replace(believed(odometry, wider, known), seconds=seconds)
        posteriors = (odometry,)
        while not again and self.closer.placement(posteriors, state.map_view, steps=steps)[0] is None:
            target = self.closer.relocalisation_target(posteriors, state.map_view)
            if target is None:
                break
            posteriors = (*posteriors, self._pair(state, view, target, grown))
        return posteriors

    def _pairs(
        self, state: State, pairs: Sequence[tuple[RayImage, int]], priors: Sequence[AbstractPrior]
    ) -> Iterator[Posterior]:
        """Yield the posteriors of pairs, side by side where there is an executor."""
        apply = map if self.executor is None else self.executor.map
        yield from apply(lambda pair, prior: self._pair(state, pair[0], pair[1], prior), pairs, priors)

    def _pair(
        self, state: State, source: RayImage, target: int, prior: AbstractPrior, *, briefly: bool = False
    ) -> Posterior:
        """Register a view against an accepted one; where the prior does not apply, that is the outcome."""
        view = self.ready(state, state.views[target])
        register = self.glance if briefly and self.glance is not None else self.register
        try:
            return register(self.ready(state, source), view, prior)
        except InputError as error:
            self.refusals[source.index, target] = PriorRefused(str(error))
            return failed(source, view, Outcome.NOT_KNOWN)


def _promising(glance: Posterior) -> bool:
    """Return whether a search may place a frame where a glance went; at a limit it may find only what is cut off."""
    return glance.matches and glance.outcome is not Outcome.AT_LIMIT
