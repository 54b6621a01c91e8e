"""Search for modes of the posterior: descent from many samples of the prior, climb and ridge tracing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.kernels import mixture
from modeler.kernels.point_to_plane import Regulariser
from modeler.registration.visibility.candidates import Candidates, Problem
from modeler.registration.visibility.likelihood import PairLikelihood
from modeler.types import AbstractPoseDensity, Array, PoseGaussian

_PRIOR_SAMPLES = 500


@dataclass(frozen=True)
class Starts:
    """Starting poses: the best of many samples of the prior (method.md, eq. 9)."""

    max_starts: int = 400
    min_starts: int = 60
    per_basin: float = 3.0
    """Starts for each basin that the prior covers."""
    basin_deg: float = 10.0
    """Standard deviation of a basin in each rotation."""
    basin: float = 0.15
    """Standard deviation of a basin in each translation, as a share of the object's size."""
    proposals_per_start: int = 15
    """Samples of the prior for each start."""

    def problem(self, pair: PairLikelihood, density: AbstractPoseDensity, rng: np.random.Generator) -> Problem:
        """Return what is searched, with moments of the prior from its samples."""
        poses = density.sample(_PRIOR_SAMPLES, rng)
        mean, covariance = se3.mean(poses, np.ones(len(poses)), about_m=pair.centre_m, iterations=4)
        gaussian = PoseGaussian(mean, covariance + np.diag(np.repeat([1e-4, 1e-5], 3) ** 2))
        return Problem(pair, density, gaussian, np.repeat([np.deg2rad(self.basin_deg), self.basin * pair.size_m], 3))

    def count(self, problem: Problem) -> int:
        """Return the number of starts for the width of the prior."""
        variances = np.linalg.eigvalsh(problem.gaussian.covariance / np.outer(problem.basin, problem.basin))
        basins = np.sqrt(np.prod(np.maximum(variances, 1.0)))
        return int(np.clip(self.per_basin * basins, self.min_starts, self.max_starts))

    def draw(self, problem: Problem, blur: float, rng: np.random.Generator) -> Array:
        """Return starting poses (n, 4, 4), in the order in which they were drawn, by their match at a coarse blur."""
        pair, count = problem.pair, self.count(problem)
        poses = problem.density.sample(self.proposals_per_start * count, rng)
        plain, share = pair.log_likelihoods(poses, blur * pair.size_m, stride=8)
        # Coarse surface matches easily: a match counts as the range that it determines, relative to a guess.
        scores = plain - np.log(blur) * share * pair.points
        return poses[np.sort(np.argsort(-scores, kind="stable")[:count])]


@dataclass(frozen=True)
class Descent:
    """Damped Gauss-Newton steps on matching surface, regularised by the prior (method.md, eq. 10)."""

    iterations: int = 4
    """Steps at each blur."""
    max_step_rad: float = 0.2
    """Largest rotation of a step."""
    max_independent: float = 400.0
    """Independent measurements in all points: large, so that the Gaussian approximation of a uniform prior hardly pulls
    directions that matching surface leaves open towards its mean."""
    survivors: float = 0.25
    """Largest share of the starts that goes on after the first blur."""

    def run(self, problem: Problem, poses: Array, blur_m: float) -> Array:
        """Return poses (n, 4, 4) after their descent."""
        return problem.pair.descend(poses, blur_m, self.regulariser(problem), steps=self.iterations)

    def regulariser(self, problem: Problem) -> Regulariser:
        """Return the regulariser of a descent: the prior's Gaussian, and damping."""
        pair, prior = problem.pair, problem.gaussian
        precision = np.asarray(np.linalg.inv(self.max_independent / pair.points * prior.covariance), dtype=np.float64)
        damping = np.repeat([1.0 / self.max_step_rad, 1.0 / (self.max_step_rad * pair.size_m)], 3) ** 2
        return Regulariser(se3.rows(prior.mean), precision, 0.0025 * pair.points * damping, self.max_step_rad)


@dataclass(frozen=True)
class Stage:
    """One stage of a climb."""

    blur: float
    """Blur of the surfaces, as a share of the object's size."""
    stride: int
    """Every `stride`-th point is used."""
    climbers: int
    """Largest number of climbers that go on from here."""

    def scaled(self, share: float) -> Stage:
        """Return the stage with a share (0..1) of the climbers."""
        return replace(self, climbers=int(np.ceil(share * self.climbers)))


@dataclass(frozen=True)
class Climb:
    """Ascent of the likelihood itself by a (1 + λ) evolution strategy (Rechenberg 1973), coarse to fine.

    Descent leads to where most surface matches. Where two views share little, empty space says more, and hardly any
    surface leads to the truth. Trial steps are drawn as wide as matching surface leaves each direction open, so that
    climbers move along a contact rather than into it. Steps grow after a success and shrink after a failure.
    """

    samples: int = 10_000
    """Samples of the prior."""
    first: Stage = Stage(0.25, 8, 1000)
    """How they are scored."""
    stages: tuple[Stage, ...] = (Stage(0.12, 8, 500), Stage(0.06, 4, 150), Stage(0.03, 2, 60), Stage(0.015, 2, 40))
    apart: float = 0.4
    """Of climbers within this many standard deviations of a basin, only the highest goes on."""
    rounds: int = 10
    """Steps of each climber at each stage."""
    trials: int = 6
    """Trial steps for each step: λ."""
    max_independent: float = 40.0
    """Independent measurements in all points, for the width of the steps."""
    step: float = 0.7
    """Length of the first steps, in standard deviations."""
    growth: float = 1.2
    """Factor of the step length after a success."""
    decay: float = 0.8
    """Factor of the step length after a failure."""

    def scaled(self, share: float) -> Climb:
        """Return a climb with a share (0..1) of the samples and climbers, for a narrower prior."""
        return replace(
            self,
            samples=int(np.ceil(share * self.samples)),
            first=self.first.scaled(share),
            stages=tuple(stage.scaled(share) for stage in self.stages),
        )

    def run(self, problem: Problem, rng: np.random.Generator, *, max_independent: float) -> Array:
        """Return the poses (n, 4, 4) reached from samples of the prior, the highest first.

        Args:
            problem: what is searched.
            rng: source of all randomness.
            max_independent: of the likelihood that is climbed, see `PairLikelihood.independent_points`.
        """
        poses, stage = problem.density.sample(self.samples, rng), self.first
        height = partial(_height, problem, max_independent)
        for following in self.stages:
            poses = self._survivors(problem, poses, height(stage, poses), stage.climbers)
            stage = following
            poses = self._ascend(problem, poses, stage, partial(height, stage), rng)
        return self._survivors(problem, poses, height(stage, poses), stage.climbers)

    def _survivors(self, problem: Problem, poses: Array, heights: Array, most: int) -> Array:
        """Return the highest of poses (n, 4, 4), one of each neighbourhood."""
        ordered = poses[np.argsort(-heights, kind="stable")]
        near = self.apart * problem.basin
        return ordered[mixture.suppress_neighbours(se3.rows(ordered), near, problem.pair.centre_m, 1, most)]

    def _ascend(
        self,
        problem: Problem,
        poses: Array,
        stage: Stage,
        height: Callable[[Array], Array],
        rng: np.random.Generator,
    ) -> Array:
        """Return the poses (n, 4, 4) reached in one stage."""
        pair = problem.pair
        spreads = problem.spreads(poses, stage.blur * pair.size_m, self.max_independent, np.diag(problem.basin**-2.0))
        count, poses, heights = len(poses), poses.copy(), height(poses)
        step, everyone = np.full(count, self.step), np.arange(count)
        for _ in range(self.rounds):
            draws = rng.normal(size=(count, self.trials, 6, 1)) * step[:, None, None, None]
            xi = (spreads[:, None] @ draws).reshape(-1, 6)
            tried = se3.moved(np.repeat(poses, self.trials, axis=0), xi, pair.centre_m)
            reached = height(tried).reshape(count, self.trials)
            best = np.argmax(reached, axis=1)
            higher: npt.NDArray[np.bool_] = reached[everyone, best] > heights
            poses[higher] = tried.reshape(count, self.trials, 4, 4)[everyone, best][higher]
            heights = np.maximum(heights, reached[everyone, best])
            step *= np.where(higher, self.growth, self.decay)
        return poses


def _height(problem: Problem, max_independent: float, stage: Stage, poses: Array) -> Array:
    """Return tempered log-likelihoods (n,) of poses (n, 4, 4); -inf outside the prior's support."""
    heights, possible = np.full(len(poses), -np.inf), problem.possible(poses)
    if possible.any():
        heights[possible] = problem.pair.tempered(
            poses[possible], stage.blur * problem.pair.size_m, max_independent=max_independent, stride=stage.stride
        )
    return heights


@dataclass(frozen=True)
class RidgeTracing:
    """Traces ridges of the likelihood from the best candidates, in both directions of the least determined axis.

    Descent from anywhere on the ridge of a can's spin ends at the same few points of it, where noise of normals leads.
    """

    starts: int = 3
    """Number of candidates from which ridges are traced."""
    step: float = 2.0
    """Length of a step in standard deviations."""
    max_steps: int = 10
    """Largest number of steps in each direction."""

    def run(
        self,
        problem: Problem,
        found: Candidates,
        regulariser: Regulariser,
        *,
        blur_m: float,
        max_independent: float,
        negligible: float,
    ) -> Array:
        """Return poses (n, 4, 4) along the ridges through the best candidates, as far as they are not negligible."""
        best = found.select(np.arange(min(self.starts, len(found))))
        scaled = best.spreads / problem.basin[:, None]
        axes = np.linalg.eigh(scaled.transpose(0, 2, 1) @ scaled)[1][:, :, -1]  # in units of each one's own spread
        return problem.pair.trace_ridges(
            np.concatenate([best.poses, best.poses]),
            np.concatenate([best.spreads, best.spreads]),
            np.concatenate([axes, -axes]),
            blur_m=blur_m,
            regulariser=regulariser,
            max_independent=max_independent,
            floor=found.scores[0] - negligible,
            step=self.step,
            max_steps=self.max_steps,
        )


@dataclass(frozen=True)
class LowOverlap:
    """When so little surface matches that the likelihood is climbed, and how candidates are scored there."""

    score: float = -20.0
    """The best candidate scores less than this (nats) at an intermediate blur."""
    max_independent: float = 150.0
    """Independent measurements in all points: errors common to matches count for little where few points match."""
    climb: Climb = field(default_factory=Climb)


@dataclass(frozen=True)
class Beyond:
    """Which poses beyond the prior's support are a sign that the prior's limits exclude the motion."""

    near: float = 1.5
    """Those this many basins beyond the support at most,"""
    enough_overlap: float = 0.5
    """where the best pose inside shows more of the surface than this; else all."""

    def signs(self, problem: Problem, poses: Array, best: Array) -> Array:
        """Return those of poses (n, 4, 4) outside the support; `best` (4, 4) is the best inside.

        Surface leads a quarter turn round a carton, where other sides of it may match better than the right ones; that
        is no sign that the limits exclude the motion.
        """
        pair = problem.pair
        if not (len(poses) and pair.overlap(best) > self.enough_overlap):
            return poses
        back = se3.difference(poses, problem.gaussian.mean, pair.centre_m)
        basins = np.linalg.norm(back / problem.basin, axis=1, keepdims=True)
        nearer = se3.moved(poses, back * np.minimum(self.near / np.maximum(basins, 1e-12), 1.0), pair.centre_m)
        return poses[problem.possible(nearer)]


@dataclass(frozen=True)
class Search:
    """Finds candidates for the modes of a posterior, coarse to fine (method.md, "Search")."""

    blurs: tuple[float, ...] = (0.25, 0.12, 0.06, 0.03, 0.015)
    """Blur of the surfaces as shares of the object's size: of the starts, and of each stage of the descent."""
    max_independent: float = 120.0
    """Independent measurements in all points, for scores; see `PairLikelihood.independent_points`."""
    local_independent: float = 40.0
    """Independent measurements in all points, for the spread of a candidate."""
    negligible: float = 20.0
    """A candidate this many nats below the best is dropped."""
    reach: float = 0.5
    """Of candidates nearer to each other than this many standard deviations one is kept."""
    starts: Starts = field(default_factory=Starts)
    descent: Descent = field(default_factory=Descent)
    low_overlap: LowOverlap = field(default_factory=LowOverlap)
    ridges: RidgeTracing = field(default_factory=RidgeTracing)
    beyond: Beyond = field(default_factory=Beyond)

    def scaled(self, effort: float) -> Search:
        """Return a search with `effort` times the starts."""
        starts = replace(
            self.starts,
            max_starts=int(effort * self.starts.max_starts),
            per_basin=effort * self.starts.per_basin,
        )
        return replace(self, starts=starts)

    def fine_m(self, pair: PairLikelihood) -> float:
        """Return the smallest blur in m."""
        return self.blurs[-1] * pair.size_m

    def run(self, pair: PairLikelihood, density: AbstractPoseDensity, rng: np.random.Generator) -> Candidates:
        """Return candidates, best first; always one at least.

        Args:
            pair: the two views.
            density: the prior.
            rng: source of all randomness.
        """
        problem, fine_m = self.starts.problem(pair, density, rng), self.fine_m(pair)
        _, coarse_m, middle_m, *_ = (blur * pair.size_m for blur in self.blurs)
        poses = self.starts.draw(problem, self.blurs[0], rng)
        poses = self.descent.run(problem, poses, coarse_m)
        poses = self._survivors(problem, poses, coarse_m)
        for blur in self.blurs[2:]:
            poses = self.descent.run(problem, poses, blur * pair.size_m)
        inside = problem.possible(poses)
        outside = poses[~inside]
        poses = poses[inside] if inside.any() else density.sample(self.starts.count(problem), rng)
        fine = self._ranked(problem, poses, fine_m)
        search, low_overlap = self, False
        if self.scores(pair, fine.poses[:1], middle_m)[0] < self.low_overlap.score:
            fine, low_overlap = self._climbed(problem, fine, rng)
            search = self._for_overlap(low_overlap=low_overlap)
        fine = search._with_ridges(problem, fine)
        outside = self.beyond.signs(problem, outside, fine.poses[0])
        gain = search.scores(pair, outside, fine_m).max() - fine.scores[0] if len(outside) else -np.inf
        return replace(fine, beyond_gain=float(gain), low_overlap=low_overlap)

    def scores(self, pair: PairLikelihood, poses: Array, blur_m: float) -> Array:
        """Return the scores (n,) of poses (n, 4, 4): tempered log-likelihoods (nats)."""
        return pair.tempered(poses, blur_m, max_independent=self.max_independent)

    def _survivors(self, problem: Problem, poses: Array, blur_m: float) -> Array:
        """Return the best of poses (n, 4, 4)."""
        ordered, _ = self._ordered(problem.pair, poses, blur_m)
        return ordered[: int(self.descent.survivors * len(poses))]

    def _climbed(self, problem: Problem, found: Candidates, rng: np.random.Generator) -> tuple[Candidates, bool]:
        """Return the best of what descent and a climb found, and whether even then little surface matches."""
        pair, low = problem.pair, self.low_overlap
        climb = low.climb.scaled(self.starts.count(problem) / self.starts.max_starts)
        high = climb.run(problem, rng, max_independent=low.max_independent)
        poses, fine_m = np.concatenate([found.poses, high]), self.fine_m(pair)
        best = self._for_overlap(low_overlap=True)._ranked(problem, poses, fine_m)
        _, share = pair.log_likelihoods(best.poses[:1], fine_m, stride=2)
        if share[0] < pair.overlap_scale:
            return best, True
        return self._ranked(problem, poses, fine_m), False

    def _for_overlap(self, *, low_overlap: bool) -> Search:
        """Return the search with the scores for little matching surface, or for enough."""
        return replace(self, max_independent=self.low_overlap.max_independent) if low_overlap else self

    def _with_ridges(self, problem: Problem, found: Candidates) -> Candidates:
        """Return candidates and those along their ridges, best first."""
        fine_m = self.fine_m(problem.pair)
        along = self.ridges.run(
            problem,
            found,
            self.descent.regulariser(problem),
            blur_m=fine_m,
            max_independent=self.max_independent,
            negligible=self.negligible,
        )
        return self._ranked(problem, np.concatenate([found.poses, along]), fine_m)

    def _ranked(self, problem: Problem, poses: Array, blur_m: float) -> Candidates:
        """Return those of poses (n, 4, 4) that are possible, good and distinct, best first."""
        return self._selected(problem, *self._ordered(problem.pair, poses[problem.possible(poses)], blur_m), blur_m)

    def _ordered(self, pair: PairLikelihood, poses: Array, blur_m: float) -> tuple[Array, Array]:
        """Return poses (n, 4, 4) and their scores (n,), best first."""
        scores = self.scores(pair, poses, blur_m)
        order = np.argsort(-scores, kind="stable")
        return poses[order], scores[order]

    def _selected(self, problem: Problem, poses: Array, scores: Array, blur_m: float) -> Candidates:
        """Return those of ordered poses (n, 4, 4) with scores (n,) that are good and distinct."""
        good = scores > scores[:1] - self.negligible
        poses, scores = poses[good], scores[good]
        precision = np.asarray(np.linalg.inv(problem.gaussian.covariance), dtype=np.float64)
        spreads = problem.spreads(poses, blur_m, self.local_independent, precision)
        return Candidates(poses, scores, spreads).distinct(problem.pair.centre_m, self.reach)
