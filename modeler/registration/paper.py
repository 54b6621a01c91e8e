"""The method of Wüthrich et al. (ICRA 2012) as published: importance sampling from the prior."""

import time
from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.kernels import paper as kernel
from modeler.registration.annealing import effective_samples, pareto_tail
from modeler.registration.posterior import failed, intrinsics, rows, weighted_gaussian
from modeler.types import AbstractMotion, AbstractRegistrar, Array, Outcome, Posterior, RayImage


@dataclass(frozen=True)
class PaperRegistrar(AbstractRegistrar):
    """Samples of the prior, each weighted by p(P_B | M_A, T) · p(P_A | M_B, T); their mean and covariance.

    The sum of eq. pbd runs over object, background and missing pixels alike. With many points the weights collapse onto
    few samples, and on round objects the likelihood prefers poses that hide points; `visibility` mends both.
    """

    samples: int = 200_000
    """Motions drawn from the prior."""
    batch: int = 50_000
    """Motions drawn and weighted at a time."""
    points: int = 60
    """Surface points taken from each view."""
    reach_sigmas: float = 4.0
    """Pixels farther from a point than so many lateral standard deviations are passed over (share e⁻⁸ of the sum)."""
    reject_below: float = 1e-6
    """A point whose density is below this share of that of a hidden point drops the sample at once."""
    min_effective: float = 10.0
    """With fewer effective samples the result is called degenerate."""

    def register(
        self, source: RayImage, target: RayImage, motion: AbstractMotion, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the posterior of target_from_source; failure is its outcome."""
        started = time.perf_counter()
        if min(len(source.points_m), len(target.points_m)) < 10:
            return failed(source, target, Outcome.TOO_FEW_POINTS)
        thinned = measured_points(source, self.points, rng), measured_points(target, self.points, rng)
        ranges = ranges_m(source), ranges_m(target)
        kept_poses, kept_weights, drawn = [], [], 0
        while drawn < self.samples:
            poses = motion.sample(min(self.batch, self.samples - drawn), rng)
            drawn += len(poses)
            log_weights = self.log_weights(poses, (source, target), points=thinned, ranges=ranges)
            alive = np.isfinite(log_weights)
            kept_poses.append(poses[alive])
            kept_weights.append(log_weights[alive])
        poses, log_weights = np.concatenate(kept_poses), np.concatenate(kept_weights)
        if len(poses) == 0:
            return failed(source, target, Outcome.NO_OVERLAP)
        weights = np.exp(log_weights - log_weights.max())
        effective = effective_samples(log_weights)
        return Posterior(
            source=source.index,
            target=target.index,
            pose=weighted_gaussian(poses, weights, source.centroid_m),
            outcome=Outcome.CONVERGED if effective >= self.min_effective else Outcome.DEGENERATE,
            overlap=1.0,  # free space is all that the likelihood tests; nothing says which surface both views share
            samples=poses,
            weights=weights / weights.sum(),
            effective_samples=effective,
            pareto_k=pareto_tail(log_weights),
            log_evidence=float(log_weights.max() + np.log(weights.sum() / drawn)),
            seconds=time.perf_counter() - started,
        )

    def log_weights(
        self,
        target_from_source: Array,
        views: tuple[RayImage, RayImage],
        *,
        points: tuple[Array, Array],
        ranges: tuple[Array, Array],
    ) -> Array:
        """Return log w_l (n,), up to a constant, of motions; -inf = rejected.

        Args:
            target_from_source: (n, 4, 4).
            views: source and target.
            points: their surface points (n, 3) in m.
            ranges: their range images (h, w) in m.
        """
        options = np.array([self.reach_sigmas, self.reject_below])
        source, target = views
        forward = kernel.log_likelihoods(
            rows(target_from_source), points[0], ranges[1], intrinsics(target), noise(target), options
        )
        alive = np.isfinite(forward)
        if alive.any():
            backward = rows(se3.inverse(target_from_source[alive]))
            forward[alive] += kernel.log_likelihoods(
                backward, points[1], ranges[0], intrinsics(source), noise(source), options
            )
        return forward


def noise(view: RayImage) -> Array:
    """Return L (3, 3), the covariance of the view's sensor in ray coordinates (w, h, r)."""
    return np.diag([view.sigma_wh, view.sigma_wh, view.sigma_r_m]) ** 2


def ranges_m(view: RayImage) -> Array:
    """Return the range r (h, w) of every pixel in m, object and background alike; 0 = no measurement."""
    w, h = view.frame.camera.rays()
    return np.nan_to_num(view.frame.depth_m.astype(np.float64), nan=0.0) * np.sqrt(1.0 + w**2 + h**2)


def measured_points(view: RayImage, count: int, rng: np.random.Generator) -> Array:
    """Return up to `count` object points (n, 3) in m as measured, drawn evenly."""
    camera = view.frame.camera
    w, h = camera.rays()
    picked = np.sort(rng.choice(len(view.pixels), min(count, len(view.pixels)), replace=False))
    row, column = view.pixels[picked].T
    z = view.frame.depth_m[row, column].astype(np.float64)
    points = np.stack([w[row, column] * z, h[row, column] * z, z], axis=1)
    return points[rng.permutation(len(points))]  # so that early rejection meets points from everywhere first
