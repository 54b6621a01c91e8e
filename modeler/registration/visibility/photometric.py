"""The colour of a pair: how well what is painted on matching surface agrees (method.md, eq. 17 to 20).

Lights stay with the camera while the object turns: shading moves over the surface, and exposure and white balance
drift. Both multiply, and shading is smooth, so that the logarithm of a colour, less its mean over a wider
neighbourhood, shows the print and little else, band by band.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from scipy import ndimage

from modeler.kernels import photometric, point_to_plane
from modeler.kernels.photometric import ColourProjection
from modeler.kernels.point_likelihood import Projection
from modeler.se3 import rows
from modeler.types import Array, Frame, RayImage

FINEST_PX = 0.6
"""Standard deviation of the finest band's Gaussian in px: below it, pixels and noise rule."""
BANDS = 6
"""Number of bands, each twice as wide as the one before."""

VALUE, BY_COLUMN, BY_ROW = 0, 1, 2
"""Of a band at a surface point: the feature, and its derivatives by column and row in 1/px."""

_BLACK = 4.0  # added to 8-bit values: below it noise and rounding would rule their logarithm
_REACH = 3.0  # of a Gaussian, in standard deviations
_KNOWN: WeakKeyDictionary[RayImage, np.ndarray] = WeakKeyDictionary()  # features of views made so far

_FINEST_SCORED = 1
"""Finest band by which samples are weighted; weights by the finest of all are too uneven (it refines the samples)."""
_STEADY = 4.0
"""So many standard deviations of the colours' shift is the finest band by which samples are weighted, at least."""
UNDECIDED = 0.7
"""Correlation that is assumed where a descent starts."""
_MOST = 0.99  # correlation
_HALVINGS = 5  # patches of surface, as many as the refinement has


@dataclass(frozen=True, eq=False)
class PairColour:
    """Colour of two views at the points that the likelihood compares."""

    source: RayImage
    target: RayImage
    source_points: np.ndarray
    """(n,) numbers of the source's surface points that are compared."""
    target_points: np.ndarray
    """(m,) of the target's."""
    surfaces: tuple[Projection, Projection]
    """The source's points in the target, and the target's in the source."""
    _unmoved: dict[int, float] = field(default_factory=dict)
    _evenness: dict[int, float] = field(default_factory=dict)
    _left: dict[int, tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)
    _made: dict[tuple[int, int], tuple[ColourProjection, ColourProjection]] = field(default_factory=dict)

    def at(
        self, source_points: np.ndarray, target_points: np.ndarray, surfaces: tuple[Projection, Projection]
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
        forward, backward = self.projections(band, stride)
        found = photometric.moments(rows(poses), (forward, backward), surface_m)
        scale = np.sqrt(found[:, photometric.OWN_SQUARE] * found[:, photometric.OTHER_SQUARE])
        share = found[:, photometric.MATCHES] / (len(forward.values) + len(backward.values))
        return found[:, photometric.PRODUCT] / np.maximum(scale, 1e-12), share

    def log_likelihoods(
        self, poses: Array, blur_m: float, max_independent: float, *, surface_m: float, stride: int
    ) -> Array:
        """Return how much likelier (n,) in nats the target's colours are, given the source's (method.md, eq. 19)."""
        band = max(self.band(blur_m), self._finest_scored)
        correlation, share = self.correlations(poses, band, surface_m, stride=stride)
        patches = max(self.evenness(band) * self.patches(band), 1e-6)  # without features there is nothing to count
        independent = 1.0 / (1.0 / max_independent + 1.0 / patches)
        count = share * (1.0 - self.unmoved(band) ** 2) * independent
        gain = -0.5 * count * np.log1p(-(np.clip(correlation, 0.0, _MOST) ** 2))
        return np.asarray(np.logaddexp(0.0, gain - 0.5 * np.log(np.maximum(count, 1.0))), dtype=np.float64)

    @property
    def _finest_scored(self) -> int:
        """Number of the finest band by which samples are weighted: a shift of the colours changes little in it."""
        steady = int(np.ceil(np.log2(max(_STEADY * self.target.sigma_colour_px / FINEST_PX, 1.0))))
        return int(np.clip(steady, _FINEST_SCORED, BANDS - 1))

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
        projection = self.projections(band, 1)[0 if forward else 1]
        view, chosen = (self.source, self.source_points) if forward else (self.target, self.target_points)
        other = self.target if forward else self.source
        position = matches[:, point_to_plane.POSITION]
        camera = other.frame.camera
        z = np.maximum(position[:, 2], 1e-6)
        column = np.clip(np.round(camera.fx * position[:, 0] / z + camera.cx), 0, camera.width - 1)
        row = np.clip(np.round(camera.fy * position[:, 1] / z + camera.cy), 0, camera.height - 1)
        cells = projection.colours[(row * camera.width + column).astype(np.int64)].astype(np.float64)
        pixels = view.pixels[chosen]
        mirror = self.projections(band, 1)[1 if forward else 0]
        own = mirror.colours[pixels[:, 0] * view.frame.camera.width + pixels[:, 1], :3].astype(np.float64)
        normals = matches[:, point_to_plane.OWN]
        # Along the surface a gradient turns with it; then it is taken along the other camera's rays.
        own = own @ carried[:3, :3].T
        own -= normals * np.sum(own * normals, axis=1, keepdims=True)
        slope = np.sum(own * position, axis=1) / np.minimum(np.sum(normals * position, axis=1), -1e-6)
        own -= normals * slope[:, None]
        found = matches.copy()
        found[:, point_to_plane.OWN], found[:, point_to_plane.OTHER] = own, cells[:, :3]
        found[:, point_to_plane.RESIDUAL] = np.sum(cells[:, :3] * position, axis=1) + cells[:, 3] - projection.values
        matched = matches[:, point_to_plane.WEIGHT] > 0.0
        found[:, point_to_plane.WEIGHT] = weight * matched * matches[:, point_to_plane.FACING_WEIGHT]
        return found

    def projections(self, band: int, stride: int) -> tuple[ColourProjection, ColourProjection]:
        """Return the two directions of a band, at every `stride`-th point."""
        if (band, stride) not in self._made:
            forward, backward = self._projections(band) if stride == 1 else self.projections(band, 1)
            self._made[band, stride] = forward.thinned(stride), backward.thinned(stride)
        return self._made[band, stride]

    def _projections(self, band: int) -> tuple[ColourProjection, ColourProjection]:
        values, cells = self._looked_up(band)
        forward = ColourProjection(*self.surfaces[0], values[0][self.source_points], cells[1])
        backward = ColourProjection(*self.surfaces[1], values[1][self.target_points], cells[0])
        return forward, backward

    def _looked_up(self, band: int) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Return the features of all points of source and target in a band, and the cells of both images."""
        if band not in self._left:
            source, target = (view_features(view)[band] for view in (self.source, self.target))
            share = max(self.unmoved(band), 0.0)
            here = _unexplained(source, target, self._partners[0], share)
            there = _unexplained(target, source, self._partners[1], share)
            cells = _cells(self.source, here), _cells(self.target, there)
            self._left[band] = (here[VALUE], there[VALUE]), cells
        return self._left[band]

    def patches(self, band: int) -> float:
        """Return the number of patches of the surface whose features are independent; mean of both views."""
        points = 0.5 * (len(self.source.points_m) + len(self.target.points_m))
        return points / (4.0 * np.pi * (FINEST_PX * 2**band) ** 2)

    def evenness(self, band: int) -> float:
        """Return the share of the surface that makes up the features: 1 where they are as strong everywhere.

        It is the participation ratio of the energies of 32 patches of either view. On a plain box most lies at its
        edges, which meet few of them.
        """
        if band not in self._evenness:
            shares = []
            for patches, projection in zip(self._patches, self.projections(band, 1), strict=True):
                energies = np.bincount(patches, projection.values.astype(np.float64) ** 2, 2**_HALVINGS)
                shares.append(np.sum(energies) ** 2 / max(len(energies) * np.sum(energies**2), 1e-12))
            self._evenness[band] = float(np.mean(shares))
        return self._evenness[band]

    @cached_property
    def _patches(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the patches of the points of either view."""
        source, target = self.source.points_m[self.source_points], self.target.points_m[self.target_points]
        return point_to_plane.bisected(source, _HALVINGS), point_to_plane.bisected(target, _HALVINGS)

    def unmoved(self, band: int) -> float:
        """Return the correlation of features that both views show in the same place (method.md, eq. 18).

        What stays in its place while the object turns is light: highlights, shading, fixed pattern noise.
        """
        if band not in self._unmoved:
            source, target = (view_features(view)[band] for view in (self.source, self.target))
            partners = self._partners[0]
            theirs = _in_other(target, partners)
            self._unmoved[band] = _correlation(source[VALUE] * (partners[0] >= 0), theirs[VALUE])
        return self._unmoved[band]

    @cached_property
    def _partners(self) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """See `_in_place`: of the source's points in the target, and vice versa."""
        shift_m = self.target.centroid_m - self.source.centroid_m
        return _in_place(self.source, self.target, shift_m), _in_place(self.target, self.source, -shift_m)


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


def _in_place(view: RayImage, other: RayImage, shift_m: Array) -> tuple[np.ndarray, np.ndarray]:
    """Return where the points of a view fall in the other if the object only moves by a shift (3,), without a turn.

    Returns:
        Number (n,) of the other view's point there, -1 for none; and columns and rows (n, 2) from its pixel.
    """
    camera = other.frame.camera
    numbers = np.full((camera.height, camera.width), -1, dtype=np.int32)
    numbers[other.pixels[:, 0], other.pixels[:, 1]] = np.arange(len(other.pixels))
    x, y, z = (view.points_m + shift_m).T
    place = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    pixel = np.round(place).astype(np.int64)
    inside = np.all((pixel >= 0) & (pixel < (camera.width, camera.height)), axis=1) & (z > 0.0)
    column, row = np.where(inside[:, None], pixel, 0).T
    return np.where(inside, numbers[row, column], -1), (place - pixel).astype(np.float32)


def _in_other(others: np.ndarray, partners: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return what features (3, m) of the other view are in the same places, (3, n); see `_in_place`; 0 for none."""
    numbers, offsets = partners
    there = others[:, numbers] * (numbers >= 0)
    there[VALUE] += there[BY_COLUMN] * offsets[:, 0] + there[BY_ROW] * offsets[:, 1]
    return there


def _unexplained(
    features: np.ndarray, others: np.ndarray, partners: tuple[np.ndarray, np.ndarray], share: float
) -> np.ndarray:
    """Return features (3, n) of unit variance, less a share of the other view's in the same places (eq. 18)."""
    left = features / _deviation(features) - share / _deviation(others) * _in_other(others, partners)
    return np.asarray(left / _deviation(left), dtype=np.float32)


def _deviation(features: np.ndarray) -> float:
    """Return the standard deviation of features (3, n); never quite 0."""
    return max(float(np.std(features[VALUE])), 1e-6)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation of features (n,) about 0."""
    scale = np.sqrt(float(np.sum(a * a)) * float(np.sum(b * b)))
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
        _KNOWN[view] = features(view.frame, view.pixels)
    return _KNOWN[view]


def features(frame: Frame, pixels: np.ndarray) -> np.ndarray:
    """Return the features of surface points in bands of increasing width (method.md, eq. 17).

    Args:
        frame: with its colour.
        pixels: (n, 2) row and column of each surface point.

    Returns:
        (BANDS, 3, n) float32: `VALUE`, `BY_COLUMN` and `BY_ROW`.
    """
    found = np.zeros((BANDS, 3, len(pixels)), dtype=np.float32)
    if frame.colour is None or not len(pixels):
        return found
    low, high = pixels.min(axis=0), pixels.max(axis=0) + 1
    places = pixels - low
    logs = np.log(frame.colour[low[0] : high[0], low[1] : high[1]].astype(np.float32) + np.float32(_BLACK)).mean(axis=2)
    share = np.zeros(logs.shape, dtype=np.float32)
    share[tuple(places.T)] = 1.0
    image = (logs - logs[tuple(places.T)].mean()) * share
    scale = 1
    for band in range(BANDS):
        if band > 1:  # from an image of half the size of the one before
            image, share, scale = _halved(image), _halved(share), 2 * scale
        width_px = FINEST_PX * 2**band / scale
        cell = places // scale
        away = (places + 0.5) / scale - (cell + 0.5)
        layer = np.where(share > 0.0, _mean(image, share, width_px) - _mean(image, share, 2.0 * width_px), 0.0)
        by_row, by_column = (_slope(layer, share > 0.0, axis)[tuple(cell.T)] for axis in (0, 1))
        found[band, VALUE] = layer[tuple(cell.T)] + by_row * away[:, 0] + by_column * away[:, 1]
        found[band, BY_COLUMN], found[band, BY_ROW] = by_column / scale, by_row / scale
    return found


def _halved(image: np.ndarray) -> np.ndarray:
    """Return the means of blocks of 2 × 2 px of an image (h, w)."""
    padded = np.pad(image, [(0, side % 2) for side in image.shape])
    return np.asarray(padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2).mean(axis=(1, 3)))


def _mean(image: np.ndarray, share: np.ndarray, width_px: float) -> np.ndarray:
    """Return Gaussian means of an image (h, w), which is weighted by the share of each pixel that is surface."""
    weighted, weight = (
        ndimage.gaussian_filter(part, width_px, mode="constant", truncate=_REACH) for part in (image, share)
    )
    return np.asarray(weighted / np.maximum(weight, np.float32(1e-3)))


def _slope(image: np.ndarray, inside: np.ndarray, axis: int) -> np.ndarray:
    """Return central differences of an image (h, w) per px; 0 where a neighbour is outside."""
    slope = np.zeros_like(image)
    middle, after, before = (
        tuple(part if k == axis else slice(None) for k in (0, 1))
        for part in (slice(1, -1), slice(2, None), slice(0, -2))
    )
    slope[middle] = 0.5 * (image[after] - image[before]) * inside[after] * inside[before]
    return slope
