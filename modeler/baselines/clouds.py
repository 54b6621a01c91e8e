"""Common parts of the point cloud baselines: voxel downsampling, initial pose, and covariance from residuals.

These methods are standard practice. They ignore free space; of the prior they use the centre as the initial pose, and
the spread for directions that the surfaces leave open.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular
from scipy.spatial import KDTree

from modeler import se3
from modeler.types import (
    AbstractPoseDensity,
    AbstractRegistrar,
    Array,
    BoolArray,
    InputError,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    ViewPair,
)

_MIN_SIGMA = 1e-6  # rad or m: keeps covariances positive definite if prior or residuals vanish


@dataclass(frozen=True, eq=False)
class Cloud:
    """Surface points with normals, in one camera's coordinates."""

    points_m: Array
    """(n, 3)."""
    normals: Array
    """(n, 3) unit normals, towards the camera."""
    intensity: Array | None = None
    """(n,) mean of red, green and blue, 0 to 1; None if colour is not used."""

    @staticmethod
    def of(view: RayImage) -> Cloud:
        """Return the surface points of a view."""
        return Cloud(view.points_m, view.normals)

    @staticmethod
    def coloured(view: RayImage) -> Cloud:
        """Return the surface points of a view with their intensity.

        Raises:
            InputError: if the view has points, but no colour.
        """
        colour, (row, column) = view.frame.colour, view.pixels.T
        if colour is None and len(view.points_m):
            raise InputError(
                f"frame {view.index}: has no colour, which coloured ICP compares; give colour aligned to depth,"
                " or use another method."
            )
        intensity = np.zeros(0) if colour is None else colour[row, column].mean(axis=1) / 255.0
        return Cloud(view.points_m, view.normals, intensity)

    @property
    def size_m(self) -> float:
        """Twice the root mean square distance of the points from their centroid."""
        return 2.0 * float(np.sqrt(np.sum(np.var(self.points_m, axis=0))))

    @property
    def spacing_m(self) -> float:
        """Median distance of a point to its nearest neighbour, estimated from a few hundred points."""
        some = self.points_m[:: 1 + len(self.points_m) // 400]
        distances, _ = KDTree(self.points_m).query(some, k=2)
        return float(np.median(distances[:, 1]))

    def thinned(self, voxel_m: float) -> Cloud:
        """Return the mean point and normal of each occupied cube of edge `voxel_m`, on a grid about the centroid."""
        cubes = np.floor((self.points_m - self.points_m.mean(axis=0)) / voxel_m).astype(np.int64)
        cubes -= cubes.min(axis=0)
        number = np.ravel_multi_index(tuple(cubes.T), tuple(cubes.max(axis=0) + 1))
        _, cube, count = np.unique(number, return_inverse=True, return_counts=True)
        points, normals = np.zeros((2, len(count), 3))
        np.add.at(points, cube, self.points_m)
        np.add.at(normals, cube, self.normals)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        intensity = None if self.intensity is None else np.bincount(cube, self.intensity) / count
        return Cloud(points / count[:, None], normals / np.maximum(lengths, np.finfo(float).tiny), intensity)


def cube_edges_m(source: Cloud, target: Cloud, shares: Sequence[float]) -> list[float]:
    """Return voxel edges, given as fractions of the larger object's size, but not finer than the points."""
    size_m, spacing_m = max(source.size_m, target.size_m), max(source.spacing_m, target.spacing_m)
    return list(dict.fromkeys(max(share * size_m, spacing_m) for share in shares))


@dataclass(frozen=True, eq=False)
class Start:
    """The initial pose of a local search, with the prior's spread about it."""

    target_from_source: Array
    """(4, 4)."""
    centre_m: Array
    """(3,) point of the source to which the spread refers."""
    sigma_rad: float
    """Root mean square rotation of the prior about the start, per axis."""
    sigma_m: float
    """Root mean square shift of `centre_m`, per axis."""

    @property
    def sigmas(self) -> Array:
        """(6,) standard deviations of ξ about `centre_m`: rad, then m."""
        return np.repeat([self.sigma_rad, self.sigma_m], 3)


def start(source: RayImage, target: RayImage, density: AbstractPoseDensity, rng: np.random.Generator) -> Start:
    """Return the centre of the prior: the intrinsic mean of its samples.

    Its fixed-point iteration starts from the shift that aligns the centroids. If the prior leaves the rotation open (a
    root mean square over 90°), it has no centre, and this shift itself is the initial pose. For a prior given by
    centroids and a largest rotation, the two agree within sampling error.
    """
    samples = density.sample(1000, rng)
    if len(source.points_m) and len(target.points_m):
        centre_m = source.centroid_m
        guess = se3.translation(target.centroid_m - centre_m)
    else:
        centre_m, guess = np.zeros(3), samples[0]
    pose, _ = se3.mean(samples, np.ones(len(samples)), start=guess)
    if _rms_angle(pose, samples) > 0.5 * np.pi:  # beyond which a mean rotation is meaningless
        pose = guess
    shifts = samples[:, :3, :3] @ centre_m + samples[:, :3, 3] - se3.transform(pose, centre_m[None])
    return Start(
        pose,
        centre_m,
        sigma_rad=max(_rms_angle(pose, samples) / np.sqrt(3.0), _MIN_SIGMA),
        sigma_m=max(float(np.sqrt(np.mean(shifts**2))), _MIN_SIGMA),
    )


def _rms_angle(pose: Array, samples: Array) -> float:
    return float(np.sqrt(np.mean(se3.rotation_angle(se3.inverse(pose) @ samples) ** 2)))


@dataclass(frozen=True, eq=False)
class Matches:
    """Points of the source with their correspondences: the nearest points of the target under a motion."""

    points_m: Array
    """(n, 3) points of the source that have a correspondence."""
    partners: Cloud
    """Their n correspondences."""
    fitness: float
    """Fraction of the source's points that have a correspondence."""


def matched(source_m: Array, target: Cloud, tree: KDTree, pose: Array, reach_m: float) -> Matches:
    """Match points (n, 3), transformed by `pose`, with the nearest of `target`, in `tree`, within `reach_m`."""
    near, partner = nearest(source_m, tree, pose, reach_m)
    return Matches(source_m[near], Cloud(target.points_m[partner], target.normals[partner]), float(np.mean(near)))


def nearest(source_m: Array, tree: KDTree, pose: Array, reach_m: float) -> tuple[BoolArray, npt.NDArray[np.intp]]:
    """Return whether points (n, 3), moved by `pose`, have a neighbour in `tree` within `reach_m`, and its index."""
    distances, indices = tree.query(se3.transform(pose, source_m), distance_upper_bound=reach_m)
    near = np.isfinite(distances)
    return near, np.asarray(indices)[near]


def plane_residuals(matches: Matches, pose: Array) -> tuple[Array, Array]:
    """Return the point-to-plane residuals of matched points p, with planes (q, n) of their correspondences.

    Returns:
        Residuals n · (pose p - q) in m, (n,), and their derivative (n, 6) by the ξ of `pose @ exp(ξ)`.
    """
    gaps = se3.transform(pose, matches.points_m) - matches.partners.points_m
    normals_in_source = matches.partners.normals @ pose[:3, :3]
    jacobian = np.hstack([np.cross(matches.points_m, normals_in_source), normals_in_source])
    return np.sum(gaps * matches.partners.normals, axis=1), jacobian


def whitened_jacobian(residuals: Array, weights: Array, jacobian: Array) -> Array:
    """Return a least-squares fit's Jacobian (n, 6), divided by the noise estimated from the residuals.

    This standard practice assumes independent residuals and correct matches. It is overconfident by orders of
    magnitude, and therefore the negative control in the calibration study.

    Args:
        residuals: (n,) in m.
        weights: (n,) between 0 and 1.
        jacobian: (n, 6) by ξ.
    """
    variance = residual_variance(float(weights @ residuals**2), float(np.sum(weights)))
    return np.sqrt(weights / variance)[:, None] * jacobian


def residual_variance(squares: float, count: float) -> float:
    """Return the residual variance of a fit of six parameters from its sum of squares; always positive."""
    return max(squares / max(count - 6.0, 1.0), _MIN_SIGMA**2)


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a point cloud method."""

    target_from_source: Array
    """(4, 4)."""
    jacobian: Array
    """(n, 6) whitened Jacobian by ξ, from the surfaces alone: JᵀJ is the information, which may be singular."""
    fitness: float
    """Fraction of the source's points that have a correspondence."""


@dataclass(frozen=True)
class AbstractCloudRegistrar(AbstractRegistrar):
    """A method that aligns point clouds, with the residual-scaled inverse Hessian as its covariance."""

    min_points: int = 12
    """Least number of points of each cloud: twice as many as a motion has components."""
    min_fitness: float = 0.1
    """Least fraction of matched points of whole clouds that counts as overlap: a quarter of what the visibility method
    requires of the surface that both views should see."""

    @abstractmethod
    def fit(self, source: RayImage, target: RayImage, initial: Array, rng: np.random.Generator) -> Fit | None:
        """Return the fit from an initial pose; None if there are too few points.

        Args:
            source: the view whose points are transformed.
            target: the view to which they are aligned.
            initial: (4, 4) the prior's centre.
            rng: source of all randomness.

        Raises:
            InputError: if the views lack what the method compares.
        """

    def posterior_of(self, pair: ViewPair) -> Posterior:
        """Return the fit from the prior's centre; directions that the surfaces leave open have the prior's spread.

        Raises:
            InputError: if the views lack what the method compares.
        """
        began, source, target = time.perf_counter(), pair.source, pair.target
        initial = start(source, target, pair.density, pair.rng)
        fit = self.fit(source, target, initial.target_from_source, pair.rng)
        found = posterior(source, target, initial, fit, self.min_fitness)
        return replace(found, seconds=time.perf_counter() - began)


def posterior(source: RayImage, target: RayImage, initial: Start, fit: Fit | None, min_fitness: float) -> Posterior:
    """Return a fit as a posterior; without one, the prior's centre and spread as TOO_FEW_POINTS.

    Directions without information keep the prior's spread, so that the covariance is positive definite.
    """
    if fit is None:
        pose = PoseGaussian(initial.target_from_source, _covariance(np.zeros((0, 6)), initial))
        return Posterior(source.index, target.index, pose, Outcome.TOO_FEW_POINTS, 0.0)
    pose = PoseGaussian(fit.target_from_source, _covariance(fit.jacobian, initial))
    outcome = Outcome.CONVERGED if fit.fitness >= min_fitness else Outcome.NO_OVERLAP
    return Posterior(source.index, target.index, pose, outcome, fit.fitness)


def _covariance(jacobian: Array, initial: Start) -> Array:
    """Return the covariance (6, 6) of ξ under a whitened Jacobian (n, 6) and the prior's spread.

    By QR of the two stacked, about the object's centre. Surfaces may be 10¹⁴ times as informative as the prior, whose
    information would be lost to rounding in a sum.
    """
    about_centre = jacobian @ se3.adjoint(se3.translation(initial.centre_m))
    upper = np.linalg.qr(np.vstack([about_centre, np.diag(1.0 / initial.sigmas)]), mode="r")
    root = se3.adjoint(se3.translation(initial.centre_m)) @ solve_triangular(upper, np.eye(6))
    covariance = root @ root.T
    return 0.5 * (covariance + covariance.T)
