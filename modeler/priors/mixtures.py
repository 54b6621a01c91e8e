"""Building blocks of priors: Gaussians, kernel mixtures and defensive mixtures on SE(3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import i0e, i1e

from modeler import se3
from modeler.significance import UNLIKELY
from modeler.types import AbstractPoseDensity, Array, RayImage
from modeler.types.base import check_covariance

NODES = 4097  # of a tabulated distribution function: a thousand times finer than a standard deviation
_OVERLAP_SAMPLES = 4096  # by which the fraction of a proposal's mass within the support is estimated


def directions(count: int, rng: np.random.Generator) -> Array:
    """Draw unit vectors (count, 3) uniformly over the sphere."""
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def directions_about(axis: Array, concentration: Array | float, count: int, rng: np.random.Generator) -> Array:
    """Draw unit vectors (count, 3) from a von Mises-Fisher distribution about a mean direction (3,).

    Args:
        axis: (3,) unit.
        concentration: κ > 0, scalar or (count,): the density is proportional to exp(κ cos).
        count: number of vectors.
        rng: source of all randomness.
    """
    cosine = 1.0 + np.log1p(rng.random(count) * np.expm1(-2.0 * concentration)) / concentration
    bearing = rng.uniform(0.0, 2.0 * np.pi, count)
    across = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    local = np.stack([across * np.cos(bearing), across * np.sin(bearing), cosine], axis=1)
    return local @ np.vstack([across_axis(axis), axis])


def across_axis(axis: Array) -> Array:
    """Return two unit vectors (2, 3) orthogonal to a unit axis (3,) and to each other, right-handed with it."""
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first = np.asarray(first / np.linalg.norm(first), dtype=np.float64)
    return np.array([first, np.cross(axis, first)], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Gaussian(AbstractPoseDensity):
    """A Gaussian in the rotation, `mean` · exp(ω), and in the position of a point: (ω, p - mean p) ~ N(0, C)."""

    mean: Array
    """(4, 4) target_from_source."""
    covariance: Array
    """(6, 6) of the rotation vector in rad, then of the point's position in m, in target coordinates."""
    centre_m: Array
    """(3,) the point, in source coordinates."""

    def __post_init__(self) -> None:
        """Check the covariance."""
        check_covariance("the covariance of a Gaussian", self.covariance)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        deviation = rng.normal(size=(count, 6)) @ self._root.T
        poses = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
        turn = se3.exp(np.concatenate([deviation[:, :3], np.zeros((count, 3))], axis=1))
        poses[:, :3, :3] = self.mean[:3, :3] @ turn[:, :3, :3]
        poses[:, :3, 3] = self._place_m + deviation[:, 3:] - poses[:, :3, :3] @ self.centre_m
        return poses

    def log_density(self, target_from_source: Array) -> Array:
        deviation = self.deviations(target_from_source)
        whitened = np.asarray(np.linalg.solve(self._root, deviation.T), dtype=np.float64)
        half_rad = 0.5 * np.sqrt(np.sum(deviation[:, :3] ** 2, axis=1))
        # The uniform measure of rotations is (sin(θ/2) / (θ/2))² dω.
        measure = 2.0 * np.log(np.sinc(half_rad / np.pi))
        log_density = -0.5 * np.sum(whitened**2, axis=0) - measure - self._log_volume
        return np.asarray(log_density, dtype=np.float64)

    def deviations(self, target_from_source: Array) -> Array:
        """Return rotation vectors and position offsets (n, 6) of poses (n, 4, 4) from the mean."""
        turn = np.broadcast_to(np.eye(4), target_from_source.shape).copy()
        turn[:, :3, :3] = self.mean[:3, :3].T @ target_from_source[:, :3, :3]
        place_m = target_from_source[:, :3, :3] @ self.centre_m + target_from_source[:, :3, 3]
        return np.concatenate([se3.log(turn)[:, :3], place_m - self._place_m], axis=1)

    @cached_property
    def _root(self) -> Array:
        return np.asarray(np.linalg.cholesky(self.covariance), dtype=np.float64)

    @cached_property
    def _place_m(self) -> Array:
        return self.mean[:3, :3] @ self.centre_m + self.mean[:3, 3]

    @cached_property
    def _log_volume(self) -> float:
        return float(3.0 * np.log(2.0 * np.pi) + np.sum(np.log(np.diag(self._root))))


def fitted(motions: Array, weights: Array, centre_m: Array, spread: float = 1.0) -> Gaussian:
    """Return the Gaussian fitted to weighted poses (n, 4, 4), its standard deviations scaled by `spread`.

    Args:
        motions: (n, 4, 4).
        weights: (n,), summing to 1.
        centre_m: (3,) point of the source whose position is described.
        spread: more than 1 for a proposal with heavier tails.
    """
    mean, _ = se3.mean(motions, weights, about_m=centre_m)
    deviation = Gaussian(mean, np.eye(6), centre_m).deviations(motions)
    offset = weights @ deviation
    mean[:3, 3] += offset[3:]
    deviation -= np.concatenate([np.zeros(3), offset[3:]])
    covariance = (weights[:, None] * deviation).T @ deviation
    floor = np.diag(np.repeat([1e-5, 1e-6], 3) ** 2)
    return Gaussian(mean, spread**2 * (covariance + floor), centre_m)


@dataclass(frozen=True, eq=False)
class KernelMixture(AbstractPoseDensity):
    """A mixture of isotropic kernels: matrix Fisher in the rotation, Gaussian in the position of a point.

    The kernel exp(κ (cos θ - 1)), κ = 1/σ², has the integral 8π² e⁻ᵏ (I₀(κ) - I₁(κ)) over rotations. Its exponent is
    linear in the rotation matrix, so that many components cost little.
    """

    means: Array
    """(k, 4, 4) target_from_source, the centres of the kernels."""
    weights: Array
    """(k,) weights, summing to 1."""
    centre_m: Array
    """(3,) the point of the source whose position the Gaussian describes, such as the object's centroid."""
    sigma_rad: float
    """Standard deviation of the rotation, about each axis."""
    sigma_m: float
    """Standard deviation of the point's position, along each axis."""
    evidence: bool = True

    @classmethod
    def about(cls, motion: Array, source: RayImage, sigma_rad: float, sigma_m: float) -> KernelMixture:
        """Return a proposal about one motion (4, 4) of a source view, or about several (n, 4, 4) alike."""
        means = motion.reshape(-1, 4, 4)
        weights = np.full(len(means), 1.0 / len(means))
        return cls(means, weights, source.centroid_m, sigma_rad, sigma_m, evidence=False)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        middles = self.means[rng.choice(len(self.weights), count, p=self.weights)]
        angles, cumulative = self._angles
        angle_rad = np.interp(rng.random(count), cumulative, angles)
        vectors = np.concatenate([angle_rad[:, None] * directions(count, rng), np.zeros((count, 3))], axis=1)
        poses = middles.copy()
        poses[:, :3, :3] = middles[:, :3, :3] @ se3.exp(vectors)[:, :3, :3]
        place_m = middles[:, :3, :3] @ self.centre_m + middles[:, :3, 3] + rng.normal(0.0, self.sigma_m, (count, 3))
        poses[:, :3, 3] = place_m - poses[:, :3, :3] @ self.centre_m
        return poses

    def log_density(self, target_from_source: Array) -> Array:
        rotations, places_m = self._flat(target_from_source)
        middle_rotations, middle_places_m = self._flat(self.means)
        # 2 (cos θ - 1) = trace(R_middleᵀ R) - 3, and the trace is a sum over elements.
        exponents = 0.5 * self._concentration * (rotations @ middle_rotations.T - 3.0)
        exponents -= (0.5 / self.sigma_m**2) * (
            np.sum(places_m**2, axis=1)[:, None]
            - 2.0 * places_m @ middle_places_m.T
            + np.sum(middle_places_m**2, axis=1)
        )
        exponents += np.log(self.weights)
        top = exponents.max(axis=1)
        return top + np.log(np.sum(np.exp(exponents - top[:, None]), axis=1)) - self._log_volume

    def _flat(self, motions: Array) -> tuple[Array, Array]:
        """Return rotations (n, 9), and the positions (n, 3) of the point relative to their mean over the kernels."""
        places_m = motions[:, :3, :3] @ self.centre_m + motions[:, :3, 3]
        # Relative to the mean, so that squares of large coordinates do not cancel.
        return motions[:, :3, :3].reshape(len(motions), 9), places_m - self._middle_m

    @cached_property
    def _middle_m(self) -> Array:
        return np.mean(self.means[:, :3, :3] @ self.centre_m + self.means[:, :3, 3], axis=0)

    @property
    def _concentration(self) -> float:
        return self.sigma_rad**-2.0

    @cached_property
    def _log_volume(self) -> float:
        rotations = 8.0 * np.pi**2 * (i0e(self._concentration) - i1e(self._concentration))
        return float(np.log(rotations) + 1.5 * np.log(2.0 * np.pi * self.sigma_m**2))

    @cached_property
    def _angles(self) -> tuple[Array, Array]:
        """Angles (m,) of the kernel's rotations, and their distribution function (m,)."""
        angles = np.linspace(0.0, min(np.pi, 10.0 * self.sigma_rad), NODES)
        fall = 2.0 * np.sin(0.5 * angles) ** 2  # 1 - cos θ, without cancellation
        density = fall * np.exp(-self._concentration * fall)
        cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
        return angles, cumulative / cumulative[-1]


@dataclass(frozen=True, eq=False)
class Alternatives(AbstractPoseDensity):
    """A mixture of alternatives, exactly one of which is true; all of it is evidence."""

    densities: tuple[AbstractPoseDensity, ...]
    """The alternatives, each evidence."""
    probabilities: Array
    """(k,) of each, positive, summing to 1."""

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        chosen = rng.choice(len(self.densities), count, p=self.probabilities)
        poses = np.empty((count, 4, 4))
        for number, density in enumerate(self.densities):
            poses[chosen == number] = density.sample(int(np.count_nonzero(chosen == number)), rng)
        return poses

    def log_density(self, target_from_source: Array) -> Array:
        logs = [density.log_density(target_from_source) for density in self.densities]
        weighted = np.stack(logs) + np.log(self.probabilities)[:, None]
        return np.asarray(np.logaddexp.reduce(weighted, axis=0), dtype=np.float64)

    @property
    def alternatives(self) -> tuple[AbstractPoseDensity, ...]:
        return self.densities


@dataclass(frozen=True, eq=False)
class DefensiveMixture(AbstractPoseDensity):
    """A mixture of proposals and independent knowledge within the latter's support; only the latter is evidence.

    Importance weights `exp(log_prior - log_density)` divide the proposals out. The fraction of the independent
    knowledge bounds those weights, however wrong the proposals are (Hesterberg 1995).
    """

    known: AbstractPoseDensity
    """The independent knowledge, possibly only limits."""
    proposals: tuple[AbstractPoseDensity, ...]
    """Proposal densities."""
    inside: Array
    """(k,) fraction of each proposal's mass within the support of `known`."""
    share: float
    """Fraction (0..1) of all proposals together, equal among them."""
    evidence: bool = False

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        part = rng.integers(len(self.proposals), size=count)
        part[rng.random(count) >= self.share] = -1
        poses = np.empty((count, 4, 4))
        of_known = part < 0
        poses[of_known] = self.known.sample(int(of_known.sum()), rng)
        for number, proposal in enumerate(self.proposals):
            places = np.flatnonzero(part == number)
            while len(places):  # a fraction `inside`, at least 1 %, is accepted in each round
                drawn = proposal.sample(len(places), rng)
                fits = np.isfinite(self.known.log_density(drawn))
                poses[places[fits]] = drawn[fits]
                places = places[~fits]
        return poses

    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of poses (n, 4, 4); -inf outside the support of `known`."""
        total = self.known.log_density(target_from_source)
        fits = np.isfinite(total)
        poses = target_from_source if fits.all() else target_from_source[fits]
        mixed = total[fits] + np.log1p(-self.share)
        for proposal, inside in zip(self.proposals, self.inside, strict=True):
            log_share = np.log(self.share / (len(self.proposals) * inside))
            mixed = np.logaddexp(mixed, proposal.log_density(poses) + log_share)
        total[fits] = mixed
        return total

    def log_prior(self, target_from_source: Array) -> Array:
        return self.known.log_prior(target_from_source)


def defensive_mixture(
    known: AbstractPoseDensity, proposals: Sequence[AbstractPoseDensity], share: float = 0.8
) -> AbstractPoseDensity:
    """Return the mixture with those proposals that overlap the support of `known`; `known` itself if none does.

    Args:
        known: the independent knowledge, possibly only limits.
        proposals: proposal densities.
        share: fraction (0..1) of all proposals together.
    """
    rng = np.random.default_rng(0)  # equal arguments give equal densities
    shares = [float(np.mean(np.isfinite(known.log_density(item.sample(_OVERLAP_SAMPLES, rng))))) for item in proposals]
    useful = [number for number, inside in enumerate(shares) if inside >= UNLIKELY]
    if not useful:
        return known
    return DefensiveMixture(
        known, tuple(proposals[number] for number in useful), np.array([shares[n] for n in useful]), share
    )
