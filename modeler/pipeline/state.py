"""The state of a run."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from modeler import se3
from modeler.closure import MapView, PathNetwork
from modeler.graph import CommonAxis, PoseGraph, Smoother, shared_noise, variance_factor
from modeler.graph.smoother import OUTLIER_DISTANCE
from modeler.pipeline.pairs import Prepared
from modeler.priors.proposals import MAX_STEPS
from modeler.registration.posterior import of_multipath
from modeler.system.disk_arrays import ViewStore
from modeler.types import (
    AbstractPrior,
    Edge,
    FocalLength,
    InputError,
    JoinsPrevious,
    NotPlaced,
    PoseGaussian,
    Posterior,
    RayImage,
    Solution,
)
from modeler.views import Sensor

_READY_BYTES = 128 * 2**20  # of views whose images stay in memory: 13 of 640 × 480, at least one


@dataclass(frozen=True, eq=False)
class State:
    """The state of a run after some frames. Immutable."""

    graph: PoseGraph = field(default_factory=PoseGraph)
    """All edges so far."""
    smoother: Smoother = field(default_factory=Smoother)
    """Its solution."""
    views: Mapping[int, RayImage] = field(default_factory=dict)
    """The accepted views by frame number, in order of acceptance, without the images that a likelihood looks up."""
    keyframes: tuple[int, ...] = ()
    """Numbers of the views that are keyframes."""
    network: PathNetwork = field(default_factory=PathNetwork)
    """That of the edges before the newest frame's."""
    ready: Mapping[int, RayImage] = field(default_factory=dict)
    """The newest views, with the images that a likelihood looks up."""
    places: Mapping[int, int] = field(default_factory=dict)
    """By frame number, the number of frames read before."""
    lost: Mapping[int, Prepared] = field(default_factory=dict)
    """Frames that show the object and were left out."""
    newest: Prepared | None = None
    """The newest processed frame in order of time."""
    failed_searches: int = 0
    """Number of frames lost since a search last placed one."""
    spans: tuple[Edge, ...] = ()
    """Edges of the refinement, of which the newest are not in the graph yet."""
    store: ViewStore = field(default_factory=ViewStore)
    """Storage of the views and the lost frames."""

    @property
    def solution(self) -> Solution:
        """The poses so far."""
        return self.smoother.solution

    @cached_property
    def map_view(self) -> MapView:
        """The map by which closures are selected and tested."""
        return MapView(self.views, self.solution, self.graph.edges, self.keyframes, self.network)

    @property
    def latest(self) -> int | None:
        """Number of the view accepted last, if any."""
        return next(reversed(list(self.views)), None)

    def steps(self, frame: int, other: int | None) -> int:
        """Return the number of frames read from one frame to another; 1 without another."""
        return 1 if other is None else abs(self.places[frame] - self.places[other])

    def read(self, prepared: Prepared) -> State:
        """Return the state after reading one more frame.

        Raises:
            InputError: if its number is that of an earlier one.
        """
        return replace(self, places={**self.places, self._new(prepared): len(self.places)})

    def inserted(self, prepared: Prepared) -> State:
        """Return the state after reading a frame that was skipped: its number decides its place among the others.

        Raises:
            InputError: if its number is that of an earlier one.
        """
        frames = sorted([*self.places, self._new(prepared)])
        return replace(self, places={frame: place for place, frame in enumerate(frames)})

    def joined(self, prepared: Prepared, edges: Sequence[Edge]) -> State:
        """Return the state after a frame with its edges, whether it was accepted or not."""
        number, graph = prepared.frame.index, self.graph.plus(edges)
        stored = self._with_stored_images(prepared)
        earlier = self.newest is not None and self.places[number] < self.places[self.newest.frame.index]
        newest = self.newest if earlier or number in self.lost else stored
        if stored.view is None:
            return replace(self, graph=graph, newest=newest)
        if not prepared.accepted:
            return replace(
                self,
                graph=graph,
                newest=newest,
                lost={**self.lost, number: stored},
                failed_searches=self.failed_searches + 1,
            )
        found = number in self.lost or (bool(edges) and not edges[0].accepted)
        graph = graph if graph.first is not None else replace(graph, first=number)
        ready = {**self.ready, number: prepared.view}
        return replace(
            self,
            graph=graph,
            smoother=self.smoother.to(graph),
            views={**self.views, number: stored.view},
            network=self.map_view.network,
            ready=newest_ready(ready),
            newest=newest,
            failed_searches=0 if found else self.failed_searches,
            lost={frame: other for frame, other in self.lost.items() if frame != number},
        )

    def refined(self, edges: Sequence[Edge]) -> State:
        """Return the state with more edges between its views, which `with_spans` adds to the graph."""
        return replace(self, spans=(*self.spans, *edges))

    def with_spans(self) -> State:
        """Return the state with the edges of the refinement in its graph, in place of rejected ones of the pairs."""
        known = set(self.graph.edges)
        new = [edge for edge in self.spans if edge not in known]
        again = {(edge.source, edge.target) for edge in new}
        kept = [edge for edge in self.graph.edges if edge.accepted or (edge.source, edge.target) not in again]
        graph = PoseGraph((*kept, *new), self.graph.first)
        return replace(self, graph=graph, smoother=self.smoother.to(graph)).settled()

    def settled(self) -> State:
        """Return the state with all poses solved, some of which were not after every frame of a large graph."""
        return replace(self, smoother=self.smoother.to(self.graph))

    def lost_intervals(self) -> list[list[int]]:
        """Return the lost frames in order of time, grouped by the accepted views in between."""
        found: list[list[int]] = []
        among = sorted({*self.lost, *self.views}, key=lambda frame: self.places[frame])
        for before, frame in zip([None, *among], among, strict=False):
            if frame in self.lost:
                found = [*found[:-1], [*found[-1], frame]] if before in self.lost else [*found, [frame]]
        return found

    def subset(self, frames: Sequence[int]) -> State:
        """Return a state of some lost frames alone, without views or edges."""
        return State(places=self.places, lost={frame: self.lost[frame] for frame in frames}, store=self.store)

    def parted(self, frames: Collection[int]) -> State | None:
        """Return the state with some views alone and the edges between these; None if these do not connect them."""
        edges = tuple(edge for edge in self.graph.edges if edge.source in frames and edge.target in frames)
        views = {frame: view for frame, view in self.views.items() if frame in frames}
        first = self.graph.first if self.graph.first in views else min(views, key=lambda frame: self.places[frame])
        graph = PoseGraph(edges, first)
        found = replace(
            self,
            graph=graph,
            smoother=Smoother().to(graph),
            views=views,
            keyframes=tuple(frame for frame in self.keyframes if frame in views),
            spans=tuple(edge for edge in self.spans if edge.source in frames and edge.target in frames),
        )
        return found if found.solution.trajectory.keys() >= views.keys() else None

    def merged(self, segment: State, joins: Sequence[Edge]) -> State:
        """Return the state merged with that of a segment of its lost frames, with the edges that join them."""
        graph = self.graph.plus([*segment.graph.edges, *joins])
        return replace(
            self,
            graph=graph,
            smoother=self.smoother.to(graph),
            views={**self.views, **segment.views},
            keyframes=(*self.keyframes, *segment.keyframes),
            spans=(*self.spans, *segment.spans),
            lost={frame: lost for frame, lost in self.lost.items() if frame not in segment.views},
        )

    def under(self, log_factor: float, sensor: Sensor) -> State:
        """Return the state under another focal length: its views, edges and poses.

        Args:
            log_factor: logarithm of the other focal length over that of the views.
            sensor: of the views.
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

    def rejudged(self, judge: Callable[[Posterior, MapView], Edge]) -> State:
        """Return the state with registrations judged anew of frames that were placed only later, by other ones."""
        early = [
            edge
            for edge in self.graph.edges
            if isinstance(edge.reason, NotPlaced) and edge.source in self.views and edge.target in self.views
        ]
        if not early:
            return self
        again = [judge(edge.posterior, self.map_view) for edge in early]
        graph = replace(self.graph, edges=(*(edge for edge in self.graph.edges if edge not in early), *again))
        return replace(self, graph=graph, smoother=self.smoother.to(graph))

    def reregistered(self, edges: Sequence[Edge], found: Iterable[Posterior]) -> State:
        """Return the state with edges registered again: those with a usable posterior, given in the same order."""
        new = {
            edge: replace(edge, posterior=posterior.without_samples())
            for edge, posterior in zip(edges, found, strict=True)
            if posterior.usable
        }
        graph = replace(self.graph, edges=tuple(new.get(edge, edge) for edge in self.graph.edges))
        spans = tuple(new.get(edge, edge) for edge in self.spans)
        return replace(self, graph=graph, spans=spans, smoother=self.smoother.to(graph))

    def adjusted(self, register: Callable[[Sequence[Edge]], Iterable[Posterior]]) -> State:
        """Return the state with accepted edges of one mode registered again, where the new pose is consistent.

        Args:
            register: returns the posteriors of edges of its graph.
        """
        alone = [edge for edge in self.graph.accepted if edge.kind != "join" and not edge.posterior.modes]
        found = [
            (edge, posterior)
            for edge, posterior in zip(alone, register(alone), strict=True)
            if not posterior.modes and _same_place(edge.posterior.pose, posterior.pose)
        ]
        return self.reregistered([edge for edge, _ in found], [posterior for _, posterior in found])

    def less_probable(self, prior: AbstractPrior, learned: AbstractPrior) -> list[Edge]:
        """Return edges with previous views, a mode of which is less probable by what was learned from all: their sense.

        Args:
            prior: with which they were registered.
            learned: the same with what was learned since.
        """
        found = []
        for edge in self.graph.accepted:
            if not isinstance(edge.reason, JoinsPrevious):
                continue
            views = self.views[edge.source], self.views[edge.target]
            means = np.stack([mode.pose.mean for mode in edge.posterior.modes] or [edge.posterior.pose.mean])
            before, after = (
                which.following(edge.target).between(*views).log_prior(means) for which in (prior, learned)
            )
            if (after[np.isfinite(before)] < before[np.isfinite(before)] - 1.0).any():
                found.append(edge)
        return found

    def solved(
        self,
        *,
        shared: float = 0.0,
        common: float = 0.0,
        focal: FocalLength | None = None,
        distance_sigma: float = 0.0,
        variance_factor: float = 1.0,
    ) -> State:
        """Return the state solved with shared noise and a focal length; see `Smoother`.

        `variance_factor` is on the covariances of edges; `distance_sigma` is the standard deviation of the error of all
        distances, as a share of that of the surface.
        """
        shift = None
        if self.views:
            middle_m = np.mean([view.centroid_m for view in self.views.values()], axis=0)
            multipath_m = np.sqrt(variance_factor) * np.median([view.multipath_m for view in self.views.values()])
            sigma = np.hypot(distance_sigma, multipath_m / np.linalg.norm(middle_m))
            shift = sigma**2 * np.outer(middle_m, middle_m) if sigma > 0.0 else None
        smoother = replace(
            self.smoother,
            shared=shared,
            common=common,
            focal=focal,
            common_shift_m2=shift,
            variance_factor=variance_factor,
        )
        return replace(self, smoother=smoother.to(self.graph))

    def with_shared_errors(
        self,
        prior: AbstractPrior | None,
        *,
        focal: FocalLength | None,
        common_noise: float,
        common_distance: float,
    ) -> State:
        """Return the state solved with what its edges share: an axis of all steps or else noise, and the focal length.

        The axis is estimated from all pairs, so that it makes the first pairs as precise as the last, and each pair
        informs it once. Noise is shared by the edges of a frame and by all views.

        Args:
            prior: of the steps; None: they share no axis.
            focal: estimate of the focal length; None: it is exact, and so are distances.
            common_noise: see `Modeler`.
            common_distance: see `Modeler`.
        """
        solved = partial(self.solved, focal=focal, distance_sigma=common_distance if focal is not None else 0.0)
        about_axis = None if prior is None else solved().about_axis(prior)
        if about_axis is not None:
            return about_axis
        factor = variance_factor(self.graph, self.solution, self.exact_share)
        shared = shared_noise(self.graph, self.solution, factor)
        return solved(shared=shared, common=common_noise, variance_factor=factor)

    def about_axis(self, prior: AbstractPrior) -> State | None:
        """Return the state solved with the axis that all steps share by a prior; None if they share none, or none fits.

        Nor with edges of the refinement: noise common to the edges of a frame is not modelled together with an axis.
        """
        shared = prior.shared_axis(list(self.views.values()))
        if shared is None or self.spans:
            return None
        axis = CommonAxis(shared.sigma_tilt_rad, shared.sigma_shift_m, sigma_lift_m=np.inf)
        about_axis = replace(self, smoother=replace(self.smoother, axis=axis).to(self.graph))
        return None if about_axis.solution.camera_from_axis is None else about_axis

    @property
    def exact_share(self) -> float:
        """Mean share of the covariances of edges that is not due to smooth errors of depth."""
        edges = [edge for edge in self.graph.accepted if edge.source in self.views]
        shares = [
            np.trace(np.linalg.solve(edge.posterior.pose.covariance, of_multipath(self.views[edge.source])))
            for edge in edges
        ]
        return 1.0 - float(np.mean(shares)) / 6.0 if shares else 1.0

    def retries(self) -> Iterator[tuple[int, int]]:
        """Yield lost frames, newest first, each with the next accepted view, if that followed within `MAX_STEPS`."""
        for frame in sorted(self.lost, key=lambda frame: -self.places[frame]):
            after = [view for view in self.views if 0 < self.places[view] - self.places[frame] <= MAX_STEPS]
            if after:
                yield frame, min(after, key=lambda view: self.places[view])

    def _new(self, prepared: Prepared) -> int:
        """Return the number of a frame that was not read before."""
        frame = prepared.frame.index
        if frame in self.places:
            raise InputError(f"frame {frame} comes twice; give each frame of the sequence a number of its own")
        return frame

    def _with_stored_images(self, prepared: Prepared) -> Prepared:
        """Return a frame with its images in the store."""
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


@dataclass(frozen=True, eq=False)
class Placed:
    """A processed frame."""

    state: State
    """The state of the run after it."""
    prepared: Prepared
    """The frame, with the reason if it is left out."""
    posteriors: tuple[Posterior, ...]
    """Its registrations."""
    edges: tuple[Edge, ...]
    """These as edges, accepted or rejected."""


def newest_ready(views: Mapping[int, RayImage]) -> dict[int, RayImage]:
    """Return the newest views, whose images for registration stay in memory; others are recomputed on demand."""
    kept, size = [], 0
    for frame, view in reversed(list(views.items())):
        size += sum(image.nbytes for image in view.layers.values())
        if size > _READY_BYTES and kept:
            break
        kept.append((frame, view))
    return dict(reversed(kept))


def _same_place(before: PoseGaussian, after: PoseGaussian) -> bool:
    """Return whether registrations under two focal lengths agree, and not in different modes."""
    xi = se3.log(se3.inverse(before.mean) @ after.mean)
    return bool(xi @ np.linalg.solve(before.covariance + after.covariance, xi) <= OUTLIER_DISTANCE**2)
