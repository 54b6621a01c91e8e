"""The loop: frames in, events out. Estimation does not know that it is watched."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar, final

import numpy as np

from modeler.beside import ahead
from modeler.closure import Closer
from modeler.fusion import Fuser, Preview, conditional_covariances, widened
from modeler.graph import CommonAxis, MovingGraph, estimate_focal_length, shared_noise
from modeler.pipeline.joining import LEAST_JOINS, Joiner, Segment
from modeler.pipeline.pairs import Prepared, anywhere, prepare, register
from modeler.pipeline.state import State
from modeler.pipeline.tracking import Tracker
from modeler.priors import GeneralPrior
from modeler.rays import Sensor
from modeler.registration import VisibilityRegistrar
from modeler.segmentation import Scene, Segmenter
from modeler.suggestion import Belief, Candidate, Goal, Suggestions, suggest
from modeler.types import (
    AbstractPrior,
    AbstractRegistrar,
    Edge,
    Event,
    Failed,
    FocalLength,
    Frame,
    Fusing,
    NotJoined,
    Posterior,
    RayImage,
    Reason,
    Refining,
    Searching,
    Solution,
    Step,
)

_FOCAL_REACH = 5.0  # prior standard deviations: nominal focal lengths of captures were off by up to 4.5
_LEAST_SEGMENT = 3  # frames that fit each other: two may do so by chance

T = TypeVar("T")


@final
@dataclass(frozen=True)
class Modeler:
    """Builds the model of an object while it is being turned before the camera.

    Each frame is registered against the previous accepted view and against earlier views to which the object seems to
    have come back (paper, section VI-D); the posteriors become edges of a pose graph, the solved poses fuse the views.
    """

    segmenter: Segmenter = field(default_factory=Segmenter)
    """Finds the object."""
    sensor: Sensor = field(default_factory=Sensor)
    """Noise of the camera."""
    prior: AbstractPrior = field(default_factory=GeneralPrior)
    """What is known of motions before the images are compared."""
    registrar: AbstractRegistrar = field(default_factory=VisibilityRegistrar)
    """Registers two views."""
    closer: Closer = field(default_factory=Closer)
    """Chooses the pairs and judges the results."""
    fuser: Fuser = field(default_factory=Fuser)
    """Makes the model."""
    common_noise: float = 0.1
    """Covariance of the error that all views of a run share, as a share of an edge's. No loop observes it: over many
    rendered runs, whose truth is known, the covariances of poses come out no smaller than they may be with this."""
    glance: AbstractRegistrar | None = None
    """A cheap registration of frames in which the object is probably hidden: a search follows only where they
    match (see `glancing`). None: every lost frame is searched for."""
    seed: int = 0
    """Each pair draws from a generator of its own, made from this and the two frame numbers."""

    def run(self, frames: Iterable[Frame], scene: Scene) -> Iterator[Event]:
        """Build a model and yield what happens: for each frame a `Step`, the last of which has the final model.

        To skip or cut short the refinement, go through the phases of `start(scene)` instead.

        Args:
            frames: in order of time; read one ahead, because the last frame is always compared with the first.
            scene: what the segmenter learnt from the sequence.

        Raises:
            InputError: where two frames have the same number.
        """
        run = self.start(scene)
        yield from run.track(frames)
        yield from run.revisit()
        yield from run.rejoin()
        yield from run.refine()
        yield from run.finish()

    def start(self, scene: Scene) -> Run:
        """Return a run before its first frame."""
        return Run(replace(self, sensor=self.sensor.measured(scene.range_noise)), scene)

    def prepare(self, frame: Frame, scene: Scene) -> Prepared:
        """Segment a frame and prepare it for registration."""
        return prepare(frame, scene, self.segmenter, self.sensor.measured(scene.range_noise))

    def register(self, source: RayImage, target: RayImage, prior: AbstractPrior | None = None) -> Posterior:
        """Return the posterior of target_from_source. The result depends on views, prior and seed alone.

        Args:
            source: one view.
            target: another.
            prior: what is known of the motion; None: the modeler's own, and any motion where its limits are assumed and
                nothing within them matches, or the images contradict what does.

        Raises:
            InputError: where the views lack what the prior needs.
        """
        attempt = partial(self._register, self.registrar, source, target)
        if prior is not None:
            return attempt(prior)
        return anywhere(attempt(self.prior), self.prior, attempt)

    def suggest(
        self, known: Step, candidates: Sequence[Candidate] | None = None, goal: Goal | None = None
    ) -> Suggestions:
        """Return what to do next: the view, turn or poke that tells most of poses and surface.

        Args:
            known: the newest step of a run.
            candidates: what can be done; None: turns either way, pokes, laying the object on its side.
            goal: what is good enough; None: every pose known to 1°, 95 % of what can be seen was seen.

        Raises:
            InputError: where no view has a pose yet.
        """
        return suggest(self.belief(known.views, known.solution, known.edges_so_far), candidates, goal)

    def belief(self, views: Mapping[int, RayImage], solution: Solution, edges: Sequence[Edge]) -> Belief:
        """Return what is known after some views, and what further ones would go through.

        Raises:
            InputError: where no view has a pose.
        """

        def ready(view: RayImage) -> RayImage:
            return view if view.layers else self.sensor.ray_image(view.frame, view.plane)

        likelihood = self.registrar.likelihood if isinstance(self.registrar, VisibilityRegistrar) else None
        prior = self.prior.learned(solution, edges)
        return Belief.of(views, solution, edges, prior, closer=self.closer, likelihood=likelihood, ready=ready)

    def tracker(self, state: State) -> Tracker:
        """Return what registers the views of a run with these components."""
        glance = None if self.glance is None else partial(self._register, self.glance)
        return Tracker(state, self.prior, self.closer, self.sensor, self.register, glance)

    def joiner(self, tracker: Tracker) -> Joiner:
        """Return what joins segments of a run."""
        return Joiner(self.registrar, tracker.ready, seed=self.seed)

    def _register(
        self, registrar: AbstractRegistrar, source: RayImage, target: RayImage, prior: AbstractPrior
    ) -> Posterior:
        return register(registrar, source, target, prior.between(source, target), seed=self.seed)


@final
@dataclass(eq=False)
class Run:
    """One run of the loop and the only owner of its state: five phases in order, each a stream of events.

    A consumer in a hurry omits `revisit`, `rejoin` or `refine`, or stops consuming one of them: `finish` takes what is
    there.
    """

    modeler: Modeler
    """The components."""
    scene: Scene
    """What the segmenter learnt from the sequence."""
    state: State = field(default_factory=State)
    """What is known so far."""

    def __post_init__(self) -> None:
        """Begin without a model."""
        self._preview = Preview(self.modeler.fuser)

    def track(self, frames: Iterable[Frame], *, live: bool = False) -> Iterator[Step | Searching]:
        """Place each frame among the views before it. A frame that cannot be placed is reported and left out.

        Args:
            frames: in order of time.
            live: each frame is placed before the next is read, which may take as long as somebody needs to turn the
                object. Otherwise the next is prepared meanwhile, and the last one is always compared with the first.

        Raises:
            InputError: where two frames have the same number.
        """
        with ahead(partial(self.modeler.prepare, scene=self.scene)) as preparing:
            coming = map(preparing, frames)
            for prepared, last in ((one, False) for one in coming) if live else _with_last(coming):
                found = prepared()
                self.state = self.state.read(found)
                yield from self._place(found, self.state.latest, last=last)

    def revisit(self) -> Iterator[Step | Searching]:
        """Register lost frames again, newest first, with the views that followed them; yield steps of those placed."""
        tried: set[tuple[int, int]] = set()
        while waiting := [pair for pair in self.state.overdue() if pair not in tried]:
            tried.add(waiting[0])
            frame, neighbour = waiting[0]
            yield Searching(frame)
            lost = self.state.lost[frame]
            assert lost.view is not None
            view = self.modeler.tracker(self.state).ready(lost.view)
            yield from self._place(replace(lost, view=view), neighbour, again=True)

    def rejoin(self) -> Iterator[Step | Searching]:
        """Build segments of lost frames that fit each other, and join them with the rest; yield steps of their frames.

        Where the object was put down otherwise, nothing that is known of its motion holds from the frames before to
        those after, and all of those are lost; among themselves they are as good as any.
        """
        tried: set[int] = set()
        while stretches := [some for some in self.state.stretches() if len({*some} - tried) >= _LEAST_SEGMENT]:
            frames = [frame for frame in max(stretches, key=len) if frame not in tried]
            segment = yield from self._segment(frames)
            tried |= {*segment.views} if len(segment.views) >= _LEAST_SEGMENT else {*frames}
            if len(segment.views) >= _LEAST_SEGMENT:
                yield from self._joined(segment)

    def refine(self) -> Iterator[Refining]:
        """Register further pairs of views, whose edges make the poses more precise.

        None where all steps share an axis: the noise that the edges of a frame share is not modelled together with it.
        """
        if self.modeler.prior.shared_axis(list(self.state.views.values())) is not None:
            return
        yield Refining(0, None)
        tracker, known = self.modeler.tracker(self.state), self.state.map_view
        pairs = self.modeler.closer.span_pairs(known)
        yield Refining(0, len(pairs))
        for posterior in tracker.spans(pairs):
            edge = self.modeler.closer.judge_span(posterior.without_samples(), known)
            self.state = self.state.refined(tracker.explained([edge]))
            yield Refining(len(self.state.spans), len(pairs))

    def finish(self) -> Iterator[Step | Fusing]:
        """Solve the graph with the noise that its edges share, make the final model and yield the last step."""
        newest, model = self.state.newest, None
        if newest is None:
            return
        self._solve()
        if self.state.views:
            yield Fusing()
            sure = conditional_covariances(self.state.solution, self.state.graph.edges)
            model = self.modeler.fuser.fuse(self.state.views, self.state.solution.trajectory, sure)
            model = widened(model, self.state.solution)
        spans = self.state.spans
        last = self._step(newest, [edge.posterior for edge in spans], spans)
        yield replace(last, last=True, make_model=lambda: model)

    def _segment(self, frames: Sequence[int]) -> Generator[Searching, None, State]:
        """Place lost frames among each other, and return what comes of it; it begins where two of them fit."""
        apart, tracker = self.state.apart(frames), self.modeler.tracker(self.state)
        part = Run(self.modeler, self.scene, apart)
        for frame in frames:
            yield Searching(frame)
            lost = self.state.lost[frame]
            assert lost.view is not None
            lost = replace(lost, view=tracker.ready(lost.view), left_out=None)
            for _ in part._place(lost, part.state.latest, last=frame == frames[-1]):
                pass
            if frame not in part.state.views and len(part.state.views) == 1:  # the first may show it in a hand
                part.state = apart
                for _ in part._place(lost, None):
                    pass
        return part.state

    def _joined(self, segment: State) -> Iterator[Step]:
        """Join a segment with the views so far where that can be; yield steps of its frames."""
        joiner = self.modeler.joiner(self.modeler.tracker(self.state))
        parts = [Segment(state.views, state.solution, state.graph.edges) for state in (self.state, segment)]
        alignments = joiner.join(parts[0], parts[1])
        joins = alignments[0].edges if alignments else ()
        lost, left_out = self.state.lost, None
        united = self.state.united(segment, joins) if sum(edge.accepted for edge in joins) >= LEAST_JOINS else None
        if united is None or sum(united.solution.takes_part(edge) for edge in joins) < LEAST_JOINS:
            left_out = NotJoined(len(segment.views))
        else:
            self.state = united
        if (newest := self.state.newest) is not None and newest.frame.index in segment.views:
            self.state = replace(self.state, newest=replace(newest, left_out=left_out))
        for frame in sorted(segment.views, key=lambda frame: self.state.places[frame]):
            edges = [edge for edge in (*segment.graph.edges, *joins) if edge.source == frame]
            yield self._step(replace(lost[frame], left_out=left_out), [edge.posterior for edge in edges], edges)

    def _place(
        self, prepared: Prepared, previous: int | None, *, last: bool = False, again: bool = False
    ) -> Iterator[Step | Searching]:
        """Register a frame, add it to the graph and to the model, and yield its step.

        Args:
            prepared: the frame.
            previous: the view to register it to first; None where there is none.
            last: whether it is the last of the sequence.
            again: whether it was lost before: then there is no step where it still is.
        """
        tracker, posteriors = self.modeler.tracker(self.state), ()
        if prepared.view is not None and previous is not None:
            posteriors = yield from tracker.locate(prepared.view, previous, again=again)
            posteriors += tracker.closures(prepared.view, posteriors, last=last, again=again)
        steps = self.state.steps(prepared.frame.index, previous)
        lasting = [posterior.without_samples() for posterior in posteriors]
        edges = tracker.explained(self.modeler.closer.judge(lasting, self.state.map_view, steps=steps))
        prepared = replace(prepared, left_out=_left_out(prepared, edges, first=not self.state.views))
        self.state = self.state.joined(prepared, edges)
        if prepared.accepted:
            number = prepared.frame.index
            if self.modeler.closer.is_keyframe(number, self.state.map_view):
                self.state = replace(self.state, keyframes=(*self.state.keyframes, number))
        if prepared.accepted or not again:
            yield self._step(prepared, posteriors, edges)

    def _solve(self) -> None:
        """Solve the graph with what its edges share: an axis about which all steps turn, or noise, and a focal length.

        The images of every pair say where the axis lies, so that it makes the first pairs as precise as the last, and
        what each pair says of it counts once. The noise is that of a frame's image in all its edges, and that of all
        images. Where loops tell the focal length, views and edges become those of the one they tell.
        """
        state, focal = self.state.with_spans(), None
        if (sigma := self.modeler.sensor.sigma_focal) > 0.0 and len(state.solution.trajectory) > 1:
            state, focal = self._focused(state, sigma)
        axis = self.modeler.prior.shared_axis(list(state.views.values()))
        if axis is None:
            shared = shared_noise(state.graph, state.solution)
            self.state = state.solved(axis=None, shared=shared, common=self.modeler.common_noise, focal=focal)
        else:
            tilt_rad, shift_m = axis.sigma_tilt_rad, axis.sigma_shift_m
            self.state = state.solved(axis=CommonAxis(tilt_rad, shift_m, sigma_lift_m=np.inf), focal=focal)

    def _focused(self, state: State, sigma: float) -> tuple[State, FocalLength]:
        """Return a state under the focal length that its loops tell, and what that is.

        Where it is far from the given one, edges are registered again, for how they follow it is known roughly.

        Args:
            state: with all edges.
            sigma: standard deviation of the focal length's logarithm.
        """
        at, sensor = 0.0, self.modeler.sensor

        def estimate_at(log_factor: float) -> FocalLength:
            nonlocal state, at
            if log_factor != at:
                moved = state.under(log_factor - at, sensor)
                state, at = moved.again(self.modeler.tracker(moved).spans), log_factor
            return MovingGraph.of(state.graph, state.solution).estimate(sigma, -at)

        focal = estimate_focal_length(estimate_at, rounds=3, tolerance=1.0, reach=_FOCAL_REACH * sigma)
        return (state if focal.log_factor == at else state.under(focal.log_factor - at, sensor)), focal

    def _step(self, prepared: Prepared, posteriors: Sequence[Posterior], edges: Sequence[Edge]) -> Step:
        """Return what a frame brought, and what is known after it."""
        views, solution = self.state.views, self.state.solution
        return Step(
            frame=prepared.frame,
            segmentation=prepared.segmentation,
            view=prepared.view,
            posteriors=tuple(posteriors),
            edges=tuple(edges),
            left_out=prepared.left_out,
            solution=solution,
            make_model=partial(self._preview.model, views, solution.trajectory),
            edges_so_far=self.state.graph.edges,
            views=views,
        )


def _with_last(items: Iterable[T]) -> Iterator[tuple[T, bool]]:
    """Yield items with whether they are the last, by taking one ahead."""
    remaining = iter(items)
    for item in remaining:
        for following in remaining:
            yield item, False
            item = following
        yield item, True


def _left_out(prepared: Prepared, edges: Sequence[Edge], *, first: bool) -> Reason | None:
    """Return why a frame is left out; None: it is not."""
    if prepared.view is None:
        return Failed(prepared.flaw)
    if first or any(edge.accepted for edge in edges):
        return None
    return edges[0].reason
