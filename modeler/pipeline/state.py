"""What the loop knows after some frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from modeler.closure import MapView
from modeler.fusion import IncrementalTsdf
from modeler.graph import CommonAxis, PoseGraph, Smoother
from modeler.types import Edge, Frame, InputError, ObjectModel, RayImage, Segmentation, Solution

_READY = 8  # views kept ready for registration; of others the images that a likelihood looks up are made again
_SPANNED = 3  # frames between a lost one and a view that followed it, at most, for it to be tried once more


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame, and the object in it."""

    frame: Frame
    segmentation: Segmentation
    view: RayImage | None
    """None where the object was not found."""


@dataclass(frozen=True, eq=False)
class State:
    """What is known after some frames."""

    graph: PoseGraph = field(default_factory=PoseGraph)
    """Every edge judged so far."""
    smoother: Smoother = field(default_factory=Smoother)
    """Its solution."""
    views: Mapping[int, RayImage] = field(default_factory=dict)
    """The accepted views by frame number, in order of acceptance, without the images that a likelihood looks up."""
    ready: Mapping[int, RayImage] = field(default_factory=dict)
    """The newest of them with these images."""
    places: Mapping[int, int] = field(default_factory=dict)
    """How many frames were read before each."""
    lost: Mapping[int, Seen] = field(default_factory=dict)
    """Frames that show the object and were left out."""
    vain: int = 0
    """How many frames were searched for in vain since one was last found by it."""
    model: ObjectModel | None = None
    """The newest model."""
    growing: IncrementalTsdf | None = None
    """What it grows from while frames still come."""

    @property
    def solution(self) -> Solution:
        """The poses so far."""
        return self.smoother.solution

    @cached_property
    def map_view(self) -> MapView:
        """What closures are chosen and judged by."""
        return MapView(self.views, self.solution, self.graph.edges)

    @property
    def latest(self) -> int | None:
        """Number of the view accepted last; None where there is none."""
        return next(reversed(list(self.views)), None)

    def steps(self, frame: int, other: int | None) -> int:
        """Return how many frames apart two that were read are; 1 without another."""
        return 1 if other is None else abs(self.places[frame] - self.places[other])

    def read(self, frame: int) -> State:
        """Return the state once one more frame is read.

        Raises:
            InputError: where its number is that of an earlier one.
        """
        if frame in self.places:
            raise InputError(f"frame {frame} comes twice; give each frame of the sequence a number of its own")
        return replace(self, places={**self.places, frame: len(self.places)})

    def joined(self, seen: Seen, edges: Sequence[Edge], *, accepted: bool) -> State:
        """Return the state once a frame is judged."""
        number, graph = seen.frame.index, self.graph.plus(edges)
        if not accepted or seen.view is None:
            lost = self.lost if seen.view is None else {**self.lost, number: replace(seen, view=_light(seen.view))}
            return replace(self, graph=graph, lost=lost, vain=self.vain + (seen.view is not None))
        found = number in self.lost or (bool(edges) and not edges[0].accepted)
        graph = graph if graph.first is not None else replace(graph, first=number)
        ready = {**self.ready, number: seen.view}
        return replace(
            self,
            graph=graph,
            smoother=self.smoother.to(graph),
            views={**self.views, number: _light(seen.view)},
            ready=dict(list(ready.items())[-_READY:]),
            vain=0 if found else self.vain,
            lost={frame: other for frame, other in self.lost.items() if frame != number},
        )

    def spanned(self, edges: Sequence[Edge]) -> State:
        """Return the state with more edges between views that are in it."""
        graph = self.graph.plus(edges)
        return replace(self, graph=graph, smoother=self.smoother.to(graph))

    def solved(self, *, axis: CommonAxis | None, shared: float = 0.0, common: float = 0.0) -> State:
        """Return the state solved with an axis that all steps share, or the noise that edges do; see `Smoother`."""
        return replace(self, smoother=replace(self.smoother, axis=axis, shared=shared, common=common).to(self.graph))

    def overdue(self) -> Iterator[tuple[Seen, int]]:
        """Yield lost frames, newest first, each with the view that followed it soonest, if that was soon."""
        for frame in sorted(self.lost, key=lambda frame: -self.places[frame]):
            after = [view for view in self.views if 0 < self.places[view] - self.places[frame] <= _SPANNED]
            if after:
                yield self.lost[frame], min(after, key=lambda view: self.places[view])


def _light(view: RayImage) -> RayImage:
    """Return a view without the images that a likelihood looks up, which are ten times as large as the frame."""
    return replace(view, layers={})
