"""The method of Wüthrich et al. (ICRA 2012) as published: importance sampling from the prior.

Most poses move some point in front of a surface that the other camera measured. A test of a few nanoseconds
(`FreeSpace`) rejects them before the likelihood is evaluated.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from modeler import se3
from modeler.kernels import gpu
from modeler.kernels import paper as kernel
from modeler.priors.general import GeneralDensity
from modeler.registration.posterior import effective_samples, failed, intrinsics, pareto_tail, weighted_gaussian
from modeler.registration.visibility import VisibilityLikelihood
from modeler.se3 import matrices, rows
from modeler.types import (
    AbstractPoseDensity,
    AbstractRegistrar,
    Array,
    BoolArray,
    Outcome,
    Posterior,
    RayImage,
    ViewPair,
)

_SAMPLES, _UNIFORM_SAMPLES = 200_000, 2_000_000  # from a prior, and from everywhere
_BATCH = 50_000  # samples drawn at a time
_ANGLE_LIMIT_RAD = 2.0  # up to which rejection sampling of the rotation mostly succeeds


@dataclass(frozen=True)
class PaperRegistrar(AbstractRegistrar):
    """Samples of the prior, each weighted by p(P_B | M_A, T) · p(P_A | M_B, T); their mean and covariance.

    The sum of eq. pbd runs over object, background and missing pixels alike. With many points the weights collapse onto
    few samples, and for round objects the likelihood prefers poses that hide points. The `visibility` method has
    neither problem.
    """

    samples: int | None = None
    """Number of samples of the prior; None = 2·10⁶ of a uniform prior, 2·10⁵ of others, which take longer."""
    points: int = 60
    """Number of surface points of each view; with more, the weights collapse onto fewer samples."""
    reach_sigmas: float = 4.0
    """Lateral standard deviations beyond which pixels are ignored; at 4, their part of the sum is e⁻⁸."""
    reject_below: float = 1e-6
    """A sample is rejected if a point's density is below this fraction of that of a hidden point, as its weight is
    negligible."""
    device: gpu.Device = "auto"
    """Device that draws, tests and weights samples."""

    def posterior_of(self, pair: ViewPair) -> Posterior:
        started = time.perf_counter()
        source, target, density, rng = pair.source, pair.target, pair.density, pair.rng
        if min(len(source.points_m), len(target.points_m)) < 10:
            return failed(source, target, Outcome.TOO_FEW_POINTS, density, rng)
        views = measured(source, self.points, rng), measured(target, self.points, rng)
        kept_poses, kept_weights, drawn = [], [], 0
        for tried, passing, log_likelihoods in self._weighted(views, density, rng):
            drawn += tried
            log_weights = log_likelihoods + _log_correction(density, passing)
            alive = np.isfinite(log_weights)
            kept_poses.append(matrices(passing[alive]))
            kept_weights.append(log_weights[alive])
        poses, log_weights = np.concatenate(kept_poses), np.concatenate(kept_weights)
        if len(poses) == 0:
            nothing = failed(source, target, Outcome.NO_OVERLAP, density, rng)
            return replace(nothing, seconds=time.perf_counter() - started)
        weights = np.exp(log_weights - log_weights.max())
        effective = effective_samples(log_weights)
        pose = weighted_gaussian(poses, weights, source.centroid_m)
        return Posterior(
            source=source.index,
            target=target.index,
            pose=pose,
            outcome=Outcome.CONVERGED if effective >= 10.0 else Outcome.DEGENERATE,
            overlap=VisibilityLikelihood().between(source, target, rng).overlap(pose.mean),
            samples=poses,
            weights=weights / weights.sum(),
            effective_samples=effective,
            pareto_k=pareto_tail(log_weights),
            log_marginal_likelihood=float(log_weights.max() + np.log(weights.sum() / drawn)),
            seconds=time.perf_counter() - started,
        )

    def log_weights(self, poses: Array, views: tuple[Measured, Measured]) -> Array:
        """Return log w_l (n,), up to a constant, of poses (n, 12) between source and target; -inf = rejected."""
        options = np.array([self.reach_sigmas, self.reject_below])
        source, target = views
        total = kernel.log_likelihoods(
            poses, source.points_m, target.ranges_m, target.intrinsics, target.noise, options
        )
        alive = np.isfinite(total)
        if alive.any():
            backward = rows(se3.inverse(matrices(poses[alive])))
            total[alive] += kernel.log_likelihoods(
                backward, target.points_m, source.ranges_m, source.intrinsics, source.noise, options
            )
        return total

    def _weighted(
        self, views: tuple[Measured, Measured], density: AbstractPoseDensity, rng: np.random.Generator
    ) -> Iterator[tuple[int, Array, Array]]:
        """Yield the number of samples drawn, those (n, 12) that pass the free-space test, and their log w (n,)."""
        draws = NumberedDraws.of(density, rng)
        samples = self.samples or (_SAMPLES if draws is None else _UNIFORM_SAMPLES)
        device = gpu.chosen(self.device, samples * sum(len(view.points_m) for view in views))
        free = FreeSpace.of(*views, self.reach_sigmas, self.reject_below, device=device)
        batches = self._drawn(density if draws is None else draws, samples, rng)
        first = next(batches)
        free = free.ordered(first[:4096])
        if device is None:
            for poses in chain([first], batches):
                passing = poses[free.passes(poses)]
                yield len(poses), passing, self.log_weights(passing, views)
            return
        from modeler.kernels.gpu.paper import OnDevice

        seen = [(view.points_m, view.ranges_m, view.intrinsics, view.noise) for view in views]
        tests = free.checks, free.near_m, free.images
        there = OnDevice.of(device, seen, tests, (self.reach_sigmas, self.reject_below))
        if draws is not None:
            yield from there.weighted_draws(samples, draws.seed, draws.limits)
            return
        for poses in chain([first], batches):
            yield len(poses), *there.weighted(poses)

    def _drawn(
        self, density: AbstractPoseDensity | NumberedDraws, samples: int, rng: np.random.Generator
    ) -> Iterator[Array]:
        """Yield samples (n, 12), batch by batch."""
        for first in range(0, samples, _BATCH):
            count = min(_BATCH, samples - first)
            numbered = isinstance(density, NumberedDraws)
            yield density.poses(first, count) if numbered else rows(density.sample(count, rng))


def _log_correction(density: AbstractPoseDensity, poses: Array) -> Array | float:
    """Return log prior minus log density (n,) at poses (n, 12) drawn from a density: 0 unless it is a proposal."""
    if density.evidence:
        return 0.0
    drawn = matrices(poses)
    return density.log_prior(drawn) - density.log_density(drawn)


def noise(view: RayImage) -> Array:
    """Return L (3, 3), the covariance of the view's sensor in ray coordinates (w, h, r)."""
    return np.diag([view.sigma_wh, view.sigma_wh, view.sigma_r_m]) ** 2


def ranges_m(view: RayImage) -> Array:
    """Return the range r (h, w) of every pixel in m, object and background alike; 0 = no measurement."""
    w, h = view.frame.camera.rays()
    return np.nan_to_num(view.frame.depth_m.astype(np.float64), nan=0.0) * np.sqrt(1.0 + w**2 + h**2)


def measured(view: RayImage, count: int, rng: np.random.Generator) -> Measured:
    """Return the inputs of the likelihood from a view, with up to `count` of its points."""
    return Measured(measured_points(view, count, rng), ranges_m(view), intrinsics(view), noise(view))


def measured_points(view: RayImage, count: int, rng: np.random.Generator) -> Array:
    """Return up to `count` measured object points (n, 3) in m, drawn uniformly without replacement."""
    camera = view.frame.camera
    w, h = camera.rays()
    picked = np.sort(rng.choice(len(view.pixels), min(count, len(view.pixels)), replace=False))
    row, column = view.pixels[picked].T
    z = view.frame.depth_m[row, column].astype(np.float64)
    points = np.stack([w[row, column] * z, h[row, column] * z, z], axis=1)
    return points[rng.permutation(len(points))]  # so that the points tested first are spread over the object


@dataclass(frozen=True, eq=False)
class Measured:
    """Inputs of the paper's likelihood from one view."""

    points_m: Array
    """(n, 3) surface points."""
    ranges_m: Array
    """(h, w) range of every pixel, 0 = no measurement."""
    intrinsics: Array
    """(4,) fx, fy, cx, cy in px."""
    noise: Array
    """(3, 3) L, the covariance of the sensor in ray coordinates (w, h, r)."""


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """A test that a pose fails only if it gives some point a density below `reject_below` under eq. pbd.

    For a point b transformed to b_A, let Σ = L + J L Jᵀ be the covariance of b_A - a_i in ray coordinates, with J = Q_A
    R Q_B⁻¹. D of eq. pbd is the inverse of Σ's lateral part, so that pixels within reach lie within reach ·
    √λ_max(Σ_wh); and if a_i lies d > 0 behind b_A, its term is at most 2 exp(-½ d² / Σ_rr). Both entries of Σ are
    bounded over rotations by the largest eigenvalue of Q_B⁻¹ L Q_B⁻ᵀ. So a point far enough in front of the nearest
    pixel within the widest reach has a sum below the threshold, whatever D and v are.
    """

    checks: Array
    """(n, 5), see `kernels.paper`."""
    near_m: tuple[np.ndarray, np.ndarray]
    """`nearest_ranges` of target and source."""
    images: tuple[Array, Array]
    """Their images, see `kernels.paper.forbidden`."""

    @staticmethod
    def of(
        source: Measured, target: Measured, reach_sigmas: float, reject_below: float, *, device: str | None = None
    ) -> FreeSpace:
        """Return the test for two views; with an infinite reach or no threshold, every pose passes.

        Nearest ranges are computed on a Warp device, or by the Numba kernels.
        """
        limits = reach_sigmas, reject_below
        sides = _side(source, target, limits, device), _side(target, source, limits, device)
        checks = np.concatenate([np.insert(side[0], kernel.BACKWARD, k, axis=1) for k, side in enumerate(sides)])
        return FreeSpace(checks, (sides[0][1], sides[1][1]), (sides[0][2], sides[1][2]))

    def ordered(self, poses: Array) -> FreeSpace:
        """Return the test with its checks ordered greedily by how many of the remaining poses (m, 12) they reject."""
        forbidden = kernel.verdicts(poses, self.checks, self.near_m, self.images)
        order: list[int] = []
        left = forbidden
        while len(left) and left.any():
            order.append(int(left.sum(axis=0).argmax()))
            left = left[~left[:, order[-1]]]
        rest = np.setdiff1d(np.argsort(-forbidden.sum(axis=0), kind="stable"), order, assume_unique=True)
        return replace(self, checks=np.ascontiguousarray(self.checks[np.concatenate([order, rest]).astype(int)]))

    def passes(self, poses: Array) -> BoolArray:
        """Return whether poses (m, 12) pass, (m,)."""
        return kernel.passing(poses, self.checks, self.near_m, self.images)


@dataclass(frozen=True, eq=False)
class NumberedDraws:
    """Samples of a uniform density, each a pure function of its number and the seed, so that none is stored."""

    seed: np.uint64
    limits: Array
    """(17,), see `kernels.paper.draw`."""

    @staticmethod
    def of(density: AbstractPoseDensity, rng: np.random.Generator) -> NumberedDraws | None:
        """Return the draws of a uniform density; None for others, or if its limits make rejection sampling slow."""
        if not isinstance(density, GeneralDensity) or not 0.0 <= density.max_rotation_rad <= _ANGLE_LIMIT_RAD:
            return None
        ends = np.sin(0.5 * density.max_rotation_rad), density.max_offset_m
        limits = np.concatenate([ends, density.source_centroid_m, density.target_centroid_m, density.middle.ravel()])
        return NumberedDraws(rng.integers(2**64, dtype=np.uint64), limits)

    def poses(self, first: int, count: int) -> Array:
        """Return the poses (count, 12) numbered from `first`."""
        return kernel.drawn(np.arange(first, first + count), self.seed, self.limits)


def _side(
    own: Measured, other: Measured, limits: tuple[float, float], device: str | None
) -> tuple[Array, np.ndarray, Array]:
    """Return checks (n, 4) of one view's points against the other, and the other's nearest ranges and image."""
    reach_sigmas, reject_below = limits
    fx, fy, cx, cy = other.intrinsics
    noise = other.noise
    inverses = np.stack([kernel.ray_jacobian_inverse(point) for point in own.points_m])
    spread_m2 = np.linalg.eigvalsh(inverses @ noise @ inverses.transpose(0, 2, 1))[:, -1]
    widening = 1.5 * max(  # the largest spread of a point's rays, of the nearest's
        np.max(np.sum(view.points_m**2, axis=1) / view.points_m[:, 2] ** 4) for view in (own, other)
    )
    lateral = np.linalg.eigvalsh(noise[:2, :2])[-1]
    reach_px = reach_sigmas * np.sqrt(lateral + spread_m2.max() * widening) * np.array([fx, fy]) + 1e-6
    if not (reject_below > 0.0 and np.all(reach_px < max(other.ranges_m.shape))):
        return np.zeros((0, 4)), np.zeros((1, 1), dtype=np.float32), np.zeros(7)
    near_m = _nearest_ranges(other.ranges_m, reach_px, device)
    across, down = (
        (near - full) // 2 for near, full in zip(near_m.shape[::-1], other.ranges_m.shape[::-1], strict=True)
    )
    # K2 is at most √8 times its value for an unrotated point, and there are no more terms than pixels in the window.
    terms = 2.0 * np.sqrt(8.0) * (2 * across + 1) * (2 * down + 1)
    sigmas = np.sqrt(2.0 * np.log(max(terms / reject_below, 1.0))) + 1e-6
    margins_m = sigmas * np.sqrt(noise[2, 2] + spread_m2)
    height, width = near_m.shape
    image = np.array([fx, fy, cx + across, cy + down, width, height, widening])
    return np.column_stack([own.points_m, margins_m]), near_m, image


def _nearest_ranges(ranges_m: Array, reach_px: Array, device: str | None) -> np.ndarray:
    if device is None:
        return kernel.nearest_ranges(ranges_m, reach_px)
    from modeler.kernels.gpu.paper import nearest_ranges

    return nearest_ranges(ranges_m, reach_px, device)
