"""The colour of a pair: how well what is painted on matching surface agrees (method.md, eq. 17 to 20).

Lights stay with the camera while the object turns: shading moves over the surface, and exposure and white balance
drift. Both multiply, and shading is smooth, so that the logarithm of a colour, less its mean over a wider
neighbourhood, shows the print and little else, band by band.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from scipy import ndimage

from modeler.kernels import photometric, point_to_plane
from modeler.kernels.photometric import Colours
from modeler.kernels.point_likelihood import Projection
from modeler.kernels.shading import harmonics_of
from modeler.se3 import rows
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
_SHADED = 2000  # points from which the shading of a view is fitted
_CREASE = 3.0  # standard deviations by which shading changes where surface has an edge, beyond noise of its normals
_NORMAL_QUARTILE = 0.6745  # median magnitude of a standard normal variable
_LEVEL = 1.0 / 255.0  # smallest change of a bright colour's logarithm that 8 bits show
_REACH = 3.0  # of a Gaussian, in standard deviations
_KNOWN: WeakKeyDictionary[RayImage, np.ndarray] = WeakKeyDictionary()  # features of views made so far

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
    surfaces: Callable[[int], tuple[Projection, Projection]]
    """Every so many of the source's points in the target, and of the target's in the source."""
    _unmoved: dict[int, float] = field(default_factory=dict)
    _places: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    _left: dict[int, tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)
    _made: dict[tuple[int, int], tuple[Colours, Colours]] = field(default_factory=dict)

    def at(
        self,
        source_points: np.ndarray,
        target_points: np.ndarray,
        surfaces: Callable[[int], tuple[Projection, Projection]],
    ) -> PairColour:
        """Return the colour of the same views at other points, which shares what was made of the images."""
        return replace(self, source_points=source_points, target_points=target_points, surfaces=surfaces, _made={})

    def band(self, blur_m: float) -> int:
        """Return the number of the band for surfaces of that blur."""
        blur_px = blur_m * self.target.frame.camera.fx / max(float(self.target.centroid_m[2]), 1e-3)
        return int(np.clip(np.round(np.log2(max(blur_px / FINEST_PX, 1.0))), 0, BANDS - 1))

    def correlations(self, poses: Array, band: int, surface_m: float, *, stride: int) -> tuple[Array, Array]:
        """Return correlations (n,) of the features of matching points under poses (n, 4, 4), and the share that match.

        Args:
            poses: target_from_source.
            band: number of the band.
            surface_m: noise of the surfaces, within which points match.
            stride: every `stride`-th point is used.
        """
        forward, backward = self.colours(band, stride)
        found = photometric.moments(rows(poses), self.surfaces(stride), (forward, backward), surface_m)
        scale = np.sqrt(found[:, photometric.OWN_SQUARE] * found[:, photometric.OTHER_SQUARE])
        share = found[:, photometric.MATCHES] / (len(forward.values) + len(backward.values))
        return found[:, photometric.PRODUCT] / np.maximum(scale, 1e-12), share

    def log_likelihoods(
        self, poses: Array, blur_m: float, max_independent: float, *, surface_m: float, stride: int
    ) -> Array:
        """Return how much likelier (n,) in nats the target's colours are, given the source's (method.md, eq. 19)."""
        band = self.scored_band(blur_m)
        correlation, share = self.correlations(poses, band, surface_m, stride=stride)
        count = share * self.independent(band, max_independent)
        gain = -0.5 * count * np.log1p(-(np.clip(correlation, 0.0, _MOST) ** 2))
        return np.asarray(np.logaddexp(0.0, gain - 0.5 * np.log(np.maximum(count, 1.0))), dtype=np.float64)

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

    def matches(self, carried: Array, matches: Array, band: int, weight: float, *, forward: bool) -> Array:
        """Return the features of matches (n, 12) of one direction in the place of their surface, see `point_to_plane`.

        The gradient of a feature is the normal, the difference of features the distance.

        Args:
            carried: (4, 4) the transform that carries the points into the other camera.
            matches: of all points, `point_to_plane.matches`.
            band: number of the band.
            weight: of squared differences of features.
            forward: whether the points are the source's.
        """
        colours = self.colours(band, 1)
        theirs, mirror = colours if forward else colours[::-1]
        view, chosen = (self.source, self.source_points) if forward else (self.target, self.target_points)
        other = self.target if forward else self.source
        position = matches[:, point_to_plane.POSITION]
        camera = other.frame.camera
        z = np.maximum(position[:, 2], 1e-6)
        column = np.clip(np.round(camera.fx * position[:, 0] / z + camera.cx), 0, camera.width - 1)
        row = np.clip(np.round(camera.fy * position[:, 1] / z + camera.cy), 0, camera.height - 1)
        cells = theirs.cells[(row * camera.width + column).astype(np.int64)].astype(np.float64)
        pixels = view.pixels[chosen]
        own = mirror.cells[pixels[:, 0] * view.frame.camera.width + pixels[:, 1], :3].astype(np.float64)
        normals = matches[:, point_to_plane.OWN]
        # Along the surface a gradient turns with it; then it is taken along the other camera's rays.
        own = own @ carried[:3, :3].T
        own -= normals * np.sum(own * normals, axis=1, keepdims=True)
        slope = np.sum(own * position, axis=1) / np.minimum(np.sum(normals * position, axis=1), -1e-6)
        own -= normals * slope[:, None]
        found = matches.copy()
        found[:, point_to_plane.OWN], found[:, point_to_plane.OTHER] = own, cells[:, :3]
        found[:, point_to_plane.RESIDUAL] = np.sum(cells[:, :3] * position, axis=1) + cells[:, 3] - theirs.values
        matched = matches[:, point_to_plane.WEIGHT] > 0.0
        found[:, point_to_plane.WEIGHT] = weight * matched * matches[:, point_to_plane.FACING_WEIGHT]
        return found

    def colours(self, band: int, stride: int) -> tuple[Colours, Colours]:
        """Return the two directions of a band, at every `stride`-th point."""
        if (band, stride) not in self._made:
            forward, backward = self._colours(band) if stride == 1 else self.colours(band, 1)
            self._made[band, stride] = forward.thinned(stride), backward.thinned(stride)
        return self._made[band, stride]

    def _colours(self, band: int) -> tuple[Colours, Colours]:
        (of_source, of_target), (in_source, in_target) = self._looked_up(band)
        return Colours(of_source[self.source_points], in_target), Colours(of_target[self.target_points], in_source)

    def _looked_up(self, band: int) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Return the features of all points of source and target in a band, and the cells of both images."""
        if band not in self._left:
            views, share = (self.source, self.target), max(self.unmoved(band), 0.0)
            source, target = (
                _unexplained(view_features(view)[band], there, view_features(other)[band], share)
                for view, other, there in zip(views, views[::-1], self._in_place(band), strict=True)
            )
            self._left[band] = (
                (source[VALUE], target[VALUE]),
                (_cells(self.source, source), _cells(self.target, target)),
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
            there, found = self._in_place(band)[0], self._partners[0][0] >= 0
            self._unmoved[band] = _correlation(view_features(self.source)[band][VALUE] * found, there[VALUE])
        return self._unmoved[band]

    def _in_place(self, band: int) -> tuple[np.ndarray, np.ndarray]:
        """Return features (3, n) of the target in the places of the source's points, and vice versa; 0 for none."""
        if band not in self._places:
            self._places[band] = (
                _in_other(view_features(self.target)[band], self._partners[0]),
                _in_other(view_features(self.source)[band], self._partners[1]),
            )
        return self._places[band]

    @cached_property
    def _partners(self) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """See `_in_place`: of the source's points in the target, and vice versa."""
        return _aligned(self.source, self.target), _aligned(self.target, self.source)


def unshifted(equations: Array, shifts: Array) -> Array:
    """Return the matrices (..., 6, 6) that take unknown shifts out of equations (method.md, eq. 24).

    Args:
        equations: (..., 6, 6) normal equations of colours.
        shifts: (..., 6, 2) their shifts by a standard deviation, as motions ξ.
    """
    felt, across = equations @ shifts, np.swapaxes(shifts, -1, -2)
    return np.eye(6) - felt @ np.linalg.solve(np.eye(2) + across @ felt, across)


def weight_of(correlation: float) -> float:
    """Return the weight of squared differences of features of unit variance (method.md, eq. 20)."""
    square = float(np.clip(correlation, 0.0, _MOST)) ** 2
    return square / (1.0 - square)


def _aligned(view: RayImage, other: RayImage) -> tuple[np.ndarray, np.ndarray]:
    """Return the partners of a view's points in the other, shifted so that the two look most alike: see `_partners`.

    Centroids err by more than the finest bands are wide. One step of least squares (Lucas and Kanade 1981).
    """
    own, others = view_features(view)[_ALIGNED], view_features(other)[_ALIGNED]
    partners = _partners(view, other, np.zeros(2))
    there = _in_other(others, partners) * (1.0 / _deviation(others))
    slopes = there[[BY_COLUMN, BY_ROW]].astype(np.float64)
    apart = (own[VALUE] * (1.0 / _deviation(own)) - there[VALUE]) * (partners[0] >= 0)
    step = np.linalg.lstsq(slopes @ slopes.T, slopes @ apart, rcond=None)[0]
    width_px = FINEST_PX * 2**_ALIGNED  # farther features are not linear
    return _partners(view, other, step * min(1.0, width_px / max(float(np.linalg.norm(step)), 1e-12)))


def _partners(view: RayImage, other: RayImage, shift_px: Array) -> tuple[np.ndarray, np.ndarray]:
    """Return where the points of a view fall in the other if the object only moves, without a turn.

    Args:
        view: the points'.
        other: where they fall.
        shift_px: (2,) columns and rows from where the difference of the centroids brings them.

    Returns:
        Number (n,) of the other view's point there, -1 for none; and columns and rows (n, 2) from its pixel.
    """
    camera = other.frame.camera
    numbers = np.full((camera.height, camera.width), -1, dtype=np.int32)
    numbers[other.pixels[:, 0], other.pixels[:, 1]] = np.arange(len(other.pixels))
    found = np.empty(len(view.points_m), dtype=np.int32)
    offsets = np.zeros((len(view.points_m), 2), dtype=np.float32)
    lens = np.array([camera.fx, camera.fy, camera.cx + shift_px[0], camera.cy + shift_px[1]])
    photometric.find_in_place(view.points_m, other.centroid_m - view.centroid_m, lens, numbers, found, offsets)
    return found, offsets


def _in_other(others: np.ndarray, partners: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return what features (3, m) of the other view are in the same places, (3, n); see `_partners`; 0 for none."""
    there = np.empty((3, len(partners[0])), dtype=np.float32)
    photometric.fetch_in_place(others, *partners, there)
    return there


def _unexplained(features: np.ndarray, there: np.ndarray, others: np.ndarray, share: float) -> np.ndarray:
    """Return features (3, n) of unit variance, less a share of the other view's in the same places (eq. 18).

    Args:
        features: (3, n) of a view.
        there: (3, n) of the other view in the same places.
        others: (3, m) of the other view.
        share: that light makes up.
    """
    left = features * (1.0 / _deviation(features)) - there * (share / _deviation(others))
    left *= 1.0 / _deviation(left)
    return left


def _deviation(features: np.ndarray) -> float:
    """Return the standard deviation of features (3, n); never quite 0."""
    return max(float(np.std(features[VALUE])), 1e-6)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation of features (n,) about 0."""
    scale = math.sqrt(float(np.sum(a * a)) * float(np.sum(b * b)))
    return float(np.sum(a * b)) / scale if scale > 0.0 else 0.0


def _cells(view: RayImage, features: np.ndarray) -> np.ndarray:
    """Return cells (h · w, 4) of a view's features (3, n), see `photometric`."""
    camera = view.frame.camera
    pixels = view.pixels[:, 0] * camera.width + view.pixels[:, 1]
    # Memory that nothing is written to costs nothing.
    cells = np.zeros((camera.height * camera.width, photometric.CELL_SIZE), dtype=np.float32)
    photometric.fill_cells(features, view.points_m, pixels, np.array([camera.fx, camera.fy]), cells)
    return cells


def view_features(view: RayImage) -> np.ndarray:
    """Return the features of a view's surface points, see `features`; made once, as a view is part of several pairs."""
    if view not in _KNOWN:
        _KNOWN[view] = features(view.frame, view.pixels, view.normals)
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
    low, high = pixels.min(axis=0), pixels.max(axis=0) + 1
    places = pixels - low
    red, green, blue = frame.colour[pixels[:, 0], pixels[:, 1]].T
    logs = _LOGS[red] + _LOGS[green] + _LOGS[blue]
    images = np.zeros((3, *(high - low)), dtype=np.float32)  # colours, shading, and which pixels are surface
    images[:, places[:, 0], places[:, 1]] = logs - logs.mean(), _shading(logs, normals), np.ones(len(logs))
    scale, inner = 1, _blurred(images, FINEST_PX)
    for band in range(BANDS):
        outer = _blurred(images, 2.0 * FINEST_PX * 2**band / scale)
        cell = places // scale
        flat, away = cell[:, 0] * images.shape[-1] + cell[:, 1], (places + 0.5) / scale - (cell + 0.5)
        layer, inside = _unshaded(*(_means(inner) - _means(outer)), images[2] > 0.0)
        by_row, by_column = (_slope(layer, inside, axis).ravel()[flat] for axis in (0, 1))
        found[band, VALUE] = layer.ravel()[flat] + by_row * away[:, 0] + by_column * away[:, 1]
        found[band, BY_COLUMN], found[band, BY_ROW] = by_column / scale, by_row / scale
        if band == 0:
            inner = outer
        else:  # the next band is taken from images of half the size
            images, inner, scale = _halved(images), _halved(outer), 2 * scale
    return found


def _shading(logs: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return what harmonics of normals (n, 3) tell of logarithms of colours (n,) (Basri and Jacobs 2003)."""
    basis = np.column_stack([np.ones(len(logs)), harmonics_of(normals, np.eye(4))])
    some = slice(None, None, max(len(logs) // _SHADED, 1))
    inverse = np.linalg.pinv(basis[some].T @ basis[some], rcond=1e-4, hermitian=True)  # few faces tell few harmonics
    return basis @ (inverse @ (basis[some].T @ logs[some]))


def _unshaded(colours: np.ndarray, shading: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a band (h, w) of colours without what that of the shading explains, and which pixels it holds for.

    Lamps that stay with the camera light the faces of a plain box unlike, and their edges would be its print: where
    shading changes by more than the noise of the normals would have it, there is no telling. Where that noise prevails,
    the band of the shading explains little.
    """
    colours, shading = colours * inside, shading * inside
    power = float(np.vdot(shading, shading)) + np.count_nonzero(inside) * _LEVEL**2
    noise = max(float(np.median(np.abs(shading[inside]))) / _NORMAL_QUARTILE, _LEVEL)
    steady = inside & (np.abs(shading) <= _CREASE * noise)
    return (colours - np.float32(float(np.vdot(colours, shading)) / power) * shading) * steady, steady


def _halved(images: np.ndarray) -> np.ndarray:
    """Return the means of blocks of 2 × 2 px of images (k, h, w)."""
    padded = np.pad(images, [(0, 0), *((0, side % 2) for side in images.shape[1:])])
    return np.float32(0.25) * (
        padded[:, ::2, ::2] + padded[:, 1::2, ::2] + padded[:, ::2, 1::2] + padded[:, 1::2, 1::2]
    )


def _blurred(images: np.ndarray, width_px: float) -> np.ndarray:
    """Return images (k, h, w) blurred by a Gaussian."""
    return ndimage.gaussian_filter(images, width_px, mode="constant", truncate=_REACH, axes=(1, 2))


def _means(blurred: np.ndarray) -> np.ndarray:
    """Return Gaussian means (k - 1, h, w) over surface, from blurred images of which the last is its share."""
    return np.asarray(blurred[:-1] / np.maximum(blurred[-1], np.float32(1e-3)))


def _slope(image: np.ndarray, inside: np.ndarray, axis: int) -> np.ndarray:
    """Return central differences of an image (h, w) per px; 0 where a neighbour is outside."""
    slope = np.zeros_like(image)
    middle, after, before = (
        tuple(part if k == axis else slice(None) for k in (0, 1))
        for part in (slice(1, -1), slice(2, None), slice(0, -2))
    )
    slope[middle] = 0.5 * (image[after] - image[before]) * inside[after] * inside[before]
    return slope
