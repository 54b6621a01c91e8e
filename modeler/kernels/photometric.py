"""Colours of surface seen by both views: correlation, linear equations for a pose, and the shading by lamps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from modeler.kernels.cache import njit
from modeler.kernels.point_likelihood import FACING, ONE, VECTOR_MATHS, ZERO, X, Y, Z, plane_distance
from modeler.kernels.point_to_plane import FACING_WEIGHT, OTHER, OWN, POSITION, RESIDUAL, WEIGHT, match_weight

# Columns of a cell, the 16 bytes that are read for one point: at a point p that projects where the cell's own does, the
# feature is gradient · p + offset to first order. They are those of a plane: `plane_distance` of a cell is the feature.
GRADIENT_X, GRADIENT_Y, GRADIENT_Z, OFFSET = 0, 1, 2, 3
CELL_SIZE = 4

_MIN_DEVIATION = 1e-6  # standard deviation of features, for images without any

FloatArray = npt.NDArray[np.float32]


class Colours(NamedTuple):
    """Colours of one direction of a comparison, for the points of a `Projection`."""

    values: FloatArray
    """(n,) features of the points in their own view, of unit variance; (0,) if colours are not compared."""
    cells: FloatArray
    """(m + 1, 4) cells of colour of the other view's surface points; the last, of no point, is zero."""
    numbers: npt.NDArray[np.int32]
    """(h · w,) index of the other view's point at each pixel, m for none."""

    def thinned(self, stride: int) -> Colours:
        """Return the colours of every `stride`-th point."""
        return self._replace(values=np.ascontiguousarray(self.values[::stride]))


NO_COLOURS = Colours(
    np.zeros(0, dtype=np.float32), np.zeros((1, CELL_SIZE), dtype=np.float32), np.zeros(1, dtype=np.int32)
)
"""Placeholder for colours that are not compared."""


@njit(cache=True, error_model="numpy")
def find_in_place(points_m, shift_m, camera, numbers, none, found, offsets):
    """Find where points fall in another view if they are only shifted.

    Args:
        points_m: (n, 3) the points.
        shift_m: (3,) the shift.
        camera: (4,) fx, fy, cx, cy of the other view.
        numbers: (h, w) indices of the other view's points.
        none: index for no point.
        found: (n,) out; index of the other view's point there, or `none`.
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


@njit(cache=True, error_model="numpy", forceinline=True)
def in_place(others, numbers, offsets, j):
    """Return another view's feature at the place of a point, and its derivatives; 0 if it has no surface there."""
    k = numbers[j]
    if k >= others.shape[1]:
        return ZERO, ZERO, ZERO
    by_column, by_row = others[1, k], others[2, k]
    return others[0, k] + by_column * offsets[j, 0] + by_row * offsets[j, 1], by_column, by_row


@njit(cache=True, error_model="numpy")
def compare_in_place(features, others, numbers, offsets):
    """Return sums over the points at whose place the other view has surface.

    Args:
        features: (3, n) of the points: value, and derivatives by column and row in 1/px.
        others: (3, m) of the other view's.
        numbers: (n,) of `find_in_place`.
        offsets: (n, 2) likewise.

    Returns:
        Σ a², Σ a b and Σ b² (3,) of the features a of the points and b of the other view; Σ ∇b ∇bᵀ (2, 2); and
        Σ ∇b (a - b) (2,).
    """
    moments, matrix, gradient = np.zeros(3), np.zeros((2, 2)), np.zeros(2)
    for j in range(numbers.shape[0]):
        if numbers[j] >= others.shape[1]:
            continue
        own = features[0, j]
        there, by_column, by_row = in_place(others, numbers, offsets, j)
        moments[0] += own * own
        moments[1] += own * there
        moments[2] += there * there
        matrix[0, 0] += by_column * by_column
        matrix[0, 1] += by_column * by_row
        matrix[1, 1] += by_row * by_row
        gradient[0] += by_column * (own - there)
        gradient[1] += by_row * (own - there)
    matrix[1, 0] = matrix[0, 1]
    return moments, matrix, gradient


@njit(cache=True, error_model="numpy")
def remove_static(features, others, numbers, offsets, share, points_m, focal, values, cells):
    """Write features regressed on those of another view at the same places, and their cells (method, eq. 7.2).

    The result has unit variance. A feature is constant along a pixel's ray, so that its gradient in space vanishes
    along it.

    Args:
        features: see `compare_in_place`.
        others: see `compare_in_place`.
        numbers: see `compare_in_place`.
        offsets: see `compare_in_place`.
        share: regression coefficient, float32.
        points_m: (n, 3) the points.
        focal: (2,) fx and fy in px, float32.
        values: (n,) out.
        cells: (n + 1, 4) out.
    """
    count, total, square = points_m.shape[0], 0.0, 0.0
    for j in range(count):
        there, by_column, by_row = in_place(others, numbers, offsets, j)
        left = features[0, j] - share * there
        cells[j, OFFSET] = left
        cells[j, GRADIENT_X], cells[j, GRADIENT_Y] = features[1, j] - share * by_column, features[2, j] - share * by_row
        total += left
        square += left * left
    variance = square / max(count, 1) - (total / max(count, 1)) ** 2
    scale = np.float32(1.0 / max(math.sqrt(max(variance, 0.0)), _MIN_DEVIATION))
    for j in range(count):
        cell = cells[j]
        x, y, per_z = np.float32(points_m[j, 0]), np.float32(points_m[j, 1]), ONE / np.float32(points_m[j, 2])
        per_m = scale * per_z
        by_x, by_y = per_m * cell[GRADIENT_X] * focal[0], per_m * cell[GRADIENT_Y] * focal[1]
        cell[GRADIENT_X], cell[GRADIENT_Y], cell[GRADIENT_Z] = by_x, by_y, -(by_x * x + by_y * y) * per_z
        values[j] = cell[OFFSET] = scale * cell[OFFSET]
    cells[count] = ZERO


@njit(cache=True, error_model="numpy")
def compare_matches(matches, rotation, values, own_cells, cells, camera, numbers, weight):
    """Return the equations of features of matches (n, 15), in the layout of `point_to_plane.matches`.

    The gradient of a feature replaces the normal, the difference of features the distance.

    Args:
        matches: (n, 15) of surface.
        rotation: (3, 3) of the points into the other camera.
        values: (n,) features of the points in their own view.
        own_cells: (n, 4) cells of the points in their own view.
        cells: (m + 1, 4) cells of the other view.
        camera: (4,) fx, fy, cx and cy of the other view.
        numbers: (h, w) indices of its surface points.
        weight: of squared differences of features.
    """
    found, own = matches.copy(), np.empty(3)
    height, width = numbers.shape
    for j in range(matches.shape[0]):
        position, normal = matches[j, POSITION], matches[j, OWN]
        x, y, z = position
        column, row = np.floor(camera[0] * x / z + camera[2] + 0.5), np.floor(camera[1] * y / z + camera[3] + 0.5)
        cell = cells[numbers[int(min(max(row, 0), height - 1)), int(min(max(column, 0), width - 1))]]
        # The part along the surface rotates with it, and is then continued along the other camera's ray.
        across, ray, slope = 0.0, 0.0, 0.0
        for k in range(3):
            own[k] = 0.0
            for m in range(3):
                own[k] += rotation[k, m] * own_cells[j, m]
            across += own[k] * normal[k]
            ray += position[k] * normal[k]
        for k in range(3):
            own[k] -= across * normal[k]
            slope += own[k] * position[k]
        found[j, RESIDUAL] = cell[OFFSET] - values[j]
        for k in range(3):
            found[j, OWN.start + k] = own[k] - slope / min(ray, -1e-6) * normal[k]
            found[j, OTHER.start + k] = cell[k]
            found[j, RESIDUAL] += cell[k] * position[k]
        found[j, WEIGHT] = weight * matches[j, FACING_WEIGHT]
    return found


@njit(cache=True, error_model="numpy", forceinline=True)
def fetch_colours(count, pixels, colours, looked_up):
    """Copy cells at the first `pixels` (n,) into columns of `looked_up` (4, n)."""
    for j in range(count):
        cell = np.uint32(colours.numbers[np.uint32(max(pixels[j], np.int32(0)))])
        for k in range(CELL_SIZE):
            looked_up[k, j] = colours.cells[cell, k]


@njit(cache=True, error_model="numpy", forceinline=True)
def fetch_features(count, pixels, colours, transformed, seen):
    """Write the features `seen` (n,) of the other view where the first transformed points fall, at `pixels` (n,)."""
    for j in range(count):
        cell = np.uint32(colours.numbers[np.uint32(max(pixels[j], np.int32(0)))])
        seen[j] = (
            colours.cells[cell, GRADIENT_X] * transformed[X, j]
            + colours.cells[cell, GRADIENT_Y] * transformed[Y, j]
            + colours.cells[cell, GRADIENT_Z] * transformed[Z, j]
            + colours.cells[cell, OFFSET]
        )


@njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def sum_moments(points, values, transformed, looked_up, seen, surface_m2):
    """Return Σ a b, Σ a², Σ b² and the number of matches of one direction, each weighted by f."""
    product, own_square, other_square, count = ZERO, ZERO, ZERO, ZERO
    for j in range(points.shape[1]):
        distance = plane_distance(transformed, looked_up, j)
        matched = match_weight(points, transformed, looked_up, distance, surface_m2, j) > ZERO
        weight = transformed[FACING, j] if matched else ZERO
        own, other = values[j], seen[j]
        product += weight * own * other
        own_square += weight * own * own
        other_square += weight * other * other
        count += weight
    return product, own_square, other_square, count


@njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def linearise_features(values, transformed, colour, centre, weight, rows):
    """Replace the equations of matches in `rows` (9, n), see `point_to_plane.linearise`, by those of their features.

    A feature is linear in the point's position, like a plane's distance, with its gradient in place of the normal.
    """
    cx, cy, cz = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2])
    for j in range(values.shape[0]):
        rows[6, j] = plane_distance(transformed, colour, j) - values[j]
        rows[7, j] = weight * transformed[FACING, j] if rows[7, j] > ZERO else ZERO
    for j in range(values.shape[0]):
        x, y, z = transformed[X, j] - cx, transformed[Y, j] - cy, transformed[Z, j] - cz
        slope_x, slope_y, slope_z = colour[GRADIENT_X, j], colour[GRADIENT_Y, j], colour[GRADIENT_Z, j]
        rows[0, j] = y * slope_z - z * slope_y
        rows[1, j] = z * slope_x - x * slope_z
        rows[2, j] = x * slope_y - y * slope_x
        rows[3, j], rows[4, j], rows[5, j] = slope_x, slope_y, slope_z


HARMONICS = 8  # up to the second degree, without the constant


@njit(cache=True)
def harmonics(pose, x, y, z):
    """Return the spherical harmonics of degrees 1 and 2 (8,), unscaled, of a direction rotated to a camera's frame.

    They describe nearly all shading of a matt surface by distant lamps (Basri and Jacobs 2003, "Lambertian reflectance
    and linear subspaces").
    """
    a = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z
    b = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z
    c = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z
    return a, b, c, a * b, b * c, a * c, a * a - b * b, 3.0 * c * c - 1.0


@njit(cache=True)
def harmonics_of(normals, pose):
    """Return the harmonics (n, 8) of normals (n, 3), see `harmonics`."""
    result = np.empty((len(normals), HARMONICS))
    for n in range(len(normals)):
        turned = harmonics(pose, normals[n, 0], normals[n, 1], normals[n, 2])
        for h in range(HARMONICS):
            result[n, h] = turned[h]
    return result


@njit(cache=True)
def shading_of(normals, coefficients):
    """Return the shading (n,) of normals (n, 3), given coefficients (9,) of a constant and the harmonics."""
    result = np.empty(len(normals))
    camera = np.eye(4)
    for n in range(len(normals)):
        turned = harmonics(camera, normals[n, 0], normals[n, 1], normals[n, 2])
        result[n] = coefficients[0]
        for h in range(HARMONICS):
            result[n] += coefficients[1 + h] * turned[h]
    return result


SCALE, SHIFT_X, SHIFT_Y, FLIP_X, FLIP_Y = 0, 1, 2, 3, 4
"""Columns of a displacement: size of things in colour relative to depth, shift in px, and 1 or -1 along both axes."""
_MIN_SQUARE = 1e-12  # of features, for images without any


@njit(cache=True, error_model="numpy", inline="always")
def _at(image, displacement, x, y):
    """Return the value of an image (h, w) where a pixel of depth is in colour, interpolated; NaN outside."""
    height, width = image.shape
    middle_x, middle_y = 0.5 * (width - 1), 0.5 * (height - 1)
    column = middle_x + displacement[FLIP_X] * (displacement[SCALE] * (x - middle_x) + displacement[SHIFT_X])
    row = middle_y + displacement[FLIP_Y] * (displacement[SCALE] * (y - middle_y) + displacement[SHIFT_Y])
    if not (0.0 <= column <= width - 1 and 0.0 <= row <= height - 1):
        return math.nan
    j, i = min(int(column), width - 2), min(int(row), height - 2)
    across, down = column - j, row - i
    above = (1.0 - across) * image[i, j] + across * image[i, j + 1]
    below = (1.0 - across) * image[i + 1, j] + across * image[i + 1, j + 1]
    return (1.0 - down) * above + down * below


@njit(cache=True, error_model="numpy")
def displaced_correlations(images, pairs, starts, places, displacements):
    """Return the correlation (m, k) of features of k pairs under m displacements; 0 if too few are in the image.

    Args:
        images: (v, h, w) features of the views.
        pairs: (k, 2) indices of the two views of each pair.
        starts: (k + 1,) where the places of each pair start.
        places: (n, 4) column and row of surface in the first view, and in the second.
        displacements: (m, 5).
    """
    found = np.zeros((displacements.shape[0], pairs.shape[0]))
    for m in range(displacements.shape[0]):
        for k in range(pairs.shape[0]):
            first, second = images[pairs[k, 0]], images[pairs[k, 1]]
            count, of_first, of_second, square_first, square_second, product = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for n in range(starts[k], starts[k + 1]):
                a = _at(first, displacements[m], places[n, 0], places[n, 1])
                b = _at(second, displacements[m], places[n, 2], places[n, 3])
                if math.isnan(a + b):
                    continue
                count += 1
                of_first += a
                of_second += b
                square_first += a * a
                square_second += b * b
                product += a * b
            if 2 * count < starts[k + 1] - starts[k]:
                continue
            square_first -= of_first * of_first / count
            square_second -= of_second * of_second / count
            product -= of_first * of_second / count
            found[m, k] = product / math.sqrt(max(square_first * square_second, _MIN_SQUARE))
    return found
