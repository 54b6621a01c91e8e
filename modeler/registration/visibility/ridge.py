"""Likelihood along ridges, without what is chance (method, eq. 5.5)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modeler import se3
from modeler.kernels import scores
from modeler.registration.visibility.likelihood import PairLikelihood
from modeler.registration.visibility.refinement import Refiner
from modeler.registration.visibility.sampling import LogLikelihood
from modeler.se3 import rows
from modeler.types import Array

_MIN_POSES = 5  # a correlation of fewer says little
_WIDTH = 0.5  # sd of the smoothing kernel in basins: candidates on a ridge are about as far apart


@dataclass(frozen=True, eq=False)
class RidgeLikelihood:
    """A tempered log-likelihood without the part of its differences along a ridge that is chance.

    Where surface looks the same under all poses of a ridge, such as the spins of a can, noise prefers some of them.
    Real differences appear in both halves of the points, chance in one.
    """

    likelihood: LogLikelihood
    """Of poses (n, 4, 4) under focal lengths, tempered."""
    poses: Array
    """(k, 4, 4) target_from_source, on the ridge."""
    chance_nats: Array
    """(k,) what is to be subtracted there."""
    centre_m: Array
    """(3,) point of the source about which tangents are taken."""
    width: Array
    """(6,) sd of the kernel that smooths between poses: rotation in rad, translation in m."""

    def __call__(self, target_from_source: Array, log_focal: Array) -> Array:
        """Return the log-likelihoods (n,) of poses (n, 4, 4) under logarithms (n,) of focal lengths."""
        offsets = se3.difference(target_from_source[:, None], self.poses[None], self.centre_m) / self.width
        squares = np.sum(offsets**2, axis=2)
        weights = np.exp(-0.5 * (squares - squares.min(axis=1, keepdims=True)))
        return self.likelihood(target_from_source, log_focal) - weights @ self.chance_nats / weights.sum(axis=1)


def without_chance(
    pair: PairLikelihood,
    poses: Array,
    likelihood: LogLikelihood,
    *,
    blur_m: float,
    typical_misfit: float,
    basin: Array,
) -> LogLikelihood:
    """Return a log-likelihood without chance along a ridge; unchanged with too few poses.

    Args:
        pair: the two views.
        poses: (k, 4, 4) target_from_source, separate optima that form a mode.
        likelihood: of the pair, tempered.
        blur_m: blur of the surfaces in m.
        typical_misfit: misfit μ of a typical match (nats).
        basin: (6,) extent of a basin in rad and m.
    """
    if len(poses) < _MIN_POSES:
        return likelihood
    share = reliability(by_halves(pair, poses, blur_m, typical_misfit=typical_misfit))
    surface = replace(pair, colour=None).tempered(poses, blur_m, typical_misfit=typical_misfit)
    mean = np.logaddexp.reduce(surface) - np.log(len(surface))  # so that the evidence of the mode stays
    return RidgeLikelihood(likelihood, poses, (1.0 - share) * (surface - mean), pair.centre_m, _WIDTH * basin)


def by_halves(pair: PairLikelihood, poses: Array, blur_m: float, *, typical_misfit: float) -> Array:
    """Return log-likelihoods L (2, 2, n) of surface: of the points of either view, of either half of them.

    Halves alternate in as many blocks as refinement has patches, which share little noise. Not tempered.

    Args:
        pair: the two views.
        poses: (n, 4, 4) target_from_source.
        blur_m: blur of the surfaces in m.
        typical_misfit: misfit μ of a typical match (nats).
    """
    whole = pair.surfaces(1)
    parameters = [side.parameters(blur_m, typical_misfit) for side in (pair.forward, pair.backward)]
    found = np.empty((2, 2, len(poses)))
    for side, half in np.ndindex(2, 2):
        chosen = [np.arange(0)] * 2  # of the other view, no point
        count = whole[side].points.shape[1]
        chosen[side] = np.flatnonzero(np.arange(count) * Refiner.patches // count % 2 == half)
        parts = [
            view._replace(points=np.ascontiguousarray(view.points[:, some]))
            for view, some in zip(whole, chosen, strict=True)
        ]
        found[side, half] = scores.scores(rows(poses), *parts, *parameters)[:, scores.LOG_LIKELIHOOD]
    return found


def reliability(halves: Array) -> float:
    """Return the share of the variance of sums that is no chance, from sums (m, 2, n) over halves (eq. 5.5).

    With r the correlation of the halves, that of their sum with another such sum is 2 r / (1 + r) (Spearman 1910; Brown
    1910).

    Args:
        halves: m kinds of sums, each over either half, under n poses.
    """
    apart = halves - halves.mean(axis=2, keepdims=True)
    correlation = 2.0 * np.sum(apart[:, 0] * apart[:, 1]) / max(np.sum(apart**2), 1e-300)
    return float(2.0 * max(correlation, 0.0) / (1.0 + max(correlation, 0.0)))
