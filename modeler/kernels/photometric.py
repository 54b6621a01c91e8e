"""Colours of surface that both views saw: their correlation, and the equations by which they move a pose."""

from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from modeler.kernels.point_likelihood import (
    FACING,
    VECTOR_MATHS,
    ZERO,
    X,
    Y,
    Z,
    buffers,
    invert,
    plane_distance,
    project,
)
from modeler.kernels.point_to_plane import match_weight
from modeler.kernels.threads import over_rows

# Columns of a cell, the 16 bytes that are read for one pixel: at a point p that projects into it, the feature is
# gradient · p + offset to first order. They are those of a plane, so that `plane_distance` of a cell is the feature.
GRADIENT_X, GRADIENT_Y, GRADIENT_Z, OFFSET = 0, 1, 2, 3
CELL_SIZE = 4

# Columns of `moments`.
PRODUCT, OWN_SQUARE, OTHER_SQUARE, MATCHES = 0, 1, 2, 3

FloatArray = npt.NDArray[np.float32]


class Colours(NamedTuple):
    """Colours of one direction of a comparison, of the points of a `Projection`."""

    values: FloatArray
    """(n,) features of the points in their own view, of unit variance; (0,) where colours are not compared."""
    cells: FloatArray
    """(h · w, 4) cells of colour of the other view."""

    def thinned(self, stride: int) -> "Colours":
        """Return those of every `stride`-th point."""
        return self._replace(values=np.ascontiguousarray(self.values[::stride]))


NO_COLOURS = Colours(np.zeros(0, dtype=np.float32), np.zeros((1, CELL_SIZE), dtype=np.float32))
"""One direction of views whose colours are not compared."""


@numba.njit(cache=True, error_model="numpy")
def fill_cells(features, points_m, pixels, focal, cells):
    """Write the cells of features: their gradients by position in 1/m, and the features themselves.

    Along a pixel's ray a feature stays the same, so that its gradient there adds nothing at the pixel's own point.

    Args:
        features: (3, n) of the surface points: value, and derivatives by column and row in 1/px.
        points_m: (n, 3) the points.
        pixels: (n,) their pixels, row by row.
        focal: (2,) fx and fy in px.
        cells: (h · w, 4) out; zeros, and left so where there is no point.
    """
    for j in range(pixels.shape[0]):
        x, y, z = points_m[j]
        by_x, by_y = features[1, j] * focal[0] / z, features[2, j] * focal[1] / z
        cell = cells[pixels[j]]
        cell[GRADIENT_X], cell[GRADIENT_Y], cell[GRADIENT_Z] = by_x, by_y, -(by_x * x + by_y * y) / z
        cell[OFFSET] = features[0, j]


@numba.njit(cache=True, error_model="numpy")
def find_in_place(points_m, shift_m, camera, numbers, found, offsets):
    """Find where points fall in another view if they only move by a shift.

    Args:
        points_m: (n, 3) the points.
        shift_m: (3,) the shift.
        camera: (4,) fx, fy, cx, cy of the other view.
        numbers: (h, w) numbers of the other view's points, -1 for none.
        found: (n,) out; number of the other view's point there, -1 for none.
        offsets: (n, 2) out; columns and rows from that point's pixel.
    """
    height, width = numbers.shape
    for j in range(points_m.shape[0]):
        x, y, z = points_m[j, 0] + shift_m[0], points_m[j, 1] + shift_m[1], points_m[j, 2] + shift_m[2]
        found[j] = -1
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
        if k < 0:
            found[0, j], found[1, j], found[2, j] = ZERO, ZERO, ZERO
        else:
            value, by_column, by_row = features[0, k], features[1, k], features[2, k]
            found[0, j] = value + by_column * offsets[j, 0] + by_row * offsets[j, 1]
            found[1, j], found[2, j] = by_column, by_row


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def fetch_colours(count, pixels, cells, looked_up):
    """Copy the cells of colour at the first `pixels` (n,) into columns of `looked_up` (4, n)."""
    for j in range(count):
        cell = np.uint32(max(pixels[j], np.int32(0)))
        for k in range(CELL_SIZE):
            looked_up[k, j] = cells[cell, k]


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


def moments(poses, surfaces, colours, surface_m):
    """Return moments (m, 4) of the features of matching surface under poses (m, 12), summed over both directions.

    Args:
        poses: rows of the 3×4 matrices of target_from_source.
        surfaces: the `Projection` of the source's points in the target, and of the target's in the source.
        colours: their `Colours`.
        surface_m: noise of the surfaces in m beyond that of points and planes.
    """
    return over_rows(_moments, poses, surfaces, colours, np.float32(surface_m * surface_m), least=16)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moments(poses, surfaces, colours, surface_m2):
    result = np.zeros((poses.shape[0], 4))
    carried = np.empty(12)
    most = max(colours[0].values.shape[0], colours[1].values.shape[0])
    (transformed, pixels, found), colour = buffers(most), np.empty((CELL_SIZE, most), dtype=np.float32)
    for i in range(poses.shape[0]):
        for direction in range(2):
            surface, features = surfaces[direction], colours[direction]
            if direction == 0:
                for k in range(12):
                    carried[k] = poses[i, k]
            else:
                invert(poses[i], carried)
            project(carried, surface, transformed, pixels, found)
            fetch_colours(features.values.shape[0], pixels, features.cells, colour)
            found_moments = sum_moments(surface.points, features.values, transformed, found, colour, surface_m2)
            for k in range(4):
                result[i, k] += found_moments[k]
    return result


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
