"""Colours of surface that both views saw: their correlation, and the equations by which they move a pose."""

from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from modeler.kernels.point_likelihood import (
    FACING,
    VECTOR_MATHS,
    ZERO,
    Projection,
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


class ColourProjection(NamedTuple):
    """One direction of a comparison of colours."""

    points: FloatArray
    """(7, n) as of a `Projection`."""
    cells: FloatArray
    """(h · w, 8) of the other view's surface, as of a `Projection`."""
    camera: FloatArray
    """(6,) as of a `Projection`."""
    cosines: FloatArray
    """(4,) as of a `Projection`."""
    values: FloatArray
    """(n,) features of the points in their own view, of unit variance."""
    colours: FloatArray
    """(h · w, 4) cells of colour of the other view."""

    def thinned(self, stride: int) -> "ColourProjection":
        """Return every `stride`-th point."""
        points, values = (np.ascontiguousarray(part[..., ::stride]) for part in (self.points, self.values))
        return self._replace(points=points, values=values)


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


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def fetch_colours(count, pixels, cells, looked_up):
    """Copy the cells of colour at the first `pixels` (n,) into columns of `looked_up` (4, n)."""
    for j in range(count):
        cell = np.uint32(max(pixels[j], np.int32(0)))
        for k in range(CELL_SIZE):
            looked_up[k, j] = cells[cell, k]


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def sum_moments(projection, transformed, looked_up, colour, surface_m2):
    """Return Σ a b, Σ a², Σ b² and the number of matches of one direction, each weighted by f."""
    product, own_square, other_square, count = ZERO, ZERO, ZERO, ZERO
    points = projection.points
    for j in range(points.shape[1]):
        distance = plane_distance(transformed, looked_up, j)
        matched = match_weight(points, transformed, looked_up, distance, surface_m2, j) > ZERO
        weight = transformed[FACING, j] if matched else ZERO
        own, other = projection.values[j], plane_distance(transformed, colour, j)
        product += weight * own * other
        own_square += weight * own * own
        other_square += weight * other * other
        count += weight
    return product, own_square, other_square, count


def moments(poses, projections, surface_m):
    """Return moments (m, 4) of the features of matching surface under poses (m, 12), summed over both directions.

    Args:
        poses: rows of the 3×4 matrices of target_from_source.
        projections: the `ColourProjection` of the source's points in the target, and of the target's in the source.
        surface_m: noise of the surfaces in m beyond that of points and planes.
    """
    return over_rows(_moments, poses, projections, np.float32(surface_m * surface_m), least=16)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moments(poses, projections, surface_m2):
    result = np.zeros((poses.shape[0], 4))
    carried = np.empty(12)
    wide = projections[0] if projections[0].values.shape[0] > projections[1].values.shape[0] else projections[1]
    (transformed, pixels, found), colour = (
        buffers(wide.values.shape[0]),
        np.empty((CELL_SIZE, wide.values.shape[0]), dtype=np.float32),
    )
    for i in range(poses.shape[0]):
        for direction in range(2):
            projection = projections[direction]
            if direction == 0:
                for k in range(12):
                    carried[k] = poses[i, k]
            else:
                invert(poses[i], carried)
            project(carried, projection, transformed, pixels, found)
            fetch_colours(projection.values.shape[0], pixels, projection.colours, colour)
            found_moments = sum_moments(projection, transformed, found, colour, surface_m2)
            for k in range(4):
                result[i, k] += found_moments[k]
    return result


def no_colour(projection: Projection) -> ColourProjection:
    """Return one direction of views without colour: no points."""
    return ColourProjection(
        *projection.empty(), np.zeros(0, dtype=np.float32), np.zeros((1, CELL_SIZE), dtype=np.float32)
    )


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def linearise_features(projection, transformed, found, colour, centre, surface_m2, weight, rows):
    """Write the equations of features into `rows` (8, n): derivatives by ζ, residual and weight.

    A feature is linear in the point's position as a plane's distance is, its gradient in the place of the normal.
    """
    points = projection.points
    cx, cy, cz = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2])
    for j in range(points.shape[1]):
        distance = plane_distance(transformed, found, j)
        matched = match_weight(points, transformed, found, distance, surface_m2, j) > ZERO
        rows[6, j] = plane_distance(transformed, colour, j) - projection.values[j]
        rows[7, j] = weight * transformed[FACING, j] if matched else ZERO
    for j in range(points.shape[1]):
        x, y, z = transformed[X, j] - cx, transformed[Y, j] - cy, transformed[Z, j] - cz
        slope_x, slope_y, slope_z = colour[GRADIENT_X, j], colour[GRADIENT_Y, j], colour[GRADIENT_Z, j]
        rows[0, j] = y * slope_z - z * slope_y
        rows[1, j] = z * slope_x - x * slope_z
        rows[2, j] = x * slope_y - y * slope_x
        rows[3, j], rows[4, j], rows[5, j] = slope_x, slope_y, slope_z
