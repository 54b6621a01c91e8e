"""Search for modes of the posterior: descent from many samples of the prior (method, eq. 5.1 to 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.kernels import mixture
from modeler.kernels.gauss_newton import Regulariser
from modeler.registration.features import FeatureMatcher
from modeler.registration.posterior import MIN_MODE_SHARE, PRIOR_SAMPLES
from modeler.registration.visibility.directed import MISFIT
from modeler.registration.visibility.likelihood import PairLikelihood
from modeler.types import AbstractPoseDensity, Array, BoolArray, PoseGaussian

_STRIDE = 2  # every second point is used for scores; with every fourth, NEES/6 of hard pairs is 2.3 for 1.5
_COARSE_STRIDE = 8  # where the best pose need only be roughly right; with 4 or 16, pairs of six sequences are as good
_OPEN = 0.5  # sd in basins from which on prior and surface leave a motion open: descents reach no farther
SEPARATE_RAD = 0.25
"""Rotation between different modes: wider than a basin of attraction (`Search.basin`), in which descents end at one."""
OPEN_ROTATION_RAD = 1.0
"""Standard deviation of an open rotation: it is 1.33 if all are equally likely, 1.0 within limits of 130°."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses found by the search, each with a local Gaussian."""

    poses: Array
    """(k, 4, 4) target_from_source, best first."""
    scores: Array
    """(k,) tempered log-likelihoods (nats)."""
    spreads: Array
    """(k, 6, 6) lower triangular roots of the covariances of ξ about the source's centroid (method, eq. 5.3)."""
    any_rotation: bool = False
    """Whether the prior leaves the rotation open: by `OPEN_ROTATION_RAD` or more in every direction."""
    beyond_gain: float = -np.inf
    """Difference in nats between the best pose beyond the prior's support and the best candidate."""
    beyond: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """(1, 4, 4) that pose; (0, 4, 4) if there is none."""

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self.poses)

    def select(self, chosen: npt.NDArray[np.int64] | BoolArray) -> Candidates:
        """Return candidates by index or mask."""
        return replace(self, poses=self.poses[chosen], scores=self.scores[chosen], spreads=self.spreads[chosen])

    def distinct(self, centre_m: Array) -> Candidates:
        """Return the candidates without those within a standard deviation of a better one (greedy)."""
        kept: list[int] = []
        remaining = np.ones(len(self), dtype=bool)
        near = mixture.mahalanobis_distances(se3.rows(self.poses), self.spreads, centre_m) <= 1.0
        for number in range(len(self)):
            if remaining[number]:
                kept.append(number)
                remaining &= ~near[number]
        return self.select(np.array(kept, dtype=np.int64))

    def modes(self, centre_m: Array, basin: Array) -> list[Candidates]:
        """Return the candidates by mode, the best mode first.

        Candidates joined by chains of overlapping basins of extent `basin` (6,) form a mode, so that a ridge, such as
        the spin of a can, is one.
        """
        distances = se3.difference(self.poses[:, None], self.poses[None], centre_m) / basin
        linked = np.linalg.norm(distances, axis=-1) <= 2.0
        label = np.arange(len(self))
        for number in range(len(self)):  # connected components, each labelled by its best candidate
            neighbours = np.unique(label[linked[number]])
            label[np.isin(label, neighbours)] = neighbours[0]
        return [self.select(label == name) for name in np.unique(label)]


@dataclass(frozen=True)
class Search:
    """Finds candidates for the modes of a posterior, coarse to fine (docs/method/search.md)."""

    basin: float = 0.2
    """Extent of a basin of attraction: rotation in rad, translation as a fraction of the object's size."""
    per_basin: float = 3.0
    """Number of starts per basin in the prior; with 1.5 and 6, 11 pairs are off by 0.20° and 0.17° in the median, with
    3 by 0.15°."""
    min_starts: int = 60
    """Least number of starts; with a limit of 60 a basin in place of 3, as many pairs fail, and they take 1.7 times as
    long."""
    max_starts: int = 400
    """Largest number of starts. With 200, 7 of 11 pairs of the dragon 96° apart fail, with 400 4; 800 are no better."""
    proposals: int = 15
    """Samples of the prior per start, of which the best are used. Without a choice, 6 of 30 pairs of a dog fail, with
    15 none; 45 are no better."""
    finest: float = 0.015
    """Blur of the surfaces in the last stage of the descent, as a fraction of the object's size; halved or doubled, 68
    pairs are as good."""
    matcher: FeatureMatcher = field(default_factory=FeatureMatcher)
    """Matches features for further starts, if the prior has more basins than `max_starts` reach."""
    turns: int = 3000
    """Number of poses along three motions that surface leaves open whose colours are compared: 5° apart on a ball."""
    stages: int = 3
    """Stages of the descent, each with half the blur of the previous one."""
    steps: int = 4
    """Gauss-Newton steps at each blur."""

    def scaled(self, effort: float) -> Search:
        """Return a search with `effort` times the starts."""
        return replace(self, max_starts=int(effort * self.max_starts), per_basin=effort * self.per_basin)

    def blurs_m(self, pair: PairLikelihood) -> Array:
        """Return the blur in m of each stage of the descent."""
        return np.ldexp(self.finest * pair.size_m, np.arange(self.stages - 1, -1, -1))

    def fine_m(self, pair: PairLikelihood) -> float:
        """Return the smallest blur in m."""
        return self.finest * pair.size_m

    def extent(self, pair: PairLikelihood) -> Array:
        """Return the extent (6,) of a basin in rad and m."""
        return self.basin * np.repeat([1.0, pair.size_m], 3)

    def starts(self, pair: PairLikelihood, prior: PoseGaussian) -> int:
        """Return the number of starts for the width of the prior, not limited by `max_starts` (method, eq. 5.1)."""
        extent = self.extent(pair)
        variances = np.linalg.eigvalsh(prior.covariance / np.outer(extent, extent))
        basins = np.sqrt(np.prod(np.maximum(variances, 1.0)))
        return max(int(self.per_basin * basins), self.min_starts)

    def run(
        self,
        pair: PairLikelihood,
        density: AbstractPoseDensity,
        rng: np.random.Generator,
        *,
        min_overlap: float,
        near: Array | None = None,
    ) -> Candidates:
        """Return candidates, best first, at least one.

        Args:
            pair: the two views.
            density: the prior.
            rng: source of all randomness.
            min_overlap: overlap of the best pose inside the prior's support above which poses beyond it count only
                within a basin of the support.
            near: (4, 4) the only start, if the mode is known roughly.
        """
        parts = density.alternatives
        priors = [_moments(pair, part, rng) for part in parts]
        descents = [self._descended(pair, part, prior, rng, near) for part, prior in zip(parts, priors, strict=True)]
        started, poses = (np.concatenate(kind) for kind in zip(*descents, strict=True))
        part = np.repeat(np.arange(len(parts)), [len(ended) for _, ended in descents])
        inside = np.isfinite(density.log_prior(poses))
        outside = poses[~inside]
        poses, part = (poses[inside], part[inside]) if inside.any() else (started, part)
        any_rotation = any(_is_open(prior) for prior in priors)
        blur_m, misfit = self._nuisance(pair, poses, any_rotation=any_rotation)
        likelihoods = pair.tempered(poses, blur_m, typical_misfit=misfit, stride=_STRIDE)
        # One alternative may be far denser than another, so that the likelihood alone does not rank modes.
        scores = likelihoods + density.log_prior(poses) if len(parts) > 1 else likelihoods
        order = np.argsort(-scores, kind="stable")
        # The volumes of two modes may differ as much as their likelihoods: hence twice the log of a negligible share.
        order = order[scores[order] > scores.max() + 2.0 * np.log(MIN_MODE_SHARE)]
        poses, part = poses[order], part[order]
        precisions = np.array([np.linalg.inv(prior.covariance) for prior in priors], dtype=np.float64)[part]
        spreads = _spreads(pair, precisions, poses, blur_m)
        found = Candidates(poses, scores[order], spreads, any_rotation)
        if pair.overlap(found.poses[0]) > min_overlap:
            outside = self._near_support(pair, priors[-1], density, outside)
        found = found.distinct(pair.centre_m)
        if not len(outside):
            return found
        gains = pair.tempered(outside, blur_m, typical_misfit=misfit, stride=_STRIDE) - likelihoods[order[0]]
        best = int(np.argmax(gains))
        return replace(found, beyond_gain=float(gains[best]), beyond=outside[best : best + 1])

    def _descended(
        self,
        pair: PairLikelihood,
        density: AbstractPoseDensity,
        prior: PoseGaussian,
        rng: np.random.Generator,
        near: Array | None,
    ) -> tuple[Array, Array]:
        """Return starting poses (n, 4, 4), and the poses (n, 4, 4) after descent from them."""
        regulariser = self._regulariser(pair, prior)
        *coarse_m, fine_m = self.blurs_m(pair)

        def descended(pair: PairLikelihood, poses: Array, blurs_m: Sequence[float]) -> Array:
            for blur_m in blurs_m:
                poses = pair.descend(poses, blur_m, regulariser, steps=self.steps)
            return poses

        if near is not None:
            return near[None], descended(pair, near[None], [*coarse_m, fine_m])
        wanted = self.starts(pair, prior)
        started = self._drawn(pair, density, min(wanted, self.max_starts), rng)
        if wanted > self.max_starts:
            started = np.concatenate([started, self._from_features(pair, density)])
        poses = descended(replace(pair, colour=None), started, coarse_m)
        turned = self._by_colour(pair, density, prior, poses, rng)
        if len(turned):  # colours decide
            started = np.concatenate([started, turned])
            poses = descended(pair, started, coarse_m)
        return started, descended(pair, poses, [fine_m])

    def _by_colour(
        self,
        pair: PairLikelihood,
        density: AbstractPoseDensity,
        prior: PoseGaussian,
        poses: Array,
        rng: np.random.Generator,
    ) -> Array:
        """Return further starting poses (n, 4, 4) whose colours agree, along motions that surface leaves open.

        Surface leads to one of the poses that it cannot distinguish, such as those of a ball; few of these have
        colours within reach of a descent. Moves along them keep matching surface, so that many can be compared.
        """
        if pair.colour is None:
            return poses[:0]
        coarse_m, surface = float(self.blurs_m(pair)[0]), replace(pair, colour=None)
        best = poses[np.argmax(surface.tempered(poses, self.fine_m(pair), stride=_COARSE_STRIDE))]
        open_motions = self._open_motions(pair, prior, best, coarse_m)
        dimensions = open_motions.shape[1]
        if not dimensions:
            return poses[:0]
        count = max(round(self.turns ** (min(dimensions, 3) / 3.0)), self.min_starts)  # as far apart as on a ball
        moves = rng.normal(size=(count, dimensions)) @ open_motions.T
        moved = se3.moved(np.broadcast_to(best, (count, 4, 4)), moves, pair.centre_m)
        moved = moved[np.isfinite(density.log_prior(moved))]
        colours = pair.scores(moved, coarse_m, stride=_COARSE_STRIDE).colours if len(moved) else np.zeros(0)
        return moved[np.argsort(-colours, kind="stable")[: self.min_starts]]

    def _open_motions(self, pair: PairLikelihood, prior: PoseGaussian, pose: Array, blur_m: float) -> Array:
        """Return motions ξ (6, k) that prior and surface leave open at a pose (4, 4), by one sd of the prior."""
        extent = self.extent(pair)
        covariance = prior.covariance / np.outer(extent, extent)
        levels, axes = np.linalg.eigh(pair.sensitivity(pose, blur_m) * np.outer(extent, extent))
        precision = (axes * np.maximum(levels, 0.0)) @ axes.T + np.linalg.inv(covariance)
        variances, axes = np.linalg.eigh(np.linalg.inv(precision))
        open_axes = axes[:, variances > _OPEN**2]
        root = np.linalg.cholesky(open_axes.T @ covariance @ open_axes)
        return np.asarray(extent[:, None] * (open_axes @ root), dtype=np.float64)

    def _drawn(self, pair: PairLikelihood, density: AbstractPoseDensity, count: int, rng: np.random.Generator) -> Array:
        """Return starting poses (n, 4, 4): samples of the prior that match best at twice the coarsest blur."""
        poses, blur = density.sample(self.proposals * count, rng), self.finest * 2.0**self.stages
        found = replace(pair, colour=None).scores(poses, blur * pair.size_m, stride=_COARSE_STRIDE)
        # A coarse match determines the depth less well than a fine one: each has the weight -log(blur / size).
        matches = np.log(blur) * found.explained * pair.points
        return poses[np.argsort(matches - found.surface, kind="stable")[:count]]

    def _from_features(self, pair: PairLikelihood, density: AbstractPoseDensity) -> Array:
        """Return starting poses (n, 4, 4) from feature matches, no two in a basin, those with most matches first."""
        motions, _ = self.matcher.motions(pair.backward.image, pair.forward.image)
        motions = motions[np.isfinite(density.log_density(motions))] if len(motions) else motions
        kept, remaining = [], np.ones(len(motions), dtype=bool)
        while remaining.any():
            kept.append(int(np.argmax(remaining)))
            distances = se3.difference(motions, motions[kept[-1]], pair.centre_m) / self.extent(pair)
            remaining &= np.linalg.norm(distances, axis=1) > 1.0
        return motions[kept]

    def _nuisance(self, pair: PairLikelihood, poses: Array, *, any_rotation: bool) -> tuple[float, float]:
        """Return the noise b in m and the misfit μ of a typical match at the best of some poses (n, 4, 4).

        b is at least the smallest blur. With less noise, likelihoods of poses that fit equally well would differ by
        chance, and with a larger misfit by their numbers of matches, so that all but one would be dropped. If the
        rotation is open, the views have nothing in common under most motions: matches are evidence, as with μ = ½.
        """
        fine_m = self.fine_m(pair)
        best = poses[np.argmax(pair.tempered(poses, fine_m, stride=_COARSE_STRIDE))]
        blur_m = max(pair.noises_m(best, fine_m)[0], fine_m)
        return blur_m, MISFIT if any_rotation else pair.typical_misfit(best, blur_m)

    def _regulariser(self, pair: PairLikelihood, prior: PoseGaussian) -> Regulariser:
        """Return the regulariser of a descent: the prior's Gaussian, and damping (method, eq. 5.2).

        The likelihood is not tempered in descent, so that the Gaussian approximation of a uniform prior hardly biases
        directions that surface leaves open towards its mean.
        """
        precision = np.asarray(np.linalg.inv(prior.covariance), dtype=np.float64)
        damping = 0.0025 * pair.points / self.extent(pair) ** 2
        return Regulariser(se3.rows(prior.mean), precision, damping, self.basin)

    def _near_support(
        self, pair: PairLikelihood, prior: PoseGaussian, density: AbstractPoseDensity, poses: Array
    ) -> Array:
        """Return the poses (n, 4, 4) outside the prior's support that lie within a basin of it.

        Descent may lead a quarter turn around a carton, where other sides match better than the right ones; this does
        not indicate that the prior's limits exclude the motion.
        """
        if not len(poses):
            return poses
        back = se3.difference(poses, prior.mean, pair.centre_m)
        basins = np.linalg.norm(back / self.extent(pair), axis=1, keepdims=True)
        nearer = se3.moved(poses, back / np.maximum(basins, 1.0), pair.centre_m)
        return poses[np.isfinite(density.log_prior(nearer))]


def _moments(pair: PairLikelihood, density: AbstractPoseDensity, rng: np.random.Generator) -> PoseGaussian:
    """Return mean and covariance of the prior, for ξ about the pair's centre."""
    poses = density.sample(PRIOR_SAMPLES, rng)
    mean, covariance = se3.mean(poses, np.ones(len(poses)), about_m=pair.centre_m, iterations=4)
    return PoseGaussian(mean, covariance + np.diag(np.repeat([1e-4, 1e-5], 3) ** 2))


def _is_open(prior: PoseGaussian) -> bool:
    """Return whether a prior leaves the rotation open."""
    return bool(np.linalg.eigvalsh(prior.covariance[:3, :3])[0] > OPEN_ROTATION_RAD**2)


def _spreads(pair: PairLikelihood, precisions: Array, poses: Array, blur_m: float) -> Array:
    """Return roots (n, 6, 6) of covariances from matching surface and the prior's precisions (n, 6, 6) (eq. 5.3)."""
    precision = pair.curvatures(poses, blur_m, stride=_STRIDE) + precisions
    return np.asarray(np.linalg.cholesky(np.linalg.inv(precision)), dtype=np.float64)
