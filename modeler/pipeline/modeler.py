"""The loop: frames in, steps out. Estimation does not know that it is watched."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from modeler.closure import Closer
from modeler.fusion import Fuser, IncrementalTsdf, conditional_covariances
from modeler.graph import CommonAxis, shared_noise
from modeler.pipeline.pairing import Pairing
from modeler.pipeline.state import Seen, State
from modeler.rays import Sensor
from modeler.segmentation import Scene, Segmenter
from modeler.types import (
    AbstractPrior,
    AbstractRegistrar,
    Edge,
    Failed,
    Frame,
    Outcome,
    Posterior,
    RayImage,
    Reason,
    Segmentation,
    Step,
)


@dataclass(frozen=True)
class Modeler:
    """Builds the model of an object while it is being turned before the camera.

    Each frame is registered against the previous accepted view and against earlier views to which the object seems to
    have come back (paper, section VI-D); the posteriors become edges of a pose graph, the solved poses fuse the views.
    """

    segmenter: Segmenter
    """Finds the object."""
    sensor: Sensor
    """Noise of the camera."""
    prior: AbstractPrior
    """What is known of motions before the images are compared."""
    registrar: AbstractRegistrar
    """Registers two views."""
    closer: Closer
    """Chooses the pairs and judges the results."""
    fuser: Fuser
    """Makes the model."""
    common_noise: float = 0.1
    """Covariance of what all views of a run err by alike, as a share of an edge's. No loop tells it: over many rendered
    runs, whose truth is known, the covariances of poses come out no smaller than they may be with this."""
    glance: AbstractRegistrar | None = None
    """Looks briefly at pairs of frames that are likely hidden, so that a search follows only where surface matches (see
    `glancing`); None: every frame that is lost is searched for."""
    seed: int = 0
    """Each pair draws from a generator of its own, made from this and the two frame numbers."""
    executor: Executor | None = None
    """Where the pairs of one frame are registered side by side; None: one after the other. Results are the same."""

    def run(
        self,
        frames: Iterable[Frame],
        scene: Scene,
        *,
        hurry: Callable[[], bool] = lambda: False,
        ending: Callable[[str, int, int], None] = lambda stage, done, total: None,
        seeking: Callable[[int], None] = lambda frame: None,
    ) -> Iterator[Step]:
        """Yield what each frame brings. A frame that cannot be used is reported and left out.

        Before the last step, frames left out are tried once more, against views that followed them: one that then joins
        has a second step.

        Args:
            frames: in order of time; read one ahead, so that the last step is known as such.
            scene: what the segmenter learnt from the sequence.
            hurry: asked after the last frame; once it says so, no more edges are tried beyond those that placed the
                frames.
            ending: told after the last frame what is being done, and how much of how much is done.
            seeking: told the number of a frame that the previous view does not place, while others are tried.
        """
        state = State()
        for frame, last in _with_last(frames):
            seen = Seen(frame, *self.view(frame, scene))
            state = state.read(frame.index)
            state, step = self._joined(state, seen, state.latest, last=last, seeking=seeking)
            if last:
                for later, found in self._caught_up(state, seeking):
                    state = replace(later, growing=state.growing, model=state.model)
                    if found.accepted:
                        state = self._fused(state, last=False)
                        yield replace(found, model=state.model)
                state, spans = (state, ()) if hurry() else self._spanned(state, hurry, ending)
                state = self._solved(state)
                ending("making the model", 0, 1)
                step = replace(step, posteriors=(*step.posteriors, *(edge.posterior for edge in spans)))
                step = replace(step, edges=(*step.edges, *spans))
                step = replace(step, solution=state.solution, edges_so_far=state.graph.edges, views=state.views)
            if state.views and (last or step.accepted):
                state = self._fused(state, last=last)
            yield replace(step, model=state.model, last=last)

    def view(self, frame: Frame, scene: Scene) -> tuple[Segmentation, RayImage | None]:
        """Return the object in a frame, and the frame made ready; None where the object was not found."""
        segmentation = self.segmenter.segment(frame, scene)
        if segmentation.outcome not in (Outcome.CONVERGED, Outcome.UNSURE_MASK):
            return segmentation, None
        view = self.sensor.ray_image(replace(frame, mask=segmentation.mask), segmentation.plane)
        return segmentation, view if len(view.points_m) else None

    def register(self, source: RayImage, target: RayImage, prior: AbstractPrior | None = None) -> Posterior:
        """Return the posterior of target_from_source. The result depends on views, prior and seed alone.

        Args:
            source: one view.
            target: another.
            prior: what is known of the motion; None: what is known of any.

        Raises:
            InputError: where the views lack what the prior needs.
        """
        return self._asking(self.registrar, source, target, self.prior if prior is None else prior)

    def _asking(
        self, registrar: AbstractRegistrar, source: RayImage, target: RayImage, prior: AbstractPrior
    ) -> Posterior:
        rng = np.random.default_rng([self.seed, source.index, target.index])
        return registrar.register(source, target, prior.between(source, target), rng=rng)

    def _joined(
        self,
        state: State,
        seen: Seen,
        previous: int | None,
        *,
        seeking: Callable[[int], None],
        last: bool = False,
        again: bool = False,
    ) -> tuple[State, Step]:
        """Return the state with one more frame, if it can be placed, and its step.

        Args:
            state: what is known so far.
            seen: the frame.
            previous: the view that it should hang on; None where there is none.
            seeking: told its number where that view does not place it.
            last: whether it is the last.
            again: whether it was tried before.
        """
        pairing, posteriors = replace(self._pairing(), seeking=seeking), ()
        if seen.view is not None and previous is not None:
            posteriors = pairing.placed(state, seen.view, previous, last=last, again=again)
        lasting = [posterior.without_samples() for posterior in posteriors]
        steps = state.steps(seen.frame.index, previous)
        edges = self.closer.judge(lasting, state.map_view, steps=steps)
        edges = pairing.explained(edges)
        left_out = _left_out(seen, edges, first=not state.views)
        state = state.joined(seen, edges, accepted=left_out is None)
        step = Step(
            frame=seen.frame,
            segmentation=seen.segmentation,
            view=seen.view,
            posteriors=posteriors,
            edges=edges,
            left_out=left_out,
            solution=state.solution,
            model=None,
            edges_so_far=state.graph.edges,
            views=state.views,
        )
        return state, step

    def _caught_up(self, state: State, seeking: Callable[[int], None]) -> Iterator[tuple[State, Step]]:
        """Yield states and steps of lost frames, newest first, tried once more against a view that followed them."""
        tried: set[tuple[int, int]] = set()
        waiting = list(state.overdue())
        while waiting:
            seen, neighbour = waiting[0]
            tried.add((seen.frame.index, neighbour))
            seeking(seen.frame.index)
            if seen.view is not None:
                seen = replace(seen, view=self._ready(state, seen.view))
            state, step = self._joined(state, seen, neighbour, seeking=seeking, again=True)
            yield state, step
            waiting = [(seen, view) for seen, view in state.overdue() if (seen.frame.index, view) not in tried]

    def _spanned(
        self, state: State, hurry: Callable[[], bool], ending: Callable[[str, int, int], None]
    ) -> tuple[State, tuple[Edge, ...]]:
        """Return the state with edges beyond those that placed the frames, each judged, and these.

        Not where all steps share an axis: beside it the noise that a frame's edges have in common does not count yet.
        """
        if self.prior.shared_axis(list(state.views.values())) is not None:
            return state, ()
        ending("choosing more pairs", 0, 1)
        pairing, edges, stage = self._pairing(), [], "registering more pairs"
        pairs = self.closer.span_pairs(state.map_view)
        ending(stage, 0, len(pairs))
        for posterior in pairing.spanning(state, pairs):
            edges.append(self.closer.judge_span(posterior.without_samples(), state.map_view))
            ending(stage, len(edges), len(pairs))
            if hurry():
                break
        explained = pairing.explained(edges)
        return state.spanned(explained), explained

    def _solved(self, state: State) -> State:
        """Return the state solved with what edges have in common.

        That is an axis about which all steps turn: the images of every pair say where it lies, so that it sharpens the
        first pairs as the last, and what each pair says of it counts once. Or it is the noise of a frame's image, and
        what all images err by alike.
        """
        axis = self.prior.shared_axis(list(state.views.values()))
        if axis is None:
            return state.solved(axis=None, shared=shared_noise(state.graph, state.solution), common=self.common_noise)
        common = CommonAxis(sigma_tilt_rad=axis.sigma_tilt_rad, sigma_shift_m=axis.sigma_shift_m, sigma_lift_m=np.inf)
        return state.solved(axis=common)

    def _pairing(self) -> Pairing:
        glance = None if self.glance is None else partial(self._asking, self.glance)
        return Pairing(self.prior, self.closer, self.register, self._ready, self.executor, glance=glance)

    def _ready(self, state: State, view: RayImage) -> RayImage:
        """Return a view with the images that a likelihood looks up."""
        if view.layers:
            return view
        return state.ready.get(view.index) or self.sensor.ray_image(view.frame, view.plane)

    def _fused(self, state: State, *, last: bool) -> State:
        """Return the state with its model: that of before brought up to date, or in the end one made with care."""
        if last:
            sure = conditional_covariances(state.solution, state.graph.edges)
            return replace(state, model=self.fuser.fuse(state.views, state.solution.trajectory, sure))
        growing = (state.growing or IncrementalTsdf(self.fuser)).updated(state.views, state.solution.trajectory)
        return replace(state, growing=growing, model=growing.model())


def _with_last(frames: Iterable[Frame]) -> Iterator[tuple[Frame, bool]]:
    """Yield frames with whether they are the last, by reading one ahead."""
    ahead = iter(frames)
    for frame in ahead:
        for following in ahead:
            yield frame, False
            frame = following
        yield frame, True


def _left_out(seen: Seen, edges: Sequence[Edge], *, first: bool) -> Reason | None:
    """Return why a frame is left out; None: it is not."""
    if seen.view is None:
        outcome = seen.segmentation.outcome
        return Failed(Outcome.TOO_FEW_POINTS if outcome is Outcome.CONVERGED else outcome)
    if first or any(edge.accepted for edge in edges):
        return None
    return edges[0].reason
