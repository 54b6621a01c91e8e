"""Where the posterior may have its mass: many starts from the prior, each led downhill to surface that matches."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from modeler import se3
from modeler.kernels import mixture
from modeler.kernels.matching import Regulariser
from modeler.registration.candidates import Candidates
from modeler.registration.climb import Climb
from modeler.registration.pair import PairLikelihood
from modeler.types import AbstractPoseDensity, Array, PoseGaussian


@dataclass(frozen=True)
class Search:
    """Looks for separate modes: the best of many samples of the prior go downhill as point-to-plane ICP does."""

    max_starts: int = 400
    """At most so many motions are led to matching surface."""
    starts_per_basin: float = 3.0
    """With a narrow prior fewer do: so many for each basin from which the way leads to the same place."""
    basin_deg: float = 10.0
    """Standard deviation of a basin in each rotation."""
    basin: float = 0.15
    """Standard deviation of a basin in each translation, as a share of the object's size."""
    proposals_per_start: int = 15
    """Motions drawn from the prior for each that is led on: the best of them."""
    survivors: float = 0.25
    """Share of them that is followed to the end at most."""
    max_per_basin: int = 3
    """At most so many of one basin are, so that a place next to a better one is not lost."""
    min_starts: int = 60
    """At least so many motions are led to matching surface."""
    blurs: tuple[float, ...] = (0.25, 0.12, 0.06, 0.03, 0.015)
    """Blur of the surfaces as shares of the object's size: of the first look, and of each stage of the way down."""
    iterations: int = 4
    """Gauss-Newton steps of each stage."""
    max_step_rad: float = 0.2
    """A step turns the object no further."""
    descent_points: float = 400.0
    """Number of independent measurements that all points are worth on the way down: so many that the Gaussian which
    stands for an even prior hardly draws what matching surface leaves open to the middle."""
    local_points: float = 40.0
    """Likewise around a candidate."""
    effective_points: float = 120.0
    """Most independent measurements that all points are worth when separate places are compared; see
    `PairLikelihood.independent`."""
    negligible: float = 20.0
    """A candidate so many nats below the best is dropped."""
    rescued: int = 6
    """The best of at most so many basins are brought to where they are best before any is dropped,"""
    valley: float = 5.0
    """unless no valley so deep (nats) parts it from the best of all: then it is but a place on the same ridge."""
    reach: float = 0.5
    """Of candidates nearer to each other than so many standard deviations one is kept."""
    ridge_starts: int = 3
    """From so many of the best the ridges are trace_ridges."""
    stride: float = 2.0
    """Length of a walker's stride in standard deviations."""
    max_ridge_steps: int = 10
    """A walker takes at most so many."""
    next_to: float = 1.5
    """What is so many basins beyond the possible is still next to it, and may be where the motion leads;"""
    enough_overlap: float = 0.5
    """what is farther only where no possible place shows so much of the surface that both views should."""
    low_overlap_score: float = -20.0
    """Where the best place is worse than this (nats) even to somewhat blurred views, little surface matches."""
    low_overlap_points: float = 150.0
    """Most independent measurements that all points are worth there, in a place and between places.

    What matching surfaces have in common, the errors of smoothing and of the sensor, counts for little where few match.
    """
    climb: Climb = field(default_factory=Climb)
    """How more places are found there."""

    def thorough(self) -> Search:
        """Return a search that looks four times as hard."""
        return replace(self, max_starts=4 * self.max_starts, starts_per_basin=4 * self.starts_per_basin)

    def candidates(self, pair: PairLikelihood, density: AbstractPoseDensity, rng: np.random.Generator) -> Candidates:
        """Return what was found, best first; always one at least.

        Args:
            pair: the two views.
            density: where to look.
            rng: source of all randomness.
        """
        prior = _gaussian(density.sample(500, rng), pair.centre_m)
        starts = self._starts(prior, pair.size_m)
        poses = density.sample(self.proposals_per_start * starts, rng)
        # Blunt surfaces match easily; that they do counts as much as how much better they tell the depth than a guess.
        plain, share = pair.log_likelihoods(poses, self.blurs[0] * pair.size_m, stride=8)
        look = plain - np.log(self.blurs[0]) * share * pair.points
        poses = poses[_best(look, starts)]
        poses = self._descend(pair, poses, prior, self.blurs[1] * pair.size_m)
        poses = self._survivors(pair, poses, int(self.survivors * starts))
        coarse = self._ranked(pair, density, poses, prior, self.blurs[1] * pair.size_m)
        for blur in self.blurs[2:]:
            poses = self._descend(pair, poses, prior, blur * pair.size_m)
        fine_m = self.blurs[-1] * pair.size_m
        outside = ~np.isfinite(density.log_evidence(poses))
        beyond = poses[outside]
        poses = density.sample(starts, rng) if outside.all() else poses[~outside]
        poses, scores = self._ordered(pair, poses, fine_m)
        rescued = self._rescue(pair, density, poses, scores, rng)
        if len(rescued):
            poses, scores = self._ordered(pair, np.concatenate([poses, rescued]), fine_m)
        sharp = self._kept(pair, poses, scores, prior, fine_m)
        search = self
        if self.scores(pair, sharp.poses[:1], self.blurs[2] * pair.size_m)[0] < self.low_overlap_score:
            search, sharp = self._climb(pair, density, sharp, prior, rng)
        sharp = search._along(pair, density, sharp, prior)
        coarse = replace(coarse, coarse=np.ones(len(coarse), dtype=np.bool_))
        if len(beyond) and pair.overlap(sharp.poses[0]) > self.enough_overlap:
            beyond = self._next_to_possible(pair, density, beyond, prior)
        better = search.scores(pair, beyond, fine_m).max() - sharp.scores[0] if len(beyond) else -np.inf
        return replace(sharp.beside(coarse), beyond=float(better), low_overlap=search is not self)

    def _rescue(
        self, pair: PairLikelihood, density: AbstractPoseDensity, poses: Array, scores: Array, rng: np.random.Generator
    ) -> Array:
        """Return better poses for basins that are about to be dropped, though blurred views do not tell them apart.

        Matching surface leads to the right turn of a stool and leaves it a few millimetres aside, which the outlines of
        its legs do not forgive: before one place is dropped for another, it is brought to where it is best.

        Args:
            pair: the two views.
            density: what is possible.
            poses: (n, 4, 4), best first.
            scores: (n,) how good they are.
            rng: source of all randomness.
        """
        basin = self._basin(pair.size_m)
        heads = mixture.uncrowded(se3.rows(poses), basin, pair.centre_m, 1, self.rescued)
        dropped = heads[scores[heads] < scores[:1] - self.negligible]
        if not len(dropped):
            return poses[:0]
        ways = se3.difference(poses[0], poses[dropped], pair.centre_m)
        shares = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
        along = se3.moved(poses[0], (shares[:, None, None] * ways).reshape(-1, 6), pair.centre_m)
        blurred = self.scores(pair, along, self.blurs[2] * pair.size_m).reshape(len(shares), -1)
        apart = blurred[1:-1].min(axis=0) < np.minimum(blurred[0], blurred[-1]) - self.valley
        chosen = poses[dropped[apart & (blurred[-1] > blurred[0] - 2.0 * self.negligible)]]
        if not len(chosen):
            return chosen
        return self.climb.onward(pair, density, chosen, basin, rng, effective_points=self.effective_points)

    def _climb(
        self,
        pair: PairLikelihood,
        density: AbstractPoseDensity,
        found: Candidates,
        prior: PoseGaussian,
        rng: np.random.Generator,
    ) -> tuple[Search, Candidates]:
        """Return how places are compared, and those of what was found and of what is climbed that are good."""
        fine_m, sparing = self.blurs[-1] * pair.size_m, self._where(low_overlap=True)
        basin = self._basin(pair.size_m)
        climb = self.climb.thinned(self._starts(prior, pair.size_m) / self.max_starts)
        high = climb.places(pair, density, basin, rng, effective_points=self.low_overlap_points)
        poses = np.concatenate([found.poses, high])
        best = sparing._ranked(pair, density, poses, prior, fine_m)
        _, share = pair.log_likelihoods(best.poses[:1], fine_m, stride=2)
        if share[0] < pair.little_overlap:
            return sparing, best
        return self, self._ranked(pair, density, poses, prior, fine_m)

    def onward(
        self,
        pair: PairLikelihood,
        density: AbstractPoseDensity,
        found: Candidates,
        poses: Array,
        rng: np.random.Generator,
    ) -> Candidates:
        """Return what was found, better poses (n, 4, 4) that are possible, and what lies along their ridges."""
        prior, fine_m = _gaussian(density.sample(500, rng), pair.centre_m), self.blurs[-1] * pair.size_m
        search = self._where(low_overlap=found.low_overlap)
        sharp = search._ranked(pair, density, np.concatenate([poses, found.poses[~found.coarse]]), prior, fine_m)
        along = search._along(pair, density, sharp, prior)
        return replace(along.beside(found.some(found.coarse)), low_overlap=found.low_overlap)

    def _where(self, *, low_overlap: bool) -> Search:
        """Return how places are compared where little surface matches, or enough."""
        return replace(self, effective_points=self.low_overlap_points) if low_overlap else self

    def _along(
        self, pair: PairLikelihood, density: AbstractPoseDensity, found: Candidates, prior: PoseGaussian
    ) -> Candidates:
        """Return candidates and what lies along their ridges, best first."""
        poses = np.concatenate([found.poses, self._trace_ridges(pair, found, prior)])
        return self._ranked(pair, density, poses, prior, self.blurs[-1] * pair.size_m)

    def _survivors(self, pair: PairLikelihood, poses: Array, most: int) -> Array:
        """Return the best of poses (n, 4, 4), but of each basin no more than a few."""
        ordered = poses[np.argsort(-self.scores(pair, poses, self.blurs[1] * pair.size_m), kind="stable")]
        basin = self._basin(pair.size_m)
        return ordered[mixture.uncrowded(se3.rows(ordered), basin, pair.centre_m, self.max_per_basin, most)]

    def _trace_ridges(self, pair: PairLikelihood, found: Candidates, prior: PoseGaussian) -> Array:
        """Return poses (n, 4, 4) along the ridges through the best candidates.

        Downhill from anywhere on the ridge of a can's spin, the noise of normals leads to the same few points of it.
        From the best of them the way goes out both ways along the least determined direction, and down only across it.
        """
        best = found.some(np.arange(min(self.ridge_starts, len(found))))
        scaled = best.spreads / self._basin(pair.size_m)[:, None]
        axes = np.linalg.eigh(scaled.transpose(0, 2, 1) @ scaled)[1][:, :, -1]  # in units of each one's own spread
        return pair.trace_ridges(
            np.concatenate([best.poses, best.poses]),
            np.concatenate([best.spreads, best.spreads]),
            np.concatenate([axes, -axes]),
            blur_m=self.blurs[-1] * pair.size_m,
            regulariser=self._regulariser(pair, prior),
            effective_points=self.effective_points,
            floor=found.scores[0] - self.negligible,
            stride=self.stride,
            max_ridge_steps=self.max_ridge_steps,
        )

    def _starts(self, prior: PoseGaussian, size_m: float) -> int:
        """Return how many starts a prior is worth."""
        basin = self._basin(size_m)
        variances = np.linalg.eigvalsh(prior.covariance / np.outer(basin, basin))
        basins = np.sqrt(np.prod(np.maximum(variances, 1.0)))
        return int(np.clip(self.starts_per_basin * basins, self.min_starts, self.max_starts))

    def _basin(self, size_m: float) -> Array:
        """Return the standard deviations (6,) of a basin."""
        return np.repeat([np.deg2rad(self.basin_deg), self.basin * size_m], 3)

    def _ranked(
        self, pair: PairLikelihood, density: AbstractPoseDensity, poses: Array, prior: PoseGaussian, blur_m: float
    ) -> Candidates:
        """Return those of some poses (n, 4, 4) that are possible, good and distinct, best first."""
        ordered, scores = self._ordered(pair, poses[np.isfinite(density.log_evidence(poses))], blur_m)
        return self._kept(pair, ordered, scores, prior, blur_m)

    def _ordered(self, pair: PairLikelihood, poses: Array, blur_m: float) -> tuple[Array, Array]:
        """Return poses (n, 4, 4) and their scores (n,), best first."""
        scores = self.scores(pair, poses, blur_m)
        order = np.argsort(-scores, kind="stable")
        return poses[order], scores[order]

    def _kept(
        self, pair: PairLikelihood, poses: Array, scores: Array, prior: PoseGaussian, blur_m: float
    ) -> Candidates:
        """Return those of some poses (n, 4, 4) with scores (n,), best first, that are good and distinct."""
        good = scores > scores[:1] - self.negligible
        poses, scores = poses[good], scores[good]
        _, matrices = pair.normal_equations(poses, blur_m, stride=2)
        weight = self.local_points / pair.points
        spreads = np.linalg.cholesky(np.linalg.inv(weight * matrices + np.linalg.inv(prior.covariance)))
        found = Candidates(poses, scores, np.asarray(spreads, dtype=np.float64), np.zeros(len(poses), dtype=np.bool_))
        return found.distinct(pair.centre_m, self.reach)

    def scores(self, pair: PairLikelihood, poses: Array, blur_m: float) -> Array:
        """Return how good (n,) places are beside each other (nats)."""
        return pair.tempered(poses, blur_m, effective_points=self.effective_points)

    def _descend(self, pair: PairLikelihood, poses: Array, prior: PoseGaussian, blur_m: float) -> Array:
        """Return motions led downhill on matching surface, held by what the prior says of them."""
        return pair.descend(poses, blur_m, self._regulariser(pair, prior), steps=self.iterations, stride=4)

    def _next_to_possible(
        self, pair: PairLikelihood, density: AbstractPoseDensity, poses: Array, prior: PoseGaussian
    ) -> Array:
        """Return those of poses (n, 4, 4) beyond what is possible that are not far beyond.

        Surface leads a quarter turn round a carton, where other sides of it may match better than the right ones; that
        is no sign that limits cut off the motion.
        """
        back = se3.difference(poses, prior.mean, pair.centre_m)
        basins = np.linalg.norm(back / self._basin(pair.size_m), axis=1, keepdims=True)
        nearer = se3.moved(poses, back * np.minimum(self.next_to / np.maximum(basins, 1e-12), 1.0), pair.centre_m)
        return poses[np.isfinite(density.log_evidence(nearer))]

    def _regulariser(self, pair: PairLikelihood, prior: PoseGaussian) -> Regulariser:
        """Return what holds motions on their way down: the prior, and some damping."""
        hold = np.asarray(np.linalg.inv(self.descent_points / pair.points * prior.covariance), dtype=np.float64)
        damping = np.repeat([1.0 / self.max_step_rad, 1.0 / (self.max_step_rad * pair.size_m)], 3) ** 2
        return Regulariser(se3.rows(prior.mean), hold, 0.0025 * pair.points * damping, self.max_step_rad)


def _gaussian(poses: Array, centre_m: Array) -> PoseGaussian:
    """Return the mean of poses, and the covariance of ξ about it at the centre."""
    mean, covariance = se3.mean(poses, np.ones(len(poses)), about_m=centre_m, iterations=4)
    return PoseGaussian(mean, covariance + np.diag(np.repeat([1e-4, 1e-5], 3) ** 2))


def _best(scores: Array, count: int) -> np.ndarray:
    """Return the numbers of the highest scores, at most `count`, in their order of arrival."""
    return np.sort(np.argsort(-scores, kind="stable")[:count])
