"""The focal length as a variable that all edges share: what loops tell of it, and what it leaves uncertain.

Edges are registered under a focal length that is not known exactly, and each states how its mean moves with it
(method.md, eq. 25). Loops close under one focal length only; where there are none, its prior stays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modeler import se3
from modeler.graph.optimise import Optimum, optimise
from modeler.graph.pose_graph import Factor, PoseGraph, SpanningTree, anchored, chain
from modeler.graph.smoother import Smoother
from modeler.types import Array, FocalLength, Solution

TURNS = 0.004
"""Relative error of all turns alike, which loops take for one of the focal length: measured on renders."""

_STEP = 0.005  # for derivatives, at most, and a quarter of the prior's: some standard deviations that loops leave
_ROUNDS = 8  # of Newton's method at most; near the optimum two or three are enough
_REACH = 3.0  # prior standard deviations within which loops are asked, and means are believed that loops hardly tell
_GRID = 0.02  # of the logarithm at most, between the values that Newton's method starts from
_SLOPES = 0.3  # relative error of an estimate: noise of the derivatives makes it too small, by 29 % on the bundled box


@dataclass(frozen=True, eq=False)
class MovingGraph:
    """Edges whose means follow the focal length: all at the logarithm of the true one over that of the views."""

    factors: Sequence[Factor]
    """With that of the views."""
    root: int
    """Frame whose pose is the identity."""
    start: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number, to start from; frames without one start on the chain."""
    threshold: float = 0.5 * Smoother.outlier_distance**2
    """Error in nats beyond which a loop is an outlier."""

    @classmethod
    def of(cls, graph: PoseGraph, solution: Solution) -> MovingGraph:
        """Return the accepted edges of a graph, of several modes as one Gaussian each, with its solution as a start."""
        factors = [Factor(edge, solution.pose_of(edge)) for edge in graph.accepted]
        return cls(factors, graph.root or 0, solution.trajectory)

    def estimate(self, prior_sigma: float, prior_mean: float = 0.0) -> FocalLength:
        """Return the logarithm of least error, prior included, by Newton's method (method.md, eq. G12 and G13).

        Args:
            prior_sigma: standard deviation of the logarithm before the edges are asked.
            prior_mean: its mean.
        """

        def cost(log_factor: float) -> float:
            return self.at(log_factor).error + 0.5 * ((log_factor - prior_mean) / prior_sigma) ** 2

        step = min(_STEP, 0.25 * prior_sigma)
        best, curvature = prior_mean, 1.0 / prior_sigma**2
        if not all(self.at(prior_mean).inlier):  # loops that are outliers there tell nothing
            reach = _REACH * prior_sigma
            grid = np.linspace(prior_mean - reach, prior_mean + reach, 1 + 2 * int(np.ceil(reach / _GRID)))
            best = min(grid.tolist(), key=cost)
        for _ in range(_ROUNDS if self.loops else 0):
            less, middle, more = (cost(best + shift) for shift in (-step, 0.0, step))
            curvature = max((less - 2.0 * middle + more) / step**2, 1.0 / prior_sigma**2)
            move = float(np.clip((less - more) / (2.0 * step * curvature), -2.0 * prior_sigma, 2.0 * prior_sigma))
            while cost(best + move) > middle and abs(move) > step:  # far from the optimum steps may lead beyond it
                move *= 0.5
            best += move
            if abs(move) * np.sqrt(curvature) < 0.01:
                break
        less, more = (self.at(best + sign * step).poses for sign in (-1.0, 1.0))
        conditions = max(6 * self.loops, 1)
        before, after = (2.0 * self.at(value).error / conditions for value in (0.0, best))
        fitting = self.at(best)
        agreeing = 6 * sum(fitting.inlier)
        left = 2.0 * (fitting.error - self.threshold * fitting.inlier.count(False))
        worse = max(left / (agreeing - 1), 1.0) if agreeing else 1.0  # than the edges state
        sigma = float(np.linalg.norm([np.sqrt(worse / curvature), _SLOPES * best, TURNS]))
        return FocalLength(
            log_factor=best,
            sigma=min(sigma, prior_sigma),
            prior_sigma=prior_sigma,
            loops=self.loops,
            sigmas_before=float(np.sqrt(before)),
            sigmas_after=float(np.sqrt(after)),
            by_focal={frame: se3.log(more[frame] @ se3.inverse(less[frame])) / (2.0 * step) for frame in more},
        )

    def at(self, log_factor: float) -> Optimum:
        """Return the poses of least error under a focal length."""
        if log_factor not in self._solved:
            spanning = SpanningTree.of([factor.under(log_factor) for factor in self.factors], self.root)
            self._solved[log_factor] = self._optimum(spanning, self._nearest(log_factor))
        return self._solved[log_factor]

    def _nearest(self, log_factor: float) -> Optimum:
        """Return what is known of the solution: that under the nearest focal length, or the start."""
        if not self._solved:
            return Optimum(self.start, (), 0.0)
        return self._solved[min(self._solved, key=lambda known: abs(known - log_factor))]

    def _optimum(self, spanning: SpanningTree, near: Optimum) -> Optimum:
        """Return the poses of least error, from others that are near."""
        tree, loops, root = spanning.tree, spanning.loops, self.root
        if not loops:
            return Optimum(chain(tree, root, {}), (), 0.0)
        start = chain(tree, root, anchored(near.poses, root))
        # Not the loops that took part nearby: the bare chain contradicts one that all edges together can close.
        return optimise(tree, loops, start, root=root, threshold=self.threshold)

    @cached_property
    def loops(self) -> int:
        """Number of loops."""
        return len(SpanningTree.of(self.factors, self.root).loops)

    @cached_property
    def _solved(self) -> dict[float, Optimum]:
        return {}


def located(told_at: Callable[[float], FocalLength], *, rounds: int, enough: float, reach: float) -> FocalLength:
    """Return the focal length that edges tell when they are registered again under each estimate (method.md, eq. S2).

    Noise of the derivatives makes every step too small, as that of regressors does; further ones find what is missing.

    Args:
        told_at: returns what edges tell that were registered under a focal length, its logarithm over the given one
            known; relative to it.
        rounds: of registration at most.
        enough: of standard deviations of a step, after which edges are not registered again.
        reach: largest logarithm.
    """
    first = told = told_at(0.0)
    centre = 0.0
    for number in range(rounds):
        if not told.loops:  # those that there were cannot be registered with the estimate
            return replace(told, log_factor=0.0, sigma=told.prior_sigma)
        before = centre
        centre = float(np.clip(before + told.log_factor, -reach, reach))
        if abs(centre - before) <= enough * told.sigma or number == rounds - 1:
            break
        told = told_at(centre)
    if told.told_by == "prior" and abs(centre) > _REACH * np.sqrt(told.prior_sigma**2 - told.sigma**2):
        # Further from the prior's mean than evidence that weak can lead: the rounds differ, since an edge is wrong.
        centre, told = 0.0, replace(told, sigma=told.prior_sigma)
    return replace(told, log_factor=centre, sigmas_before=first.sigmas_before)
