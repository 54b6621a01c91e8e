"""Refinement of samples by the point-to-plane equations of matching surface (method, eq. 6.1 to 6.3).

A product over hundreds of points with common errors overstates the information, so that the sampled likelihood is
tempered: adequate for directions that the images hardly determine, far too wide for those that they determine well. For
these, the point-to-plane equations are used, with the covariance of their solution from the scatter between patches of
the surface (Godambe 1960: sensitivity J, variability V, information J V⁻¹ J).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from modeler import se3
from modeler.kernels import point_to_plane
from modeler.registration.posterior import FLOOR, KNOWN, NEGLIGIBLE_VARIANCE, FocalNuisance
from modeler.registration.visibility.directed import OWN_RIM, DirectedLikelihood, FixedPattern, IntArray, by_motion
from modeler.registration.visibility.likelihood import MatchNoise, PairLikelihood
from modeler.registration.visibility.photometric import without_shift
from modeler.registration.visibility.sampling import WeightedSamples
from modeler.se3 import rows
from modeler.types import Array, Camera

_STEP_SIGMAS = 0.1  # of the samples, at which iterations end; a last step follows; 0.01 moves means by 0.02 to 0.05 sd


@dataclass(frozen=True)
class Refiner:
    """Moves the samples of a tempered posterior by the information of matching surface."""

    patches: int = 32
    """Number of parts into which the surface is bisected, whose errors are assumed independent: a power of two. With 16
    and 64, NEES/6 of 68 pairs is 1.17 and 0.98, with 32 1.02."""
    min_matches: float = 6.0
    """Least mean number of matches in a patch, as many as a motion has components; with fewer in all, there are fewer
    patches."""

    def refine(
        self,
        pair: PairLikelihood,
        dense: PairLikelihood,
        samples: WeightedSamples,
        rng: np.random.Generator,
        *,
        fine_m: float,
    ) -> Array:
        """Return refined samples (n, 4, 4): those of posterior × matching surface, if both are Gaussian (eq. 6.3).

        Each sample moves by its own Gauss-Newton step, scaled by the surface's information relative to the samples'
        spread, and a fraction of the surface's uncertainty (randomised maximum likelihood: Oliver, He and Reynolds
        1996). In directions without information, such as the spin of a can, samples stay.

        Args:
            pair: the two views, at the points for the samples' steps.
            dense: the same, at the points for the mode of matching surface and its information.
            samples: of target_from_source; each takes its step under its focal length.
            rng: source of all randomness.
            fine_m: smallest blur in m at which matches are selected.
        """
        centre_m = pair.centre_m
        mean, covariance = se3.mean(samples.poses, samples.weights, about_m=centre_m)
        spread = np.asarray(np.linalg.cholesky(covariance + FLOOR), dtype=np.float64)
        dense, mode, noise = _mode(dense, mean, spread, centre_m, fine_m=fine_m)
        pair = pair.with_rim_m(dense.forward.rim_m)
        surface, colours = _equations(dense, mode, noise)
        basis, information = self._information(dense, mode, noise, spread, (surface, colours))
        scales, axes = np.linalg.eigh(information)
        root = axes * np.sqrt(np.maximum(scales, 0.0))
        narrowed = np.linalg.inv(np.eye(6) + information)
        to_basis = np.linalg.inv(basis)
        steps = _steps(pair, samples.under_focal_lengths, noise, spread, stride=2, log_focal=samples.log_focal)
        # To first order, the shift of all samples by the choice of few points, and by errors common to both rims.
        there = _steps(dense, mode[None], noise, spread, stride=1, explained=surface.explained)
        steps += there - _steps(pair, mode[None], noise, spread, stride=2)
        step = steps @ to_basis.T @ information
        scatter = rng.normal(size=steps.shape) @ root.T
        moved = (step + scatter) @ narrowed.T @ basis.T  # method, eq. 6.3
        return se3.moved(samples.poses, moved, centre_m)

    def _information(
        self,
        pair: PairLikelihood,
        mode: Array,
        noise: MatchNoise,
        spread: Array,
        equations: tuple[Equations, Equations],
    ) -> tuple[Array, Array]:
        """Return a basis (6, 6) of ξ about the centre, and the information (6, 6) in it (method, eq. 6.1)."""
        surface, colours = equations
        halvings = int(np.log2(min(max(len(surface.residuals) / self.min_matches, 1.0), self.patches)))
        if 2**halvings <= len(spread):  # the scatter of six equations would be singular
            return spread, np.zeros((6, 6))
        patches = point_to_plane.bisected(surface.arms, halvings)  # of colours, too: they are those of the same matches
        sensitivity, variability = surface.scatter(spread, patches, pair.patches)
        if pair.colour is not None and len(colours.residuals):
            by_colour, scatter = colours.scatter(spread, patches, pair.colour.patches(noise.band))
            shifts = np.asarray(np.linalg.solve(spread, pair.colour.shifts(mode)), dtype=np.float64)
            kept, coupled = without_shift(by_colour, shifts), by_colour @ shifts
            sensitivity = sensitivity + kept @ by_colour
            variability = variability + kept @ (scatter + coupled @ coupled.T) @ kept.T
        scales, axes = np.linalg.eigh(0.5 * (sensitivity + sensitivity.T))
        positive = np.diag(np.maximum(scales, 0.0))
        information = positive @ np.linalg.solve(axes.T @ variability @ axes, positive)
        return spread @ axes, np.asarray(0.5 * (information + information.T), dtype=np.float64)


def first_order(pair: PairLikelihood, pose: Array, spread: Array, noise_m: float) -> FocalNuisance:
    """Return how poses depend on the focal length, by a Gauss-Newton step under either of two (method, eq. 10.1).

    Args:
        pair: the two views.
        pose: (4, 4) target_from_source that matches.
        spread: (6, 6) root of the covariance of ξ about it; it limits what surface does not determine.
        noise_m: noise of matching surface.
    """
    sigma = pair.forward.image.sigma_focal
    if sigma == 0.0:
        return KNOWN
    noise, ends = pair.match_noise(pose, noise_m), np.array([-sigma, sigma])
    gradients, matrices = pair.normal_equations(np.stack([pose, pose]), noise, stride=1, log_focal=ends)
    precision = matrices.mean(axis=0) + np.linalg.inv(spread @ spread.T)
    about_centre = np.linalg.solve(precision, (gradients[1] - gradients[0]) / (2.0 * sigma))
    by_focal = se3.adjoint(se3.translation(pair.centre_m)) @ about_centre
    return FocalNuisance(sigma, np.asarray(by_focal, dtype=np.float64))


def shrunk(scores: Array, shape: Array) -> Array:
    """Return the variability (k, k) of a sum of scores: their scatter, shrunk towards the predicted shape.

    A few dozen scores determine it poorly, and underestimates make a posterior overconfident. It is shrunk towards the
    shape for independent errors of equal size, by the oracle approximation (Chen, Wiesel, Eldar and Hero 2010, eq. 23).
    It is regular also for noise-free images, whose residuals vanish.

    Args:
        scores: (n, k), which sum to about 0.
        shape: (k, k) positive semi-definite: the variability if residuals have their predicted variances.
    """
    count, size = scores.shape
    root = np.linalg.cholesky(shape + max(1e-9 * np.trace(shape), 1e-300) * np.eye(size))
    white = np.linalg.solve(root, scores.T)
    scatter = white @ white.T * count / (count - 1.0)
    level, square = max(np.trace(scatter) / size, NEGLIGIBLE_VARIANCE), np.sum(scatter**2)
    departure = (count + 1.0 - 2.0 / size) * (square - size * level**2)
    chance = (1.0 - 2.0 / size) * square + (size * level) ** 2
    share = chance / max(chance, departure, 1e-300)
    return np.asarray(root @ ((1.0 - share) * scatter + share * level * np.eye(size)) @ root.T, dtype=np.float64)


def visible_share(size: float) -> float:
    """Return the fraction of the variability in the scatter of patches of `size` balls (method, eq. 6.2).

    Smoothing spreads a pixel's noise over a ball, across the border of a patch, and the scatter misses errors common to
    neighbouring patches. With patches of w² and balls of d², both square, a patch's sum weights the noise by a
    trapezoid in each direction, whose square is 1 - d / 3w of the whole surface's, and (1 - w / 3d) w / d if w < d.
    """
    width = np.sqrt(size)  # of a patch, in widths of a ball
    share = 1.0 - 1.0 / (3.0 * width) if width >= 1.0 else width * (1.0 - width / 3.0)
    return float(share**2)


def _mode(
    pair: PairLikelihood, start: Array, spread: Array, centre_m: Array, *, fine_m: float
) -> tuple[PairLikelihood, Array, MatchNoise]:
    """Return the mode of matching surface × a Gaussian about `start`, `spread` (6, 6) the root of its covariance.

    With it come the pair, with the noise near silhouettes there, and the noise of matches.
    """
    precision = np.linalg.inv(spread @ spread.T)
    surface_m, rim_m = pair.noises_m(start, fine_m)
    pair, pose = pair.with_rim_m(rim_m), start
    noise = pair.match_noise(start, surface_m)
    for _ in range(8):
        gradient, matrix = (part[0] for part in pair.normal_equations(pose[None], noise, stride=1))
        offset = se3.difference(start, pose, centre_m)
        step = np.asarray(np.linalg.solve(matrix + precision, gradient - precision @ offset), dtype=np.float64)
        pose = se3.moved(pose, step, centre_m)
        surface_m, rim_m = pair.noises_m(pose, fine_m)
        pair, noise = pair.with_rim_m(rim_m), noise._replace(surface_m=surface_m)
        if np.linalg.norm(np.linalg.solve(spread, step)) < _STEP_SIGMAS:
            break
    return pair, pose, pair.match_noise(pose, noise.surface_m)


def _steps(
    pair: PairLikelihood,
    poses: Array,
    noise: MatchNoise,
    spread: Array,
    *,
    stride: int,
    explained: Explained | None = None,
    log_focal: Array | None = None,
) -> Array:
    """Return Gauss-Newton steps (n, 6), regularised by the samples' spread, without what a nuisance explains."""
    gradient, matrix = pair.normal_equations(poses, noise, stride=stride, log_focal=log_focal)
    if explained is not None:
        gradient, matrix = gradient - explained.gradient, matrix - explained.matrix
    regularised = matrix + np.linalg.inv(spread @ spread.T)
    return np.asarray(np.linalg.solve(regularised, gradient[:, :, None])[:, :, 0], dtype=np.float64)


class Explained(NamedTuple):
    """What a nuisance parameter explains of normal equations for ξ about the centre."""

    gradient: Array
    """(6,)."""
    matrix: Array
    """(6, 6)."""


class Equations(NamedTuple):
    """Linear equations for ξ about the centre, from surface or its colours."""

    arms: Array
    """(n, 3) positions in m, relative to the centre."""
    by_own: Array
    """(n, 6) derivatives of the residuals by ξ, from the point's own normal or gradient."""
    by_other: Array
    """(n, 6) likewise, from the other surface's."""
    residuals: Array
    """(n,) in m; for colours without a unit."""
    weights: Array
    """(n,) in 1/m²; for colours without a unit."""
    pattern_slopes: Array
    """(n, 6) derivatives of f c / 2, the term of the fixed pattern."""
    pattern_curvatures: Array
    """(2, 6, 6) its second derivatives, summed over each direction."""
    explained: Explained | None = None
    """What an eliminated nuisance parameter explains."""

    def without(self, by_nuisance: Array) -> Equations:
        """Return the equations after elimination of a parameter β ~ N(0, 1) (method, eq. 6.4).

        Args:
            by_nuisance: (n,) derivatives of the residuals by β.
        """
        weighted = self.weights * by_nuisance
        coupled = _products(0.5 * (self.by_own + self.by_other), weighted)
        share = coupled / (1.0 + weighted @ by_nuisance)
        own, other = (by_motion - by_nuisance[:, None] * share for by_motion in (self.by_own, self.by_other))
        explained = Explained(-(weighted @ self.residuals) * share, np.outer(coupled, share))
        return self._replace(by_own=own, by_other=other, explained=explained)

    def scatter(self, basis: Array, patches: IntArray, independent: float) -> tuple[Array, Array]:
        """Return sensitivity (6, 6) and variability (6, 6) of the sum of the equations (method, eq. 6.1 and 6.2).

        Args:
            basis: (6, 6) of ξ.
            patches: (n,) number of the patch of the surface to which an equation belongs.
            independent: number of patches whose errors are independent.
        """
        by_own, by_other = self.by_own @ basis, self.by_other @ basis
        # The noise of normals would add up in squares; in products of both surfaces it averages out.
        product = (by_own.T * self.weights) @ by_other + basis.T @ self.pattern_curvatures.sum(axis=0) @ basis
        scales, axes = np.linalg.eigh(0.5 * (product + product.T))
        by_both = 0.5 * (by_own + by_other)
        of_match = by_both * (self.weights * self.residuals)[:, None] + self.pattern_slopes @ basis
        scores = np.stack([np.bincount(patches, column) for column in of_match.T], axis=1).astype(np.float64)
        variability = shrunk(scores, (by_both.T * self.weights) @ by_both) / visible_share(independent / len(scores))
        return (axes * np.maximum(scales, 0.0)) @ axes.T, variability


def _equations(pair: PairLikelihood, pose: Array, noise: MatchNoise) -> tuple[Equations, Equations]:
    """Return the equations of matching points, and of their colours, in the source's frame, about the centre."""
    parts: list[list[tuple[Array, ...]]] = [[], []]
    rims = []  # derivatives by β: points too near their own camera are in front of the surface, or it of them
    directions: list[tuple[DirectedLikelihood, Array, float]] = [
        (pair.forward, pose, 1.0),
        (pair.backward, se3.inverse(pose), -1.0),
    ]
    for directed, transform, sign in directions:
        found = directed.matches(rows(transform), noise.surface_m)
        points = np.flatnonzero(found[:, point_to_plane.WEIGHT] > 0.0)
        surface = found[points]
        positions = surface[:, point_to_plane.POSITION]
        to_source = np.eye(4) if sign < 0.0 else se3.inverse(pose)
        arms = se3.transform(to_source, positions) - pair.centre_m
        colours = pair.colour_matches(transform, surface, points, noise, forward=sign > 0.0)
        rims.append(directed.rim_m * (directed.points[points, OWN_RIM] - surface[:, point_to_plane.OTHER_RIM]))
        for part, used, pattern in zip(parts, (surface, colours), (directed.pattern, FixedPattern()), strict=True):
            at = arms[: len(used)]  # all or none
            own, other = (used[:, k] @ to_source[:3, :3].T for k in (point_to_plane.OWN, point_to_plane.OTHER))
            derivatives = [sign * by_motion(at, normals) for normals in (own, other)]
            residuals, weights = used[:, point_to_plane.RESIDUAL], used[:, point_to_plane.WEIGHT]
            slopes, curvature = _pattern_derivatives(pattern, used, at, to_source[:3, :3], directed.image.frame.camera)
            part.append((at, *derivatives, residuals, weights, sign * slopes, curvature))
    joined = [[np.concatenate(columns) for columns in zip(*part, strict=True)] for part in parts]
    surface, colours = (Equations(*columns, explained=None) for columns in joined)
    by_rim = np.concatenate(rims)
    return surface.without(by_rim) if by_rim.any() else surface, colours


def _pattern_derivatives(
    pattern: FixedPattern, used: Array, arms: Array, to_source: Array, camera: Camera
) -> tuple[Array, Array]:
    """Return first (n, 6) and second (1, 6, 6) derivatives by ξ of f c / 2, the latter summed over matches.

    Args:
        pattern: errors common to both views.
        used: (n, 15) matches, see `point_to_plane.matches`.
        arms: (n, 3) their positions in the source's frame, about the centre.
        to_source: (3, 3) rotation into that frame.
        camera: in which they were looked up.
    """
    if pattern.share == 0.0:
        return np.zeros((len(used), 6)), np.zeros((1, 6, 6))
    slopes, curvatures = pattern.derivatives(used, camera)
    slopes, jacobians = slopes @ to_source.T, _position_jacobians(arms) @ to_source
    curvature = np.einsum("nil,njl->ij", jacobians @ curvatures, jacobians)[None]
    return by_motion(arms, slopes), np.asarray(curvature, dtype=np.float64)


def _products(rows: Array, factors: Array) -> Array:
    """Return the sum (k,) of rows (n, k) times factors (n,), without BLAS, whose threads would stay awake for long."""
    return np.asarray(np.einsum("nk,n->k", rows, factors), dtype=np.float64)


def _position_jacobians(arms: Array) -> Array:
    """Return the derivatives (n, 6, 3) by ξ of points' positions (n, 3) about the centre."""
    return np.concatenate([se3.hat(arms), np.broadcast_to(np.eye(3), (len(arms), 3, 3))], axis=1)
