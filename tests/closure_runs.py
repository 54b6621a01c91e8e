"""A loop whose registration knows the truth, to see what a closer asks for and how it judges."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from modeler import se3
from modeler.closure import Closer, MapView
from modeler.graph import PoseGraph, Smoother
from modeler.types import Array, Camera, Edge, Frame, Outcome, PoseGaussian, Posterior, RayImage, Solution

CENTROID_M = np.array([0.03, -0.02, 0.8])
ABOUT_OBJECT = se3.translation(CENTROID_M)
COVARIANCE = se3.adjoint(ABOUT_OBJECT) @ np.diag([0.003**2] * 3 + [0.001**2] * 3) @ se3.adjoint(ABOUT_OBJECT).T
REGULAR_DEG = 25.0 * np.arange(14)  # the last frame at 325°


def view(index: int) -> RayImage:
    camera = Camera(2, 2, 500.0, 500.0, 0.5, 0.5)
    frame = Frame(index, float(index), np.full((2, 2), 0.8, dtype=np.float32), camera)
    points = CENTROID_M + np.array([[0.05, 0.0, 0.0], [-0.05, 0.0, 0.0], [0.0, 0.05, 0.0], [0.0, -0.05, 0.0]])
    return RayImage(frame, None, 0.001, 0.001, points, np.tile([0.0, 0.0, -1.0], (4, 1)), np.zeros((4, 2), np.int64))


def turned(angle_deg: float) -> Array:
    """True object_from_camera of an object turned about a tilted axis through itself."""
    axis = np.array([0.1, 0.99, -0.1])
    xi = np.concatenate([np.radians(angle_deg) * axis / np.linalg.norm(axis), np.zeros(3)])
    return se3.inverse(ABOUT_OBJECT @ se3.exp(xi) @ se3.inverse(ABOUT_OBJECT))


def posterior_of(source: int, target: int, pose: Array, outcome: Outcome = Outcome.CONVERGED) -> Posterior:
    return Posterior(source, target, PoseGaussian(pose, COVARIANCE), outcome, overlap=0.8)


class Run:
    """The pipeline's loop, with a registration that knows the truth."""

    def __init__(self, angles_deg: Sequence[float], numbers: Sequence[int] | None = None) -> None:
        self.numbers = list(range(len(angles_deg))) if numbers is None else list(numbers)
        self.truth = {k: turned(angle) for k, angle in zip(self.numbers, angles_deg, strict=True)}
        self.tried: dict[int, tuple[int, ...]] = {}
        self.judged: dict[int, tuple[Edge, ...]] = {}
        self.graph = PoseGraph(first=self.numbers[0])
        self.views: dict[int, RayImage] = {}
        self.keyframes: tuple[int, ...] = ()
        self.smoother = Smoother()

    def measured(self, target: int, source: int, rng: np.random.Generator, bias: Array) -> Posterior:
        noise = rng.multivariate_normal(np.zeros(6), COVARIANCE) + se3.adjoint(ABOUT_OBJECT) @ bias
        return posterior_of(source, target, self.truth_between(target, source) @ se3.exp(noise))

    def run(
        self,
        closer: Closer,
        spoil: Callable[[Posterior], Posterior] = lambda posterior: posterior,
        bias: Array | None = None,
    ) -> Run:
        """Take in the frames one after the other, and return what that leaves."""
        rng = np.random.default_rng(0)
        bias_here = np.zeros(6) if bias is None else bias
        for source in self.numbers:
            posteriors: list[Posterior] = []
            map_view = self.map_view
            steps = self.numbers.index(source) - self.numbers.index(max(self.views)) if self.views else 1
            if self.views:
                posteriors = [spoil(self.measured(next(reversed(self.views)), source, rng, bias_here))]
                while closer.placement(posteriors, map_view, steps=steps).base is None:
                    target = closer.relocalisation_target(posteriors, map_view)
                    if target is None:
                        break
                    posteriors.append(spoil(self.measured(target, source, rng, bias_here)))
                base = closer.placement(posteriors, map_view, steps=steps).base
                if base is not None:
                    targets = closer.closure_targets(base, map_view, last=source == self.numbers[-1])
                    tried = [posterior.target for posterior in posteriors]
                    targets = [target for target in targets if target not in tried]
                    posteriors += [spoil(self.measured(target, source, rng, bias_here)) for target in targets]
            edges = judged(closer, posteriors, map_view, steps=steps)
            self.tried[source], self.judged[source] = tuple(p.target for p in posteriors), edges
            self.graph = self.graph.plus(edges)
            if not self.views or any(edge.accepted for edge in edges):
                self.views[source] = view(source)
            self.smoother = self.smoother.to(self.graph)
            if source in self.views and closer.is_keyframe(source, self.map_view):
                self.keyframes = (*self.keyframes, source)
        return self

    @property
    def solution(self) -> Solution:
        return self.smoother.solution

    @property
    def map_view(self) -> MapView:
        return MapView(self.views, self.solution, self.graph.edges, self.keyframes)

    def truth_between(self, target: int, source: int) -> Array:
        return se3.inverse(self.truth[target]) @ self.truth[source]

    def closures(self) -> list[Edge]:
        return [edge for edges in self.judged.values() for edge in edges if edge.kind == "closure"]


def judged(closer: Closer, posteriors: Sequence[Posterior], map_view: MapView, *, steps: int = 1) -> tuple[Edge, ...]:
    return closer.judge(posteriors, closer.placement(posteriors, map_view, steps=steps), map_view, steps=steps)


def weighed(posterior: Posterior, nats: float) -> Posterior:
    return replace(posterior, log_marginal_likelihood=nats)


def stated(source: int, *, scatter: float = 4.0, wrong: float = -90.0) -> Callable[[Posterior], Posterior]:
    """Give evidence to registrations: as edges have it, and to those over more than one step from `source` far less."""

    def given(posterior: Posterior) -> Posterior:
        doubtful = posterior.source == source and posterior.source - posterior.target > 1
        return weighed(posterior, wrong if doubtful else scatter * float(np.sin(3.0 * posterior.source)) - 20.0)

    return given
