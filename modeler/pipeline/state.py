"""What a run knows after some frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.closure import MapView, PathNetwork
from modeler.disk_arrays import ViewStore
from modeler.graph import CommonAxis, PoseGraph, Smoother
from modeler.pipeline.pairs import Prepared
from modeler.rays import Sensor
from modeler.types import Edge, FocalLength, InputError, PoseGaussian, Posterior, RayImage, Solution

_READY_BYTES, _LEAST_READY = 128 * 2**20, 8  # of views kept ready, 13 of 640 × 480; however large, so many are
_REVISITED = 3  # frames at most between a lost one and a view that followed it, to which it is registered again


@dataclass(frozen=True, eq=False)
class State:
    """What is known after some frames."""

    graph: PoseGraph = field(default_factory=PoseGraph)
    """Every edge judged so far."""
    smoother: Smoother = field(default_factory=Smoother)
    """Its solution."""
    views: Mapping[int, RayImage] = field(default_factory=dict)
    """The accepted views by frame number, in order of acceptance, without the images that a likelihood looks up."""
    keyframes: tuple[int, ...] = ()
    """Those of them that are keyframes."""
    network: PathNetwork = field(default_factory=PathNetwork)
    """That of the edges before the newest frame's."""
    ready: Mapping[int, RayImage] = field(default_factory=dict)
    """The newest of them with these images."""
    places: Mapping[int, int] = field(default_factory=dict)
    """How many frames were read before each."""
    lost: Mapping[int, Prepared] = field(default_factory=dict)
    """Frames that show the object and were left out."""
    newest: Prepared | None = None
    """The frame read last in order of time, once it is judged."""
    vain: int = 0
    """How many frames were searched for in vain since a search last found one."""
    spans: tuple[Edge, ...] = ()
    """Edges of the refinement, which the graph does not hold yet."""
    store: ViewStore = field(default_factory=ViewStore)
    """What keeps the views and the lost frames."""

    @property
    def solution(self) -> Solution:
        """The poses so far."""
        return self.smoother.solution

    @cached_property
    def map_view(self) -> MapView:
        """What closures are chosen and judged by."""
        return MapView(self.views, self.solution, self.graph.edges, self.keyframes, self.network)

    @property
    def latest(self) -> int | None:
        """Number of the view accepted last; None where there is none."""
        return next(reversed(list(self.views)), None)

    def steps(self, frame: int, other: int | None) -> int:
        """Return how many frames apart two that were read are; 1 without another."""
        return 1 if other is None else abs(self.places[frame] - self.places[other])

    def read(self, prepared: Prepared) -> State:
        """Return the state once one more frame is read.

        Raises:
            InputError: where its number is that of an earlier one.
        """
        frame = prepared.frame.index
        if frame in self.places:
            raise InputError(f"frame {frame} comes twice; give each frame of the sequence a number of its own")
        return replace(self, places={**self.places, frame: len(self.places)})

    def joined(self, prepared: Prepared, edges: Sequence[Edge]) -> State:
        """Return the state once a frame is judged."""
        number, graph = prepared.frame.index, self.graph.plus(edges)
        light = self._stored(prepared)
        newest = self.newest if number in self.lost else light
        if light.view is None:
            return replace(self, graph=graph, newest=newest)
        if not prepared.accepted:
            return replace(self, graph=graph, newest=newest, lost={**self.lost, number: light}, vain=self.vain + 1)
        found = number in self.lost or (bool(edges) and not edges[0].accepted)
        graph = graph if graph.first is not None else replace(graph, first=number)
        ready = {**self.ready, number: prepared.view}
        return replace(
            self,
            graph=graph,
            smoother=self.smoother.to(graph),
            views={**self.views, number: light.view},
            network=self.map_view.network,
            ready=newest_ready(ready),
            newest=newest,
            vain=0 if found else self.vain,
            lost={frame: other for frame, other in self.lost.items() if frame != number},
        )

    def refined(self, edges: Sequence[Edge]) -> State:
        """Return the state with more edges between views that are in it, of which `with_spans` makes use."""
        return replace(self, spans=(*self.spans, *edges))

    def with_spans(self) -> State:
        """Return the state whose graph holds the edges of the refinement."""
        graph = self.graph.plus(self.spans)
        return replace(self, graph=graph, smoother=self.smoother.to(graph))

    def stretches(self) -> list[list[int]]:
        """Return the lost frames in order of time, those between which no view was accepted together."""
        found: list[list[int]] = []
        among = sorted({*self.lost, *self.views}, key=lambda frame: self.places[frame])
        for before, frame in zip([None, *among], among, strict=False):
            if frame in self.lost:
                found = [*found[:-1], [*found[-1], frame]] if before in self.lost else [*found, [frame]]
        return found

    def apart(self, frames: Sequence[int]) -> State:
        """Return what is known of some lost frames alone: that they were read."""
        return State(places=self.places, lost={frame: self.lost[frame] for frame in frames}, store=self.store)

    def united(self, segment: State, joins: Sequence[Edge]) -> State:
        """Return the state with another of frames that are lost here, and edges between both."""
        graph = self.graph.plus([*segment.graph.edges, *joins])
        return replace(
            self,
            graph=graph,
            smoother=self.smoother.to(graph),
            views={**self.views, **segment.views},
            keyframes=(*self.keyframes, *segment.keyframes),
            lost={frame: lost for frame, lost in self.lost.items() if frame not in segment.views},
        )

    def under(self, log_factor: float, sensor: Sensor) -> State:
        """Return the state as it is under another focal length: its views, edges and poses.

        Args:
            log_factor: logarithm of the other focal length over that of the views.
            sensor: that made the views.
        """
        moved = {edge: replace(edge, posterior=edge.posterior.under(log_factor)) for edge in self.graph.edges}
        views: dict[int, RayImage] = {}
        ready: dict[int, RayImage] = {}
        for frame, view in self.views.items():
            refocused = sensor.refocused(view, log_factor)
            views[frame], ready = self.store.keep(refocused), newest_ready({**ready, frame: refocused})
        graph = replace(self.graph, edges=tuple(moved.values()))
        newest = self.newest
        if newest is not None and newest.frame.index in views:
            newest = replace(newest, view=views[newest.frame.index])
        spans = tuple(moved[edge] for edge in self.spans)
        smoother = replace(self.smoother, focal=None).to(graph)
        return replace(self, graph=graph, smoother=smoother, views=views, ready=ready, newest=newest, spans=spans)

    def again(self, register: Callable[[Sequence[tuple[int, int]]], Iterable[Posterior]]) -> State:
        """Return the state with the edges that take part registered again where that finds them at the same place.

        Args:
            register: returns the posteriors of pairs (source, target) of its views.
        """
        lasting = [edge for edge in self.graph.accepted if edge.kind != "join" and not edge.posterior.modes]
        found = register([(edge.source, edge.target) for edge in lasting])
        new = {
            edge: replace(edge, posterior=posterior.without_samples())
            for edge, posterior in zip(lasting, found, strict=True)
            if posterior.usable and not posterior.modes and _same_place(edge.posterior.pose, posterior.pose)
        }
        graph = replace(self.graph, edges=tuple(new.get(edge, edge) for edge in self.graph.edges))
        spans = tuple(new.get(edge, edge) for edge in self.spans)
        return replace(self, graph=graph, spans=spans, smoother=self.smoother.to(graph))

    def solved(
        self,
        *,
        axis: CommonAxis | None,
        shared: float = 0.0,
        common: float = 0.0,
        focal: FocalLength | None = None,
    ) -> State:
        """Return the state solved with what its edges share: an axis or noise, and a focal length; see `Smoother`."""
        smoother = replace(self.smoother, axis=axis, shared=shared, common=common, focal=focal)
        return replace(self, smoother=smoother.to(self.graph))

    def overdue(self) -> Iterator[tuple[int, int]]:
        """Yield lost frames, newest first, each with the view that followed it soonest, if that was soon."""
        for frame in sorted(self.lost, key=lambda frame: -self.places[frame]):
            after = [view for view in self.views if 0 < self.places[view] - self.places[frame] <= _REVISITED]
            if after:
                yield frame, min(after, key=lambda view: self.places[view])

    def _stored(self, prepared: Prepared) -> Prepared:
        """Return a frame whose images are in the store."""
        if prepared.frame.index in self.lost:
            return replace(self.lost[prepared.frame.index], left_out=prepared.left_out)
        if prepared.view is None:
            return prepared
        view = self.store.keep(prepared.view)
        images = view.frame
        frame = replace(prepared.frame, depth_m=images.depth_m, colour=images.colour, occluder=images.occluder)
        assert images.mask is not None
        found = replace(prepared.segmentation, mask=images.mask)
        return replace(prepared, frame=frame, segmentation=found, view=view)


def newest_ready(views: Mapping[int, RayImage]) -> dict[int, RayImage]:
    """Return the last of some views, those whose images for registration are to stay in memory.

    Of others these images are made again.
    """
    kept, size = [], 0
    for frame, view in reversed(list(views.items())):
        size += sum(image.nbytes for image in view.layers.values())
        if size > _READY_BYTES and len(kept) >= _LEAST_READY:
            break
        kept.append((frame, view))
    return dict(reversed(kept))


def _same_place(before: PoseGaussian, after: PoseGaussian) -> bool:
    """Return whether a registration found what it did under another focal length, or another mode."""
    xi = se3.log(se3.inverse(before.mean) @ after.mean)
    return bool(xi @ np.linalg.solve(before.covariance + after.covariance, xi) <= Smoother.outlier_distance**2)
