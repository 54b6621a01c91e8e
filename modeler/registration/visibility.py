"""Registration by what each view should see of the other's surface; the default method."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from modeler.registration.candidates import Candidates
from modeler.registration.importance import AdaptiveSampler, WeightedSamples
from modeler.registration.lookup import DirectedLikelihood
from modeler.registration.mixture import Gaussians, MixtureProposal
from modeler.registration.modes import ModeSamples, split_modes, weigh_modes
from modeler.registration.pair import PairLikelihood
from modeler.registration.posterior import failed, share_at_limit, weighted_gaussian
from modeler.registration.refinement import Refiner
from modeler.registration.search import Search
from modeler.registration.surface import measured_share, spread_points
from modeler.types import (
    AbstractPoseDensity,
    AbstractRegistrar,
    Mode,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    as_one,
    separate,
)


@dataclass(frozen=True, eq=False)
class _Sampled:
    """Samples of one place, and the noise of matching surface with which they were weighed."""

    population: WeightedSamples
    noise_m: float
    typical: float
    """What a good match loses to its misfit (nats)."""
    rise: float
    """By how much (nats) the best of them is better than what the search had found."""
    compared_points: float
    """Most independent measurements that all points are worth beside other places."""


@dataclass(frozen=True)
class VisibilityRegistrar(AbstractRegistrar):
    """The paper's likelihood with normals: surface that faces a camera is seen by it, other surface is hidden.

    p(surface of B | image A, T) · p(surface of A | image B, T), each a product over points, tempered because
    neighbouring points err alike. A search finds the places where it may be high, each is sampled and weighed, and what
    matching surface determines well is sharpened by its own equations.
    """

    points: int = 600
    """Surface points taken from each view."""
    effective_points: float = 70.0
    """Most independent measurements that the points of both views together are worth where surface matches; see
    `PairLikelihood.independent`."""
    compared_points: float = 40.0
    """Likewise where separate places are weighed against each other: sides that are alike differ by what all points of
    one side err by, which averages out in none."""
    surface_noise: float = 0.1
    """Least error that smoothing leaves in a surface, common to neighbours, as a share of the sensor's range noise."""
    surface_detail: float = 0.003
    """Least error of local planes on a curved surface, as a share of the object's size."""
    hidden_share: float = 0.5
    """Share of points that face the other camera and are hidden by another part of the object.

    Where points go behind the surface seen they lose the log of it. With a lower share the inside of a bowl, hidden
    wherever the bowl has turned, would say that it had not.
    """
    max_point_cost: float = 10.0
    """Most that one point may cost (nats)."""
    normal_cost: float = 2.0
    """Cost (nats) of normals at right angles."""
    search: Search = field(default_factory=Search)
    """How the places are found where the posterior has its mass."""
    max_modes: int = 4
    """The best of so many are explored."""
    widening: float = 1.3
    """How much wider than the search's Gaussians the first samples lie."""
    coarse_share: float = 0.4
    """Share of them that looks farther, as far as surface leaves open when it is blurred."""
    restart_gain: float = 3.0
    """Where samples are so much better (nats) than all that the search had found, it goes on from them,"""
    restarts: int = 20
    """from so many of the best,"""
    max_rounds: int = 3
    """and samples are drawn at most so many times."""
    sampler: AdaptiveSampler = field(default_factory=AdaptiveSampler)
    """How each place is explored."""
    refiner: Refiner = field(default_factory=Refiner)
    """How samples are sharpened by the surface that matches."""
    min_points: int = 60
    """Fewer surface points than this in a view are not registered."""
    min_overlap: float = 0.35
    """Least share of the surface that both should see and do."""
    max_at_limit: float = 0.2
    """With a larger share of the samples at the end of the prior, the motion may lie beyond it."""
    max_beyond: float = 5.0
    """Where matching surface leads out of the prior to a place so much better (nats), the motion may lie beyond it."""
    min_effective: float = 100.0
    """With fewer effective samples the result is called degenerate."""
    max_sigma_deg: float = 10.0
    """Rotation less sure than this is called ambiguous."""

    def register(
        self, source: RayImage, target: RayImage, density: AbstractPoseDensity, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the posterior of target_from_source; failure is its outcome."""
        started = time.perf_counter()
        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return failed(source, target, Outcome.TOO_FEW_POINTS, density, rng)
        pair = self.pair(source, target, rng)
        posterior = self._explored(pair, self.search, density, rng=rng)
        if not posterior.usable:  # a place may have been missed: look once more, and harder
            posterior = self._explored(pair, self.search.thorough(), density, rng=rng)
        return replace(posterior, seconds=time.perf_counter() - started)

    def _explored(
        self, pair: PairLikelihood, search: Search, density: AbstractPoseDensity, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the posterior that one search finds."""
        source, target = pair.backward.image, pair.forward.image
        candidates = search.candidates(pair, density, rng)
        sampled = [
            self._sampled_to_the_top(pair, density, found, rng)
            for found in split_modes(candidates, pair.centre_m)[: self.max_modes]
        ]
        strict = min(sampled, key=lambda one: one.noise_m)
        places = weigh_modes([self._place(pair, density, one, strict, rng) for one in sampled])
        samples = np.concatenate([place.poses for _, place in places])
        weights = np.concatenate([share * place.weights for share, place in places])
        modes = tuple(Mode(share, place.gaussian(pair.centre_m)) for share, place in places)
        pose = (
            as_one(modes) if len(modes) == 1 or separate(modes) else weighted_gaussian(samples, weights, pair.centre_m)
        )
        overlap = pair.overlap(modes[0].pose.mean)
        effective = 1.0 / sum(share**2 / place.effective_samples for share, place in places)
        beyond = candidates.beyond > self.max_beyond
        at_limit = (
            1.0 if beyond else share_at_limit(density, places[0][1].poses, places[0][1].weights, pair.centre_m, rng)
        )
        return Posterior(
            source=source.index,
            target=target.index,
            pose=pose,
            outcome=self._outcome(effective, pose, overlap, at_limit=at_limit),
            overlap=overlap,
            least_overlap=self.min_overlap,
            samples=samples,
            weights=weights,
            modes=modes if len(modes) > 1 else (),
            effective_samples=effective,
            pareto_k=max(place.pareto_k for _, place in places),
            log_evidence=float(np.logaddexp.reduce([place.log_mass for _, place in places])),
        )

    def _sampled_to_the_top(
        self, pair: PairLikelihood, density: AbstractPoseDensity, found: Candidates, rng: np.random.Generator
    ) -> _Sampled:
        """Return samples of one place.

        Matching surface alone does not lead to the top where free space has a say, at the ends of a tube. Where samples
        come out far above what the search had found, it goes on from the best of them, and they are drawn anew.
        """
        sampled = self._sampled(pair, density, found, rng)
        for _ in range(self.max_rounds - 1):
            if sampled.rise < self.restart_gain:
                break
            order = np.argsort(-sampled.population.log_likelihoods, kind="stable")
            best = sampled.population.poses[order[: self.restarts]]
            found = self.search.onward(pair, density, found, best, rng)
            sampled = self._sampled(pair, density, found, rng)
        return sampled

    def _sampled(
        self, pair: PairLikelihood, density: AbstractPoseDensity, found: Candidates, rng: np.random.Generator
    ) -> _Sampled:
        """Return samples around candidates."""
        noise_m = pair.surface_noise_m(found.poses[0], self.search.blurs[-1] * pair.size_m)
        typical = pair.typical_misfit(found.poses[0], noise_m)
        within, beside = self.effective_points, self.compared_points
        if found.low_overlap:
            within = beside = self.search.low_overlap_points
        likelihood = partial(pair.tempered, blur_m=noise_m, effective_points=within, typical=typical)
        plain = likelihood(found.poses)
        volumes = np.log(np.diagonal(found.spreads, axis1=1, axis2=2)).sum(axis=1)
        log_weights = np.where(found.coarse, found.scores, plain + volumes)
        for kind, share in ((found.coarse, self.coarse_share), (~found.coarse, 1.0 - self.coarse_share)):
            if kind.any():
                log_weights[kind] += np.log(share) - np.logaddexp.reduce(log_weights[kind])
        gaussians = Gaussians(found.poses, self.widening * found.spreads, log_weights, pair.centre_m)
        population = self.sampler.run(MixtureProposal(density, gaussians), likelihood, pair.centre_m, rng)
        rise = float(population.log_likelihoods.max() - plain[0])
        return _Sampled(population, noise_m, typical, rise, beside)

    def _place(
        self,
        pair: PairLikelihood,
        density: AbstractPoseDensity,
        one: _Sampled,
        strict: _Sampled,
        rng: np.random.Generator,
    ) -> ModeSamples:
        """Return one of the places, sharpened by matching surface but where that would leave what is possible.

        Each place was sampled under the noise that it shows itself, which would forgive it everything; beside each
        other all are held to the noise of the one that matches best.
        """
        population = one.population
        refined = self.refiner.refine(
            pair, population.poses, population.weights, rng, fine_m=self.search.blurs[-1] * pair.size_m
        )
        inside = np.isfinite(density.log_evidence(refined))
        best = int(np.argmax(population.log_likelihoods))
        beside = pair.tempered(
            population.poses[best : best + 1],
            strict.noise_m,
            effective_points=one.compared_points,
            typical=strict.typical,
        )
        return ModeSamples(
            np.where(inside[:, None, None], refined, population.poses),
            population.weights,
            population.log_evidence + float(beside[0] - population.log_likelihoods[best]),
            population.effective_samples,
            population.pareto_k,
        )

    def pair(self, source: RayImage, target: RayImage, rng: np.random.Generator) -> PairLikelihood:
        """Return the comparison of two views, at points drawn with `rng`."""
        size_m = 0.5 * (source.size_m + target.size_m)
        return PairLikelihood(
            self._lookup(source, target, size_m, rng),
            self._lookup(target, source, size_m, rng),
            size_m=size_m,
        )

    def _lookup(self, view: RayImage, image: RayImage, size_m: float, rng: np.random.Generator) -> DirectedLikelihood:
        """Return points of a view to be looked up in another's image."""
        return DirectedLikelihood(
            spread_points(view, self.points, rng),
            image,
            surface_m=float(np.hypot(self.surface_detail * size_m, self.surface_noise * image.sigma_r_m)),
            hidden_share=self.hidden_share,
            max_point_cost=self.max_point_cost,
            normal_cost=self.normal_cost,
            measured_share=measured_share(image),
        )

    def _outcome(self, effective_samples: float, pose: PoseGaussian, overlap: float, *, at_limit: float) -> Outcome:
        if at_limit > self.max_at_limit:
            return Outcome.AT_LIMIT
        if overlap < self.min_overlap:
            return Outcome.NO_OVERLAP
        if effective_samples < self.min_effective:
            return Outcome.DEGENERATE
        sigma_rad = np.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3])[-1])
        return Outcome.AMBIGUOUS if sigma_rad > np.deg2rad(self.max_sigma_deg) else Outcome.CONVERGED
