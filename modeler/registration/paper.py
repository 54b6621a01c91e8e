"""The method of Wüthrich et al. (ICRA 2012) as published: importance sampling from the prior."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from modeler import se3
from modeler.kernels import paper as kernel
from modeler.registration.free_space import Draws, FreeSpace, Measured
from modeler.registration.posterior import effective_samples, failed, intrinsics, pareto_tail, weighted_gaussian
from modeler.registration.visibility import VisibilityLikelihood
from modeler.se3 import matrices, rows
from modeler.types import AbstractPoseDensity, AbstractRegistrar, Array, Outcome, Posterior, RayImage

_SAMPLES, _EVEN_SAMPLES = 200_000, 2_000_000
_DRAWN = 1 << 22  # motions of an even spread at a time: one byte each
_PILOT = 4096  # motions that show which points forbid most


@dataclass(frozen=True)
class PaperRegistrar(AbstractRegistrar):
    """Samples of the prior, each weighted by p(P_B | M_A, T) · p(P_A | M_B, T); their mean and covariance.

    The sum of eq. pbd runs over object, background and missing pixels alike. With many points the weights collapse onto
    few samples, and on round objects the likelihood prefers poses that hide points; `visibility` mends both.
    """

    samples: int | None = None
    """Motions drawn from the prior; None = 2·10⁶ of an even spread, 2·10⁵ of another, which takes longer to draw."""
    batch: int = 50_000
    """Motions that the prior itself draws at a time; an even spread is drawn without it."""
    points: int = 60
    """Surface points taken from each view."""
    reach_sigmas: float = 4.0
    """Pixels farther from a point than so many lateral standard deviations are passed over (share e⁻⁸ of the sum)."""
    reject_below: float = 1e-6
    """A point whose density is below this share of that of a hidden point drops the sample at once."""
    min_effective: float = 10.0
    """With fewer effective samples the result is called degenerate."""

    def register(
        self, source: RayImage, target: RayImage, density: AbstractPoseDensity, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the posterior of target_from_source; failure is its outcome."""
        started = time.perf_counter()
        if min(len(source.points_m), len(target.points_m)) < 10:
            return failed(source, target, Outcome.TOO_FEW_POINTS, density, rng)
        views = measured(source, self.points, rng), measured(target, self.points, rng)
        kept_poses, kept_weights, drawn = [], [], 0
        for tried, passing in self._passing(views, density, rng):
            drawn += tried
            log_weights = self.log_weights(passing, views) + _known(density, passing)
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
            outcome=Outcome.CONVERGED if effective >= self.min_effective else Outcome.DEGENERATE,
            overlap=VisibilityLikelihood().between(source, target, rng).overlap(pose.mean),
            samples=poses,
            weights=weights / weights.sum(),
            effective_samples=effective,
            pareto_k=pareto_tail(log_weights),
            log_evidence=float(log_weights.max() + np.log(weights.sum() / drawn)),
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

    def _passing(
        self, views: tuple[Measured, Measured], density: AbstractPoseDensity, rng: np.random.Generator
    ) -> Iterator[tuple[int, Array]]:
        """Yield, batch by batch, how many motions were drawn and those (n, 12) that may have a likelihood."""
        free = FreeSpace.of(*views, self.reach_sigmas, self.reject_below)
        draws = Draws.of(density.even_spread(), rng)
        samples = self.samples or (_SAMPLES if draws is None else _EVEN_SAMPLES)
        if draws is None:
            for first in range(0, samples, self.batch):
                poses = rows(density.sample(min(self.batch, samples - first), rng))
                if first == 0:
                    free = free.ordered(poses[:_PILOT])
                yield len(poses), poses[free.passes(poses)]
        else:
            free = free.ordered(draws.poses(0, min(_PILOT, samples)))
            for first in range(0, samples, _DRAWN):
                count = min(_DRAWN, samples - first)
                yield count, free.passing(draws, first, count)


def _known(density: AbstractPoseDensity, poses: Array) -> Array | float:
    """Return what is known (n,) of poses (n, 12) beyond that they were drawn from the motion: 0 but for a guess."""
    if density.evidence:
        return 0.0
    drawn = matrices(poses)
    return density.log_evidence(drawn) - density.log_density(drawn)


def noise(view: RayImage) -> Array:
    """Return L (3, 3), the covariance of the view's sensor in ray coordinates (w, h, r)."""
    return np.diag([view.sigma_wh, view.sigma_wh, view.sigma_r_m]) ** 2


def ranges_m(view: RayImage) -> Array:
    """Return the range r (h, w) of every pixel in m, object and background alike; 0 = no measurement."""
    w, h = view.frame.camera.rays()
    return np.nan_to_num(view.frame.depth_m.astype(np.float64), nan=0.0) * np.sqrt(1.0 + w**2 + h**2)


def measured(view: RayImage, count: int, rng: np.random.Generator) -> Measured:
    """Return what the likelihood takes of a view, with up to `count` of its points."""
    return Measured(measured_points(view, count, rng), ranges_m(view), intrinsics(view), noise(view))


def measured_points(view: RayImage, count: int, rng: np.random.Generator) -> Array:
    """Return up to `count` object points (n, 3) in m as measured, drawn evenly."""
    camera = view.frame.camera
    w, h = camera.rays()
    picked = np.sort(rng.choice(len(view.pixels), min(count, len(view.pixels)), replace=False))
    row, column = view.pixels[picked].T
    z = view.frame.depth_m[row, column].astype(np.float64)
    points = np.stack([w[row, column] * z, h[row, column] * z, z], axis=1)
    return points[rng.permutation(len(points))]  # so that early rejection meets points from everywhere first
