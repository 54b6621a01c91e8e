"""Registration by what each view should see of the other's surface; the default method."""

import time
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from modeler.registration.annealing import AnnealedSampler, Level, Population
from modeler.registration.lookup import Lookup
from modeler.registration.pair import Pair
from modeler.registration.posterior import failed, share_at_limit, weighted_gaussian
from modeler.registration.refinement import Refiner
from modeler.registration.surface import measured_share, relief_m, spread_points
from modeler.types import AbstractMotion, AbstractRegistrar, Outcome, PoseGaussian, Posterior, RayImage


@dataclass(frozen=True)
class VisibilityRegistrar(AbstractRegistrar):
    """The paper's likelihood with normals: surface that faces a camera is seen by it, other surface is hidden.

    p(surface of B | image A, T) · p(surface of A | image B, T), each a product over points, tempered because
    neighbouring points err alike, and sampled by annealing from a blurred likelihood to the sharp one.
    """

    points: int = 600
    """Surface points taken from each view."""
    effective_points: float = 40.0
    """Number of independent measurements that the points of both views together are worth."""
    blurs_m: tuple[float, ...] = (0.016, 0.008, 0.004, 0.002, 0.001)
    """Blur of the surfaces at each level of the annealing; at one more, their own noise as the samples show it."""
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
    relief_noise: float = 1.0
    """Noise of the surfaces that relief stands out from, as a share of the sensor's range noise."""
    worst: float = 10.0
    """Most that one point may cost (nats)."""
    bend: float = 2.0
    """Cost (nats) of normals at right angles."""
    sampler: AnnealedSampler = field(default_factory=AnnealedSampler)
    """How the posterior is explored."""
    refiner: Refiner = field(default_factory=Refiner)
    """How samples are sharpened by the surface that matches."""
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
        pair = self.pair(source, target, rng)
        posterior = self._explored(pair, self.sampler, motion, rng=rng)
        if not posterior.usable:  # a mode may have been missed: look once more, and harder
            posterior = self._explored(pair, self.sampler.thorough(), motion, rng=rng)
        return replace(posterior, seconds=time.perf_counter() - started)

    def _explored(
        self, pair: Pair, sampler: AnnealedSampler, motion: AbstractMotion, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the posterior that one run of a sampler finds."""
        source, target = pair.backward.image, pair.forward.image
        levels: list[Level] = [partial(pair.level, blur_m) for blur_m in self.blurs_m]
        levels.append(lambda poses: pair.level(pair.surface_noise_m(poses, self.blurs_m[-1]), poses, lead=False))
        population = sampler.run(motion, levels, source.centroid_m, rng)
        at_limit = share_at_limit(motion, population.poses, source.centroid_m, rng)
        refined = self.refiner.refine(pair, population.poses, rng, fine_m=self.blurs_m[-1])
        inside = np.isfinite(motion.log_density(refined))
        samples = np.where(inside[:, None, None], refined, population.poses)
        weights = np.full(len(samples), 1.0 / len(samples))
        pose = weighted_gaussian(samples, weights, source.centroid_m)
        overlap = pair.overlap(pose.mean)
        return Posterior(
            source=source.index,
            target=target.index,
            pose=pose,
            outcome=self._outcome(population, pose, overlap, at_limit=at_limit),
            overlap=overlap,
            samples=samples,
            weights=weights,
            effective_samples=population.effective_samples,
            pareto_k=population.pareto_k,
            log_evidence=population.log_evidence,
        )

    def pair(self, source: RayImage, target: RayImage, rng: np.random.Generator) -> Pair:
        """Return the comparison of two views, at points drawn with `rng`."""
        size_m = float(np.mean([np.sqrt(np.sum(np.var(view.points_m, axis=0))) for view in (source, target)]))
        return Pair(
            self._lookup(source, target, size_m, rng), self._lookup(target, source, size_m, rng), self.effective_points
        )

    def _lookup(self, view: RayImage, image: RayImage, size_m: float, rng: np.random.Generator) -> Lookup:
        """Return points of a view to be looked up in another's image.

        A match is worth what it says beyond what the surroundings said already: the log of the ratio of the two
        Gaussians' widths, ½ log(1 + relief² / noise²). It leads the blurred levels; the last goes without, for on round
        objects it would count as knowledge of the spin what is only less surface in common.
        """
        points = spread_points(view, self.points, rng)
        detail_m = self.surface_detail * size_m
        noise = 2.0 * points[:, 6] + detail_m**2 + (self.relief_noise * view.sigma_r_m) ** 2
        excess = np.maximum(relief_m(view, points, self.relief_reaches) ** 2 - noise, 0.0)
        points[:, 7] = np.minimum(0.5 * np.log1p(excess / noise), self.max_gain)
        return Lookup(
            points,
            image,
            surface_m=float(np.hypot(detail_m, self.surface_noise * image.sigma_r_m)),
            hidden_share=self.hidden_share,
            worst=self.worst,
            bend=self.bend,
            measured_share=measured_share(image),
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
