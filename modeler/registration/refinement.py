"""What matching surface says of the motion, and how sure it is: sharpens samples where it says much.

A likelihood that multiplies hundreds of points is too sure of what they have in common, so that the sampled one is
tempered: right for what the images hardly determine, far too wide for what they determine well. There the classical
way is exact: point-to-plane equations, and the covariance of their solution from how the equations scatter between
patches of the surface (Godambe 1960: sensitivity J, variability V, information J V⁻¹ J).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.kernels import matching, patches
from modeler.registration.lookup import DirectedLikelihood
from modeler.registration.pair import PairLikelihood
from modeler.registration.posterior import FLOOR
from modeler.se3 import rows
from modeler.types import Array


@dataclass(frozen=True)
class Refiner:
    """Moves each sample of a tempered posterior to where matching surface and the sample together put it."""

    halvings: int = 5
    """The surface is cut in two so many times: 2⁵ patches, whose errors are taken to be independent."""
    min_matches: float = 6.0
    """A patch holds at least so many matching points; with fewer in all, there are fewer patches."""
    min_patches: int = 16
    """With fewer patches than this nothing is refined: the scatter of six equations would not be known."""

    def refine(
        self, pair: PairLikelihood, poses: Array, weights: Array, rng: np.random.Generator, *, fine_m: float
    ) -> Array:
        """Return the refined samples (n, 4, 4): those of posterior × matching surface, if both were Gaussian.

        Each sample takes its own Gauss-Newton step, as far as the surface is surer than the samples' spread, and a
        share of the surface's uncertainty (randomised maximum likelihood: Oliver, He and Reynolds 1996). Where the
        surface says nothing, about the axis of a can, samples stay as they are.

        Args:
            pair: the two views.
            poses: (n, 4, 4) samples of target_from_source.
            weights: (n,) of the samples, of any sum.
            rng: source of all randomness.
            fine_m: least blur in m at which surfaces are told apart.
        """
        centre_m = pair.centre_m
        mean, covariance = se3.mean(poses, weights, about_m=centre_m)
        spread = np.asarray(np.linalg.cholesky(covariance + FLOOR), dtype=np.float64)
        mode, noise_m = _mode(pair, mean, spread, centre_m, fine_m=fine_m)
        basis, information = self._information(pair, mode, noise_m, spread, centre_m)
        scales, axes = np.linalg.eigh(information)
        root = axes * np.sqrt(np.maximum(scales, 0.0))
        narrowed = np.linalg.inv(np.eye(6) + information)
        to_basis = np.linalg.inv(basis)
        step = _steps(pair, poses, noise_m, spread, centre_m) @ to_basis.T @ information
        scatter = rng.normal(size=(len(poses), 6)) @ root.T
        moved = (step + scatter) @ narrowed.T @ basis.T
        return se3.moved(poses, moved, centre_m)

    def _information(
        self, pair: PairLikelihood, mode: Array, noise_m: float, spread: Array, centre_m: Array
    ) -> tuple[Array, Array]:
        """Return a basis (6, 6) of ξ about the centre, and the information (6, 6) about the coordinates in it."""
        places, by_own, by_other, residuals, weights = _equations(pair, mode, noise_m, centre_m)
        halvings = min(self.halvings, int(np.log2(max(len(places) / self.min_matches, 1.0))))
        if 2**halvings < self.min_patches:
            return spread, np.zeros((6, 6))
        by_own, by_other = by_own @ spread, by_other @ spread
        # The noise of either surface's normals would add up in its own square; in their product it averages out.
        product = (by_own.T * weights) @ by_other
        sensitivity, axes = np.linalg.eigh(0.5 * (product + product.T))
        count = 2**halvings
        members = (patches.halved(places, halvings) == np.arange(count)[:, None]).astype(np.float64)
        by_both = 0.5 * (by_own + by_other) @ axes
        scores = members @ (by_both * (weights * residuals)[:, None])
        variability = shrunk(scores, (by_both.T * weights) @ by_both)
        sure = np.diag(np.maximum(sensitivity, 0.0))
        information = seen_alone(pair.patches / count) * sure @ np.linalg.solve(variability, sure)
        return spread @ axes, np.asarray(0.5 * (information + information.T), dtype=np.float64)


def shrunk(scores: Array, shape: Array) -> Array:
    """Return the variability (k, k) of a sum of scores, from their scatter and from what it should look like.

    A few dozen scores tell it poorly, and what they tell too low makes a posterior too sure. So it is drawn to the
    shape that errors alike everywhere would give it, the farther, the less their scatter departs from that beyond
    chance (oracle approximating shrinkage: Chen, Wiesel, Eldar and Hero 2010, equation 23).

    Args:
        scores: (n, k), which sum up to about 0.
        shape: (k, k) positive semi-definite, of any scale.
    """
    count, size = scores.shape
    root = np.linalg.cholesky(shape + max(1e-9 * np.trace(shape), 1e-300) * np.eye(size))
    white = np.linalg.solve(root, scores.T)
    scatter = white @ white.T * count / (count - 1.0)
    level, square = np.trace(scatter) / size, np.sum(scatter**2)
    departure = (count + 1.0 - 2.0 / size) * (square - size * level**2)
    chance = (1.0 - 2.0 / size) * square + (size * level) ** 2
    share = chance / max(chance, departure, 1e-300)
    return np.asarray(root @ ((1.0 - share) * scatter + share * level * np.eye(size)) @ root.T, dtype=np.float64)


def seen_alone(size: float) -> float:
    """Return how much of the variability patches show by their own scatter, each as large as so many balls.

    Smoothing spreads a pixel's noise over a ball, across the border of a patch, and what neighbours err by alike their
    scatter leaves out. Take both for squares, w and d wide: in each direction the patch's sum is a trapezoid of the
    noise, whose square holds 1 - w / 3d of what the whole surface's does; and (1 - d / 3w) d / w where d < w.
    """
    width = np.sqrt(size)  # of a patch, in those of a ball
    share = 1.0 - 1.0 / (3.0 * width) if width >= 1.0 else width * (1.0 - width / 3.0)
    return float(share**2)


def _mode(pair: PairLikelihood, start: Array, spread: Array, centre_m: Array, *, fine_m: float) -> tuple[Array, float]:
    """Return where matching surface and the spread (6, 6) of the samples about their mean settle, and the noise."""
    precision = np.linalg.inv(spread @ spread.T)
    pose, noise_m = start, pair.surface_noise_m(start, fine_m)
    for _ in range(8):
        gradient, matrix = pair.normal_equation(pose, noise_m)
        away = se3.difference(start, pose, centre_m)
        step = np.asarray(np.linalg.solve(matrix + precision, gradient - precision @ away), dtype=np.float64)
        pose = se3.moved(pose, step, centre_m)
        noise_m = pair.surface_noise_m(pose, fine_m)
        if np.linalg.norm(np.linalg.solve(spread, step)) < 0.01:  # standard deviations
            break
    return pose, noise_m


def _steps(pair: PairLikelihood, poses: Array, noise_m: float, spread: Array, centre_m: Array) -> Array:
    """Return the Gauss-Newton steps (n, 6) of motions, held by the samples' spread where nothing else holds them."""
    gradient, matrix = pair.normal_equations(poses, noise_m, stride=2)
    held = matrix + np.linalg.inv(spread @ spread.T)
    return np.asarray(np.linalg.solve(held, gradient[:, :, None])[:, :, 0], dtype=np.float64)


def _equations(
    pair: PairLikelihood, pose: Array, noise_m: float, centre_m: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the matching points' equations in the source's frame, about the centre.

    Returns:
        Positions (n, 3), derivatives of the residuals by ξ with the point's own normal and with the other surface's
        (n, 6), residuals (n,) in m and weights (n,) in 1/m².
    """
    parts = []
    directions: list[tuple[DirectedLikelihood, Array, float]] = [
        (pair.forward, pose, 1.0),
        (pair.backward, se3.inverse(pose), -1.0),
    ]
    for lookup, there, sign in directions:
        found = lookup.matches(rows(there), noise_m)
        found = found[found[:, matching.WEIGHT] > 0.0]
        to_source = np.eye(4) if sign < 0.0 else se3.inverse(pose)
        arms = se3.transform(to_source, found[:, matching.POSITION]) - centre_m
        own, other = (found[:, k] @ to_source[:3, :3].T for k in (matching.OWN, matching.OTHER))
        derivatives = [sign * np.hstack([np.cross(arms, normals), normals]) for normals in (own, other)]
        parts.append((arms, *derivatives, found[:, matching.RESIDUAL], found[:, matching.WEIGHT]))
    arms, by_own, by_other, residuals, weights = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return arms, by_own, by_other, residuals, weights
