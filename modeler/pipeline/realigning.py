"""Parts of a run, aligned anew across a pair that the images contradict, and segments joined."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass

from modeler.pipeline.attempts import told_otherwise
from modeler.pipeline.joining import MIN_JOINS, Joiner, Segment, rejected_elsewhere
from modeler.pipeline.state import State
from modeler.pipeline.tracking import Tracker
from modeler.types import Edge, Searching
from modeler.verdict.evidence import FreeSpace, default_tolerance_m, free_space


@dataclass(frozen=True)
class Realigner:
    """Aligns two parts of a run anew while surface of one violates the other's free space (docs/method/segments.md).

    A pair that matches by chance, as similar sides of an object do, misplaces all frames from it on. Alignments of both
    parts are judged by all their views.
    """

    tracker: Callable[[State], Tracker]
    """Returns the tracker of a state."""
    joiner: Callable[[Tracker], Joiner]
    """Returns the joiner of segments."""
    tolerance_m: float | None = None
    """Error of the surface above which a model is called wrong; None: `default_tolerance_m`."""

    def realigned(self, state: State) -> Generator[Searching, None, State]:
        """Return a state whose views violate each other's free space less, or the same one."""
        tried: set[tuple[int, int]] = set()
        while (free := self.free_space(state)) is not None and not free.holds:
            gap = self._most_contradicted(state, free)
            if gap is None or gap in tried:
                break
            tried.add(gap)
            other = yield from self._aligned_across(state, *gap)
            found = None if other is None else self.free_space(other)
            if other is None or found is None or found.excess >= free.excess:
                break
            state = other
        return state

    def free_space(self, state: State, among: Iterable[int] | None = None) -> FreeSpace | None:
        """Return the free-space violations between views of a state, by default all, as the verdict judges them."""
        views = {frame: state.views[frame] for frame in (state.views if among is None else among)}
        return free_space(views, state.solution.trajectory, self.tolerance(state))

    def tolerance(self, state: State) -> float:
        """Return the error in m of the surface above which a model is called wrong."""
        return self.tolerance_m or default_tolerance_m([*state.views.values()], state.solution.variance_factor)

    def _aligned_across(self, state: State, before: int, after: int) -> Generator[Searching, None, State | None]:
        """Return a state with another alignment of the frames from one on with those before; None without one.

        Args:
            state: with all edges.
            before: number of a frame.
            after: number of the next one, the first of those to align.
        """
        state = state.with_spans()
        early = {frame for frame in state.views if state.places[frame] <= state.places[before]}
        target, source = state.parted(early), state.parted({*state.views} - early)
        if target is None or source is None:
            return None
        yield Searching(after)
        tracker = self.tracker(state)
        merged, _ = joined(self.joiner(tracker), target, source)
        if merged is None:
            return None
        views, motion = state.views, merged.solution.relative(before, after)
        steps = state.steps(after, before)
        if told_otherwise(tracker.learned_prior, views[after], views[before], steps, motion[None]):
            return None
        kept = {*target.graph.edges, *source.graph.edges}
        others = [edge for edge in state.graph.edges if edge not in kept]
        rejected = [rejected_elsewhere(edge, merged.solution) if edge.accepted else edge for edge in others]
        return merged.refined(rejected).with_spans()

    def _most_contradicted(self, state: State, free: FreeSpace) -> tuple[int, int] | None:
        """Return the two successive views across which most surface violates free space, if any does."""
        places, gap = state.places, free.most_contradicted(state.places)
        while gap is not None:  # of long runs, some views are compared
            between = [view for view in state.views if places[gap[0]] <= places[view] <= places[gap[1]]]
            if len(between) == 2:
                return gap
            found = self.free_space(state, between)
            gap = None if found is None else found.most_contradicted(places)
        return None


def joined(joiner: Joiner, target: State, source: State) -> tuple[State | None, Sequence[Edge]]:
    """Return two states joined by their likeliest alignment, None if too few pairs agree on it, and its edges."""
    parts = [Segment(state.views, state.solution, state.graph.edges) for state in (target, source)]
    alignments = joiner.join(parts[0], parts[1])
    joins = alignments[0].edges if alignments else ()
    if sum(edge.accepted for edge in joins) < MIN_JOINS:
        return None, joins
    merged = target.merged(source, joins)
    return merged if sum(merged.solution.takes_part(edge) for edge in joins) >= MIN_JOINS else None, joins
