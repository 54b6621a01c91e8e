"""The focal length as a variable shared by all edges, estimated from loops (method, eq. 10.3 to 10.5).

Edges are registered under a focal length that is not known exactly; each has its mean's derivative (eq. 10.2).
Loops close under one focal length only; without loops, its prior remains.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.graph.optimise import MAX_ROUNDS, Optimum, optimise
from modeler.graph.pose_graph import Factor, PoseGraph, SpanningTree, anchored, chain, collapse_modes
from modeler.graph.smoother import OUTLIER_DISTANCE
from modeler.priors.proposals import PredictedProposal
from modeler.significance import SIGMAS
from modeler.types import AbstractPrior, Array, Edge, FocalLength, Posterior, RayImage, Solution
from modeler.views import Sensor

RELIEF_ERROR = 0.008
"""Relative error of the depth's relief, which loops cannot distinguish from a focal length: measured (eq. 10.4)."""

_STEP = 0.005  # of finite differences, at most a quarter of the prior's standard deviation: a few posterior ones
_GRID = 0.02  # largest spacing, in the logarithm, of starting values for Newton's method
_CONVERGED = 0.25  # standard deviations that the last registration of the edges moves the estimate
_MIN_SHARE = 0.3  # of the way to the optimum that a step goes: ten rendered runs have 0.56 to 1
_DERIVATIVE_ERROR = 0.3  # relative, of an estimate: 0.26 in the median of ten first steps


@dataclass(frozen=True, eq=False)
class MovingGraph:
    """Edges whose means depend on the focal length, by the logarithm of the true one over that of the views."""

    factors: Sequence[Factor]
    """Under the focal length of the views."""
    root: int
    """Frame whose pose is the identity."""
    start: Mapping[int, Array]
    """Initial object_from_camera (4, 4) by frame number; for other frames, dead reckoning."""

    @classmethod
    def of(cls, graph: PoseGraph, solution: Solution) -> MovingGraph:
        """Return the accepted edges of a graph, one Gaussian each, with its solution as the initial value."""
        factors = [Factor(edge, solution.pose_of(edge)) for edge in graph.accepted]
        return cls(factors, graph.root or 0, solution.trajectory)

    def estimate(self, prior_sigma: float, prior_mean: float = 0.0) -> FocalLength:
        """Return the logarithm of least error, prior included, by Newton's method (method, eq. 10.3 and 10.4).

        Args:
            prior_sigma: prior standard deviation of the logarithm.
            prior_mean: its prior mean.
        """

        def cost(log_factor: float) -> float:
            return self.at(log_factor).error + 0.5 * ((log_factor - prior_mean) / prior_sigma) ** 2

        step = min(_STEP, 0.25 * prior_sigma)
        best, curvature = prior_mean, 1.0 / prior_sigma**2
        if not all(self.at(prior_mean).inlier):  # outliers have no gradient there
            reach = SIGMAS * prior_sigma
            grid = np.linspace(prior_mean - reach, prior_mean + reach, 1 + 2 * int(np.ceil(reach / _GRID)))
            best = min(grid.tolist(), key=cost)
        for _ in range(MAX_ROUNDS if self.loops else 0):
            less, middle, more = (cost(best + shift) for shift in (-step, 0.0, step))
            curvature = max((less - 2.0 * middle + more) / step**2, 1.0 / prior_sigma**2)
            move = float(np.clip((less - more) / (2.0 * step * curvature), -2.0 * prior_sigma, 2.0 * prior_sigma))
            while cost(best + move) > middle and abs(move) > step:  # far from the optimum, Newton steps may overshoot
                move *= 0.5
            best += move
            if abs(move) * np.sqrt(curvature) < 0.01:
                break
        less, more = (self.at(best + sign * step).poses for sign in (-1.0, 1.0))
        conditions = max(6 * self.loops, 1)
        before, after = (2.0 * self.at(value).error / conditions for value in (0.0, best))
        optimum = self.at(best)
        conditions_met = 6 * sum(optimum.inlier)
        residual = 2.0 * (optimum.error - self.threshold * optimum.inlier.count(False))
        inflation = max(residual / (conditions_met - 1), 1.0) if conditions_met else 1.0  # of the edges' covariances
        noise_sigma = float(np.sqrt(inflation / curvature))
        sigma = float(np.linalg.norm([noise_sigma, _DERIVATIVE_ERROR * best, RELIEF_ERROR]))
        return FocalLength(
            log_factor=best,
            sigma=min(sigma, prior_sigma),
            prior_sigma=prior_sigma,
            loops=self.loops,
            sigmas_before=float(np.sqrt(before)),
            sigmas_after=float(np.sqrt(after)),
            by_focal={frame: se3.log(more[frame] @ se3.inverse(less[frame])) / (2.0 * step) for frame in more},
            noise_sigma=noise_sigma,
        )

    def at(self, log_factor: float) -> Optimum:
        """Return the poses of least error under a focal length."""
        if log_factor not in self._solved:
            spanning = SpanningTree.of([factor.under(log_factor) for factor in self.factors], self.root)
            self._solved[log_factor] = self._optimum(spanning, self._nearest(log_factor))
        return self._solved[log_factor]

    def _nearest(self, log_factor: float) -> Optimum:
        """Return the known solution under the nearest focal length, or the initial value."""
        if not self._solved:
            return Optimum(self.start, (), 0.0)
        return self._solved[min(self._solved, key=lambda known: abs(known - log_factor))]

    def _optimum(self, spanning: SpanningTree, near: Optimum) -> Optimum:
        """Return the poses of least error, starting from a nearby solution."""
        tree, loops, root = spanning.tree, spanning.loops, self.root
        if not loops:
            return Optimum(chain(tree, root, {}), (), 0.0)
        start = chain(tree, root, anchored(near.poses, root))
        # Inliers are not taken from nearby: dead reckoning may contradict a loop that all edges together can close.
        return optimise(tree, loops, start, root=root, threshold=self.threshold)

    @property
    def threshold(self) -> float:
        """Error in nats beyond which a loop is an outlier."""
        return 0.5 * OUTLIER_DISTANCE**2

    @cached_property
    def loops(self) -> int:
        """Number of loops."""
        return len(SpanningTree.of(self.factors, self.root).loops)

    @cached_property
    def _solved(self) -> dict[float, Optimum]:
        return {}


def estimate_focal_length(estimate_at: Callable[[float], FocalLength], *, reach: float) -> FocalLength:
    """Return the focal length, estimated iteratively from edges registered under each estimate (method, eq. 10.5).

    Eight captures take one to five estimates.

    The derivatives hold near the focal length of the edges only, so that first steps may be too short. The secant
    through the last two steps shows by how much.

    Args:
        estimate_at: returns the estimate by edges registered under a focal length, relative to it; its argument is the
            logarithm of this focal length over the given one.
        reach: largest absolute logarithm.
    """
    first = estimate = estimate_at(0.0)
    centre, share = 0.0, 1.0
    for number in range(MAX_ROUNDS):
        if not estimate.loops:  # their edges cannot be registered under the estimate
            return replace(estimate, log_factor=0.0, sigma=estimate.prior_sigma)
        before, step = centre, estimate.log_factor
        centre = float(np.clip(before + step / share, -reach, reach))
        if abs(step) <= _CONVERGED * estimate.sigma or centre == before or number == MAX_ROUNDS - 1:
            break
        estimate = estimate_at(centre)
        if abs(centre - before) > estimate.sigma:  # in less, the noise of registrations would show
            share = float(np.clip((step - estimate.log_factor) / (centre - before), _MIN_SHARE, 1.0))
    farthest = SIGMAS * np.sqrt(estimate.prior_sigma**2 - estimate.sigma**2)
    if estimate.determined_by == "prior" and abs(centre) > farthest:
        # Farther from the prior's mean than such weak evidence can lead: the rounds disagree, so that an edge is wrong.
        centre, estimate = 0.0, replace(estimate, sigma=estimate.prior_sigma)
    # Noise moves the end of the iteration by as many times more as its steps are too short.
    more = estimate.noise_sigma * np.sqrt(1.0 / share**2 - 1.0)
    sigma = min(float(np.hypot(estimate.sigma, more)), estimate.prior_sigma)
    return replace(estimate, log_factor=centre, sigma=sigma, sigmas_before=first.sigmas_before)


Register = Callable[[RayImage, RayImage, AbstractPrior], Posterior]
"""Returns the posterior of target_from_source of a source and a target view under a prior."""

LIMIT_STEPS = 2.0  # steps for which limits hold where the graph predicts the motion, so that they do not truncate it


@dataclass(frozen=True)
class FocalCalibrator:
    """Estimates the focal length from the views and the edges of a run: that under which its loops close.

    A surface at angle θ to the image plane, seen with a focal length too short by a factor c, appears at atan(c tan θ),
    so that estimated rotations are too small or too large, and those of a closed loop do not sum up to 360°. A run
    estimates its focal length from the derivatives of its edges, which hold near the given one. Here every edge is
    registered again under each estimate, until convergence (method, eq. 10.5).
    """

    prior_sigma: float = 0.05
    """Prior standard deviation of log c; up to three of them are considered. Given focal lengths of three captures were
    off by 4 to 10 %, calibrated ones by 1 %."""

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
            views: by frame number, made with the given focal length.
            edges: of the run. Closures also take part if they were rejected as contradicting the chain.
            sensor: that made the views.
            register: as the run did.
            prior: of the run.
        """
        known, root = prior.relaxed(LIMIT_STEPS), min(views)
        # Unsure, so that registrations tell how they follow it.
        unsure = replace(sensor, noise=sensor.noise._replace(sigma_focal=self.prior_sigma))
        taking_part = [edge for edge in edges if {edge.source, edge.target} <= views.keys() and _counts(edge)]

        def estimate_at(centre: float) -> FocalLength:
            made = _Made(views, unsure, centre)
            found = [self._registered(edge, made, register, known) for edge in taking_part]
            graph = MovingGraph([factor for factor in found if factor is not None], root, {})
            return graph.estimate(self.prior_sigma, -centre)

        return estimate_focal_length(estimate_at, reach=SIGMAS * self.prior_sigma)

    def _registered(self, edge: Edge, made: _Made, register: Register, prior: AbstractPrior) -> Factor | None:
        """Return an edge under another focal length; None if its change is unknown.

        If it cannot be registered again, such as steps at the limit of the search, its derivative predicts the change;
        edges of a run with an exact focal length have none.

        Args:
            edge: of the run, whose solution proposes where to search: the focal length changes it by a few degrees.
            made: the views.
            register: see `estimate`.
            prior: of the motion.
        """
        proposal = PredictedProposal(prior, collapse_modes(edge.posterior))
        posterior = register(made.view(edge.source), made.view(edge.target), proposal)
        pose = collapse_modes(posterior if posterior.usable else edge.posterior.under(made.centre))
        return Factor(edge, pose) if pose.by_focal.any() else None


@dataclass(frozen=True, eq=False)
class _Made:
    """Views under another focal length."""

    views: Mapping[int, RayImage]
    sensor: Sensor
    centre: float
    """log c."""

    def view(self, frame: int) -> RayImage:
        """Return a view at the centre."""
        if frame not in self._known:
            self._known[frame] = self.sensor.refocused(self.views[frame], self.centre)
        return self._known[frame]

    @cached_property
    def _known(self) -> dict[int, RayImage]:
        return {}


def _counts(edge: Edge) -> bool:
    return edge.kind != "join" and (edge.accepted or (edge.kind == "closure" and edge.posterior.usable))
