"""Search for modes of the posterior: descent from many samples of the prior."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from modeler import se3
from modeler.kernels.point_to_plane import Regulariser
from modeler.registration.visibility.candidates import Candidates, Problem
from modeler.registration.visibility.likelihood import PairLikelihood
from modeler.types import AbstractPoseDensity, Array, PoseGaussian

_PRIOR_SAMPLES = 500


@dataclass(frozen=True)
class Starts:
    """Starting poses: samples of the prior (method.md, eq. 9)."""

    max_starts: int = 400
    min_starts: int = 60
    per_basin: float = 3.0
    """Starts for each basin that the prior covers."""
    basin_deg: float = 10.0
    """Standard deviation of a basin in each rotation."""
    basin: float = 0.15
    """Standard deviation of a basin in each translation, as a share of the object's size."""

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


@dataclass(frozen=True)
class Descent:
    """Damped Gauss-Newton steps on matching surface, regularised by the prior (method.md, eq. 10)."""

    iterations: int = 4
    """Steps at each blur."""
    max_step_rad: float = 0.2
    """Largest rotation of a step."""

    def run(self, problem: Problem, poses: Array, blur_m: float) -> Array:
        """Return poses (n, 4, 4) after their descent."""
        return problem.pair.descend(poses, blur_m, self.regulariser(problem), steps=self.iterations)

    def regulariser(self, problem: Problem) -> Regulariser:
        """Return the regulariser of a descent: the prior's Gaussian, and damping.

        Matching surface is not tempered there, so that the Gaussian approximation of a uniform prior hardly pulls
        directions that surface leaves open towards its mean.
        """
        pair, prior = problem.pair, problem.gaussian
        precision = np.asarray(np.linalg.inv(prior.covariance), dtype=np.float64)
        damping = np.repeat([1.0 / self.max_step_rad, 1.0 / (self.max_step_rad * pair.size_m)], 3) ** 2
        return Regulariser(se3.rows(prior.mean), precision, 0.0025 * pair.points * damping, self.max_step_rad)


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

    blurs: tuple[float, ...] = (0.12, 0.06, 0.03, 0.015)
    """Blur of the surfaces in each stage of the descent, as shares of the object's size."""
    negligible: float = 20.0
    """A candidate this many nats below the best is dropped."""
    starts: Starts = field(default_factory=Starts)
    descent: Descent = field(default_factory=Descent)
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
        poses = density.sample(self.starts.count(problem), rng)
        for blur in self.blurs:
            poses = self.descent.run(problem, poses, blur * pair.size_m)
        inside = problem.possible(poses)
        outside = poses[~inside]
        poses = poses[inside] if inside.any() else density.sample(self.starts.count(problem), rng)
        fine = self._ranked(problem, poses, fine_m)
        outside = self.beyond.signs(problem, outside, fine.poses[0])
        gain = pair.tempered(outside, fine_m).max() - fine.scores[0] if len(outside) else -np.inf
        return replace(fine, beyond_gain=float(gain))

    def _ranked(self, problem: Problem, poses: Array, blur_m: float) -> Candidates:
        """Return those of poses (n, 4, 4) that are not negligible, best first."""
        scores = problem.pair.tempered(poses, blur_m)
        order = np.argsort(-scores, kind="stable")
        order = order[scores[order] > scores.max() - self.negligible]
        return Candidates(poses[order], scores[order], problem.spreads(poses[order], blur_m))
