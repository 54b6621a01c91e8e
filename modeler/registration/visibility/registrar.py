"""The default registration method: search, sample and refine the posterior of the visibility likelihood."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from modeler import se3
from modeler.registration.posterior import MIN_MODE_SHARE, failed, of_multipath, share_at_limit, weighted_gaussian
from modeler.registration.visibility.likelihood import MIN_MATCHES, PairLikelihood, VisibilityLikelihood
from modeler.registration.visibility.refinement import Refiner, first_order
from modeler.registration.visibility.ridge import without_chance
from modeler.registration.visibility.sampling import (
    AdaptiveSampler,
    GaussianMixture,
    MixtureProposal,
    WeightedSamples,
    weigh_modes,
)
from modeler.registration.visibility.search import Candidates, Search
from modeler.types import (
    FULL_EFFORT,
    AbstractPoseDensity,
    AbstractRegistrar,
    Array,
    Mode,
    Outcome,
    PoseGaussian,
    Posterior,
    ViewPair,
    are_separate,
    checked,
    pooled,
)

_LEAST_EFFORT = 0.25  # 0.5 s of 2 s for a pair without common surface


@dataclass(frozen=True, eq=False)
class ModeSamples:
    """Samples of one mode, and the nuisance parameters (method, eq. 4.7) under which they were weighted."""

    samples: WeightedSamples
    noise_m: float
    """Noise b of matching surfaces."""
    typical_misfit: float
    """Misfit μ of a typical match (nats)."""


@checked
@dataclass(frozen=True)
class VisibilityRegistrar(AbstractRegistrar):
    """The paper's likelihood with normals: surface that faces a camera is seen by it, other surface is hidden.

    p(surface of B | image A, T) · p(surface of A | image B, T), each a product over points, tempered because errors of
    neighbouring points are correlated. A search finds the modes, each is sampled and weighted, and directions that
    matching surface determines well are refined (docs/method/index.md).
    """

    likelihood: VisibilityLikelihood = field(default_factory=VisibilityLikelihood)
    search: Search = field(default_factory=Search)
    sampler: AdaptiveSampler = field(default_factory=AdaptiveSampler)
    refiner: Refiner = field(default_factory=Refiner)
    max_modes: int = 4
    """Largest number of modes that are sampled; without a limit, 98 pairs are as good, and a dog's take ten times as
    long."""
    min_points: int = MIN_MATCHES
    """Views with fewer surface points are not registered."""
    min_overlap: float = 0.4
    """Least fraction of matches in the surface that both views should see, as of further edges (`Thresholds`). With
    less than a half, the verdict wants another edge to confirm the registration."""
    max_at_limit: float = 0.2
    """Largest fraction of the samples at the limit of the prior; with 0.1 or 0.4, 14 pairs have the same outcomes."""
    max_sigma_deg: float = 10.0
    """Largest standard deviation of a rotation that is not ambiguous; with 5 or 20, 14 pairs have the same outcomes."""

    @property
    def least_effort(self) -> float:
        """A quarter of the usual effort."""
        return _LEAST_EFFORT

    def posterior_of(self, pair: ViewPair) -> Posterior:
        """Return the posterior of target_from_source; its outcome states failure.

        With less than full effort, only the best mode is sampled: pairs that share no surface are the most expensive,
        as every mode that the search finds is sampled.
        """
        method = self if pair.effort == FULL_EFFORT else self.scaled(pair.effort)
        return method._registered(pair)

    def scaled(self, effort: float) -> VisibilityRegistrar:
        """Return the method with a share (0..1] of the starts of a search and of the samples, of one mode."""
        sampler = replace(self.sampler, max_draws=int(effort * self.sampler.max_draws))
        return replace(self, search=self.search.scaled(effort), sampler=sampler, max_modes=1)

    def _registered(self, views: ViewPair) -> Posterior:
        started = time.perf_counter()
        source, target, density, rng = views.source, views.target, views.density, views.rng
        if min(len(source.points_m), len(target.points_m)) < self.min_points:
            return failed(source, target, Outcome.TOO_FEW_POINTS, density, rng)
        if views.near is not None and not np.isfinite(density.log_prior(views.near[None]))[0]:
            return failed(source, target, Outcome.AT_LIMIT, density, rng)  # as of an edge between segments
        pair = self.likelihood.between(source, target, rng)
        found = self.search.run(pair, density, rng, min_overlap=self.min_overlap, near=views.near)
        # Overlaps are judged without noise near silhouettes, which the misfit of a wrong pose increases.
        noisy = pair.with_rim_m(pair.noises_m(found.poses[0], self.search.fine_m(pair))[1])
        modes_found = found.modes(pair.centre_m, self.search.extent(pair))[: self.max_modes]
        sampled = [self._sampled(noisy, density, mode, rng) for mode in modes_found]
        compared = comparable(sampled, noisy)
        if found.any_rotation:
            compared = overlapping(compared, pair.overlap, self.min_overlap)
        dense = self.likelihood.denser(noisy, rng)
        modes = [(share, self._refined(noisy, dense, density, mode, rng)) for share, mode in weigh_modes(compared)]
        at_limit = self._share_at_limit(pair, density, found, modes[0][1], rng)
        posterior = self._posterior(pair, modes, found, at_limit=at_limit, seconds=time.perf_counter() - started)
        return replace(posterior, beyond=found.beyond) if _leads_beyond(found) else posterior

    def _sampled(
        self, pair: PairLikelihood, density: AbstractPoseDensity, found: Candidates, rng: np.random.Generator
    ) -> ModeSamples:
        """Return samples of the mode that some candidates form."""
        noise_m, _ = pair.noises_m(found.poses[0], self.search.fine_m(pair))
        typical_misfit = pair.typical_misfit(found.poses[0], noise_m)
        basin = self.search.extent(pair)

        def tempered(poses: Array, log_focal: Array) -> Array:
            return pair.tempered(poses, noise_m, typical_misfit=typical_misfit, log_focal=log_focal)

        likelihood = without_chance(
            pair, found.poses, tempered, blur_m=noise_m, typical_misfit=typical_misfit, basin=basin
        )
        volumes = np.log(np.diagonal(found.spreads, axis1=1, axis2=2)).sum(axis=1)
        log_weights = likelihood(found.poses, np.zeros(len(found.poses))) + volumes
        if len(density.alternatives) > 1:
            log_weights += density.log_prior(found.poses)
        gaussians = GaussianMixture(found.poses, found.spreads, log_weights, pair.centre_m)
        nuisance = first_order(pair, found.poses[0], found.spreads[0], noise_m)
        proposal = MixtureProposal(density, gaussians)
        samples = self.sampler.run(proposal, likelihood, pair.centre_m, rng, nuisance=nuisance)
        # The likelihood is that of aligned colours: an unknown shift moves samples as it moves the mode.
        by_shift = pair.moved_by_shift(found.poses[0], found.spreads[0], max(noise_m, self.search.fine_m(pair)))
        shifts = rng.normal(size=(len(samples.poses), 2)) @ by_shift.T
        samples = replace(samples, poses=se3.moved(samples.poses, shifts, pair.centre_m))
        return ModeSamples(samples, noise_m, typical_misfit)

    def _refined(
        self,
        pair: PairLikelihood,
        dense: PairLikelihood,
        density: AbstractPoseDensity,
        samples: WeightedSamples,
        rng: np.random.Generator,
    ) -> WeightedSamples:
        """Return refined samples of a mode; those that would leave the prior's support are kept unchanged."""
        fine_m = self.search.fine_m(pair)
        refined = replace(samples, poses=self.refiner.refine(pair, dense, samples, rng, fine_m=fine_m))
        inside = np.isfinite(density.log_prior(refined.under_focal_lengths))
        poses = np.where(inside[:, None, None], refined.poses, samples.poses)
        return replace(samples, poses=poses).conditional(pair.centre_m)

    def _share_at_limit(
        self,
        pair: PairLikelihood,
        density: AbstractPoseDensity,
        found: Candidates,
        heaviest: WeightedSamples,
        rng: np.random.Generator,
    ) -> float:
        """Return the fraction of the heaviest mode at the limit of the prior; 1 if descent leads beyond it."""
        if _leads_beyond(found):
            return 1.0
        return share_at_limit(density, heaviest.poses, heaviest.weights, pair.centre_m, rng)

    def _posterior(
        self,
        pair: PairLikelihood,
        weighted: list[tuple[float, WeightedSamples]],
        found: Candidates,
        *,
        at_limit: float,
        seconds: float,
    ) -> Posterior:
        """Return the posterior of weighted modes, and its outcome (docs/method/refinement.md)."""
        samples = np.concatenate([mode.poses for _, mode in weighted])
        weights = np.concatenate([share * mode.weights for share, mode in weighted])
        systematic = of_multipath(pair.backward.image)

        def gaussian(poses: Array, weights: Array, by_focal: Array) -> PoseGaussian:
            found = weighted_gaussian(poses, weights, pair.centre_m)
            return PoseGaussian(found.mean, found.covariance + systematic, by_focal)

        modes = tuple(
            Mode(share, gaussian(mode.poses, mode.weights, mode.nuisance.by_focal)) for share, mode in weighted
        )
        separate = len(modes) == 1 or are_separate(modes)
        pose = pooled(modes)
        if not separate:
            pose = gaussian(samples, weights, pose.by_focal)
        overlap = pair.overlap(modes[0].pose.mean)
        # Among very many poses, some match by chance; among few, the likeliest is right even if a mask is truncated.
        contradicted = not pair.fits(modes[0].pose.mean, self.search.fine_m(pair))
        matches = not (found.any_rotation and contradicted)
        correlation, independent = pair.agreement(modes[0].pose.mean, self.search.blurs_m(pair))
        effective = 1.0 / sum(share**2 / mode.effective_samples for share, mode in weighted)
        return Posterior(
            source=pair.backward.image.index,
            target=pair.forward.image.index,
            pose=pose,
            outcome=self._outcome(effective, pose, overlap if matches else 0.0, at_limit=at_limit),
            overlap=overlap,
            least_overlap=self.min_overlap,
            contradicted=contradicted,
            colour_correlation=correlation,
            independent_colours=independent,
            samples=samples,
            weights=weights,
            modes=modes if len(modes) > 1 else (),
            effective_samples=effective,
            pareto_k=max(mode.pareto_k for _, mode in weighted),
            log_marginal_likelihood=float(np.logaddexp.reduce([mode.log_marginal_likelihood for _, mode in weighted])),
            seconds=seconds,
        )

    def _outcome(self, effective_samples: float, pose: PoseGaussian, overlap: float, *, at_limit: float) -> Outcome:
        if at_limit > self.max_at_limit:
            return Outcome.AT_LIMIT
        if overlap < self.min_overlap:
            return Outcome.NO_OVERLAP
        if effective_samples < self.sampler.min_effective:
            return Outcome.DEGENERATE
        return Outcome.AMBIGUOUS if self._is_ambiguous(pose) else Outcome.CONVERGED

    def _is_ambiguous(self, pose: PoseGaussian) -> bool:
        sigma_rad = np.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3])[-1])
        return bool(sigma_rad > np.deg2rad(self.max_sigma_deg))


def comparable(modes: list[ModeSamples], pair: PairLikelihood) -> list[WeightedSamples]:
    """Return the samples of modes with evidence that can be compared (method, eq. 5.6).

    All modes get the nuisance parameters of the one that matches best, as its own noise estimate would favour a mode
    that matches badly. Holes are left out: of modes that look alike, the one that moves less surface into shadows would
    win.
    """
    if len(modes) == 1:
        return [modes[0].samples]
    reference = min(modes, key=lambda mode: mode.noise_m)
    without_holes, gains = pair.without_holes(), []
    for mode in modes:
        best = [np.argmax(mode.samples.log_likelihoods)]
        found = mode.samples.under_focal_lengths[best], mode.samples.log_focal[best]
        gains.append(float((_tempered(without_holes, reference, *found) - _tempered(pair, mode, *found))[0]))
    of_reference = gains[modes.index(reference)]
    return [
        replace(mode.samples, log_marginal_likelihood=mode.samples.log_marginal_likelihood + gain - of_reference)
        for mode, gain in zip(modes, gains, strict=True)
    ]


def _tempered(pair: PairLikelihood, mode: ModeSamples, poses: Array, log_focal: Array) -> Array:
    """Return tempered log-likelihoods (n,) with a mode's nuisance parameters, see `PairLikelihood.tempered`."""
    return pair.tempered(poses, mode.noise_m, typical_misfit=mode.typical_misfit, log_focal=log_focal)


def overlapping(
    modes: list[WeightedSamples], overlap: Callable[[Array], float], min_overlap: float
) -> list[WeightedSamples]:
    """Return the modes in which the views overlap, if the likeliest pose is in one of them; otherwise all modes.

    Without limits, views have nothing in common under most motions. The images cannot distinguish these, and their
    volume would outweigh a precise match (docs/method/search.md).

    Args:
        modes: samples of each mode.
        overlap: returns the share of matches under a pose (4, 4).
        min_overlap: least share of an overlap.
    """
    best = [int(np.argmax(mode.log_likelihoods)) for mode in modes]
    likelihoods = np.array([mode.log_likelihoods[k] for mode, k in zip(modes, best, strict=True)])
    overlaps = np.array([overlap(mode.poses[k]) >= min_overlap for mode, k in zip(modes, best, strict=True)])
    if not overlaps[np.argmax(likelihoods)]:
        return modes
    return [mode for mode, shown in zip(modes, overlaps, strict=True) if shown]


def _leads_beyond(found: Candidates) -> bool:
    """Return whether descent leads beyond the prior's support: the best inside would be negligible relative to it."""
    return found.beyond_gain > -np.log(MIN_MODE_SHARE)
