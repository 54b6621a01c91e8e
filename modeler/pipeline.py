"""The loop: frames in, steps out. Estimation does not know that it is watched."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from modeler.closure import Closer
from modeler.fusion import Fuser
from modeler.graph import PoseGraph, solve
from modeler.rays import Sensor
from modeler.segmentation import Scene, Segmenter
from modeler.types import (
    AbstractPrior,
    AbstractRegistrar,
    Edge,
    Frame,
    InputError,
    ObjectModel,
    Outcome,
    Posterior,
    RayImage,
    Segmentation,
    Solution,
    Step,
)

ACCEPTED = "accepted"


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
    seed: int = 0
    """Each pair draws from a generator of its own, made from this and the two frame numbers."""
    executor: Executor | None = None
    """Where the pairs of one frame are registered side by side; None: one after the other. Results are the same."""

    def run(self, frames: Iterable[Frame], scene: Scene) -> Iterator[Step]:
        """Yield what each frame brings. A frame that cannot be used is reported and left out.

        Args:
            frames: in order of time; read one ahead, so that the last step is known as such.
            scene: what the segmenter learnt from the sequence.
        """
        graph, views, solution, model = PoseGraph(), dict[int, RayImage](), Solution(), None
        for frame, last in _with_last(frames):
            segmentation, view = self.view(frame, scene)
            posteriors, flaw = self._register(view, views, solution)
            edges = self.closer.edges(posteriors, views, solution)
            outcome = flaw or _outcome(segmentation, view, edges, first=not views)
            graph = graph.plus(edges)
            if view is not None and outcome == ACCEPTED:
                views = views | {frame.index: view}
                graph = graph if graph.first is not None else replace(graph, first=frame.index)
                solution = solve(graph, solution.trajectory)
            if views and (last or outcome == ACCEPTED):
                model = self._fused(views, solution, last=last)
            yield Step(
                frame=frame,
                segmentation=segmentation,
                view=view,
                posteriors=posteriors,
                edges=edges,
                outcome=outcome,
                solution=solution,
                model=model,
                edges_so_far=graph.edges,
                views=views,
                last=last,
            )

    def view(self, frame: Frame, scene: Scene) -> tuple[Segmentation, RayImage | None]:
        """Return the object in a frame, and the frame made ready; None where the object was not found."""
        segmentation = self.segmenter.segment(frame, scene)
        if segmentation.outcome not in (Outcome.CONVERGED, Outcome.UNSURE_MASK):
            return segmentation, None
        view = self.sensor.ray_image(replace(frame, mask=segmentation.mask), segmentation.plane)
        return segmentation, view if len(view.points_m) else None

    def register(self, source: RayImage, target: RayImage) -> Posterior:
        """Return the posterior of target_from_source. The result depends on nothing but the views and the seed.

        Raises:
            InputError: where the views lack what the prior needs.
        """
        motion = self.prior.between(source, target)
        rng = np.random.default_rng([self.seed, source.index, target.index])
        return self.registrar.register(source, target, motion, rng=rng)

    def _register(
        self, view: RayImage | None, views: Mapping[int, RayImage], solution: Solution
    ) -> tuple[tuple[Posterior, ...], str | None]:
        """Return the posteriors of a new view, and why there are none where the prior does not apply."""
        if view is None:
            return (), None
        targets = [views[target] for target in self.closer.targets(solution, views, view.index)]
        sources = [view] * len(targets)
        apply = map if self.executor is None else self.executor.map
        try:
            return tuple(apply(self.register, sources, targets)), None
        except InputError as error:
            return (), str(error)

    def _fused(self, views: Mapping[int, RayImage], solution: Solution, *, last: bool) -> ObjectModel:
        return (self.fuser.fuse if last else self.fuser.preview)(views, solution.trajectory)


def _with_last(frames: Iterable[Frame]) -> Iterator[tuple[Frame, bool]]:
    """Yield frames with whether they are the last, by reading one ahead."""
    ahead = iter(frames)
    for frame in ahead:
        for following in ahead:
            yield frame, False
            frame = following
        yield frame, True


def _outcome(segmentation: Segmentation, view: RayImage | None, edges: tuple[Edge, ...], *, first: bool) -> str:
    """Return "accepted", or in words why a frame is left out."""
    if view is None:
        flaw = Outcome.TOO_FEW_POINTS if segmentation.outcome is Outcome.CONVERGED else segmentation.outcome
        return f"{flaw.label}: {flaw.advice}"
    if first or any(edge.accepted for edge in edges):
        return ACCEPTED
    return edges[0].reason
