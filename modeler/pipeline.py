"""The loop: frames in, steps out. Estimation does not know that it is watched."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from modeler.closure import Closer
from modeler.fusion import Fuser, own_covariances
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
_BEYOND = (Outcome.AT_LIMIT, Outcome.NO_OVERLAP, Outcome.DEGENERATE)  # what a motion beyond the prior may look like


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
        steps = 0  # since the last accepted frame
        for frame, last in _with_last(frames):
            segmentation, view = self.view(frame, scene)
            steps += 1
            prior = self.prior.learned(solution, graph.edges)
            posteriors, flaw = self._registered(view, views, solution, prior=prior, steps=steps)
            edges = self.closer.edges(posteriors, views, solution)
            outcome = flaw or _outcome(segmentation, view, edges, first=not views)
            graph = graph.plus(edges)
            if view is not None and outcome == ACCEPTED:
                views, steps = views | {frame.index: view}, 0
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

    def register(self, source: RayImage, target: RayImage, prior: AbstractPrior | None = None) -> Posterior:
        """Return the posterior of target_from_source. The result depends on views, prior and seed alone.

        Args:
            source: one view.
            target: another.
            prior: what is known of the motion; None: what is known of any.

        Raises:
            InputError: where the views lack what the prior needs.
        """
        motion = (self.prior if prior is None else prior).between(source, target)
        rng = np.random.default_rng([self.seed, source.index, target.index])
        return self.registrar.register(source, target, motion, rng=rng)

    def _registered(
        self,
        view: RayImage | None,
        views: Mapping[int, RayImage],
        solution: Solution,
        *,
        prior: AbstractPrior,
        steps: int,
    ) -> tuple[tuple[Posterior, ...], str | None]:
        """Return the posteriors of a new view, and why there are none where the prior does not apply.

        Args:
            view: the new view; None where the object was not found.
            views: the accepted views, in order of acceptance.
            solution: the poses so far.
            prior: what is known of the motion from one frame to the next.
            steps: how many frames ago the last view was accepted.
        """
        if view is None or not views:
            return (), None
        targets = self.closer.targets(solution, views, view.index)
        priors = [prior.grown(steps) if steps > 1 else prior, *[prior] * (len(targets) - 1)]
        apply = map if self.executor is None else self.executor.map
        try:
            posteriors = tuple(apply(self.register, [view] * len(targets), [views[t] for t in targets], priors))
            return self._relocalised(view, posteriors, views, solution, prior=prior.grown(max(steps, 2))), None
        except InputError as error:
            return (), str(error)

    def _relocalised(
        self,
        view: RayImage,
        posteriors: tuple[Posterior, ...],
        views: Mapping[int, RayImage],
        solution: Solution,
        *,
        prior: AbstractPrior,
    ) -> tuple[Posterior, ...]:
        """Return the posteriors, with more where none of them places the frame: other views, within a grown prior."""
        if self._placed(posteriors, views, solution):
            return posteriors
        previous = posteriors[0]
        if previous.outcome in _BEYOND:  # the motion may be larger than the prior allows for one step
            again = self.register(view, views[previous.target], prior)
            again = replace(again, seconds=previous.seconds + again.seconds)
            posteriors = (again, *posteriors[1:])
        while not self._placed(posteriors, views, solution):
            target = self.closer.relocation(posteriors, views, solution)
            if target is None:
                break
            posteriors = (*posteriors, self.register(view, views[target], prior))
        return posteriors

    def _placed(self, posteriors: tuple[Posterior, ...], views: Mapping[int, RayImage], solution: Solution) -> bool:
        return any(edge.accepted for edge in self.closer.edges(posteriors, views, solution))

    def _fused(self, views: Mapping[int, RayImage], solution: Solution, *, last: bool) -> ObjectModel:
        if not last:
            return self.fuser.preview(views, solution.trajectory)
        return self.fuser.fuse(views, solution.trajectory, own_covariances(solution))


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
