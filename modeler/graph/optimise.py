"""The nonlinear solution: Levenberg and Marquardt, and graduated non-convexity where loops contradict each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from modeler.graph.factors import Factor
from modeler.types import Array

_PIN_SIGMA = 1e-6  # rad and m: far below any registration, so that it pins a pose without being seen
_ROUGH = 1e-4  # of the error, while annealing: what it chooses is then solved with care


@dataclass(frozen=True, eq=False)
class Optimum:
    """The poses that meet a set of factors best."""

    poses: Mapping[int, Array]
    """object_from_camera (4, 4) by frame number."""
    inlier: tuple[bool, ...]
    """Which loops take part."""
    error: float
    """Half the squared Mahalanobis distance of all factors to the poses; those left out count as the threshold."""


def optimise(
    tree: Sequence[Factor],
    loops: Sequence[Factor],
    start: Mapping[int, Array],
    *,
    root: int,
    threshold: float,
    inlier: Sequence[bool] = (),
) -> Optimum:
    """Return the optimum and which loops take part in it: those whose error stays below the threshold.

    Where some do not, the choice is made by graduated non-convexity with a truncated least-squares loss (Yang et al.,
    Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020), unless the choice given already stands: all that
    take part agree with the optimum, all that are left out contradict it.

    Args:
        tree: factors that are trusted.
        loops: factors that may be contradicted.
        start: object_from_camera (4, 4) by frame number.
        root: the frame whose pose is the identity.
        threshold: half the squared Mahalanobis distance beyond which a loop is left out.
        inlier: which loops took part in an earlier solution; those beyond it are taken to.
    """
    initial = values_of(start)
    taking_part = (*inlier, *[True] * (len(loops) - len(inlier)))
    chosen = joining(loops, taking_part)
    found = _least_squares(gtsam_graph_of([*tree, *chosen], root), initial)
    if agree(loops, found, threshold) != taking_part:
        gtsam_graph = gtsam_graph_of([*tree, *loops], root)
        trusted = 1 + len(tree)
        parameters = gtsam.GncLMParams(_parameters(_ROUGH))
        parameters.setLossType(gtsam.GncLossType.TLS)
        parameters.setKnownInliers(list(range(trusted)))
        annealing = gtsam.GncLMOptimizer(gtsam_graph, initial, parameters)
        annealing.setInlierCostThresholds(threshold)
        found = annealing.optimize()
        taking_part = tuple(bool(weight > 0.5) for weight in annealing.getWeights()[trusted:])
        chosen = joining(loops, taking_part)
        # At full weight, where annealing ended between.
        found = _least_squares(gtsam_graph_of([*tree, *chosen], root), found)
    error = gtsam_graph_of([*tree, *chosen], root).error(found) + threshold * taking_part.count(False)
    return Optimum(poses_of(found, start, root), taking_part, error)


def anchor(root: int) -> gtsam.PriorFactorPose3:
    """Return the factor that pins the root's pose at the identity."""
    return gtsam.PriorFactorPose3(root, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, _PIN_SIGMA))


def values_of(poses: Mapping[int, Array]) -> gtsam.Values:
    """Return object_from_camera (4, 4) by frame number as GTSAM takes it."""
    values = gtsam.Values()
    for frame, object_from_camera in poses.items():
        values.insert(frame, gtsam.Pose3(object_from_camera))
    return values


def poses_of(values: gtsam.Values, frames: Iterable[int], root: int) -> dict[int, Array]:
    """Return object_from_camera (4, 4) by frame number; the root's, pinned by `anchor`, is the identity."""
    rows = np.asarray(gtsam.utilities.extractPose3(values), dtype=np.float64)  # by key: rotation, translation
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    found = dict(zip(values.keys(), poses, strict=True))
    return {frame: found[frame] for frame in frames} | {root: np.eye(4)}


def agree(loops: Iterable[Factor], values: gtsam.Values, threshold: float) -> tuple[bool, ...]:
    """Return which loops stay below the threshold: where that is which take part, the choice stands."""
    return tuple(loop.between.error(values) <= threshold for loop in loops)


def joining(loops: Sequence[Factor], taking_part: Sequence[bool]) -> list[Factor]:
    """Return the loops that take part."""
    return [loop for loop, good in zip(loops, taking_part, strict=True) if good]


def gtsam_graph_of(factors: Iterable[Factor], root: int) -> gtsam.NonlinearFactorGraph:
    """Return a prior that pins the root at the identity, and factors."""
    gtsam_graph = gtsam.NonlinearFactorGraph()
    gtsam_graph.add(anchor(root))
    for factor in factors:
        gtsam_graph.push_back(factor.between)
    return gtsam_graph


def _least_squares(gtsam_graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    return gtsam.LevenbergMarquardtOptimizer(gtsam_graph, start, _parameters()).optimize()


def _parameters(tolerance: float = 1e-12) -> gtsam.LevenbergMarquardtParams:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")  # Cholesky gives up where one direction is 4096 times vaguer
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(tolerance)
    return parameters
