"""Posteriors of registrations: statistics of samples, the focal length as a nuisance, errors alike, and failures."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from modeler import se3
from modeler.se3 import rows
from modeler.types import AbstractPoseDensity, Array, Outcome, PoseGaussian, Posterior, RayImage

FLOOR = np.diag(np.repeat([1e-6, 1e-7], 3) ** 2)
"""Added to sample covariances (6, 6) of ξ (rad, m), so that they are positive definite: a thousandth of a
registration's."""
NEGLIGIBLE_VARIANCE = 1e-4
"""Relative to what is expected: a hundredth of a standard deviation, as of images without noise."""
MIN_MODE_SHARE = 0.005
"""Modes of less posterior probability are negligible: three that are left out hold 1.5 %."""
PRIOR_SAMPLES = 500
"""Samples of a prior, for its mean and covariance: a standard deviation is then known to 3 %."""


def weighted_gaussian(poses: Array, weights: Array, centre_m: Array) -> PoseGaussian:
    """Return the mean and covariance of weighted poses (paper, E[f(T)] ≈ Σ w_l f(T_l)).

    The mean is taken about the object's centre: about the camera, rotation and translation would be strongly coupled,
    and the mean of a wide posterior would leave the object.

    Args:
        poses: (n, 4, 4) target_from_source.
        weights: (n,), any positive sum.
        centre_m: (3,) point of the source.
    """
    mean, covariance = se3.mean(poses, weights, about_m=centre_m)
    return PoseGaussian(mean, se3.covariance_about(covariance + FLOOR, -centre_m))  # from the centre to the camera


def normalised(log_weights: Array) -> Array:
    """Return weights (n,) that sum to 1; uniform ones if all are 0."""
    top = np.max(log_weights)
    weights = np.exp(log_weights - top) if np.isfinite(top) else np.ones(len(log_weights))
    return weights / np.sum(weights)


def effective_samples(log_weights: Array) -> float:
    """Return Kish's effective sample size of unnormalised log weights (n,)."""
    return 1.0 / float(np.sum(normalised(log_weights) ** 2))


def pareto_tail(log_weights: Array) -> float:
    """Return the Pareto tail index of importance weights (Zhang and Stephens 2009; Vehtari et al. 2024)."""
    count = len(log_weights)
    tail = int(min(0.2 * count, 3.0 * np.sqrt(count)))
    if tail < 5 or not np.isfinite(np.max(log_weights)):
        return float("nan")
    ordered = np.sort(log_weights - np.max(log_weights))
    excess = np.exp(ordered[-tail:]) - np.exp(ordered[-tail - 1])
    if excess[-1] <= 0.0 or excess[0] <= 0.0:
        return -np.inf  # equal weights have no tail
    grid = 30 + int(np.sqrt(tail))
    quartile = excess[int(tail / 4 + 0.5) - 1]
    theta = 1.0 / excess[-1] + (1.0 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))) / (3.0 * quartile)
    shape = np.mean(np.log1p(-theta[:, None] * excess), axis=1)
    weights = normalised(tail * (np.log(-theta / shape) - shape - 1.0))
    k = float(np.mean(np.log1p(-np.sum(weights * theta) * excess)))
    return (tail * k + 10.0 * 0.5) / (tail + 10.0)


def share_at_limit(
    density: AbstractPoseDensity, poses: Array, weights: Array, centre_m: Array, rng: np.random.Generator
) -> float:
    """Return the fraction of weighted poses (n, 4, 4) that leave the support by a random step of about 1° and 1 mm.

    A posterior at the limit of its prior is truncated. Rotations of the steps are about `centre_m` (3,), a point of the
    source.
    """
    perturbations = rng.normal(size=(len(poses), 6)) * np.repeat([np.radians(1.0), 0.001], 3)
    perturbed = se3.moved(poses, perturbations, centre_m)
    return float(weights @ ~np.isfinite(density.log_density(perturbed)))


def failed(
    source: RayImage,
    target: RayImage,
    outcome: Outcome,
    density: AbstractPoseDensity | None = None,
    rng: np.random.Generator | None = None,
) -> Posterior:
    """Return the posterior of a failed registration: the prior, or an uninformative Gaussian.

    Args:
        source: first view.
        target: second view.
        outcome: why it failed.
        density: the prior, whose mean and covariance are returned; without it the standard deviations are π and 10 m.
        rng: source of all randomness, with a density.
    """
    if density is None or rng is None:
        pose = PoseGaussian(np.eye(4), np.diag(np.repeat([np.pi, 10.0], 3) ** 2))
    else:
        pose = weighted_gaussian(density.sample(PRIOR_SAMPLES, rng), np.ones(PRIOR_SAMPLES), source.centroid_m)
    return Posterior(source=source.index, target=target.index, pose=pose, outcome=outcome, overlap=0.0, seconds=0.0)


def intrinsics(view: RayImage) -> Array:
    """Return fx, fy, cx, cy (4,) in px of a view's camera."""
    camera = view.frame.camera
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


_OPEN = 1e-3  # of the best determined direction's information: surface says nothing of less
_DIFFERS: Final = 0.08**2
"""Share of the variance of smooth errors of depth that moves one view against another.

The rest is alike in both, as light comes from the same surroundings. Measured on rendered time of flight (tuning half):
with it NEES/6 is 0.8, and 95 % regions hold 91 %.
"""


def displacement(arms_m: Array, normals: Array, size_m: float) -> Array:
    """Return the covariance (6, 6) of ξ of least squares of point-to-plane distances with a common sd of 1 m.

    The rows are a = (p × n, n), and the covariance is (Σ a aᵀ / N)⁻¹, without directions that surface leaves open.

    Args:
        arms_m: (n, 3) points p, relative to the origin of ξ; at least one.
        normals: (n, 3).
        size_m: of the surface: a length by which rotations are compared with shifts.
    """
    scale = np.repeat([1.0 / size_m, 1.0], 3)
    rows = np.concatenate([np.cross(arms_m, normals), normals], axis=1) * scale
    values, axes = np.linalg.eigh(rows.T @ rows / len(rows))
    spread = np.where(values > _OPEN * values[-1], 1.0 / np.maximum(values, 1e-12), 0.0)
    return np.asarray((axes * spread) @ axes.T * np.outer(scale, scale), dtype=np.float64)


def of_multipath(view: RayImage) -> Array:
    """Return the covariance (6, 6) of ξ in target_from_source · Exp(ξ) due to smooth errors of depth of both views.

    Args:
        view: the source.
    """
    if view.sigma_multipath == 0.0 or not len(view.points_m):
        return np.zeros((6, 6))
    about = _DIFFERS * view.multipath_m**2 * displacement(view.points_m - view.centroid_m, view.normals, view.size_m)
    return se3.covariance_about(about, -view.centroid_m)


class FocalNuisance(NamedTuple):
    """What is known of the focal length, and how poses depend on it."""

    sigma: float = 0.0
    """Standard deviation of the logarithm of the true focal length over that of the views; 0 = it is known."""
    by_focal: Array = np.zeros(6)
    """(6,) derivative of a pose's ξ by that logarithm."""

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Draw logarithms (count,) of focal lengths."""
        return rng.normal(0.0, self.sigma, count) if self.sigma > 0.0 else np.zeros(count)

    def under(self, poses: Array, log_focal: Array) -> Array:
        """Return poses (n, 4, 4) under other focal lengths, given as logarithms (n,) of their factors."""
        return poses @ se3.exp(log_focal[:, None] * self.by_focal) if log_focal.any() else poses


KNOWN: Final = FocalNuisance()
"""A focal length that is known."""


def rows_under(poses: Array, log_focal: Array | None) -> Array:
    """Return the rows (n, 12) of poses (n, 4, 4) for kernels; under logarithms (n,) of focal lengths (n, 13)."""
    if log_focal is None or not log_focal.any():
        return rows(poses)
    return np.column_stack([rows(poses), np.exp(log_focal)])
