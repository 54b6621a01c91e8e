"""Self-calibration: the focal length under which the loops of a run close.

A surface at angle θ to the image plane, seen with a focal length too short by a factor c, appears at atan(c tan θ), so
that turns come out too small or too large, and the turns of a closed loop do not sum up to 360°. Every edge is
registered again under a few focal lengths, which gives its mean as a function of log c; the estimate is the
focal length of least graph error (method.md, eq. S1 to S3).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, final

import numpy as np

from modeler import se3
from modeler.graph import Smoother
from modeler.graph.optimise import optimise
from modeler.graph.pose_graph import Factor, SpanningTree, chain, collapse_modes
from modeler.priors.proposals import PredictedProposal
from modeler.rays import Sensor
from modeler.types import AbstractPrior, Array, Edge, Plane, PoseGaussian, Posterior, RayImage

Register = Callable[[RayImage, RayImage, AbstractPrior], Posterior]
"""Returns the posterior of target_from_source of a source and a target view under a prior."""

_STEP = 0.002  # of log c, for the curvature of the graph's error: half a standard error of a good loop
_LIMIT_STEPS = 2.0  # steps for which limits hold, as where a run places a view that one step's do not
_MAX_ROUNDS = 5  # of registering the edges again about the estimate; on captures two to four are enough
_CONVERGED = 0.25  # standard deviations by which the last round moved the estimate


@final
@dataclass(frozen=True)
class FocalLength:
    """The estimate of a focal length from a run."""

    factor: float
    """True focal length relative to the one that the run was made with."""
    sigma: float
    """Standard deviation of the factor's logarithm."""
    told_by: Literal["loop", "prior"]
    """Whether loops determine it; otherwise it is the prior's."""
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
    outlier_distance: float = Smoother.outlier_distance
    """Mahalanobis distance beyond which a loop is an outlier."""

    def estimate(
        self,
        views: Mapping[int, RayImage],
        edges: Sequence[Edge],
        sensor: Sensor,
        register: Register,
        prior: AbstractPrior,
    ) -> FocalLength:
        """Return the focal length of least graph error.

        Args:
            views: by frame number, made with the focal length that was given.
            edges: of the run. Closures take part also where they were refused because the chain contradicts them.
            sensor: that made the views.
            register: as the run did.
            prior: of the run.
        """
        known = prior.relaxed(_LIMIT_STEPS)
        taking_part = [edge for edge in edges if {edge.source, edge.target} <= views.keys() and _counts(edge)]

        def solved(centre: float) -> _Graph:
            nodes = [
                {frame: _with_focal(view, centre + shift, sensor) for frame, view in views.items()}
                for shift in (0.0, -self.node, self.node)
            ]
            found = [
                # The solution of the run proposes where to search: another focal length changes it by a few degrees.
                self._moving(edge, centre, nodes, register, PredictedProposal(known, collapse_modes(edge.posterior)))
                for edge in taking_part
            ]
            return _Graph([edge for edge in found if edge is not None], min(views), 0.5 * self.outlier_distance**2)

        graph = solved(0.0)
        if not graph.loops:
            return FocalLength(1.0, self.prior_sigma, "prior", float("nan"), float("nan"), 0)
        before = graph.chi_square(0.0)
        best, curvature = self._optimum(graph)
        for _ in range(_MAX_ROUNDS):  # parabolas are exact only about the centre
            centre = best
            graph = solved(centre)
            best, curvature = self._optimum(graph)
            if abs(best - centre) < _CONVERGED / np.sqrt(curvature):
                break
        if not graph.loops:  # those that there were cannot be registered with the estimate
            return FocalLength(1.0, self.prior_sigma, "prior", float(np.sqrt(before)), float("nan"), 0)
        after, conditions = graph.chi_square(best), 6 * graph.loops
        scale = max(after * conditions / (conditions - 1), 1.0)  # where loops disagree by more than they state
        sigma = min(float(np.sqrt(scale / curvature)), self.prior_sigma)
        return FocalLength(
            factor=float(np.exp(best)),
            sigma=sigma,
            told_by="loop" if sigma < 0.5 * self.prior_sigma else "prior",
            sigmas_before=float(np.sqrt(before)),
            sigmas_after=float(np.sqrt(after)),
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

    def _moving(
        self,
        edge: Edge,
        centre: float,
        nodes: Sequence[Mapping[int, RayImage]],
        register: Register,
        prior: AbstractPrior,
    ) -> _MovingEdge | None:
        """Return an edge as a function of log c; None where it cannot be registered.

        Args:
            edge: of the run.
            centre: log c of the first node.
            nodes: the views at the centre, and at less and more by `node`.
            register: see `estimate`.
            prior: of the motion, and where to search.
        """
        middle, *others = (register(made[edge.source], made[edge.target], prior) for made in nodes)
        if not middle.usable:
            return None
        pose = collapse_modes(middle)
        changes = {
            sign * self.node: se3.log(se3.inverse(pose.mean) @ collapse_modes(other).mean)
            for sign, other in zip((-1.0, 1.0), others, strict=True)
            if other.usable
        }
        if len(changes) == 2:
            jump = np.mean(list(changes.values()), axis=0)
            if jump @ np.linalg.solve(pose.covariance, jump) > self.outlier_distance**2:  # one is another mode
                del changes[max(changes, key=lambda shift: np.linalg.norm(changes[shift]))]
        if not changes:
            return None
        slope = np.mean([xi / shift for shift, xi in changes.items()], axis=0)
        bend = np.mean(list(changes.values()), axis=0) / self.node**2 if len(changes) == 2 else np.zeros(6)
        return _MovingEdge(Factor(edge, pose), centre, slope, bend)


@dataclass(frozen=True, eq=False)
class _MovingEdge:
    """An edge whose mean follows the focal length."""

    factor: Factor
    """At the centre."""
    centre: float
    """log c."""
    slope: Array
    """(6,) ξ by log c, at the centre."""
    bend: Array
    """(6,) ξ by its square."""

    def at(self, log_factor: float) -> Factor:
        """Return the factor under a focal length (method.md, eq. S2)."""
        away = log_factor - self.centre
        moved = self.factor.pose.mean @ se3.exp(self.slope * away + self.bend * away**2)
        return Factor(self.factor.edge, PoseGaussian(moved, self.factor.pose.covariance))


@dataclass(frozen=True, eq=False)
class _Graph:
    """The edges of a run as functions of the focal length."""

    moving: Sequence[_MovingEdge]
    root: int
    """Frame whose pose is the identity."""
    threshold: float
    """Error in nats beyond which a loop is an outlier."""

    @cached_property
    def loops(self) -> int:
        """Number of loops."""
        return len(self._spanning(0.0).loops)

    def error(self, log_factor: float) -> float:
        """Return the least error of the graph in nats (method.md, eq. S3)."""
        spanning = self._spanning(log_factor)
        start = chain(spanning.tree, self.root, {})
        return optimise(spanning.tree, spanning.loops, start, root=self.root, threshold=self.threshold).error

    def chi_square(self, log_factor: float) -> float:
        """Return the squared normalised residuals of the loops, a condition: 1 where all is true."""
        return 2.0 * self.error(log_factor) / (6 * self.loops)

    def _spanning(self, log_factor: float) -> SpanningTree:
        return SpanningTree.of([moving.at(log_factor) for moving in self.moving], self.root)


def _with_focal(view: RayImage, log_factor: float, sensor: Sensor) -> RayImage:
    """Return a view as it is under another focal length: x and y of every point shrink as it grows."""
    camera, factor = view.frame.camera, float(np.exp(log_factor))
    scaled = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    return sensor.ray_image(replace(view.frame, camera=scaled), view.plane and _scaled(view.plane, factor))


def _scaled(plane: Plane, factor: float) -> Plane:
    """Return the support plane whose points have x and y divided by a factor."""
    normal = plane.normal * (factor, factor, 1.0)
    length = float(np.linalg.norm(normal))
    return replace(plane, normal=normal / length, offset_m=plane.offset_m / length)


def _counts(edge: Edge) -> bool:
    return edge.kind != "join" and (edge.accepted or (edge.kind == "closure" and edge.posterior.usable))
