"""Where colour is against depth: its shift and scale, from print that pairs of views share (method, eq. 7.7).

Under right poses, a place on the surface has the same print in two views. If colour is displaced, each view shows there
the print of another place, and how far these are apart depends on how the surface turns from one view to the other: a
shift along the axis of the turn moves both alike, and is not observable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import linalg, ndimage

from modeler import se3
from modeler.registration.visibility import VisibilityLikelihood
from modeler.registration.visibility.photometric import MAX_CORRELATION
from modeler.types import FLIPS, Array, ColourAlignment
from modeler.verdict.colour_fit import (
    AT_LEAST,
    COARSE,
    LOG_SCALES,
    MIN_SHARED,
    REACH,
    Comparison,
    Displacement,
    Pair,
    places_in,
)
from modeler.views import Sensor

_REACH_SDS: Final = 2.0  # of the prior: colour of another camera is as far off as is searched, 15 to 50 mm aside
_STEPS: Final = 4  # in each band: from a few px off, the last one moves it by less than 0.1 sd
_APART_PX: Final = 0.25  # of places whose difference is a derivative: on planes, it is nearly linear
_SMALL: Final = 1e-9 * np.eye(3)  # information of no importance
_FAINTEST: Final = 1e-6  # standard deviation of a feature, of images without any


def colour_alignment(compared: Comparison, start: Displacement) -> ColourAlignment:
    """Return shift and scale of a run's colours as a Gaussian: steps of Gauss and Newton from the coarse band down.

    It is given the poses. Where print agrees poorly even there, it is the start, with the covariance of the prior.

    Args:
        compared: the colours of its pairs.
        start: where the search found them; how they are turned over, and of which frame they are, stays.
    """
    width = compared.features(compared.width_px).shape[2]
    prior = np.diag((_REACH_SDS / np.array([REACH[0] * width, REACH[1] * width, LOG_SCALES[-1]])) ** 2)
    shared = [_Shared.of(compared, pair, start.frames) for pair in compared.pairs]
    mean = np.array([*start.shift_px, np.log(start.scale)])
    for width_px in (COARSE * compared.width_px, compared.width_px):
        for _ in range(_STEPS):
            gradient, information = _evidence(compared, shared, start.moved_to(mean), width_px)
            step = np.linalg.solve(information + prior, gradient - prior @ mean)
            longest_px = max(abs(step[0]), abs(step[1]), abs(step[2]) * 0.25 * width)  # beyond, features are not linear
            mean = np.asarray(mean + step * min(1.0, width_px / max(longest_px, 1e-9)), dtype=np.float64)
    _, information = _evidence(compared, shared, start.moved_to(mean), compared.width_px)
    if compared.correlation(start.moved_to(mean), compared.width_px) < AT_LEAST:  # chance has no information
        mean, information = np.array([*start.shift_px, np.log(start.scale)]), np.zeros((3, 3))
    covariance = np.asarray(np.linalg.inv(information + prior), dtype=np.float64)
    return ColourAlignment(mean, covariance, start.flip, start.frames)


@dataclass(frozen=True, eq=False)
class _Shared:
    """Surface of a pair in the images of its two views."""

    numbers: tuple[int, int]
    """Of the views in `Comparison.frames`."""
    places: tuple[Array, Array]
    """(n, 2) column and row in either."""
    slides: tuple[Array, Array]
    """(n, 2, 2) by how far the surface that is at a place of the second moves in the first if the place moves, on the
    planes that either view has measured there."""
    apart_px: Array
    """(2,) from the middle of the object in the first to that in the second."""
    patches_px: float
    """Number of pixels that a point stands for."""
    sigma_px: float
    """Standard deviation of a shift of the colours of one against those of the other."""

    @staticmethod
    def of(compared: Comparison, pair: Pair, frames: int) -> _Shared:
        """Return the surface of a pair that faces the second view by the normals of both."""
        sides = [compared.views[frame] for frame in (pair.first, pair.second)]
        poses = [compared.camera_from_object(frame, frames) for frame in (pair.first, pair.second)]
        points_m = se3.transform(poses[1], pair.points_m)
        normals = [each @ poses[1][:3, :3].T for each in pair.normals]
        slopes = [-np.sum(each * points_m, axis=1) / np.linalg.norm(points_m, axis=1) for each in normals]
        facing = np.min(slopes, axis=0) >= Sensor.min_cosine
        points_m, first_from_second = points_m[facing], poses[0] @ se3.inverse(poses[1])
        places = places_in(sides[0], se3.transform(first_from_second, points_m)), places_in(sides[1], points_m)

        def slides(normals: Array) -> Array:
            offsets, columns = np.sum(normals * points_m, axis=1), []
            for along in np.eye(2):
                camera, there = sides[1].frame.camera, places[1] + _APART_PX * along
                rays = np.column_stack([(there - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(there))])
                slid_m = rays * (offsets / np.sum(normals * rays, axis=1))[:, None]
                moved = places_in(sides[0], se3.transform(first_from_second, slid_m))
                columns.append((moved - places[0]) / _APART_PX)
            return np.stack(columns, axis=2)

        middles = [places_in(view, view.centroid_m[None])[0] for view in sides]
        return _Shared(
            (compared.frames.index(pair.first), compared.frames.index(pair.second)),
            places,
            (slides(normals[0][facing]), slides(normals[1][facing])),
            middles[1] - middles[0],
            pair.pixels / max(len(pair.points_m), 1),
            sides[0].sigma_colour_px,
        )


def _evidence(
    compared: Comparison, shared: Sequence[_Shared], displacement: Displacement, width_px: float
) -> tuple[Array, Array]:
    """Return the gradient (3,) of all pairs' log likelihood by shift and log scale, and the information (3, 3).

    Noise of features and normals pretends to observe what is not: as that of two views is independent, what their
    derivatives have in common is not noise, and counts as much as it is of all there is.
    """
    found = [_of_pair(one, compared.features(width_px), displacement, width_px) for one in shared]
    squares = [gradient @ np.linalg.solve(total + _SMALL, gradient) for gradient, total, _ in found if total.any()]
    factor = max(1.0, np.mean(squares) / 3.0) if squares else 1.0  # of the variance, as pairs disagree
    gradient, total, common = (sum(parts) / factor for parts in zip(*found, strict=True))
    reliable, along = linalg.eigh(common, total + _SMALL)
    weights, back = np.clip(reliable, 0.0, 1.0), total @ along
    return back @ (weights * (along.T @ gradient)), (back * weights**2) @ back.T


def _of_pair(
    one: _Shared, images: np.ndarray, displacement: Displacement, width_px: float
) -> tuple[Array, Array, Array]:
    """Return a pair's gradient (3,), and its information (3, 3): in all, and what both views confirm.

    Features that stay in place are removed as in registration (eq. 7.2), shifts between the two images as in (7.5).
    """
    shape, nothing = images.shape[1:], (np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)))
    sides = list(zip(one.numbers, one.numbers[::-1], one.places, (one.apart_px, -one.apart_px), strict=True))
    own = np.stack([_sampled(images[k], displacement.moved(at, shape)) for k, _, at, _ in sides])
    still = np.stack([_sampled(images[k], displacement.moved(at + aside, shape)) for _, k, at, aside in sides])
    known = np.isfinite(own + still).all(axis=(0, 1)) & (np.linalg.det(one.slides[0]) >= Sensor.min_cosine)
    own, still = own[:, :, known], still[:, :, known]
    if known.sum() < MIN_SHARED or min(own[:, 0].std(axis=1).min(), still[:, 0].std(axis=1).min()) < _FAINTEST:
        return nothing
    share = max(0.0, *(float(np.corrcoef(one, other)[0, 1]) for one, other in zip(own[:, 0], still[:, 0], strict=True)))
    features = own - share * still
    features /= features[:, :1].std(axis=2, keepdims=True)
    values = features[:, 0] - features[:, 0].mean(axis=1, keepdims=True)
    correlation = float(np.clip(np.mean(values[0] * values[1]), 0.0, MAX_CORRELATION))
    if correlation == 0.0:
        return nothing
    patches = one.patches_px * known.sum() / (4.0 * np.pi * width_px**2)
    count = (1.0 - share**2) / (1.0 / VisibilityLikelihood.max_independent_colours + 1.0 / patches)  # as (7.3)
    weight = count / known.sum() / (2.0 * (1.0 - correlation))  # inverse variance of the difference of two values
    slides = [each[known] for each in one.slides]
    gradients = displacement.scale * np.array(FLIPS[displacement.flip])[:, None] * features[:, 1:]
    across = (gradients[0].T, np.linalg.solve(np.swapaxes(slides[0], 1, 2), gradients[1].T[:, :, None])[:, :, 0])
    first, second = (at[known] - 0.5 * (np.array(shape[::-1]) - 1.0) for at in one.places)
    by_view, nuisance = [], []
    for gradient, slide in zip(across, slides[::-1], strict=True):  # noise of each view's is in one of the two only
        by_scale = np.einsum("nij,nj->ni", slide, second) - first
        moves = np.concatenate([(slide - np.eye(2)) / displacement.scale, by_scale[:, :, None]], axis=2)
        by_view.append(np.einsum("ni,nij->nj", gradient, moves))
        nuisance.append(one.sigma_px * gradient)
    shift, move = 0.5 * (nuisance[0] + nuisance[1]), 0.5 * (by_view[0] + by_view[1])
    taken = np.linalg.solve(weight * shift.T @ shift + np.eye(2), weight * shift.T @ move)
    one_view, other_view = (each - each_shift @ taken for each, each_shift in zip(by_view, nuisance, strict=True))
    left, common, known_shift = move - shift @ taken, weight * one_view.T @ other_view, taken.T @ taken
    return (
        weight * left.T @ (values[0] - values[1]),
        weight * left.T @ left + known_shift,
        0.5 * (common + common.T) + known_shift,
    )


def _sampled(image: np.ndarray, places: Array) -> Array:
    """Return values of an image (h, w) at places (n, 2), and derivatives by column and row (3, n); NaN outside."""
    around = 0.5 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    columns, rows = (places[:, None] + around).T
    middle, right, left, below, above = ndimage.map_coordinates(image, [rows, columns], order=1, cval=np.nan)
    return np.stack([middle, right - left, below - above]).astype(np.float64)
