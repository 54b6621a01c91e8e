"""The pipeline: frames in, events out. Visualisation only consumes events."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import final

from modeler.closure import Closer, Placement
from modeler.fusion import Fuser, Preview, conditional_covariances, widened
from modeler.graph import MovingGraph, estimate_focal_length, shared_noise, variance_factor
from modeler.pipeline.attempts import Stage
from modeler.pipeline.joining import Joiner
from modeler.pipeline.newest import with_last
from modeler.pipeline.pairs import Prepared, Registrations, prepare, without_limits
from modeler.pipeline.realigning import Realigner, joined
from modeler.pipeline.state import Placed, State
from modeler.pipeline.tracking import Tracker
from modeler.priors import GeneralPrior
from modeler.registration import VisibilityRegistrar
from modeler.segmentation import Scene, Segmenter
from modeler.suggestion import Belief, Candidate, Goal, Suggestions, suggest
from modeler.system.concurrency import prefetching
from modeler.types import (
    AbstractPairCache,
    AbstractPrior,
    AbstractRegistrar,
    Edge,
    Event,
    FocalLength,
    Frame,
    FrameRecord,
    Fusing,
    InputError,
    NotJoined,
    Posterior,
    RayImage,
    Refining,
    Searching,
    Solution,
    Step,
    checked,
)
from modeler.verdict import judged
from modeler.views import Sensor

_FOCAL_REACH = 5.0  # prior standard deviations: nominal focal lengths of captures are off by up to 4.5
_MIN_SEGMENT = 3  # frames that fit each other: two may do so by chance


@final
@checked
@dataclass(frozen=True)
class Modeler:
    """Builds the model of an object while it turns in front of the camera.

    Each frame is registered against the previous accepted view, and against earlier views to which the object seems to
    have returned (paper, section VI-D). The posteriors become edges of a pose graph, with whose optimised poses the
    views are fused.
    """

    segmenter: Segmenter = field(default_factory=Segmenter)
    """Finds the object."""
    sensor: Sensor = field(default_factory=Sensor)
    """Noise model of the camera."""
    prior: AbstractPrior = field(default_factory=GeneralPrior)
    """Prior on the motion between two frames."""
    registrar: AbstractRegistrar = field(default_factory=VisibilityRegistrar)
    """Registers two views."""
    closer: Closer = field(default_factory=Closer)
    """Selects pairs to register and accepts or rejects the results."""
    fuser: Fuser = field(default_factory=Fuser)
    """Fuses views into a mesh."""
    common_noise: float = 0.1
    """Covariance of the error common to all views of a run, as a fraction of an edge's. Loops do not observe it; with
    this value, covariances of poses are calibrated over many rendered runs, whose ground truth is known."""
    common_distance: float = 0.001
    """Standard deviation of a bias of all distances, as a share of them, unless the focal length is exact. Loops do not
    observe it, and a larger value does not improve the calibration for cameras other than the renderer's."""
    tolerance_m: float | None = None
    """Error of the surface above which a model is called wrong; None: a share of the object's size, at least what the
    camera's noise allows."""
    colour: bool = True
    """Whether colour is to fit depth for a model to be trusted."""
    seed: int = 0
    """Each pair has its own random generator, seeded with this and the two frame numbers."""
    cache: AbstractPairCache | None = None
    """Registrations of an interrupted run, if any."""

    def __post_init__(self) -> None:
        """Reject a seed that random generators do not take.

        Raises:
            InputError: if it is negative.
        """
        if self.seed < 0:
            raise InputError(f"the seed {self.seed} is negative; give a whole number from 0")

    @checked
    def run(
        self,
        frames: Iterable[Frame],
        scene: Scene,
        *,
        closure_expected: bool = False,
        depth_scale_sigma: float = 0.0,
        live: bool = False,
    ) -> Iterator[Event]:
        """Build a model and yield events: for each frame a `Step`, the last of which has the final model and verdict.

        To skip or shorten the refinement, iterate over the phases of `start(scene)` instead.

        Args:
            frames: in order of time; unless `live`, read one ahead: the last frame is always compared with the first.
            scene: as the segmenter estimated it from the sequence.
            closure_expected: whether the object is known to come back to its start.
            depth_scale_sigma: standard deviation of the depth scale's logarithm; 0 = exact.
            live: process each frame before the next one is read, which may only come later.

        Raises:
            InputError: if two frames have the same number.
        """
        run = self.start(scene, closure_expected=closure_expected, depth_scale_sigma=depth_scale_sigma)
        yield from run.track(frames, live=live)
        yield from run.revisit()
        yield from run.rejoin()
        yield from run.refine()
        yield from run.realign()
        yield from run.finish()

    @checked
    def start(self, scene: Scene, *, closure_expected: bool = False, depth_scale_sigma: float = 0.0) -> Run:
        """Return a run before its first frame; for the arguments see `run`."""
        measured = replace(self, sensor=self.sensor.measured(scene.range_noise))
        return Run(measured, scene, closure_expected=closure_expected, depth_scale_sigma=depth_scale_sigma)

    @checked
    def prepare(self, frame: Frame, scene: Scene) -> Prepared:
        """Segment a frame and prepare it for registration."""
        return prepare(frame, scene, self.segmenter, self.sensor.measured(scene.range_noise))

    @checked
    def register(self, source: RayImage, target: RayImage, prior: AbstractPrior | None = None) -> Posterior:
        """Return the posterior of target_from_source. The result depends on views, prior and seed alone.

        Args:
            source: one view.
            target: another.
            prior: of the motion. None: the modeler's own; if its limits are defaults, then any motion if nothing within
                them matches, or the images contradict the match.

        Raises:
            InputError: if the views lack what the prior needs.
        """

        def attempt(prior: AbstractPrior) -> Posterior:
            return self.registrations.register(source, target, prior.between(source, target))

        return attempt(prior) if prior is not None else without_limits(attempt(self.prior), self.prior, attempt)

    @checked
    def suggest(
        self, known: Step, candidates: Sequence[Candidate] | None = None, goal: Goal | None = None
    ) -> Suggestions:
        """Return the next actions (view, turn or poke), ranked by information gain on poses and surface.

        Args:
            known: the newest step of a run.
            candidates: possible actions; None: turns either way, pokes, laying the object on its side.
            goal: when to stop; None: every pose known to 1°, 95 % of the visible surface seen.

        Raises:
            InputError: if no view has a pose yet.
        """
        return suggest(self.belief(known.views, known.solution, known.edges_so_far), candidates, goal)

    def belief(self, views: Mapping[int, RayImage], solution: Solution, edges: Sequence[Edge]) -> Belief:
        """Return the belief about poses and surface after some views, with these components.

        Raises:
            InputError: if no view has a pose.
        """

        def ready(view: RayImage) -> RayImage:
            return view if view.layers else self.sensor.ray_image(view.frame, view.plane)

        likelihood = self.registrar.likelihood if isinstance(self.registrar, VisibilityRegistrar) else None
        prior = self.prior.learned(solution, edges)
        return Belief.of(views, solution, edges, prior, closer=self.closer, likelihood=likelihood, ready=ready)

    @property
    def registrations(self) -> Registrations:
        """Registers pairs of views."""
        return Registrations(self.registrar, self.seed, self.cache)

    def tracker(self, state: State) -> Tracker:
        """Return the tracker of a run in some state, with these components."""
        return Tracker(state, self.prior, self.closer, self.sensor, self.registrations)

    def joiner(self, tracker: Tracker) -> Joiner:
        """Return the joiner of segments of a run, with these components."""
        return Joiner(self.registrations, tracker.ready)


@final
@dataclass(eq=False)
class Run:
    """One run and the only owner of its state: seven phases in order, each a stream of events.

    `fill` is for frames that were skipped. To save time, `revisit`, `rejoin`, `refine` and `realign` may be omitted or
    stopped at any event; `finish` uses what is there.
    """

    modeler: Modeler
    """The components."""
    scene: Scene
    """As the segmenter estimated it from the sequence."""
    state: State = field(default_factory=State)
    """The state so far."""
    closure_expected: bool = False
    """Whether the object is known to come back to its start."""
    depth_scale_sigma: float = 0.0
    """Standard deviation of the depth scale's logarithm; 0 = exact."""
    records: dict[int, FrameRecord] = field(default_factory=dict, init=False)
    """Results of the frames so far."""

    def __post_init__(self) -> None:
        """Start with an empty preview."""
        self._preview = Preview(self.modeler.fuser)
        self._solved: State | None = None

    def track(self, frames: Iterable[Frame], *, live: bool = False) -> Iterator[Step | Searching]:
        """Register each frame against earlier views. A frame that cannot be placed is reported and left out.

        Args:
            frames: in order of time.
            live: process each frame before reading the next one, which may only come once somebody has turned the
                object. Otherwise the next one is prepared meanwhile, and the last is always compared with the first.

        Raises:
            InputError: if two frames have the same number.
        """
        with prefetching(partial(self.modeler.prepare, scene=self.scene)) as preparing:
            coming = map(preparing, frames)
            for prepared, last in ((one, False) for one in coming) if live else with_last(coming):
                found = prepared()
                self.state = self.state.read(found)
                placed = yield from self._placed(self.state, found, self.state.latest, last=last)
                yield self._after(placed)

    def fill(self, frames: Iterable[Frame]) -> Iterator[Step | Searching]:
        """Add frames that were skipped while tracking, each registered against the nearest in time; yield their steps.

        Args:
            frames: in order of time.

        Raises:
            InputError: if two frames have the same number.
        """
        with prefetching(partial(self.modeler.prepare, scene=self.scene)) as preparing:
            for preparation, _ in with_last(map(preparing, frames)):  # reads one ahead, which is prepared meanwhile
                prepared = preparation()
                self.state = self.state.inserted(prepared)
                nearest = self.state.map_view.nearest_in_time(prepared.frame.index)
                first = nearest[0] if nearest else None
                placed = yield from self._placed(self.state, prepared, first, "fill")
                yield self._after(placed)

    def revisit(self) -> Iterator[Step | Searching]:
        """Retry lost frames, newest first, against the views that followed them; yield steps of those placed."""
        tried: set[tuple[int, int]] = set()
        while pairs := [pair for pair in self.state.retries() if pair not in tried]:
            tried.add(pairs[0])
            frame, neighbour = pairs[0]
            yield Searching(frame)
            placed = yield from self._placed(self.state, self.state.lost[frame], neighbour, "revisit")
            self.state = placed.state
            if placed.prepared.accepted:
                yield self._after(placed)

    def rejoin(self) -> Iterator[Step | Searching | Refining]:
        """Build segments of lost frames and join them with the rest; yield steps of their frames.

        If the object was laid down differently or regrasped, the motion prior does not hold between the frames before
        and after, and all frames after are lost; among these it holds.
        """
        tried: set[int] = set()
        if any(len(frames) >= _MIN_SEGMENT for frames in self.state.lost_intervals()):  # loops first, within segments
            yield from self.refine()
            self.state = self.state.with_spans()
        while intervals := [some for some in self.state.lost_intervals() if len({*some} - tried) >= _MIN_SEGMENT]:
            frames = [frame for frame in max(intervals, key=len) if frame not in tried]
            segment = yield from self._segment(frames)
            tried |= {*segment.views} if len(segment.views) > 1 else {*frames}  # two that match may be held in the air
            if len(segment.views) >= _MIN_SEGMENT:
                yield from self._joined(segment)

    def refine(self) -> Iterator[Refining]:
        """Register further pairs of views, whose edges make the poses more precise; none if an axis fits all steps."""
        tracker = self.modeler.tracker(self.state)
        if doubtful := self.state.less_probable(self.modeler.prior, tracker.learned_prior):
            pairs = [(edge.source, edge.target) for edge in doubtful]
            self.state = self.state.reregistered(doubtful, tracker.between_views(pairs))
        for state, event in self._refinement(self.state):
            self.state = state
            yield event

    def realign(self) -> Iterator[Searching | Refining]:
        """Align parts of the run anew across a pair that the images contradict, if that makes them contradict less."""
        before = self.state
        if before.newest is None:
            return
        self._solve()
        realigner = Realigner(self.modeler.tracker, self.modeler.joiner, self.modeler.tolerance_m)
        found = realigner.free_space(self.state)
        if found is None or found.holds:
            return
        realigned = yield from realigner.realigned(before)
        if realigned is before:
            return
        other = replace(self, state=realigned)
        yield from other.refine()
        other._solve()
        again = realigner.free_space(other.state)
        if again is not None and again.excess < found.excess:
            self.state = self._solved = other.state

    def finish(self, *, interrupted: bool = False) -> Iterator[Step | Fusing]:
        """Solve the graph with the noise that its edges share, fuse and judge the model, and yield the last step.

        Args:
            interrupted: whether the user ended the run before its last frame.
        """
        newest, model = self.state.newest, None
        if newest is None:
            return
        self._solve()
        if self.state.views:
            yield Fusing()
            conditional = conditional_covariances(self.state.solution, self.state.graph.edges)
            model = self.modeler.fuser.fuse(self.state.views, self.state.solution.trajectory, conditional)
            model = widened(model, self.state.solution)
        spans = self.state.spans
        last = self._step(newest, [edge.posterior for edge in spans], spans)
        last = replace(last, last=True, make_model=lambda: model)
        verdict = judged(
            last,
            interrupted=interrupted,
            closure_expected=self.closure_expected,
            prior=self.modeler.prior,
            depth_scale_sigma=self.depth_scale_sigma,
            tolerance_m=self.modeler.tolerance_m,
            colour=self.modeler.colour,
        )
        yield replace(last, verdict=verdict)

    def _refinement(self, state: State) -> Iterator[tuple[State, Refining]]:
        """Yield a state with the edges of the refinement so far."""
        if state.about_axis(self.modeler.prior) is not None:
            return
        yield state, Refining(0, None)
        tracker, before = self.modeler.tracker(state), state.map_view
        refined = {edge.source for edge in state.spans}
        pairs = [pair for pair in self.modeler.closer.span_pairs(before) if pair[0] not in refined]
        yield state, Refining(0, len(pairs))
        for done, posterior in enumerate(tracker.between_views(pairs), 1):
            edge = self.modeler.closer.judge_span(posterior.without_samples(), before)
            state = state.refined(tracker.explained([edge]))
            yield state, Refining(done, len(pairs))

    def _segment(self, frames: Sequence[int]) -> Generator[Searching | Refining, None, State]:
        """Register lost frames among each other and return their state; the first two that match start the segment."""
        subset = part = self.state.subset(frames)
        for frame in frames:
            yield Searching(frame)
            lost = replace(self.state.lost[frame], left_out=None)
            part = (yield from self._placed(part, lost, part.latest, last=frame == frames[-1])).state
            if frame not in part.views and len(part.views) == 1:  # the first may show the object in a hand
                part = (yield from self._placed(subset, lost, None)).state
        for refined, event in self._refinement(part):
            part = refined
            yield event
        return part.with_spans()

    def _joined(self, segment: State) -> Iterator[Step]:
        """Join a segment with the views so far, if possible; yield steps of its frames."""
        joiner = self.modeler.joiner(self.modeler.tracker(self.state))
        merged, joins = joined(joiner, self.state, segment)
        lost, left_out = self.state.lost, None
        if merged is None:
            left_out = NotJoined(len(segment.views))
        else:
            self.state = merged
        if (newest := self.state.newest) is not None and newest.frame.index in segment.views:
            self.state = replace(self.state, newest=replace(newest, left_out=left_out))
        for frame in sorted(segment.views, key=lambda frame: self.state.places[frame]):
            edges = [edge for edge in (*segment.graph.edges, *joins) if edge.source == frame]
            yield self._step(replace(lost[frame], left_out=left_out), [edge.posterior for edge in edges], edges)

    def _placed(
        self, state: State, prepared: Prepared, first: int | None, stage: Stage = "track", *, last: bool = False
    ) -> Generator[Searching, None, Placed]:
        """Register a frame and add it to the graph.

        Args:
            state: before it.
            prepared: the frame.
            first: number of the view to register it against first, if any.
            stage: whose attempts are made.
            last: whether it is the last of the sequence.
        """
        tracker, closer, number = self.modeler.tracker(state), self.modeler.closer, prepared.frame.index
        view = None if prepared.view is None else tracker.ready(prepared.view)
        posteriors, placement = (), Placement()
        if view is not None and first is not None:
            posteriors, placement = yield from tracker.place(view, first, stage)
            if placement.base is not None and stage != "fill":
                posteriors += tracker.closures(view, posteriors, placement.base, last=last)
        compact = [posterior.without_samples() for posterior in posteriors]
        edges = closer.judge(compact, placement, state.map_view, steps=state.steps(number, first))
        edges = tracker.explained(edges)
        prepared = replace(prepared, view=view, left_out=prepared.why_left_out(edges, first=not state.views))
        state = state.joined(prepared, edges)
        if prepared.accepted and closer.is_keyframe(number, state.map_view):
            state = replace(state, keyframes=(*state.keyframes, number))
        return Placed(state, prepared, posteriors, edges)

    def _after(self, placed: Placed) -> Step:
        """Continue from the state after a frame, and return its event."""
        self.state = placed.state
        return self._step(placed.prepared, placed.posteriors, placed.edges)

    def _solve(self) -> None:
        """Solve the graph with what its edges share: an axis of all steps or else noise, and the focal length.

        The axis is estimated from all pairs, so that it makes the first pairs as precise as the last, and each pair
        informs it once. Noise is shared by the edges of a frame and by all views. If loops determine the focal length,
        views and edges are converted to its estimate.
        """
        if self.state is self._solved:
            return
        state, focal = self.state.with_spans(), None
        if (sigma := self.modeler.sensor.noise.sigma_focal) > 0.0 and len(state.solution.trajectory) > 1:
            state, focal = self._with_focal_length(state, sigma)
        distance_sigma = self.modeler.common_distance if sigma > 0.0 else 0.0
        solved = partial(state.solved, focal=focal, distance_sigma=distance_sigma)
        if (about_axis := solved().about_axis(self.modeler.prior)) is not None:
            self.state = self._solved = about_axis
            return
        factor = variance_factor(state.graph, state.solution, state.exact_share)
        shared = shared_noise(state.graph, state.solution, factor)
        self.state = self._solved = solved(shared=shared, common=self.modeler.common_noise, variance_factor=factor)

    def _with_focal_length(self, state: State, sigma: float) -> tuple[State, FocalLength]:
        """Return a state under the focal length estimated from its loops, and the estimate.

        If it is far from the given one, edges are registered again, because their derivatives are approximate.

        Args:
            state: with all edges.
            sigma: prior standard deviation of the focal length's logarithm.
        """
        at, sensor = 0.0, self.modeler.sensor

        def estimate_at(log_factor: float) -> FocalLength:
            nonlocal state, at
            if log_factor != at:
                moved = state.under(log_factor - at, sensor)
                state, at = moved.adjusted(self.modeler.tracker(moved).again), log_factor
            return MovingGraph.of(state.graph, state.solution).estimate(sigma, -at)

        focal = estimate_focal_length(estimate_at, reach=_FOCAL_REACH * sigma)
        return (state if focal.log_factor == at else state.under(focal.log_factor - at, sensor)), focal

    def _step(self, prepared: Prepared, posteriors: Sequence[Posterior], edges: Sequence[Edge]) -> Step:
        """Return the event of a processed frame, with the views that it was registered to, which pictures show."""
        views, solution, ready = self.state.views, self.state.solution, self.state.ready
        compared = {posterior.target: ready[posterior.target] for posterior in posteriors if posterior.target in ready}
        step = Step(
            frame=prepared.frame,
            segmentation=prepared.segmentation,
            view=prepared.view,
            posteriors=tuple(posteriors),
            edges=tuple(edges),
            left_out=prepared.left_out,
            solution=solution,
            make_model=partial(self._preview.model, views, solution.trajectory),
            edges_so_far=self.state.graph.edges,
            views={**views, **compared},
        )
        self.records[step.frame.index] = step.record
        return replace(step, frames_so_far=tuple(self.records[frame] for frame in sorted(self.records)))
