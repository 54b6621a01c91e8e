"""Colours of surface that both views saw: their correlation, and the equations by which they move a pose."""

import math
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from modeler.kernels.point_likelihood import FACING, HALF, VECTOR_MATHS, ZERO, X, Y, Z, plane_distance
from modeler.kernels.point_to_plane import match_weight

# Columns of a cell, the 16 bytes that are read for one point: at a point p that projects where the cell's own does, the
# feature is gradient · p + offset to first order. They are those of a plane: `plane_distance` of a cell is the feature.
GRADIENT_X, GRADIENT_Y, GRADIENT_Z, OFFSET = 0, 1, 2, 3
CELL_SIZE = 4

_LEAST_DEVIATION = 1e-6  # of features; an image without any has none of unit variance
_LIMIT = 3.0  # standard deviations, beyond which 0.3 % of normal features are
_ROUNDS, _SETTLED = 10, 1e-3  # of variance and limit, each by the other, at most; and where they end

FloatArray = npt.NDArray[np.float32]


class Colours(NamedTuple):
    """Colours of one direction of a comparison, of the points of a `Projection`."""

    values: FloatArray
    """(n,) features of the points in their own view, of unit variance; (0,) where colours are not compared."""
    cells: FloatArray
    """(m + 1, 4) cells of colour of the other view's surface points; the last is that of no point, zeros."""
    numbers: npt.NDArray[np.int32]
    """(h · w,) number of the other view's point at each pixel, m for none."""

    def thinned(self, stride: int) -> "Colours":
        """Return those of every `stride`-th point."""
        return self._replace(values=np.ascontiguousarray(self.values[::stride]))


NO_COLOURS = Colours(
    np.zeros(0, dtype=np.float32), np.zeros((1, CELL_SIZE), dtype=np.float32), np.zeros(1, dtype=np.int32)
)
"""One direction of views whose colours are not compared."""


@numba.njit(cache=True, error_model="numpy")
def explain_light(features, there, share, points_m, focal, values, cells):
    """Write what features are, and their cells, without what another view has in the same places (method.md, eq. 18).

    What is left has unit variance. Along a pixel's ray a feature stays the same, so that its gradient there adds
    nothing at the pixel's own point.

    Args:
        features: (3, n) of the surface points: value, and derivatives by column and row in 1/px.
        there: (3, n) the other view's, see `fetch_in_place`.
        share: of `there` that light makes up.
        points_m: (n, 3) the points.
        focal: (2,) fx and fy in px.
        values: (n,) out.
        cells: (n + 1, 4) out; the last is left as it is.
    """
    count, total, square = points_m.shape[0], 0.0, 0.0
    for j in range(count):
        left = features[0, j] - share * there[0, j]
        values[j] = left
        total += left
        square += left * left
    variance = square / max(count, 1) - (total / max(count, 1)) ** 2
    scale = 1.0 / max(math.sqrt(max(variance, 0.0)), _LEAST_DEVIATION)
    for j in range(count):
        values[j] *= scale
        x, y, z = points_m[j]
        by_x = scale * (features[1, j] - share * there[1, j]) * focal[0] / z
        by_y = scale * (features[2, j] - share * there[2, j]) * focal[1] / z
        cell = cells[j]
        cell[GRADIENT_X], cell[GRADIENT_Y], cell[GRADIENT_Z] = by_x, by_y, -(by_x * x + by_y * y) / z
        cell[OFFSET] = values[j]


@numba.njit(cache=True, error_model="numpy")
def sample_layer(layer, inside, places, scale, found):
    """Write the features of surface points in one band, interpolated linearly from the nearest cell of its image.

    Args:
        layer: (h, w) the band.
        inside: (h, w) which cells it holds for; a slope across others is 0.
        places: (n, 2) row and column of each point, in px.
        scale: width of a cell in px.
        found: (3, n) out: value, and derivatives by column and row in 1/px.
    """
    height, width = layer.shape
    for j in range(places.shape[0]):
        row, column = places[j, 0] // scale, places[j, 1] // scale
        by_row, by_column = ZERO, ZERO
        if 0 < row < height - 1 and inside[row - 1, column] and inside[row + 1, column]:
            by_row = HALF * (layer[row + 1, column] - layer[row - 1, column]) / scale
        if 0 < column < width - 1 and inside[row, column - 1] and inside[row, column + 1]:
            by_column = HALF * (layer[row, column + 1] - layer[row, column - 1]) / scale
        middle = 0.5 * (scale - 1)
        found[0, j] = (
            layer[row, column]
            + by_row * (places[j, 0] - row * scale - middle)
            + by_column * (places[j, 1] - column * scale - middle)
        )
        found[1, j], found[2, j] = by_column, by_row


@numba.njit(cache=True, error_model="numpy")
def winsorise(features):
    """Scale features to unit variance, and limit them to three standard deviations, both ways.

    A few dark spots would be all that a correlation heard of, and it takes its features for normal ones. The variance
    is that of what is left, so that spots on less than a ninth of the surface are limited, prints on more are not.

    Args:
        features: (3, n) of the surface points, in place: value, and derivatives by column and row in 1/px.
    """
    count, scale, limit = features.shape[1], 0.0, np.inf
    for _ in range(_ROUNDS):
        total, square = 0.0, 0.0
        for j in range(count):
            value = min(max(features[0, j], -limit), limit)
            total += value
            square += value * value
        variance = square / max(count, 1) - (total / max(count, 1)) ** 2
        last, scale = scale, max(math.sqrt(max(variance, 0.0)), _LEAST_DEVIATION)
        limit = _LIMIT * scale
        if abs(scale - last) <= _SETTLED * scale:
            break
    for j in range(count):
        inside = abs(features[0, j]) <= limit
        features[0, j] = min(max(features[0, j], -limit), limit) / scale
        for k in range(1, 3):
            features[k, j] = features[k, j] / scale if inside else ZERO


@numba.njit(cache=True, error_model="numpy")
def find_in_place(points_m, shift_m, camera, numbers, none, found, offsets):
    """Find where points fall in another view if they only move by a shift.

    Args:
        points_m: (n, 3) the points.
        shift_m: (3,) the shift.
        camera: (4,) fx, fy, cx, cy of the other view.
        numbers: (h, w) numbers of the other view's points,
        none: where there is no point.
        found: (n,) out; number of the other view's point there, the same for none.
        offsets: (n, 2) out; columns and rows from that point's pixel.
    """
    height, width = numbers.shape
    for j in range(points_m.shape[0]):
        x, y, z = points_m[j, 0] + shift_m[0], points_m[j, 1] + shift_m[1], points_m[j, 2] + shift_m[2]
        found[j] = none
        if z <= 0.0:
            continue
        column, row = camera[0] * x / z + camera[2], camera[1] * y / z + camera[3]
        nearest_column, nearest_row = np.floor(column + 0.5), np.floor(row + 0.5)
        if 0.0 <= nearest_column < width and 0.0 <= nearest_row < height:
            found[j] = numbers[int(nearest_row), int(nearest_column)]
            offsets[j, 0], offsets[j, 1] = column - nearest_column, row - nearest_row


@numba.njit(cache=True, error_model="numpy")
def fetch_in_place(features, numbers, offsets, found):
    """Write the features (3, n) that another view has in the same places, 0 where it has none.

    Args:
        features: (3, m) of the other view's points: value, and derivatives by column and row in 1/px.
        numbers: (n,) of `find_in_place`.
        offsets: (n, 2) of `find_in_place`.
        found: (3, n) out.
    """
    for j in range(numbers.shape[0]):
        k = numbers[j]
        if k >= features.shape[1]:
            found[0, j], found[1, j], found[2, j] = ZERO, ZERO, ZERO
        else:
            value, by_column, by_row = features[0, k], features[1, k], features[2, k]
            found[0, j] = value + by_column * offsets[j, 0] + by_row * offsets[j, 1]
            found[1, j], found[2, j] = by_column, by_row


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def fetch_colours(count, pixels, colours, looked_up):
    """Copy cells at the first `pixels` (n,) into columns of `looked_up` (4, n)."""
    for j in range(count):
        cell = np.uint32(colours.numbers[np.uint32(max(pixels[j], np.int32(0)))])
        for k in range(CELL_SIZE):
            looked_up[k, j] = colours.cells[cell, k]


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def sum_moments(points, values, transformed, looked_up, colour, surface_m2):
    """Return Σ a b, Σ a², Σ b² and the number of matches of one direction, each weighted by f."""
    product, own_square, other_square, count = ZERO, ZERO, ZERO, ZERO
    for j in range(points.shape[1]):
        distance = plane_distance(transformed, looked_up, j)
        matched = match_weight(points, transformed, looked_up, distance, surface_m2, j) > ZERO
        weight = transformed[FACING, j] if matched else ZERO
        own, other = values[j], plane_distance(transformed, colour, j)
        product += weight * own * other
        own_square += weight * own * own
        other_square += weight * other * other
        count += weight
    return product, own_square, other_square, count


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def linearise_features(points, values, transformed, found, colour, centre, surface_m2, weight, rows):
    """Write the equations of features into `rows` (8, n): derivatives by ζ, residual and weight.

    A feature is linear in the point's position as a plane's distance is, its gradient in the place of the normal.
    """
    cx, cy, cz = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2])
    for j in range(points.shape[1]):
        distance = plane_distance(transformed, found, j)
        matched = match_weight(points, transformed, found, distance, surface_m2, j) > ZERO
        rows[6, j] = plane_distance(transformed, colour, j) - values[j]
        rows[7, j] = weight * transformed[FACING, j] if matched else ZERO
    for j in range(points.shape[1]):
        x, y, z = transformed[X, j] - cx, transformed[Y, j] - cy, transformed[Z, j] - cz
        slope_x, slope_y, slope_z = colour[GRADIENT_X, j], colour[GRADIENT_Y, j], colour[GRADIENT_Z, j]
        rows[0, j] = y * slope_z - z * slope_y
        rows[1, j] = z * slope_x - x * slope_z
        rows[2, j] = x * slope_y - y * slope_x
        rows[3, j], rows[4, j], rows[5, j] = slope_x, slope_y, slope_z
