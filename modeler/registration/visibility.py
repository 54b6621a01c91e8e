"""Registration by what each view should see of the other's surface; the default method."""

import time
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from modeler import se3
from modeler.kernels import visibility as kernel
from modeler.registration.annealing import AnnealedSampler, LogLikelihood, Population
from modeler.registration.posterior import failed, intrinsics, rows, share_at_limit, weighted_gaussian
from modeler.registration.surface import measured_share, relief_m, spread_points
from modeler.types import AbstractMotion, AbstractRegistrar, Array, Outcome, PoseGaussian, Posterior, RayImage


@dataclass(frozen=True)
class VisibilityRegistrar(AbstractRegistrar):
    """The paper's likelihood with normals: surface that faces a camera is seen by it, other surface is hidden.

    p(surface of B | image A, T) · p(surface of A | image B, T), each a product over points, tempered because
    neighbouring points err alike, and sampled by annealing from a blurred likelihood to the sharp one.
    """

    points: int = 300
    """Surface points taken from each view."""
    effective_points: float = 40.0
    """Number of independent measurements that the points of both views together are worth."""
    blurs_m: tuple[float, ...] = (0.016, 0.008, 0.004, 0.002, 0.001, 0.0)
    """Blur of the surfaces at each level of the annealing; at the last, the noise of the surfaces is inferred."""
    surface_noise: float = 0.1
    """Least error that smoothing leaves in a surface, common to neighbours, as a share of the sensor's range noise."""
    surface_detail: float = 0.003
    """Least error of local planes on a curved surface, as a share of the object's size."""
    hidden_share: float = 0.3
    """Share of points that face the other camera and are hidden by another part of the object."""
    max_gain: float = 1.5
    """Most that the match of one point may gain for the relief of the surface around it (nats)."""
    relief_reaches: tuple[float, ...] = (0.1, 0.2)
    """Radii of the surroundings that a point's height is predicted from, as shares of the object's size."""
    relief_noise: float = 0.5
    """Noise of the surfaces that relief stands out from, as a share of the sensor's range noise."""
    worst: float = 10.0
    """Most that one point may cost (nats)."""
    bend: float = 2.0
    """Cost (nats) of normals at right angles."""
    sampler: AnnealedSampler = field(default_factory=AnnealedSampler)
    """How the posterior is explored."""
    min_points: int = 60
    """Fewer surface points than this in a view are not registered."""
    min_overlap: float = 0.35
    """Least share of the surface that both should see and do."""
    max_at_limit: float = 0.2
    """With a larger share of the samples at the end of the prior, the motion may lie beyond it."""
    min_effective: float = 100.0
    """With fewer effective samples the result is called degenerate."""
    max_sigma_deg: float = 10.0
    """Rotation less sure than this is called ambiguous."""

    def register(
        self, source: RayImage, target: RayImage, motion: AbstractMotion, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the posterior of target_from_source; failure is its outcome."""
        started = time.perf_counter()
        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return failed(source, target, Outcome.TOO_FEW_POINTS)
        pair = Pair(self, source, target, seed=int(rng.integers(2**32)))
        levels = [partial(pair.level, blur_m) for blur_m in self.blurs_m[:-1]] + [pair.last_level]
        population = self.sampler.run(motion, levels, source.centroid_m, rng)
        weights = np.full(len(population.poses), 1.0 / len(population.poses))
        pose = weighted_gaussian(population.poses, weights, source.centroid_m)
        overlap = pair.overlap(pose.mean)
        at_limit = share_at_limit(motion, population.poses, source.centroid_m, rng)
        return Posterior(
            source=source.index,
            target=target.index,
            pose=pose,
            outcome=self._outcome(population, pose, overlap, at_limit=at_limit),
            overlap=overlap,
            samples=population.poses,
            weights=weights,
            effective_samples=population.effective_samples,
            pareto_k=population.pareto_k,
            log_evidence=population.log_evidence,
            seconds=time.perf_counter() - started,
        )

    def _outcome(self, population: Population, pose: PoseGaussian, overlap: float, *, at_limit: float) -> Outcome:
        if at_limit > self.max_at_limit:
            return Outcome.AT_LIMIT
        if overlap < self.min_overlap:
            return Outcome.NO_OVERLAP
        if population.effective_samples < self.min_effective:
            return Outcome.DEGENERATE
        sigma_rad = np.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3])[-1])
        return Outcome.AMBIGUOUS if sigma_rad > np.deg2rad(self.max_sigma_deg) else Outcome.CONVERGED


class Pair:
    """Two views with the points drawn that a registration compares; gives the log-likelihood at any blur."""

    def __init__(self, method: VisibilityRegistrar, source: RayImage, target: RayImage, *, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._method = method
        self._views = source, target
        sizes_m = [np.sqrt(np.sum(np.var(view.points_m, axis=0))) for view in self._views]
        self._surface_m = method.surface_detail * float(np.mean(sizes_m))
        self._points = tuple(self._drawn(view, rng) for view in self._views)
        self._weight = method.effective_points / sum(len(points) for points in self._points)

    def _drawn(self, view: RayImage, rng: np.random.Generator) -> Array:
        """Return points (n, 8) of a view with the gain of a match.

        A match is worth what it says beyond what the surroundings said already: the log of the ratio of the two
        Gaussians' widths, ½ log(1 + relief² / noise²). The blurred levels keep it, as a lead to where matches are.
        """
        points = spread_points(view, self._method.points, rng)
        noise = 2.0 * points[:, 6] + self._surface_m**2 + (self._method.relief_noise * view.sigma_r_m) ** 2
        relief = relief_m(view, points, self._method.relief_reaches)
        excess = np.maximum(relief**2 - noise, 0.0)
        points[:, 7] = np.minimum(0.5 * np.log1p(excess / noise), self._method.max_gain)
        return points

    def level(self, blur_m: float, _: Array) -> LogLikelihood:
        """Return the tempered log-likelihood of poses (n, 4, 4), the surfaces blurred by `blur_m`."""
        share = 1 if blur_m < 0.003 else 2 if blur_m < 0.006 else 4  # blunt comparisons need fewer points
        source, target = self._views
        of_source, of_target = (np.ascontiguousarray(points[::share]) for points in self._points)
        in_target, in_source = self._model(target, blur_m), self._model(source, blur_m)
        weight = self._weight * share

        def log_likelihood(target_from_source: Array) -> Array:
            forward = rows(target_from_source)
            backward = rows(se3.inverse(target_from_source))
            return weight * (
                kernel.log_likelihoods(forward, of_source, target.layers["cells"], intrinsics(target), in_target)
                + kernel.log_likelihoods(backward, of_target, source.layers["cells"], intrinsics(source), in_source)
            )

        return log_likelihood

    def last_level(self, poses: Array) -> LogLikelihood:
        """Return the log-likelihood with the noise of these surfaces, as the samples so far show it."""
        return self.level(self._surface_noise_m(poses), poses)

    def _surface_noise_m(self, poses: Array) -> float:
        """Return the standard deviation in m of matching surfaces' distance, beyond their pixels' noise.

        It holds what smoothing does to curved surfaces, the sensor's noise that neighbours share, and what is left of
        the samples' own spread: a nuisance parameter, at its most likely value given the samples.
        """
        blur_m = self._method.blurs_m[-2]
        source, target = self._views
        variances = []
        for pose in poses[:: max(len(poses) // 20, 1)]:
            squares = [
                kernel.matched_residuals(
                    rows(motion[None])[0], points, view.layers["cells"], intrinsics(view), self._model(view, blur_m)
                )
                for motion, points, view in (
                    (pose, self._points[0], target),
                    (se3.inverse(pose), self._points[1], source),
                )
            ]
            matched = np.concatenate(squares)
            if len(matched) > 20:
                variances.append(np.mean(matched))
        return float(np.sqrt(max(np.median(variances), 0.0))) if variances else blur_m

    def overlap(self, target_from_source: Array) -> float:
        """Return the share of points that should be seen by both cameras and are."""
        source, target = self._views
        verdicts = np.concatenate(
            [
                kernel.classify(
                    rows(pose[None])[0], points, other.layers["cells"], intrinsics(other), self._model(other, 0.0)
                )
                for pose, points, other in (
                    (target_from_source, self._points[0], target),
                    (se3.inverse(target_from_source), self._points[1], source),
                )
            ]
        )
        wrong = np.isin(verdicts, (kernel.BEHIND, kernel.IN_FRONT, kernel.IN_EMPTY_SPACE)).sum()
        matched = (verdicts == kernel.MATCHED).sum()
        return float(matched / max(matched + wrong, 1))

    def _model(self, other: RayImage, blur_m: float) -> Array:
        """Return the parameters (9,) of the kernel for points looked up in `other`."""
        method, camera = self._method, other.frame.camera
        lateral_px = max(other.sigma_wh * camera.fx, 1.0)
        depth_m = max(float(other.centroid_m[2]), 1e-3)
        blur_px = blur_m * camera.fx / depth_m
        return np.array(
            [
                np.sqrt(blur_m**2 + self._surface_m**2 + (method.surface_noise * other.sigma_r_m) ** 2),
                lateral_px + blur_px,
                1.25 * lateral_px,
                3.0 * other.sigma_r_m,
                0.1,
                0.35,
                method.hidden_share,
                method.worst,
                method.bend,
                np.log(max(method.hidden_share, 1.0 - measured_share(other))),
            ]
        )
