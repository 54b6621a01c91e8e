"""One run: its state, and the phases that change it."""

from __future__ import annotations

import zlib
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Final

import numpy as np

from modeler.closure import Placement
from modeler.fusion import conditional_covariances
from modeler.graph import MovingGraph, estimate_focal_length
from modeler.pipeline.attempts import Stage
from modeler.pipeline.correcting import (
    CELL,
    MAX_ROUNDS,
    Majority,
    Realigner,
    contradicting,
    joined,
    masks_of,
    moving_along,
    remasked,
    segmented,
    settled,
    turned_deg,
)
from modeler.pipeline.newest import with_last
from modeler.pipeline.pairs import Prepared
from modeler.pipeline.state import Placed, State
from modeler.segmentation import Scene
from modeler.significance import QUORUM
from modeler.system.processes import prefetching
from modeler.types import (
    NEAR_DEG,
    BoolArray,
    Edge,
    FocalLength,
    Frame,
    FrameRecord,
    Fusing,
    NotJoined,
    Outcome,
    Posterior,
    RayImage,
    Refining,
    Searching,
    Step,
)
from modeler.verdict import judged
from modeler.verdict.evidence import FreeSpace
from modeler.verdict.spreads import widened

if TYPE_CHECKING:
    from modeler.pipeline.modeler import Modeler

_FOCAL_REACH: Final = 5.0  # prior standard deviations: nominal focal lengths of captures are off by up to 4.5


@dataclass(eq=False)
class Run:
    """One run and the only owner of its state: seven phases in order, each a stream of events.

    `fill` is for frames that were skipped. To save time, `revisit`, `rejoin`, `refine` and `correct` may be omitted or
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
        """Start without frames."""
        self._with_other_masks: set[int] = set()  # views with masks that their frames alone do not show
        self._found: dict[int, bytes] = {}  # masks of the object, where views show what is beside it as well
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
                self._keep_mask(found)
                placed = yield from self._placed(self.state, found, self.state.latest, last=last)
                yield self._after(placed)

    def fill(self, frames: Iterable[Frame]) -> Iterator[Step | Searching]:
        """Add frames that tracking skipped, in order of time, each registered against the nearest; yield their steps.

        Raises:
            InputError: if two frames have the same number.
        """
        with prefetching(partial(self.modeler.prepare, scene=self.scene)) as preparing:
            for preparation, _ in with_last(map(preparing, frames)):  # reads one ahead, which is prepared meanwhile
                prepared = preparation()
                self.state = self.state.inserted(prepared)
                self._keep_mask(prepared)
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
        if any(len(frames) >= QUORUM for frames in self.state.lost_intervals()):  # loops first, within segments
            yield from self.refine()
            self.state = self.state.with_spans()
        while intervals := [some for some in self.state.lost_intervals() if len({*some} - tried) >= QUORUM]:
            frames = [frame for frame in max(intervals, key=len) if frame not in tried]
            segment = yield from self._segment(frames)
            tried |= {*segment.views} if len(segment.views) > 1 else {*frames}  # two that match may be held in the air
            if len(segment.views) >= QUORUM:
                yield from self._joined(segment)

    def refine(self) -> Iterator[Refining]:
        """Register further pairs of views, whose edges make the poses more precise; none if an axis fits all steps."""
        self.state = self.state.settled().rejudged(self.modeler.closer.judge_span)
        tracker = self.modeler.tracker(self.state)
        if doubtful := self.state.less_probable(self.modeler.prior, tracker.learned_prior):
            pairs = [(edge.source, edge.target) for edge in doubtful]
            self.state = self.state.reregistered(doubtful, tracker.between_views(pairs))
        for state, event in self._refinement(self.state):
            self.state = state
            yield event

    def correct(self) -> Iterator[Step | Searching | Refining]:
        """Where surface violates free space, make masks anew, then align parts anew; keep what is contradicted less.

        Parts are aligned anew as well where registrations of the refinement contradict the poses.

        Yields the steps of the frames whose masks are others.
        """
        before = self.state
        if before.newest is None:
            return
        self._solve()
        parts = self.modeler
        realigner = Realigner(parts.tracker, parts.joiner, parts.closer.judge_span, parts.tolerance_m)
        free = realigner.free_space(self.state)
        if free is not None and not free.holds and self.scene.finds_masks:
            before, free = yield from self._remasked(realigner, before, free)
        if (free is None or free.holds) and not contradicting(self.state):
            return
        realigned = yield from realigner.realigned(before)
        if realigned is before:
            return
        other = replace(self, state=realigned)
        yield from other.refine()
        other._solve()
        if realigner.contradictions(other.state) < realigner.contradictions(self.state):
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
        yield from self._cut_out()
        if self.state.views:
            yield Fusing()
            conditional = conditional_covariances(self.state.solution, self.state.graph.edges)
            model = self.modeler.fuser.fuse(self.state.views, self.state.solution.trajectory, conditional)
            model = widened(model, self.state.solution)
        newest, spans = self.state.newest or newest, self.state.spans
        last = self._step(newest, [edge.posterior for edge in spans], spans)
        last = replace(last, last=True, make_model=lambda: model, remasked=self._with_other_masks & {*self.state.views})
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

    def _remasked(
        self, realigner: Realigner, before: State, free: FreeSpace
    ) -> Generator[Step | Searching | Refining, None, tuple[State, FreeSpace]]:
        """Build the model anew of what moves with the object, while it violates free space less and keeps its frames.

        States are those before the graph was solved, violations those after that.
        """
        known = {**before.lost, **{frame: self._again(view) for frame, view in before.views.items()}}
        known = {frame: known[frame] for frame in before.places if frame in known}
        views = {frame: one.view for frame, one in known.items() if one.view is not None}
        masks, current, kept, newest = masks_of(before.views), before, self, [*known][-1]
        for _ in range(MAX_ROUNDS):
            poses = current.solution.trajectory
            moving = moving_along(views, current.views, poses, realigner.tolerance(current))
            if arm := turned_deg(poses) < NEAR_DEG:  # which is larger than the object, so that it was registered
                moving = {frame: mask & ~moving[frame] for frame, mask in masks_of(views).items() if frame in moving}
            if settled(moving, masks):
                break
            masks = moving
            other = replace(self, state=State(places=before.places, store=before.store))
            for frame, prepared in known.items():
                yield Searching(frame)
                one = remasked(prepared, masks[frame], self.modeler.sensor) if frame in masks else prepared
                placed = yield from other._placed(other.state, one, other.state.latest, last=frame == newest)
                other._after(placed)
            for event in chain(other.revisit(), other.rejoin(), other.refine()):
                if not isinstance(event, Step):
                    yield event
            current = other.state
            if len(current.views) < len(before.views) or turned_deg(current.solution.trajectory) < NEAR_DEG:
                break
            other._solve()
            again = realigner.free_space(other.state)
            if again is not None and again.excess < free.excess:
                before, free, kept = current, again, other
            elif not arm:
                break
        if kept is not self:
            self.records.update(kept.records)
            self._with_other_masks |= {*kept.state.views}
            shown = self.state.newest is None or self.state.newest.view is not None
            found = kept.state if shown else replace(kept.state, newest=self.state.newest)
            self.state = self._solved = found
            for frame in (frame for frame in known if frame in found.views or frame in found.lost):
                yield self._once_more(self._again(found.views[frame]) if frame in found.views else found.lost[frame])
        return before, free

    def _once_more(self, prepared: Prepared) -> Step:
        """Return the event of a frame that has another mask by now."""
        number = prepared.frame.index
        edges = [edge for edge in self.state.graph.edges if edge.source == number and edge.kind != "span"]
        return self._step(prepared, [edge.posterior for edge in edges], edges)

    def _keep_mask(self, prepared: Prepared) -> None:
        """Keep the object's mask where the view has what is beside it as well."""
        if self.scene.reach_m > 0.0 and prepared.view is not None and prepared.frame.mask is None:
            self._found[prepared.frame.index] = zlib.compress(np.packbits(prepared.segmentation.mask).tobytes(), 1)

    def _cut_out(self) -> Iterator[Step]:
        """Leave what is beside the object out of the views of a moving camera; yield the steps of their frames."""
        views = {frame: view for frame, view in self.state.views.items() if frame in self._found}
        if not views:
            return

        def found(frame: int) -> BoolArray:
            shape, bits = views[frame].frame.depth_m.shape, np.frombuffer(zlib.decompress(self._found[frame]), np.uint8)
            return np.unpackbits(bits, count=shape[0] * shape[1]).reshape(shape).astype(np.bool_)

        most = Majority(views, found, self.state.solution.trajectory, self.scene.reach_m * CELL)
        alone = [self.records[frame].mask for frame in views]
        sure = most.sure and 2 * alone.count(Outcome.UNSURE_MASK.label) <= len(alone)  # the others vote on a minority
        cut = {frame: self._cut(view, most, sure=sure) for frame, view in views.items()}
        own = {frame: one.view for frame, one in cut.items() if one.view is not None}
        newest = self.state.newest
        if newest is not None:
            newest = cut.get(newest.frame.index, newest)
        self.state = self._solved = replace(self.state, views={**self.state.views, **own}, ready={}, newest=newest)
        self._with_other_masks |= {*views}
        for one in cut.values():
            yield self._once_more(one)

    def _cut(self, view: RayImage, most: Majority, *, sure: bool) -> Prepared:
        """Return a frame of a moving camera with the object alone in its view; all stays if most see none there."""
        own = self.modeler.sensor.ray_image(replace(view.frame, mask=most.mask(view.index)), view.plane)
        if not len(own.points_m):
            return segmented(view, Outcome.UNSURE_MASK.label)
        label = self.records[view.index].mask
        if Outcome(label) is not Outcome.CUT_OFF:
            label = (Outcome.CONVERGED if sure else Outcome.UNSURE_MASK).label
        return segmented(self.state.store.keep(own), label)

    def _again(self, view: RayImage) -> Prepared:
        """Return a frame of the model as it was segmented."""
        return segmented(view, self.records[view.index].mask)

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
        """Register a frame, against a view `first`, if any, and then others, and add it to the graph."""
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
        """Solve the graph with what its edges share, see `State.with_shared_errors`.

        If loops determine the focal length, views and edges are converted to its estimate.
        """
        if self.state is self._solved:
            return
        state, focal = self.state.with_spans(), None
        if (sigma := self.modeler.sensor.noise.sigma_focal) > 0.0 and len(state.solution.trajectory) > 1:
            state, focal = self._with_focal_length(state, sigma)
        parts = self.modeler
        self.state = self._solved = state.with_shared_errors(
            parts.prior, focal=focal, common_noise=parts.common_noise, common_distance=parts.common_distance
        )

    def _with_focal_length(self, state: State, sigma: float) -> tuple[State, FocalLength]:
        """Return a state under the focal length estimated from its loops, and the estimate.

        If it is far from the given one, edges are registered again, because their derivatives are approximate. `sigma`
        is the prior standard deviation of its logarithm.
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
            make_model=partial(self.modeler.fuser.preview, views, solution.trajectory),
            edges_so_far=self.state.graph.edges,
            views={**views, **compared},
        )
        self.records[step.frame.index] = step.record
        return replace(step, frames_so_far=tuple(map(self.records.__getitem__, sorted(self.records))))
