"""Refinement of samples by the point-to-plane equations of matching surface (method.md, eq. 14 to 16).

A likelihood that multiplies hundreds of points overstates what errors they share, so that the sampled one is tempered:
right for what the images hardly determine, far too wide for what they determine well. There the classical equations
hold, with the covariance of their solution from the scatter between patches of the surface (Godambe 1960: sensitivity
J, variability V, information J V⁻¹ J).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from modeler import se3
from modeler.kernels import point_to_plane
from modeler.registration.posterior import FLOOR
from modeler.registration.visibility.fixed_pattern import FixedPattern
from modeler.registration.visibility.likelihood import DirectedLikelihood, MatchNoise, PairLikelihood
from modeler.registration.visibility.photometric import unshifted
from modeler.se3 import rows
from modeler.types import Array, Camera

_MIN_LEVEL = 1e-4  # of the scatter, relative to its shape: residuals are no smaller than a hundredth of their stated sd


@dataclass(frozen=True)
class Refiner:
    """Moves each sample of a tempered posterior to where matching surface and the sample together put it."""

    halvings: int = 5
    """The surface is bisected this many times: 2⁵ patches, whose errors are taken to be independent."""
    min_matches: float = 6.0
    """Least number of matches in a patch; with fewer in all, there are fewer patches."""

    def refine(
        self,
        pair: PairLikelihood,
        dense: PairLikelihood,
        samples: tuple[Array, Array],
        rng: np.random.Generator,
        *,
        fine_m: float,
    ) -> Refined:
        """Return refined samples: those of posterior × matching surface, if both were Gaussian.

        Each sample takes its own Gauss-Newton step, scaled by how much more certain the surface is than the samples'
        spread, and a share of the surface's uncertainty (randomised maximum likelihood: Oliver, He and Reynolds 1996).
        Where the surface determines nothing, as about the axis of a can, samples stay as they are.

        Args:
            pair: the two views, at the points at which each sample takes its step.
            dense: the same, at the points that say where surface matches best, and how well that is known.
            samples: poses (n, 4, 4) of target_from_source, and their weights (n,) of any sum.
            rng: source of all randomness.
            fine_m: smallest blur in m at which matches are selected.
        """
        (poses, weights), centre_m = samples, pair.centre_m
        mean, covariance = se3.mean(poses, weights, about_m=centre_m)
        spread = np.asarray(np.linalg.cholesky(covariance + FLOOR), dtype=np.float64)
        mode, noise = _mode(dense, mean, spread, centre_m, fine_m=fine_m)
        basis, information, by_focal = self._information(dense, mode, noise, spread)
        scales, axes = np.linalg.eigh(information)
        root = axes * np.sqrt(np.maximum(scales, 0.0))
        narrowed = np.linalg.inv(np.eye(6) + information)
        to_basis = np.linalg.inv(basis)
        steps = _steps(pair, poses, noise, spread, stride=2)
        # What the choice of few points moves all samples by, to first order.
        steps += _steps(dense, mode[None], noise, spread, stride=1) - _steps(pair, mode[None], noise, spread, stride=2)
        step = steps @ to_basis.T @ information
        scatter = rng.normal(size=(len(poses), 6)) @ root.T
        moved = (step + scatter) @ narrowed.T @ basis.T  # method.md, eq. 16
        from_centre = se3.adjoint(se3.translation(centre_m))
        return Refined(se3.moved(poses, moved, centre_m), np.asarray(from_centre @ by_focal, dtype=np.float64))

    def _information(
        self, pair: PairLikelihood, mode: Array, noise: MatchNoise, spread: Array
    ) -> tuple[Array, Array, Array]:
        """Return a basis (6, 6) of ξ about the centre, the information (6, 6) in it, and ξ (6,) by the focal length.

        Equations 14 and 25 of method.md.
        """
        surface, colours = _equations(pair, mode, noise)
        halvings = min(self.halvings, int(np.log2(max(len(surface.residuals) / self.min_matches, 1.0))))
        if 2**halvings <= len(spread):  # the scatter of six equations would be singular
            return spread, np.zeros((6, 6)), np.zeros(6)
        patches = point_to_plane.bisected(surface.arms, halvings)  # of colours, too: they are those of the same matches
        members = (patches == np.arange(2**halvings)[:, None]).astype(np.float64)
        sensitivity, variability = surface.scatter(spread, members, pair.patches)
        pulled = surface.pulled(spread)
        if pair.colour is not None and len(colours.residuals):
            by_colour, scatter = colours.scatter(spread, members, pair.colour.patches(noise.band))
            shifts = np.asarray(np.linalg.solve(spread, pair.colour.shifts(mode)), dtype=np.float64)
            kept, felt = unshifted(by_colour, shifts), by_colour @ shifts
            sensitivity = sensitivity + kept @ by_colour
            variability = variability + kept @ (scatter + felt @ felt.T) @ kept.T
            pulled = pulled + kept @ colours.pulled(spread)
        scales, axes = np.linalg.eigh(0.5 * (sensitivity + sensitivity.T))
        positive = np.diag(np.maximum(scales, 0.0))
        information = positive @ np.linalg.solve(axes.T @ variability @ axes, positive)
        information = np.asarray(0.5 * (information + information.T), dtype=np.float64)
        # Where the surface determines nothing, its solution follows noise of normals divided by nothing, and does not
        # count: samples, too, follow as far as it determines them, I (1 + I)⁻¹, and what refines them by the rest.
        followed = axes.T @ pulled / (1.0 + np.maximum(scales, 0.0))
        kept = np.linalg.inv(np.eye(6) + information)
        by_focal = spread @ axes @ (followed - kept @ kept @ followed)
        return spread @ axes, information, np.asarray(by_focal, dtype=np.float64)


class Refined(NamedTuple):
    """Refined samples."""

    poses: Array
    """(n, 4, 4) of target_from_source."""
    by_focal: Array
    """(6,) derivative of their mean's ξ by the logarithm of the focal length; 0 where too little matches."""


def shrunk(scores: Array, shape: Array) -> Array:
    """Return the variability (k, k) of a sum of scores: their scatter, shrunk to the shape that it should have.

    A few dozen scores determine it poorly, and underestimates make a posterior overconfident. It is drawn to the shape
    of independent errors of equal size, the more, the less the scatter departs from it beyond chance (oracle
    approximating shrinkage: Chen, Wiesel, Eldar and Hero 2010, equation 23). Images without noise, where residuals
    vanish, do not make it singular.

    Args:
        scores: (n, k), which sum up to about 0.
        shape: (k, k) positive semi-definite: the variability if residuals have their stated variances.
    """
    count, size = scores.shape
    root = np.linalg.cholesky(shape + max(1e-9 * np.trace(shape), 1e-300) * np.eye(size))
    white = np.linalg.solve(root, scores.T)
    scatter = white @ white.T * count / (count - 1.0)
    level, square = max(np.trace(scatter) / size, _MIN_LEVEL), np.sum(scatter**2)
    departure = (count + 1.0 - 2.0 / size) * (square - size * level**2)
    chance = (1.0 - 2.0 / size) * square + (size * level) ** 2
    share = chance / max(chance, departure, 1e-300)
    return np.asarray(root @ ((1.0 - share) * scatter + share * level * np.eye(size)) @ root.T, dtype=np.float64)


def visible_share(size: float) -> float:
    """Return the share of the variability that shows in the scatter of patches of `size` balls (method.md, eq. 15).

    Smoothing spreads a pixel's noise over a ball, across the border of a patch, and the scatter misses errors that
    neighbours share. With both as squares, w and d wide, the patch's sum is in each direction a trapezoid of the noise,
    whose square holds 1 - w / 3d of what the whole surface's does; and (1 - d / 3w) d / w where d < w.
    """
    width = np.sqrt(size)  # of a patch, in those of a ball
    share = 1.0 - 1.0 / (3.0 * width) if width >= 1.0 else width * (1.0 - width / 3.0)
    return float(share**2)


def _mode(
    pair: PairLikelihood, start: Array, spread: Array, centre_m: Array, *, fine_m: float
) -> tuple[Array, MatchNoise]:
    """Return the mode of matching surface × a Gaussian about `start` with the root (6, 6) of its covariance."""
    precision = np.linalg.inv(spread @ spread.T)
    pose, noise = start, pair.match_noise(start, fine_m)
    for _ in range(8):
        gradient, matrix = (part[0] for part in pair.normal_equations(pose[None], noise, stride=1))
        away = se3.difference(start, pose, centre_m)
        step = np.asarray(np.linalg.solve(matrix + precision, gradient - precision @ away), dtype=np.float64)
        pose = se3.moved(pose, step, centre_m)
        noise = noise._replace(surface_m=pair.surface_noise_m(pose, fine_m))
        if np.linalg.norm(np.linalg.solve(spread, step)) < 0.01:  # standard deviations
            break
    return pose, pair.match_noise(pose, fine_m)


def _steps(pair: PairLikelihood, poses: Array, noise: MatchNoise, spread: Array, *, stride: int) -> Array:
    """Return Gauss-Newton steps (n, 6), regularised by the samples' spread."""
    gradient, matrix = pair.normal_equations(poses, noise, stride=stride)
    regularised = matrix + np.linalg.inv(spread @ spread.T)
    return np.asarray(np.linalg.solve(regularised, gradient[:, :, None])[:, :, 0], dtype=np.float64)


class Equations(NamedTuple):
    """Linear equations of ξ about the centre, of surface or of its colours."""

    arms: Array
    """(n, 3) positions in m."""
    by_own: Array
    """(n, 6) derivatives of the residuals by ξ, from the point's own normal or gradient."""
    by_other: Array
    """(n, 6) likewise, from the other surface's."""
    residuals: Array
    """(n,) in m; of colours without a unit."""
    weights: Array
    """(n,) in 1/m²; of colours without a unit."""
    focal_own: Array
    """(n,) derivatives of the residuals by the logarithm of the focal length, from the point's own normal."""
    focal_other: Array
    """(n,) likewise, from the other surface's."""
    pattern_slopes: Array
    """(n, 6) derivatives of what the fixed pattern counts."""
    pattern_curvatures: Array
    """(2, 6, 6) second derivatives, of all of either direction."""

    def pulled(self, basis: Array) -> Array:
        """Return the derivative (6,) of the right side of the normal equations by the logarithm of the focal length.

        Args:
            basis: (6, 6) of ξ.
        """
        # As in the normal equations: in products of both surfaces the noise of normals averages out.
        found = self.by_own.T @ (self.weights * self.focal_other) + self.by_other.T @ (self.weights * self.focal_own)
        return np.asarray(0.5 * basis.T @ found, dtype=np.float64)

    def scatter(self, basis: Array, members: Array, independent: float) -> tuple[Array, Array]:
        """Return sensitivity (6, 6) and variability (6, 6) of the sum of the equations (method.md, eq. 14 and 15).

        Args:
            basis: (6, 6) of ξ.
            members: (p, n) which equations are of each patch of the surface: 1, else 0.
            independent: number of patches whose errors are independent.
        """
        by_own, by_other = self.by_own @ basis, self.by_other @ basis
        # The noise of either surface's normals would add up in its own square; in their product it averages out.
        product = (by_own.T * self.weights) @ by_other + basis.T @ self.pattern_curvatures.sum(axis=0) @ basis
        scales, axes = np.linalg.eigh(0.5 * (product + product.T))
        by_both = 0.5 * (by_own + by_other)
        scores = members @ (by_both * (self.weights * self.residuals)[:, None] + self.pattern_slopes @ basis)
        variability = shrunk(scores, (by_both.T * self.weights) @ by_both) / visible_share(independent / len(members))
        return (axes * np.maximum(scales, 0.0)) @ axes.T, variability


def _equations(pair: PairLikelihood, pose: Array, noise: MatchNoise) -> tuple[Equations, Equations]:
    """Return the equations of matching points, and of their colours, in the source's frame, about the centre."""
    parts: list[list[tuple[Array, ...]]] = [[], []]
    directions: list[tuple[DirectedLikelihood, Array, float]] = [
        (pair.forward, pose, 1.0),
        (pair.backward, se3.inverse(pose), -1.0),
    ]
    for directed, carried, sign in directions:
        found = directed.matches(rows(carried), noise.surface_m)
        points = np.flatnonzero(found[:, point_to_plane.WEIGHT] > 0.0)
        surface = found[points]
        positions = surface[:, point_to_plane.POSITION]
        to_source = np.eye(4) if sign < 0.0 else se3.inverse(pose)
        arms, moves = se3.transform(to_source, positions) - pair.centre_m, following(carried, positions)
        colours = pair.colour_matches(carried, surface, points, noise, forward=sign > 0.0)
        for part, used, pattern in zip(parts, (surface, colours), (directed.pattern, FixedPattern()), strict=True):
            at, follow = arms[: len(used)], moves[: len(used)]  # all or none
            focal = [np.sum(used[:, k] * follow, axis=1) for k in (point_to_plane.OWN, point_to_plane.OTHER)]
            own, other = (used[:, k] @ to_source[:3, :3].T for k in (point_to_plane.OWN, point_to_plane.OTHER))
            derivatives = [sign * _levered(at, normals) for normals in (own, other)]
            residuals, weights = used[:, point_to_plane.RESIDUAL], used[:, point_to_plane.WEIGHT]
            slopes, bent = _counted(pattern, used, at, to_source[:3, :3], directed.image.frame.camera)
            part.append((at, *derivatives, residuals, weights, *focal, sign * slopes, bent))
    surface, colours = (Equations(*(np.concatenate(columns) for columns in zip(*part, strict=True))) for part in parts)
    return surface, colours


def _counted(pattern: FixedPattern, used: Array, arms: Array, to_source: Array, camera: Camera) -> tuple[Array, Array]:
    """Return first (n, 6) and second (1, 6, 6) derivatives by ξ of what is counted for the pattern: of all matches.

    Args:
        pattern: what errors of both views have in common.
        used: (n, 14) matches, see `point_to_plane.matches`.
        arms: (n, 3) their positions in the source's frame, about the centre.
        to_source: (3, 3) rotation into that frame.
        camera: in which they were looked up.
    """
    if pattern.share == 0.0:
        return np.zeros((len(used), 6)), np.zeros((1, 6, 6))
    slopes, curvatures = pattern.derivatives(used, camera)
    slopes, levers = slopes @ to_source.T, _levers(arms) @ to_source
    bent = np.einsum("nik,nkl,njl->ij", levers, curvatures, levers, optimize=True)[None]
    return _levered(arms, slopes), np.asarray(bent, dtype=np.float64)


def _levered(arms: Array, slopes: Array) -> Array:
    """Return derivatives (n, 6) by ξ of what has derivatives (n, 3) by the positions (n, 3) of points."""
    (x, y, z), (a, b, c) = arms.T, slopes.T
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c], axis=1)


def _levers(arms: Array) -> Array:
    """Return by how much each of six motions moves points (n, 6, 3), given their positions (n, 3) about the centre."""
    return np.concatenate([se3.hat(arms), np.broadcast_to(np.eye(3), (len(arms), 3, 3))], axis=1)


def following(carried: Array, positions: Array) -> Array:
    """Return how other surface moves away (n, 3) from points there, in m by the logarithm of the focal length.

    A longer focal length draws what a camera measured towards its axis, x and y alike and depths not at all: the
    surface as its own camera does, the points as theirs did, in another direction once they are carried.

    Args:
        carried: (4, 4) the transform that carries the points into the other camera.
        positions: (n, 3) of the carried points in m.
    """
    drawn = np.diag([-1.0, -1.0, 0.0])
    own = se3.transform(se3.inverse(carried), positions) @ drawn @ carried[:3, :3].T
    return np.asarray(positions @ drawn - own, dtype=np.float64)
