"""Self-calibration: the focal length under which the loops of a run close.

A surface at angle θ to the image plane, seen with a focal length too short by a factor c, appears at atan(c tan θ), so
that turns come out too small or too large, and the turns of a closed loop do not sum up to 360°. The mean of every edge
is a function of log c, from its point-to-plane equations at a few focal lengths; the focal length that the run tells is
the one of least graph error (method.md, eq. S1 to S3).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, final

import numpy as np

from modeler import se3
from modeler.graph import Smoother
from modeler.graph.optimise import optimise
from modeler.graph.pose_graph import Factor, SpanningTree, chain, collapse_modes
from modeler.rays import Sensor
from modeler.registration.visibility import VisibilityLikelihood
from modeler.registration.visibility.refinement import surface_mode
from modeler.registration.visibility.search import Search
from modeler.types import Array, Edge, PoseGaussian, RayImage

_STEP = 0.002  # of log c, for the curvature of the graph's error: half a standard error of a good loop
_MAX_ROUNDS = 5  # of solving the edges again about the estimate; on captures two to four are enough
_CONVERGED = 0.25  # standard deviations by which the last round moved the estimate
_LOOSENING = 10.0  # standard deviations of an edge relative to those stated: its own mean holds it by 1 % only


@final
@dataclass(frozen=True)
class FocalLength:
    """What a run tells of the focal length."""

    factor: float
    """True focal length relative to the one that the run was made with."""
    sigma: float
    """Standard deviation of the factor's logarithm."""
    told_by: Literal["loop", "prior"]
    """Whether loops tell it, or nothing does: then it is the prior's."""
    sigmas_before: float
    """Root mean square of the loops' normalised residuals with the focal length that was given: 1 where all is true."""
    sigmas_after: float
    """The same with the estimate."""
    loops: int
    """Number of loops beyond a spanning tree of the edges."""


@final
@dataclass(frozen=True)
class FocalCalibrator:
    """Estimates the focal length from the views and the edges of a run."""

    prior_sigma: float = 0.05
    """Standard deviation of log c before anything is seen. Focal lengths that came with three captures were off by 4 to
    10 %, fitted ones by 1 %."""
    reach: float = 0.15
    """Largest |log c| that is considered: three standard deviations."""
    node: float = 0.05
    """Edges are solved at log c of 0 and ± this, and their means interpolated by parabolas."""
    likelihood: VisibilityLikelihood = field(default_factory=VisibilityLikelihood)
    """Selects the points of the views, and matches them."""
    outlier_distance: float = Smoother.outlier_distance
    """Mahalanobis distance beyond which a loop is an outlier."""

    def estimate(self, views: Mapping[int, RayImage], edges: Sequence[Edge], sensor: Sensor) -> FocalLength:
        """Return the focal length of least graph error.

        Args:
            views: by frame number, made with the focal length that was given.
            edges: of the run. Closures take part also where they were refused because the chain contradicts them.
            sensor: that made the views.
        """
        taking_part = [edge for edge in edges if {edge.source, edge.target} <= views.keys() and _counts(edge)]
        graph = self._graph([Factor(edge, collapse_modes(edge.posterior)) for edge in taking_part], views, 0.0, sensor)
        if not graph.loops:
            return FocalLength(1.0, self.prior_sigma, "prior", float("nan"), float("nan"), 0)
        conditions = 6 * graph.loops
        before = graph.error(0.0)
        best, curvature = self._optimum(graph)
        for _ in range(_MAX_ROUNDS):  # parabolas are exact only about the centre
            centre = best
            graph = self._graph([moving.at(centre) for moving in graph.moving], views, centre, sensor)
            best, curvature = self._optimum(graph)
            if abs(best - centre) < _CONVERGED / np.sqrt(curvature):
                break
        after = graph.error(best)
        scale = max(2.0 * after / max(conditions - 1, 1), 1.0)  # where loops disagree by more than they state
        sigma = min(float(np.sqrt(scale / curvature)), self.prior_sigma)
        return FocalLength(
            factor=float(np.exp(best)),
            sigma=sigma,
            told_by="loop" if sigma < 0.5 * self.prior_sigma else "prior",
            sigmas_before=float(np.sqrt(2.0 * before / conditions)),
            sigmas_after=float(np.sqrt(2.0 * after / conditions)),
            loops=graph.loops,
        )

    def _optimum(self, graph: _Graph) -> tuple[float, float]:
        """Return log c of least error, prior included, and the second derivative of the error there."""

        def cost(log_factor: float) -> float:
            return graph.error(log_factor) + 0.5 * (log_factor / self.prior_sigma) ** 2

        grid = np.arange(-self.reach, self.reach + 1e-9, 0.25 * self.node)
        best = float(grid[int(np.argmin([cost(float(value)) for value in grid]))])
        curvature = 0.0
        for _ in range(3):  # Newton steps, from near enough
            less, middle, more = (cost(best + shift) for shift in (-_STEP, 0.0, _STEP))
            curvature = max((less - 2.0 * middle + more) / _STEP**2, 1.0 / self.prior_sigma**2)
            best -= float(np.clip((more - less) / (2.0 * _STEP * curvature), -0.25 * self.node, 0.25 * self.node))
        return best, curvature

    def _graph(self, factors: Sequence[Factor], views: Mapping[int, RayImage], centre: float, sensor: Sensor) -> _Graph:
        """Return the graph of edges whose means follow log c, solved at a centre and ± `node`."""
        nodes = [
            {frame: _with_focal(view, centre + shift, sensor) for frame, view in views.items()}
            for shift in (0.0, -self.node, self.node)
        ]
        moving = []
        for factor in factors:
            middle, less, more = (self._solved(factor, made) for made in nodes)
            lower, upper = (se3.log(se3.inverse(middle) @ other) for other in (less, more))
            slope, bend = 0.5 * (upper - lower) / self.node, 0.5 * (upper + lower) / self.node**2
            moving.append(_MovingEdge(factor, centre, slope, bend))
        return _Graph(moving, min(views), 0.5 * self.outlier_distance**2)

    def _solved(self, factor: Factor, views: Mapping[int, RayImage]) -> Array:
        """Return target_from_source (4, 4) of matching surface near an edge (method.md, eq. S1)."""
        source, target = factor.source, factor.target
        pair = self.likelihood.between(views[source], views[target], np.random.default_rng([source, target]))
        about = se3.covariance_about(factor.pose.covariance, pair.centre_m)
        spread = np.asarray(np.linalg.cholesky(_LOOSENING**2 * about), dtype=np.float64)
        return surface_mode(pair, factor.pose.mean, spread, pair.centre_m, fine_m=Search().fine_m(pair))[0]


@dataclass(frozen=True, eq=False)
class _MovingEdge:
    factor: Factor
    """At the centre."""
    centre: float
    """log c."""
    slope: Array
    """(6,)"""
    bend: Array
    """(6,)"""

    def at(self, log_factor: float) -> Factor:
        """Return the factor under a focal length (method.md, eq. S2)."""
        away = log_factor - self.centre
        moved = self.factor.pose.mean @ se3.exp(self.slope * away + self.bend * away**2)
        return Factor(self.factor.edge, PoseGaussian(moved, self.factor.pose.covariance))


@dataclass(frozen=True, eq=False)
class _Graph:
    moving: Sequence[_MovingEdge]
    root: int
    threshold: float

    @cached_property
    def loops(self) -> int:
        """Number of loops."""
        return len(self._spanning(0.0).loops)

    def error(self, log_factor: float) -> float:
        """Return the least error of the graph in nats (method.md, eq. S3)."""
        spanning = self._spanning(log_factor)
        start = chain(spanning.tree, self.root, {})
        return optimise(spanning.tree, spanning.loops, start, root=self.root, threshold=self.threshold).error

    def _spanning(self, log_factor: float) -> SpanningTree:
        return SpanningTree.of([moving.at(log_factor) for moving in self.moving], self.root)


def _with_focal(view: RayImage, log_factor: float, sensor: Sensor) -> RayImage:
    """Return a view as it is under another focal length."""
    camera = view.frame.camera
    scaled = replace(camera, fx=camera.fx * np.exp(log_factor), fy=camera.fy * np.exp(log_factor))
    return sensor.ray_image(replace(view.frame, camera=scaled))


def _counts(edge: Edge) -> bool:
    return edge.accepted or (edge.kind == "closure" and edge.posterior.usable)
