"""The colour of a pair: how well what is painted on matching surface agrees (method.md, eq. 17 to 20).

Lights stay with the camera while the object turns: shading moves over the surface, and exposure and white balance
drift. Both multiply, and shading is smooth, so that the logarithm of a colour, less its mean over a wider
neighbourhood, shows the print and little else, band by band.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from modeler.kernels import bands, photometric, scores
from modeler.kernels.photometric import Colours
from modeler.kernels.shading import harmonics_of, shading_of
from modeler.types import Array, Frame, RayImage

FINEST_PX = 0.6
"""Standard deviation of the finest band's Gaussian in px: below it, pixels and noise rule."""
BANDS = 6
"""Number of bands, each twice as wide as the one before."""

VALUE, BY_COLUMN, BY_ROW = 0, 1, 2
"""Of a band at a surface point: the feature, and its derivatives by column and row in 1/px."""

_BLACK = 4.0  # added to 8-bit values: below it noise and rounding would rule their logarithm
_LOGS = (np.log(np.arange(256) + _BLACK) / 3.0).astype(np.float32)  # of each of three 8-bit values, a third
_ALIGNED = 2  # band by which images are aligned: print of a tin turns by more than its width
_ENOUGH = 2000  # points of a view from which its light is told
_CREASE = 3.0  # standard deviations by which shading changes where surface has an edge, beyond noise of its normals
_NORMAL_QUARTILE = 0.6745  # median magnitude of a standard normal variable
_LEVEL = 1.0 / 255.0  # smallest change of a bright colour's logarithm that 8 bits show
_REACH = 3.0  # of a Gaussian, in standard deviations
_KNOWN: WeakKeyDictionary[RayImage, np.ndarray] = WeakKeyDictionary()  # `view_features` made so far

_STEADY = 4.0
"""So many standard deviations of the colours' shift is the finest band by which samples are weighted, at least."""
UNDECIDED = 0.7
"""Correlation that is assumed where a descent starts."""
_MOST = 0.99  # correlation


@dataclass(frozen=True, eq=False)
class PairColour:
    """Colour of two views at the points that the likelihood compares."""

    source: RayImage
    target: RayImage
    source_points: np.ndarray
    """(n,) numbers of the source's surface points that are compared."""
    target_points: np.ndarray
    """(m,) of the target's."""
    _unmoved: dict[int, float] = field(default_factory=dict)
    _left: dict[int, tuple[_Features, _Features]] = field(default_factory=dict)
    _made: dict[tuple[int, int], tuple[Colours, Colours]] = field(default_factory=dict)

    def at(self, source_points: np.ndarray, target_points: np.ndarray) -> PairColour:
        """Return the colour of the same views at other points, which shares what was made of the images."""
        return replace(self, source_points=source_points, target_points=target_points, _made={})

    def band(self, blur_m: float) -> int:
        """Return the number of the band for surfaces of that blur."""
        blur_px = blur_m * self.target.frame.camera.fx / max(float(self.target.centroid_m[2]), 1e-3)
        return int(np.clip(np.round(np.log2(max(blur_px / FINEST_PX, 1.0))), 0, BANDS - 1))

    def log_likelihoods(self, scored: Array, band: int, max_independent: float, *, stride: int) -> Array:
        """Return how much likelier (n,) in nats the target's colours are, given the source's (method.md, eq. 19).

        Args:
            scored: (n, 6) `scores.scores` of poses, with the colours of a band.
            band: number of the band.
            max_independent: largest number of independent features.
            stride: every `stride`-th point was used.
        """
        compared = sum(len(colours.values) for colours in self.colours(band, stride))
        count = scored[:, scores.MATCHES] / compared * self.independent(band, max_independent)
        gain = -0.5 * count * np.log1p(-(np.clip(correlations(scored), 0.0, _MOST) ** 2))
        return np.asarray(np.logaddexp(0.0, gain - 0.5 * np.log(np.maximum(count, 1.0))), dtype=np.float64)

    def curvature(self, correlation: float, band: int, max_independent: float) -> float:
        """Return by how much all points' mean square difference of features lowers `log_likelihoods`, twice."""
        rho = float(np.clip(correlation, 0.0, _MOST))
        return self.independent(band, max_independent) * rho / (1.0 - rho**2)

    def independent(self, band: int, most: float) -> float:
        """Return the number of independent features if all surface matched (method.md, eq. 19)."""
        return (1.0 - self.unmoved(band) ** 2) / (1.0 / most + 1.0 / self.patches(band))

    def scored_band(self, blur_m: float) -> int:
        """Return the number of the band by which samples are weighted."""
        return max(self.band(blur_m), self._finest_scored)

    @property
    def _finest_scored(self) -> int:
        """Number of the finest band by which samples are weighted: a shift of the colours changes little in it."""
        steady = int(np.ceil(np.log2(max(_STEADY * self.target.sigma_colour_px / FINEST_PX, 1.0))))
        return int(min(steady, BANDS - 1))

    def shifts(self, poses: Array) -> Array:
        """Return the motions ξ (..., 6, 2) that shift the target's colours by a standard deviation along both axes.

        Args:
            poses: (..., 4, 4) target_from_source.
        """
        sigma_m = self.target.sigma_colour_px * float(self.target.centroid_m[2]) / self.target.frame.camera.fx
        found = np.zeros((*poses.shape[:-2], 6, 2))
        found[..., 3:, :] = sigma_m * np.swapaxes(poses[..., :2, :3], -1, -2)
        return found

    def matches(
        self, carried: Array, matches: Array, points: np.ndarray, band: int, weight: float, *, forward: bool
    ) -> Array:
        """Return the features of matches (n, 14) of one direction in the place of their surface, see `point_to_plane`.

        The gradient of a feature is the normal, the difference of features the distance.

        Args:
            carried: (4, 4) the transform that carries the points into the other camera.
            matches: `point_to_plane.matches` that are matches,
            points: (n,) and of which points.
            band: number of the band.
            weight: of squared differences of features.
            forward: whether the points are the source's.
        """
        own, theirs = self._explained(band) if forward else self._explained(band)[::-1]
        other, chosen = (self.target, self.source_points) if forward else (self.source, self.target_points)
        camera, rotation, numbers = other.frame.camera, np.ascontiguousarray(carried[:3, :3]), chosen[points]
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        sides = own.values[numbers], own.cells[numbers], theirs.cells
        return photometric.compare_matches(matches, rotation, *sides, lens, other.numbers, weight)

    def colours(self, band: int, stride: int) -> tuple[Colours, Colours]:
        """Return the two directions of a band, at every `stride`-th point."""
        if (band, stride) not in self._made:
            forward, backward = self._colours(band) if stride == 1 else self.colours(band, 1)
            self._made[band, stride] = forward.thinned(stride), backward.thinned(stride)
        return self._made[band, stride]

    def _colours(self, band: int) -> tuple[Colours, Colours]:
        source, target = self._explained(band)
        return (
            Colours(source.values[self.source_points], target.cells, self.target.numbers.ravel()),
            Colours(target.values[self.target_points], source.cells, self.source.numbers.ravel()),
        )

    def _explained(self, band: int) -> tuple[_Features, _Features]:
        """Return what light does not explain of the features of all points of source and target in a band."""
        if band not in self._left:
            there, back = self._partners
            share = max(self.unmoved(band), 0.0)
            self._left[band] = (
                _explained(self.source, self.target, there, band, share),
                _explained(self.target, self.source, back, band, share),
            )
        return self._left[band]

    def patches(self, band: int) -> float:
        """Return the number of patches of the surface whose features are independent; mean of both views."""
        points = 0.5 * (len(self.source.points_m) + len(self.target.points_m))
        return points / (4.0 * np.pi * (FINEST_PX * 2**band) ** 2)

    def unmoved(self, band: int) -> float:
        """Return the correlation of features that both views show in the same place (method.md, eq. 18).

        What stays in its place while the object turns is light: highlights, shading, fixed pattern noise.
        """
        if band not in self._unmoved:
            own, others = (view_features(view)[band] for view in (self.source, self.target))
            some = _some(own.shape[1])
            partners = (part[some] for part in self._partners[0])
            (own_square, product, square), _, _ = photometric.compare_in_place(own[:, some], others, *partners)
            self._unmoved[band] = product / max(math.sqrt(own_square * square), 1e-12)
        return self._unmoved[band]

    @cached_property
    def _partners(self) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Where the target shows what the source's points do if that is light, and vice versa: see `_aligned`."""
        return _aligned(self.source, self.target), _aligned(self.target, self.source)


class _Features(NamedTuple):
    """Features of a view's surface points, without what light explains of them."""

    values: np.ndarray
    """(n,) of unit variance."""
    cells: np.ndarray
    """(n + 1, 4) see `Colours`."""


def correlations(scored: Array) -> Array:
    """Return correlations (n,) of the features of matching points from `scores.scores` (n, 6)."""
    scale = np.sqrt(scored[:, scores.OWN_SQUARE] * scored[:, scores.OTHER_SQUARE])
    return np.asarray(scored[:, scores.PRODUCT] / np.maximum(scale, 1e-12), dtype=np.float64)


def unshifted(equations: Array, shifts: Array) -> Array:
    """Return the matrices (..., 6, 6) that take unknown shifts out of equations (method.md, eq. 24).

    Args:
        equations: (..., 6, 6) normal equations of colours.
        shifts: (..., 6, 2) their shifts by a standard deviation, as motions ξ.
    """
    felt, across = equations @ shifts, np.swapaxes(shifts, -1, -2)
    return np.eye(6) - felt @ np.linalg.inv(np.eye(2) + across @ felt) @ across


def weight_of(correlation: float) -> float:
    """Return the weight of squared differences of features of unit variance (method.md, eq. 20)."""
    square = float(np.clip(correlation, 0.0, _MOST)) ** 2
    return square / (1.0 - square)


def _aligned(view: RayImage, other: RayImage) -> tuple[np.ndarray, np.ndarray]:
    """Return the partners of a view's points in the other, shifted so that the two look most alike: see `_partners`.

    Centroids err by more than the finest bands are wide. One step of least squares (Lucas and Kanade 1981).
    """
    some = _some(len(view.points_m))
    own, others = view_features(view)[_ALIGNED], view_features(other)[_ALIGNED]
    partners = _partners(view.points_m[some], view, other, np.zeros(2))
    _, matrix, gradient = photometric.compare_in_place(own[:, some], others, *partners)
    step = np.linalg.lstsq(matrix, gradient, rcond=None)[0]
    width_px = FINEST_PX * 2**_ALIGNED  # farther features are not linear
    shift_px = step * min(1.0, width_px / max(float(np.linalg.norm(step)), 1e-12))
    return _partners(view.points_m, view, other, shift_px)


def _some(count: int) -> slice:
    """Return which of so many points, evenly spread, tell what the light does."""
    return slice(None, None, max(count // _ENOUGH, 1))


def _partners(points_m: Array, view: RayImage, other: RayImage, shift_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where points of a view fall in the other if the object only moves, without a turn.

    Args:
        points_m: (n, 3).
        view: the points'.
        other: where they fall.
        shift_px: (2,) columns and rows from where the difference of the centroids brings them.

    Returns:
        Number (n,) of the other view's point there, see `RayImage.numbers`; and columns and rows (n, 2) from its pixel.
    """
    camera = other.frame.camera
    found = np.empty(len(points_m), dtype=np.int32)
    offsets = np.zeros((len(points_m), 2), dtype=np.float32)
    lens = np.array([camera.fx, camera.fy, camera.cx + shift_px[0], camera.cy + shift_px[1]])
    photometric.find_in_place(
        points_m, other.centroid_m - view.centroid_m, lens, other.numbers, len(other.pixels), found, offsets
    )
    return found, offsets


def _explained(
    view: RayImage, other: RayImage, partners: tuple[np.ndarray, np.ndarray], band: int, share: float
) -> _Features:
    """Return a view's features in a band without a share of the other view's in the same places (eq. 18).

    Args:
        view: the view.
        other: the other view.
        partners: where the view's points are there, see `_partners`.
        band: number of the band.
        share: that light makes up.
    """
    features, camera = view_features(view)[band], view.frame.camera
    left = _Features(
        np.empty(features.shape[1], dtype=np.float32),
        np.empty((features.shape[1] + 1, photometric.CELL_SIZE), dtype=np.float32),
    )
    focal = np.array([camera.fx, camera.fy], dtype=np.float32)
    others = view_features(other)[band]
    photometric.explain_light(features, others, *partners, np.float32(share), view.points_m, focal, *left)
    return left


def view_features(view: RayImage) -> np.ndarray:
    """Return the features of a view's surface points, see `features` and `bands.winsorise`.

    They are made once, as a view is part of several pairs.
    """
    if view not in _KNOWN:
        found = features(view.frame, view.pixels, view.normals)
        for band in found:
            bands.winsorise(band)
        _KNOWN[view] = found
    return _KNOWN[view]


def features(frame: Frame, pixels: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the features of surface points in bands of increasing width (method.md, eq. 17).

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
    most = 2 ** (BANDS - 1)  # sides are halved that often
    images = np.zeros(
        (3, *(-(-(high + 1 - low) // most) * most)), dtype=np.float32
    )  # colours, shading, where surface is
    places, logs = np.empty((len(pixels), 2), dtype=np.int32), np.empty(len(pixels), dtype=np.float32)
    bands.look_up(frame.colour, pixels, low, _LOGS, places, logs)
    bands.lay_out(places, logs - logs.mean(), _shading(logs, normals), images)
    halvings, inner = 0, _blurred(images, FINEST_PX)
    for band in range(BANDS):
        outer = _blurred(images, 2.0 * FINEST_PX * 2**band / 2**halvings)
        layers = np.empty((2, *images.shape[1:]), dtype=np.float32)
        bands.subtract_means(inner, outer, images[2], layers)
        steady = _unshaded(layers, images[2])
        bands.sample_layer(layers[0], steady, places, halvings, found[band])
        if band == 0:
            inner = outer
        else:  # the next band is taken from images of half the size
            images, inner, halvings = _halved(images), _halved(outer), halvings + 1
    return found


def _shading(logs: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return what harmonics of normals (n, 3) tell of logarithms of colours (n,) (Basri and Jacobs 2003)."""
    some = _some(len(logs))
    basis = np.column_stack([np.ones(len(logs[some])), harmonics_of(normals[some], np.eye(4))])
    inverse = np.linalg.pinv(basis.T @ basis, rcond=1e-4, hermitian=True)  # few faces tell few harmonics
    return shading_of(normals, inverse @ (basis.T @ logs[some]))


def _unshaded(layers: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Take what the shading explains off a band of colours, and return which pixels (h, w) it holds for.

    Lamps that stay with the camera light the faces of a plain box unlike, and their edges would be its print: where
    shading changes by more than the noise of the normals would have it, there is no telling. Where that noise prevails,
    the band of the shading explains little.

    Args:
        layers: (2, h, w) the band of the colours, changed in place, and that of the shading.
        surface: (h, w) above 0 where surface is.
    """
    colours, shading = layers
    inside = np.flatnonzero(surface)
    changes = np.abs(shading.ravel()[inside[_some(len(inside))]])
    noise = max(float(np.median(changes)) / _NORMAL_QUARTILE, _LEVEL)
    steady = np.empty(surface.shape, dtype=np.bool_)
    bands.subtract_shading(colours, shading, surface, np.float32(_LEVEL**2), np.float32(_CREASE * noise), steady)
    return steady


def _halved(images: np.ndarray) -> np.ndarray:
    """Return the means of blocks of 2 × 2 px of images (k, h, w), whose sides are even."""
    return np.float32(0.25) * (
        images[:, ::2, ::2] + images[:, 1::2, ::2] + images[:, ::2, 1::2] + images[:, 1::2, 1::2]
    )


def _blurred(images: np.ndarray, width_px: float) -> np.ndarray:
    """Return images (k, h, w) blurred by a Gaussian."""
    weights = np.exp(-0.5 * (np.arange(int(_REACH * width_px + 0.5) + 1) / width_px) ** 2)
    weights /= 2.0 * weights.sum() - weights[0]
    blurred = np.empty_like(images)
    bands.blur(images, weights.astype(np.float32), blurred)
    return blurred
