"""The nonlinear solution: least squares with outlier rejection, and its incremental update.

Batch solutions use Levenberg–Marquardt, with graduated non-convexity if loops contradict each other (Yang et al.,
Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020). A growing graph is updated by iSAM2 (Kaess et al.,
iSAM2: Incremental smoothing and mapping using the Bayes tree, IJRR 2012) with Cholesky factorisation, which takes a
sixth of the time of QR; with QR if one direction is so uncertain that Cholesky fails.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modeler.graph import lazy_gtsam as gtsam
from modeler.graph.condensed import Condensed
from modeler.graph.pose_graph import Factor, chain
from modeler.significance import QUORUM
from modeler.types import Array

_ANCHOR_SIGMA = 1e-6  # rad and m, of the root: far below any registration's
_RELINEARISE = 1e-3  # rad and m from the linearisation point: relative error of a factor's residual
_WILDFIRE = 1e-5
"""Changes in rad and m below which iSAM2 stops back substitution; halved or doubled, the dragon's poses are the
same."""
MAX_ROUNDS = 8  # of whatever iterates over solutions; if more are needed, the initial value was too far off
CONDENSED_FROM = 1000  # frames: below, condensing saves nothing
_RENEWED_AT = 256, 16  # frames since a graph was condensed, at least and as a share of all, with which it is so again
_NEWEST = 2  # frames to which a next one may be registered, of a condensed graph
_MOST_LEFT = 64  # frames of a condensed graph, all of which depend on each other

Inlier = tuple[bool, ...]  # whether each loop takes part, in their order


@dataclass(frozen=True, eq=False)
class Optimum:
    """The poses of least error under a set of factors."""

    poses: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    inlier: tuple[bool, ...]
    """Whether each loop takes part."""
    error: float
    """Half the squared Mahalanobis distance of all factors; outliers count as the threshold (eq. 8.2)."""


def optimise(
    tree: Sequence[Factor],
    loops: Sequence[Factor],
    start: Mapping[int, Array],
    *,
    root: int,
    threshold: float,
    inlier: Sequence[bool] = (),
) -> Optimum:
    """Return the optimum of method, eq. 8.1, and which loops are inliers: those whose error is below the threshold.

    The given inliers are kept if they are consistent with their optimum: all inliers are below the threshold, all
    others above. Otherwise graduated non-convexity with a truncated least-squares loss selects them.

    Args:
        tree: factors that are trusted.
        loops: factors that may be outliers.
        start: initial object_from_camera (4, 4) by frame number.
        root: the frame whose pose is the identity.
        threshold: half the squared Mahalanobis distance beyond which a loop is an outlier.
        inlier: whether each of the first loops was an inlier in an earlier solution; the others are assumed to be.
    """
    initial = values_of(start)
    taking_part = (*inlier, *[True] * (len(loops) - len(inlier)))
    chosen = selected(loops, taking_part)
    found = _least_squares(gtsam_graph_of([*tree, *chosen], root), initial)
    if inliers(loops, found, threshold) != taking_part:
        gtsam_graph = gtsam_graph_of([*tree, *loops], root)
        trusted = 1 + len(tree)
        parameters = gtsam.GncLMParams(_parameters())
        parameters.setLossType(gtsam.GncLossType.TLS)
        parameters.setKnownInliers(list(range(trusted)))
        annealing = gtsam.GncLMOptimizer(gtsam_graph, initial, parameters)
        annealing.setInlierCostThresholds(threshold)
        found = annealing.optimize()
        taking_part = tuple(bool(weight > 0.5) for weight in annealing.getWeights()[trusted:])
        chosen = selected(loops, taking_part)
        # With full weights, as those of annealing may be fractions.
        found = _least_squares(gtsam_graph_of([*tree, *chosen], root), found)
    error = gtsam_graph_of([*tree, *chosen], root).error(found) + threshold * taking_part.count(False)
    return Optimum(poses_of(found, start, root), taking_part, error)


def anchor(root: int, sigma: float = _ANCHOR_SIGMA) -> gtsam.PriorFactorPose3:
    """Return the prior that fixes the root's pose at the identity, with a standard deviation in rad and m."""
    return gtsam.PriorFactorPose3(root, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, sigma))


def values_of(poses: Mapping[int, Array]) -> gtsam.Values:
    """Return object_from_camera (4, 4) by frame number as GTSAM values."""
    values = gtsam.Values()
    for frame, object_from_camera in poses.items():
        values.insert(frame, gtsam.Pose3(object_from_camera))
    return values


def poses_of(values: gtsam.Values, start: Mapping[int, Array], root: int) -> dict[int, Array]:
    """Return object_from_camera (4, 4) of the frames of `start`, where `values` has none from there.

    The root's, fixed by `anchor`, is the identity.
    """
    rows = np.asarray(gtsam.utilities.extractPose3(values), dtype=np.float64)  # by key: rotation, translation
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    # Copies: a view kept as a linearisation point would keep all poses of this solution in memory.
    found = {frame: pose.copy() for frame, pose in zip(values.keys(), poses, strict=True)}
    return {**start, **found, root: np.eye(4)}


def inliers(loops: Iterable[Factor], values: gtsam.Values, threshold: float) -> tuple[bool, ...]:
    """Return which loops are below the threshold."""
    return tuple(loop.between.error(values) <= threshold for loop in loops)


def selected(loops: Sequence[Factor], taking_part: Sequence[bool]) -> list[Factor]:
    """Return the loops that take part."""
    return [loop for loop, good in zip(loops, taking_part, strict=True) if good]


def gtsam_graph_of(
    factors: Iterable[Factor], root: int, root_sigma: float = _ANCHOR_SIGMA
) -> gtsam.NonlinearFactorGraph:
    """Return the GTSAM graph of factors and the prior of the root."""
    gtsam_graph = gtsam.NonlinearFactorGraph()
    gtsam_graph.add(anchor(root, root_sigma))
    for factor in factors:
        gtsam_graph.push_back(factor.between)
    return gtsam_graph


def _least_squares(gtsam_graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    return gtsam.LevenbergMarquardtOptimizer(gtsam_graph, start, _parameters()).optimize()


def _parameters() -> gtsam.LevenbergMarquardtParams:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")  # Cholesky fails if a standard deviation is 4096 times another
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    return parameters


@dataclass(frozen=True, eq=False)
class IncrementalSolver:
    """Factors with their iSAM2 solution. Immutable: `plus` works on a copy, which is cheap."""

    factors: frozenset[Factor]
    """Those that take part, and those that are condensed."""
    engine: gtsam.ISAM2
    """Never modified."""
    condensed: Condensed | None = None
    """Those that the engine holds as a Gaussian of a few of their frames."""

    @classmethod
    def of(
        cls, factors: Sequence[Factor], poses: Mapping[int, Array], root: int, condensed: Condensed | None = None
    ) -> IncrementalSolver | None:
        """Return the solver of factors that connect all frames of `poses`; None if it does not converge.

        Args:
            factors: those that take part.
            poses: object_from_camera (4, 4) by frame number, near the optimum.
            root: the frame whose pose is the identity.
            condensed: further ones, with the root.
        """
        for factorisation in ("CHOLESKY", "QR"):
            parameters = gtsam.ISAM2Params()
            parameters.setFactorization(factorisation)
            parameters.setRelinearizeThreshold(_RELINEARISE)
            parameters.relinearizeSkip = 1
            parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(_WILDFIRE))
            gtsam_graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            gtsam_graph.add(anchor(root))
            if condensed is not None:
                values.insert(condensed.poses)
                for factor in condensed.between():
                    gtsam_graph.push_back(factor)
            engine = _updated(gtsam.ISAM2(parameters), (gtsam_graph, values), factors, poses)
            if engine is not None:
                known = frozenset() if condensed is None else condensed.factors
                return cls(known.union(factors), engine, condensed)
        return None

    def plus(self, factors: Sequence[Factor], poses: Mapping[int, Array]) -> IncrementalSolver | None:
        """Return the solver with more factors; None if it does not converge.

        Args:
            factors: of which it has the frames, but for new ones; known factors are skipped.
            poses: initial object_from_camera (4, 4), at least of the new frames.
        """
        new = [factor for factor in factors if factor not in self.factors]
        start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        engine = _updated(gtsam.ISAM2(self.engine), start, new, poses)
        return None if engine is None else IncrementalSolver(self.factors.union(new), engine, self.condensed)

    def reaches(self, factors: Sequence[Factor]) -> bool:
        """Return whether no factor but known ones is of a frame that is eliminated."""
        return self.condensed is None or self.condensed.covers(self.condensed.new(factors))

    def agrees(self, loops: Sequence[Factor], inlier: Inlier, threshold: float) -> bool:
        """Return whether the inliers among loops, and no others, are below a threshold at the solution.

        Those that are condensed were tested when they were.
        """
        if self.condensed is None:
            return inliers(loops, self.values, threshold) == inlier
        kept = [(loop, good) for loop, good in zip(loops, inlier, strict=True) if loop not in self.condensed.factors]
        return inliers([loop for loop, _ in kept], self.values, threshold) == tuple(good for _, good in kept)

    def is_due(self, frames: int) -> bool:
        """Return whether a graph of so many frames was condensed so long ago that all of it is to be solved again."""
        if self.condensed is None:
            return False
        least, share = _RENEWED_AT
        return self.values.size() - len(self.condensed.frames) > max(least, frames // share)

    def lean(
        self, tree: Sequence[Factor], loops: Sequence[Factor], inlier: Inlier, poses: Mapping[int, Array], root: int
    ) -> IncrementalSolver:
        """Return the solver of a large graph condensed to the frames that new ones may be registered against.

        It is the same if the graph is small or condensed, or if too many frames have loops. `inlier` tells which loops
        take part at the solution `poses`, of which that of the root is the identity.
        """
        if self.condensed is not None or len(poses) < CONDENSED_FROM:
            return self
        newest = list(poses)[-_NEWEST:]
        left = frozenset([root, *newest, *(loop.target for loop in loops)])
        if len(left) > _MOST_LEFT:
            return self
        chosen = selected(loops, inlier)
        condensed = Condensed.of([*tree, *chosen], poses, left, outliers=set(loops).difference(chosen))
        return IncrementalSolver.of((), poses, root, condensed) or self

    @property
    def error(self) -> float:
        """Half the squared Mahalanobis distance of all factors at the solution."""
        return self.engine.getFactorsUnsafe().error(self.values)

    @cached_property
    def values(self) -> gtsam.Values:
        """The solution."""
        return self.engine.calculateEstimate()


def _updated(
    engine: gtsam.ISAM2,
    start: tuple[gtsam.NonlinearFactorGraph, gtsam.Values],
    factors: Sequence[Factor],
    poses: Mapping[int, Array],
) -> gtsam.ISAM2 | None:
    """Return an engine after an update; None if relinearisation does not converge.

    Args:
        engine: it is modified.
        start: further factors and values.
        factors: new ones.
        poses: initial object_from_camera (4, 4), at least of new frames.
    """
    gtsam_graph, values = start
    for frame in dict.fromkeys(frame for factor in factors for frame in (factor.target, factor.source)):
        if not (engine.valueExists(frame) or values.exists(frame)):
            values.insert(frame, gtsam.Pose3(poses[frame]))
    for factor in factors:
        gtsam_graph.push_back(factor.between)
    try:
        result = engine.update(gtsam_graph, values)
        for _ in range(MAX_ROUNDS):
            if result.getVariablesRelinearized() == 0:
                return engine
            result = engine.update()
    except RuntimeError:  # GTSAM reports an indeterminate system
        pass
    return None


def solve_loops(
    tree: Sequence[Factor],
    loops: Sequence[Factor],
    start: Mapping[int, Array],
    *,
    root: int,
    threshold: float,
    before: tuple[Inlier, IncrementalSolver | None] = ((), None),
    growing: bool = True,
) -> tuple[Mapping[int, Array], Inlier, IncrementalSolver | None]:
    """Return the poses given all loops, which loops are inliers, and the solver for later updates.

    Args:
        tree: factors that are trusted.
        loops: factors that may be outliers, earlier ones first.
        start: initial object_from_camera (4, 4) by frame number.
        root: the frame whose pose is the identity.
        threshold: half the squared Mahalanobis distance beyond which a loop is an outlier.
        before: which of the loops were inliers of the earlier solution, and its solver.
        growing: whether the solver of a large graph may be condensed, with which poses of eliminated frames stay as
            they are until it is so again.
    """
    poses, inlier, solver = _solved(tree, loops, start, root=root, threshold=threshold, before=before, growing=growing)
    if growing and solver is not None:
        solver = solver.lean(tree, loops, inlier, poses, root)
    return poses, inlier, solver


def _solved(
    tree: Sequence[Factor],
    loops: Sequence[Factor],
    start: Mapping[int, Array],
    *,
    root: int,
    threshold: float,
    before: tuple[Inlier, IncrementalSolver | None],
    growing: bool,
) -> tuple[Mapping[int, Array], Inlier, IncrementalSolver | None]:
    """Return poses, inliers and solver: the earlier one's with what is new, or of all anew."""
    inlier, engine = before
    if engine is not None:
        again = engine.condensed is not None and (not growing or engine.is_due(len(start)))
        found = None if again else _continued((inlier, engine), tree, loops, start, threshold)
        if found is None and engine.condensed is not None:
            found = _whole(inlier, tree, loops, start, root=root, threshold=threshold)
        if found is not None:
            return poses_of(found[1].values, start, root), *found
    if not loops:
        return chain(tree, root, {}), (), None
    optimum = optimise(tree, loops, start, root=root, threshold=threshold, inlier=inlier)
    chosen = selected(loops, optimum.inlier)
    if not chosen:  # dead reckoning fits a tree exactly
        return chain(tree, root, {}), optimum.inlier, None
    return optimum.poses, optimum.inlier, IncrementalSolver.of([*tree, *chosen], optimum.poses, root)


def _continued(
    before: tuple[Inlier, IncrementalSolver],
    tree: Sequence[Factor],
    loops: Sequence[Factor],
    start: Mapping[int, Array],
    threshold: float,
) -> tuple[Inlier, IncrementalSolver] | None:
    """Return which loops are inliers and the updated solver; None if a batch solution or eliminated frames are needed.

    If enough earlier loops agree, some of the new ones may be outliers: of the consistent selections, the one of least
    cost.
    """
    known, engine = before
    if not engine.reaches([*tree, *loops]):
        return None
    new = len(loops) - len(known)
    choices = [(True,) * new]
    if sum(known) >= max(QUORUM, 2 * known.count(False)) and new <= QUORUM:
        choices = sorted(itertools.product((True, False), repeat=new), key=lambda choice: choice.count(False))
    best: tuple[float, Inlier, IncrementalSolver] | None = None
    for choice in choices:
        inlier = (*known, *choice)
        found = engine.plus([*tree, *selected(loops, inlier)], start)
        if found is not None and found.agrees(loops, inlier, threshold):
            if all(choice):
                return inlier, found
            cost = found.error + threshold * inlier.count(False)
            if best is None or cost < best[0]:
                best = cost, inlier, found
    return None if best is None else best[1:]


def _whole(
    known: Inlier,
    tree: Sequence[Factor],
    loops: Sequence[Factor],
    start: Mapping[int, Array],
    *,
    root: int,
    threshold: float,
) -> tuple[Inlier, IncrementalSolver] | None:
    """Return which loops are inliers, all new ones too, and the solver of all; None if a batch solution is needed."""
    inlier = (*known, *[True] * (len(loops) - len(known)))
    found = IncrementalSolver.of([*tree, *selected(loops, inlier)], start, root)
    return (inlier, found) if found is not None and found.agrees(loops, inlier, threshold) else None
