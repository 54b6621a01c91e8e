"""The likelihood of a pair's colours: the correlation of print on matching surface (method, eq. 7.1 to 7.4).

Lights are fixed to the camera while the object turns: shading moves over the surface, and exposure and white balance
drift. Both are multiplicative, and shading is smooth, so that the band-passed logarithm of a colour contains the print
and little else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from modeler.kernels import bands, photometric, scores
from modeler.kernels.photometric import Colours, harmonics_of, shading_of
from modeler.significance import SIGMAS
from modeler.types import Array, Frame, RayImage

FINEST_PX = 0.6
"""Standard deviation of the finest band's Gaussian in px: below it, pixels and noise dominate."""
BANDS = 6
"""Number of bands, each twice as wide as the previous one; with 3 or 12, pairs of six sequences are as good."""

VALUE, BY_COLUMN, BY_ROW = range(3)
"""Of a band at a surface point: the feature, and its derivatives by column and row in 1/px."""

LOGS = (np.log(np.arange(256) + 4.0) / 3.0).astype(np.float32)
"""Third of the logarithm (256,) of each 8-bit value, for three channels; below 4, noise and rounding would dominate."""
_COARSEST_ALIGNMENT = 2  # band in which images are first aligned: a tin's print moves by more than its width
_SHADING_POINTS = 2000  # of a view, to estimate its shading
_NORMAL_QUARTILE = 0.6745  # median magnitude of a standard normal variable
_LEVEL = 1.0 / 255.0  # smallest change of a bright colour's logarithm in 8 bits
_CACHE: WeakKeyDictionary[RayImage, np.ndarray] = WeakKeyDictionary()  # of `view_features`

ASSUMED_RHO = 0.7
"""Correlation assumed in descent, as print has on captures (0.7 to 0.8); with 0.35 or 0.85, pairs of six sequences are
as good."""
MAX_CORRELATION = 0.99
"""Largest correlation that is assumed: of images without noise, weights would be infinite."""


@dataclass(frozen=True, eq=False)
class PairColour:
    """Colours of two views at the points of their likelihood."""

    source: RayImage
    target: RayImage
    source_points: np.ndarray
    """(n,) indices of the source's surface points to compare."""
    target_points: np.ndarray
    """(m,) of the target's."""
    max_print: float
    """Largest number of independent features of print, limited by errors that distant points share."""
    max_noise: float
    """Largest number of independent features of noise."""
    _shifts_px: dict[int, Array] = field(default_factory=dict)
    _static_correlations: dict[int, float] = field(default_factory=dict)
    _residuals: dict[int, tuple[_Features, _Features]] = field(default_factory=dict)
    _by_stride: dict[tuple[int, int], tuple[Colours, Colours]] = field(default_factory=dict)

    def at(self, source_points: np.ndarray, target_points: np.ndarray) -> PairColour:
        """Return the colours of the same views at other points, with the same cached features."""
        return replace(self, source_points=source_points, target_points=target_points, _by_stride={})

    def band(self, blur_m: float) -> int:
        """Return the index of the band for surfaces with a blur."""
        blur_px = blur_m * self.target.frame.camera.fx / max(float(self.target.centroid_m[2]), 1e-3)
        return min(round(math.log2(max(blur_px / FINEST_PX, 1.0))), BANDS - 1)

    def log_likelihoods(self, scored: Array, band: int, *, stride: int) -> Array:
        """Return log L_c (n,) in nats: colours of matching surface against independent ones (method, eq. 7.3).

        Args:
            scored: (n, 6) `scores.scores` of poses, with the colours of a band.
            band: index of the band.
            stride: every `stride`-th point was used.
        """
        found = correlations(scored)
        count = self.compared(scored, band, found, stride=stride)
        # To first order in ρ²: the exact logarithm has peaks too narrow to sample.
        gain = 0.5 * count * np.maximum(found, 0.0) ** 2
        return np.asarray(np.logaddexp(0.0, gain - 0.5 * np.log(np.maximum(count, 1.0))), dtype=np.float64)

    def compared(self, scored: Array, band: int, correlation: Array, *, stride: int) -> Array:
        """Return the numbers n_c (n,) of independent features that are compared (method, eq. 7.3).

        Args:
            scored: as for `log_likelihoods`.
            band: index of the band.
            correlation: (n,) of the features.
            stride: as for `log_likelihoods`.
        """
        points = sum(len(colours.values) for colours in self.colours(band, stride))
        return np.asarray(scored[:, scores.MATCHES] / points * self.independent(band, correlation))

    def curvature(self, correlation: float, band: int) -> float:
        """Return twice the decrease of `log_likelihoods` per mean square difference of features."""
        here, without = self.independent(band, np.array([correlation, 0.0]))
        return float(here**2 / max(without, 1e-12)) * max(correlation, 0.0)  # d(n_c ρ²) / dρ² is n_c² / n_c(0)

    def independent(self, band: int, correlation: Array) -> Array:
        """Return the numbers (n,) of independent features with correlations (n,) if all surface matches (eq. 7.3)."""
        static, wider = (self.static_correlation(one) for one in (band, min(band + 1, BANDS - 1)))
        max_noise = max((1.0 - wider**2) * self.max_noise, self.max_print)  # light that stays is not quite subtracted
        of_print = np.clip(correlation, 0.0, 1.0) ** 2
        limits = of_print / self.max_print + (1.0 - of_print) / max_noise
        return np.asarray((1.0 - static**2) / (limits + 1.0 / self.patches(band)))

    def shifts(self, poses: Array) -> Array:
        """Return E (..., 6, 2), motions ξ that shift the target's colours by a standard deviation along both axes.

        Args:
            poses: (..., 4, 4) target_from_source.
        """
        sigma_m = self.target.sigma_colour_px * float(self.target.centroid_m[2]) / self.target.frame.camera.fx
        found = np.zeros((*poses.shape[:-2], 6, 2))
        found[..., 3:, :] = sigma_m * np.swapaxes(poses[..., :2, :3], -1, -2)
        return found

    def matches(
        self, transform: Array, matches: Array, points: np.ndarray, band: int, weight: float, *, forward: bool
    ) -> Array:
        """Return the equations of features of one direction's matches, in the layout of `point_to_plane.matches`.

        The gradient of a feature replaces the normal, the difference of features the distance.

        Args:
            transform: (4, 4) transform of the points into the other camera.
            matches: (n, 15) `point_to_plane.matches` of positive weight.
            points: (n,) indices of their points.
            band: index of the band.
            weight: of squared differences of features.
            forward: whether the points are the source's.
        """
        own, theirs = self._regressed(band) if forward else self._regressed(band)[::-1]
        other, chosen = (self.target, self.source_points) if forward else (self.source, self.target_points)
        camera, rotation, numbers = other.frame.camera, np.ascontiguousarray(transform[:3, :3]), chosen[points]
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        sides = own.values[numbers], own.cells[numbers], theirs.cells
        return photometric.compare_matches(matches, rotation, *sides, lens, other.numbers, weight)

    def colours(self, band: int, stride: int) -> tuple[Colours, Colours]:
        """Return the two directions of a band, at every `stride`-th point."""
        if (band, stride) not in self._by_stride:
            forward, backward = self._colours(band) if stride == 1 else self.colours(band, 1)
            self._by_stride[band, stride] = forward.thinned(stride), backward.thinned(stride)
        return self._by_stride[band, stride]

    def _colours(self, band: int) -> tuple[Colours, Colours]:
        source, target = self._regressed(band)
        return (
            Colours(source.values[self.source_points], target.cells, self.target.numbers.ravel()),
            Colours(target.values[self.target_points], source.cells, self.source.numbers.ravel()),
        )

    def _regressed(self, band: int) -> tuple[_Features, _Features]:
        """Return the features of all points of source and target in a band, without static ones (eq. 7.2)."""
        if band not in self._residuals:
            share = max(self.static_correlation(band), 0.0)
            shift_px = self._static_shift_px(band) if share > 0.0 else np.zeros(2)
            self._residuals[band] = (
                _regressed(self.source, self.target, shift_px, band, share),
                _regressed(self.target, self.source, -shift_px, band, share),
            )
        return self._residuals[band]

    def patches(self, band: int) -> float:
        """Return the number of surface patches with independent features; mean of both views."""
        points = 0.5 * (len(self.source.points_m) + len(self.target.points_m))
        return points / (4.0 * np.pi * (FINEST_PX * 2**band) ** 2)

    def static_correlation(self, band: int) -> float:
        """Return ρ₀, the correlation of features at the same place of both views (method, eq. 7.2).

        Features that stay in place while the object turns are effects of light: highlights, shading, fixed patterns.
        A rendered view has none, and may show the object in the pose of the other.
        """
        if self.source.rendered or self.target.rendered:
            return 0.0
        if band not in self._static_correlations:
            moments, _, _ = _in_place(self.source, self.target, band, self._static_shift_px(band))
            self._static_correlations[band] = _correlation(moments)
        return self._static_correlations[band]

    def _static_shift_px(self, band: int) -> Array:
        """Return columns and rows (2,) by which static features of the target lie from the source's, besides centroids.

        Errors of centroids exceed the width of the finest bands: from `_COARSEST_ALIGNMENT` on, a step in each band.
        """
        band = min(band, _COARSEST_ALIGNMENT)
        if band not in self._shifts_px:
            coarse_px = np.zeros(2) if band == _COARSEST_ALIGNMENT else self._static_shift_px(band + 1)
            self._shifts_px[band] = _aligned(self.source, self.target, band, coarse_px)
        return self._shifts_px[band]


class _Features(NamedTuple):
    """Features of a view's surface points, without static ones."""

    values: np.ndarray
    """(n,) of unit variance."""
    cells: np.ndarray
    """(n + 1, 4) see `Colours`."""


def correlations(scored: Array) -> Array:
    """Return correlations (n,) of the features of matching points from `scores.scores` (n, 6)."""
    scale = np.sqrt(scored[:, scores.OWN_SQUARE] * scored[:, scores.OTHER_SQUARE])
    return np.asarray(scored[:, scores.PRODUCT] / np.maximum(scale, 1e-12), dtype=np.float64)


def without_shift(equations: Array, shifts: Array) -> Array:
    """Return the matrices K (..., 6, 6) that eliminate unknown shifts from equations (method, eq. 7.5).

    Args:
        equations: (..., 6, 6) normal equations of colours.
        shifts: (..., 6, 2) shifts by a standard deviation, as motions ξ.
    """
    coupled, across = equations @ shifts, np.swapaxes(shifts, -1, -2)
    return np.eye(6) - coupled @ np.linalg.inv(np.eye(2) + across @ coupled) @ across


def weight_of(correlation: float) -> float:
    """Return the weight of squared differences of features of unit variance (method, eq. 7.4)."""
    square = float(np.clip(correlation, 0.0, MAX_CORRELATION)) ** 2
    return square / (1.0 - square)


def _aligned(view: RayImage, other: RayImage, band: int, shift_px: Array) -> Array:
    """Return a shift (2,) at which features in place agree better, or the same: one step of least squares.

    The step is that of Lucas and Kanade (1981).
    """
    moments, matrix, gradient = _in_place(view, other, band, shift_px)
    step = np.linalg.lstsq(matrix, gradient, rcond=None)[0]
    width_px = FINEST_PX * 2**band  # farther features are not linear
    moved_px = shift_px + step * min(1.0, width_px / max(float(np.linalg.norm(step)), 1e-12))
    agrees_better = _correlation(_in_place(view, other, band, moved_px)[0]) > _correlation(moments)
    return moved_px if agrees_better else shift_px


def _in_place(view: RayImage, other: RayImage, band: int, shift_px: Array) -> tuple[Array, Array, Array]:
    """Return the sums of `photometric.compare_in_place` over a subset of a view's points."""
    own, others = view_features(view)[band], view_features(other)[band]
    subset = _subset(own.shape[1])
    partners = _partners(view.points_m[subset], view, other, shift_px)
    return photometric.compare_in_place(own[:, subset], others, *partners)


def _correlation(moments: Array) -> float:
    """Return the correlation of features from their second moments (3,): own, mixed, and other."""
    return float(moments[1] / max(math.sqrt(moments[0] * moments[2]), 1e-12))


def _subset(count: int) -> slice:
    """Return an evenly spread subset of points for estimates of shading."""
    return slice(None, None, max(count // _SHADING_POINTS, 1))


def _partners(points_m: Array, view: RayImage, other: RayImage, shift_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where points of a view fall in the other if the object is only shifted.

    Args:
        points_m: (n, 3).
        view: view of the points.
        other: view in which they fall.
        shift_px: (2,) columns and rows, in addition to the shift of the centroids.

    Returns:
        Index (n,) of the other view's point there, see `RayImage.numbers`; and columns and rows (n, 2) from its pixel.
    """
    camera = other.frame.camera
    found = np.empty(len(points_m), dtype=np.int32)
    offsets = np.zeros((len(points_m), 2), dtype=np.float32)
    lens = np.array([camera.fx, camera.fy, camera.cx + shift_px[0], camera.cy + shift_px[1]])
    photometric.find_in_place(
        points_m, other.centroid_m - view.centroid_m, lens, other.numbers, len(other.pixels), found, offsets
    )
    return found, offsets


def _no_partners(view: RayImage, other: RayImage) -> tuple[np.ndarray, np.ndarray]:
    """Return what `_partners` does if no point of a view falls on the other's surface."""
    count = len(view.points_m)
    return np.full(count, len(other.pixels), dtype=np.int32), np.zeros((count, 2), dtype=np.float32)


def _regressed(view: RayImage, other: RayImage, shift_px: Array, band: int, share: float) -> _Features:
    """Return a view's features in a band, regressed on the other view's at the same places (eq. 7.2).

    Args:
        view: the view.
        other: the other view.
        shift_px: (2,) columns and rows, in addition to the shift of the centroids.
        band: index of the band.
        share: regression coefficient.
    """
    features, camera = view_features(view)[band], view.frame.camera
    residual = _Features(
        np.empty(features.shape[1], dtype=np.float32),
        np.empty((features.shape[1] + 1, photometric.CELL_SIZE), dtype=np.float32),
    )
    focal = np.array([camera.fx, camera.fy], dtype=np.float32)
    others = view_features(other)[band]
    partners = _partners(view.points_m, view, other, shift_px) if share > 0.0 else _no_partners(view, other)
    photometric.remove_static(features, others, *partners, np.float32(share), view.points_m, focal, *residual)
    return residual


def view_features(view: RayImage) -> np.ndarray:
    """Return the features of a view's surface points, see `features` and `bands.winsorise`.

    They are cached, as a view is part of several pairs.
    """
    if view not in _CACHE:
        found = features(view.frame, view.pixels, view.normals)
        for band in found:
            bands.winsorise(band)
        _CACHE[view] = found
    return _CACHE[view]


def features(frame: Frame, pixels: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the features of surface points in bands of increasing width (method, eq. 7.1).

    Args:
        frame: with its colour.
        pixels: (n, 2) row and column of each surface point.
        normals: (n, 3) in the camera's frame.

    Returns:
        (BANDS, 3, n) float32: `VALUE`, `BY_COLUMN` and `BY_ROW`.
    """
    found = np.zeros((BANDS, 3, len(pixels)), dtype=np.float32)
    if frame.colour is None or not len(pixels):
        return found
    low, high = (np.array([choose(axis) for axis in pixels.T]) for choose in (np.min, np.max))
    multiple = 2 ** (BANDS - 1)  # sides are halved that often
    images = np.zeros(
        (3, *(-(-(high + 1 - low) // multiple) * multiple)), dtype=np.float32
    )  # colours, shading, where surface is
    places, logs = np.empty((len(pixels), 2), dtype=np.int32), np.empty(len(pixels), dtype=np.float32)
    bands.look_up(frame.colour, pixels, low, LOGS, places, logs)
    bands.lay_out(places, logs - logs.mean(), _shading(logs, normals), images)
    halvings, inner = 0, _blurred(images, FINEST_PX)
    for band in range(BANDS):
        outer = _blurred(images, 2.0 * FINEST_PX * 2**band / 2**halvings)
        layers = np.empty((2, *images.shape[1:]), dtype=np.float32)
        bands.subtract_means(inner, outer, images[2], layers)
        valid = _unshaded(layers, images[2])
        bands.sample_layer(layers[0], valid, places, halvings, found[band])
        if band == 0:
            inner = outer
        else:  # the next band is computed from images of half the size
            images, inner, halvings = _halved(images), _halved(outer), halvings + 1
    return found


def _shading(logs: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the fit by harmonics of normals (n, 3) to logarithms of colours (n,) (Basri and Jacobs 2003)."""
    subset = _subset(len(logs))
    basis = np.column_stack([np.ones(len(logs[subset])), harmonics_of(normals[subset], np.eye(4))])
    inverse = np.linalg.pinv(basis.T @ basis, rcond=1e-4, hermitian=True)  # few faces determine few harmonics
    return shading_of(normals, inverse @ (basis.T @ logs[subset]))


def _unshaded(layers: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Subtract from a band of colours the part explained by shading, and return where (h, w) the result is valid.

    Lamps fixed to the camera light the faces of a plain box differently, and their edges would look like print: where
    shading changes by more than noise of the normals, the result is invalid. Where that noise dominates, the band of
    the shading explains little.

    Args:
        layers: (2, h, w) the band of the colours, modified in place, and that of the shading.
        surface: (h, w) positive on the surface.
    """
    colours, shading = layers
    inside = np.flatnonzero(surface)
    changes = np.abs(shading.ravel()[inside[_subset(len(inside))]])
    noise = max(float(np.median(changes)) / _NORMAL_QUARTILE, _LEVEL)
    valid = np.empty(surface.shape, dtype=np.bool_)
    bands.subtract_shading(colours, shading, surface, np.float32(_LEVEL**2), np.float32(SIGMAS * noise), valid)
    return valid


def _halved(images: np.ndarray) -> np.ndarray:
    """Return the means of blocks of 2 × 2 px of images (k, h, w), whose sides are even."""
    return np.float32(0.25) * (
        images[:, ::2, ::2] + images[:, 1::2, ::2] + images[:, ::2, 1::2] + images[:, 1::2, 1::2]
    )


def _blurred(images: np.ndarray, width_px: float) -> np.ndarray:
    """Return images (k, h, w) blurred by a Gaussian, which is cut off at `SIGMAS`."""
    weights = np.exp(-0.5 * (np.arange(int(SIGMAS * width_px + 0.5) + 1) / width_px) ** 2)
    weights /= 2.0 * weights.sum() - weights[0]
    blurred = np.empty_like(images)
    bands.blur(images, weights.astype(np.float32), blurred)
    return blurred
