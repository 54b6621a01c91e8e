"""One direction of a comparison of two views: points of one, carried into the other's image, and what is there.

Single precision: of a point a metre away it leaves 0.1 µm, and sixteen points go through one instruction.
"""

from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from modeler.kernels.planes import CELL_SIZE, KIND, MISSING

# No flag lets the compiler assume away NaN or infinity; these let it use multiply-add and one reciprocal, and add up
# in any order. So whatever is called from a kernel is made part of it (`forceinline`): a call may end in another copy,
# compiled by itself, that adds up in another order, and a kernel just compiled would not answer as one from the cache.
VECTOR_MATHS = {"contract", "arcp", "nsz", "reassoc"}
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)  # a plain 0.5 would make double precision of all

# Rows of the points handed in, and of what `carry` makes of them.
VARIANCE_M2 = 6
X, Y, Z, FACING_X, FACING_Y, FACING_Z, FACES, SHOWS = 0, 1, 2, 3, 4, 5, 6, 7
CARRIED_ROWS = 8

FloatArray = npt.NDArray[np.float32]


class Projection(NamedTuple):
    """What one view's points meet in the other."""

    points: FloatArray
    """(7, n) position in m, unit normal, variance along the normal in m²."""
    cells: FloatArray
    """(h · w, 8) of the other view, see `planes`."""
    camera: FloatArray
    """(6,) fx, fy, cx, cy, width and height in px of the other view."""
    facing: FloatArray
    """(4,) cosines at which a point begins to face the other camera and fully does; and at which the camera may be
    relied on to measure it."""


@numba.njit(cache=True, forceinline=True)
def invert(pose, inverse):
    """Write the inverse of a pose (12,), the rows of a 3×4 matrix, into `inverse` (12,)."""
    for k in range(3):
        inverse[4 * k + 3] = 0.0
        for m in range(3):
            inverse[4 * k + m] = pose[4 * m + k]
            inverse[4 * k + 3] -= pose[4 * m + k] * pose[4 * m + 3]


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def carry(pose, projection, carried, pixels):
    """Carry points into the other camera: straight-line code over rows of numbers, which compilers turn into vectors.

    Args:
        pose: (12,) rows of the 3×4 matrix.
        projection: the points and the other camera.
        carried: (8, n) out: position, normal, how much the point faces the camera (0..1), and how much it is to be
            relied on that the camera measures it (0..1).
        pixels: (n,) out: number of the pixel it falls on, row by row; -1 outside the image or behind the camera.
    """
    p0, p1, p2, p3 = np.float32(pose[0]), np.float32(pose[1]), np.float32(pose[2]), np.float32(pose[3])
    p4, p5, p6, p7 = np.float32(pose[4]), np.float32(pose[5]), np.float32(pose[6]), np.float32(pose[7])
    p8, p9, p10, p11 = np.float32(pose[8]), np.float32(pose[9]), np.float32(pose[10]), np.float32(pose[11])
    points, (fx, fy, cx, cy, width, height) = projection.points, projection.camera
    low, per_range = projection.facing[0], ONE / (projection.facing[1] - projection.facing[0])
    flat, per_turn = projection.facing[2], ONE / (projection.facing[3] - projection.facing[2])
    for j in range(points.shape[1]):
        a, b, c, d, e, f = points[0, j], points[1, j], points[2, j], points[3, j], points[4, j], points[5, j]
        x = p0 * a + p1 * b + p2 * c + p3
        y = p4 * a + p5 * b + p6 * c + p7
        z = p8 * a + p9 * b + p10 * c + p11
        normal_x = p0 * d + p1 * e + p2 * f
        normal_y = p4 * d + p5 * e + p6 * f
        normal_z = p8 * d + p9 * e + p10 * f
        cosine = -(normal_x * x + normal_y * y + normal_z * z) / np.sqrt(x * x + y * y + z * z)
        per_z = ONE / z
        column, row = fx * x * per_z + cx + HALF, fy * y * per_z + cy + HALF
        inside = (z > ZERO) & (column >= ZERO) & (column < width) & (row >= ZERO) & (row < height)
        safe_column, safe_row = min(max(column, ZERO), width - ONE), min(max(row, ZERO), height - ONE)
        pixel = np.int32(safe_row) * np.int32(width) + np.int32(safe_column)
        carried[X, j], carried[Y, j], carried[Z, j] = x, y, z
        carried[FACING_X, j], carried[FACING_Y, j], carried[FACING_Z, j] = normal_x, normal_y, normal_z
        carried[FACES, j] = min(max((cosine - low) * per_range, ZERO), ONE)
        carried[SHOWS, j] = min(max((cosine - flat) * per_turn, ZERO), ONE)
        pixels[j] = pixel if inside else np.int32(-1)


@numba.njit(cache=True, forceinline=True)
def fetch(pixels, cells, found):
    """Copy the cells at `pixels` (n,) into the columns of `found` (8, n); outside the image they are `MISSING`."""
    for j in range(pixels.shape[0]):
        cell = np.uint32(max(pixels[j], np.int32(0)))
        for k in range(CELL_SIZE):
            found[k, j] = cells[cell, k]
        if pixels[j] < 0:
            found[KIND, j] = MISSING


@numba.njit(cache=True, forceinline=True)
def look(pose, projection, carried, pixels, found):
    """Carry points by a pose (12,), and copy what lies there: `carry`, then `fetch`."""
    carry(pose, projection, carried, pixels)
    fetch(pixels, projection.cells, found)


@numba.njit(cache=True, forceinline=True)
def buffers(projection):
    """Return room for what `look` finds: carried (8, n), pixels (n,), cells (8, n)."""
    count = projection.points.shape[1]
    carried, pixels = np.empty((CARRIED_ROWS, count), dtype=np.float32), np.empty(count, dtype=np.int32)
    return carried, pixels, np.empty((CELL_SIZE, count), dtype=np.float32)
