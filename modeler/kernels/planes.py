"""Local planes of a depth image, and the distance from the object's silhouette."""

import math
from typing import NamedTuple

import numpy as np

from modeler.kernels.cache import njit
from modeler.kernels.threads import over_rows

# Columns of a cell, the 32 bytes that a likelihood reads for one pixel (float32).
NORMAL_X, NORMAL_Y, NORMAL_Z = 0, 1, 2  # unit normal n of the local plane, towards the camera
DISTANCE = 3  # of the plane from the camera, m: n · p + distance is the height of p in front of it
VARIANCE = 4  # of that distance at the pixel, m²
KIND = 5  # one of the four below
DEPTH = 6  # measured z, m
SILHOUETTE = 7  # distance of a pixel outside the object from its silhouette, px
RIM = 7  # of a pixel of the object, in the same place: weight of errors near its silhouette (method, eq. 4.8)
CELL_SIZE = 8

_OUTLIER = 3.0  # standard deviations of a pixel's noise, by convention

_APART = 32  # of every so many rows, each thread processes some
# RAGGED: object without a reliable plane, or an occluder.
MISSING, SURFACE, RAGGED, BACKGROUND = 0.0, 1.0, 2.0, 3.0


class Ball(NamedTuple):
    """The neighbourhood of a pixel."""

    radius_m: float
    """Radius in m."""
    reach_px: int
    """Half-width in px of a window that contains it."""
    stride: int
    """Between the pixels that are read."""
    noise_m: float
    """Standard deviation in m of the depth of a pixel."""


@njit(cache=True)
def solve_symmetric_3(a00, a01, a02, a11, a12, a22, b0, b1, b2):
    """Solve a symmetric 3×3 system by Cramer's rule.

    Returns:
        (x0, x1, x2, first diagonal element of the inverse, determinant); the determinant is 0 if singular.
    """
    c00 = a11 * a22 - a12 * a12
    c01 = a02 * a12 - a01 * a22
    c02 = a01 * a12 - a02 * a11
    determinant = a00 * c00 + a01 * c01 + a02 * c02
    if determinant <= 1e-12 * a00 * a11 * a22:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    c11 = a00 * a22 - a02 * a02
    c12 = a01 * a02 - a00 * a12
    c22 = a00 * a11 - a01 * a01
    scale = 1.0 / determinant
    return (
        scale * (c00 * b0 + c01 * b1 + c02 * b2),
        scale * (c01 * b0 + c11 * b1 + c12 * b2),
        scale * (c02 * b0 + c12 * b1 + c22 * b2),
        scale * c00,
        determinant,
    )


@njit(cache=True)
def bounds(mask):
    """Return the bounding box of a mask (h, w): first row, row after the last, and the same for columns."""
    top, bottom, left, right = mask.shape[0], 0, mask.shape[1], 0
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            if mask[row, column]:
                top, bottom = min(top, row), row + 1
                left, right = min(left, column), max(right, column + 1)
    return min(top, bottom), bottom, min(left, right), right


@njit(cache=True)
def padded(depth_m, mask, intrinsics, window, ball):
    """Return positions and inverse depths of a mask's pixels in a padded window; NaN elsewhere.

    Positions decide which pixels a ball holds. If pixels err by as much as its radius, a measured position keeps only
    neighbours that err alike, which flattens slopes and averages nothing. Then positions are those of a median filter
    of 3×3 px, and outliers have none. Inverse depths, to which planes are fitted, are those measured.

    Args:
        depth_m: (h, w) z in m.
        mask: (h, w) bool.
        intrinsics: (4,) fx, fy, cx, cy in px.
        window: top, bottom, left and right of the pixels.
        ball: of the neighbourhoods; the window is padded by its reach.

    Returns:
        (4, h, w) float32 x, y, z in m, and measured 1/z in 1/m.
    """
    top, bottom, left, right = window
    fx, fy, cx, cy = intrinsics
    pad, outlier_m = ball.reach_px, _OUTLIER * ball.noise_m
    is_noisy = outlier_m > ball.radius_m
    height, width = bottom - top + 2 * pad, right - left + 2 * pad
    measured_m = np.full((height, width), np.nan, dtype=np.float32)
    for row in range(top, bottom):
        for column in range(left, right):
            z = depth_m[row, column]
            if mask[row, column] and z > 0.0:
                measured_m[row - top + pad, column - left + pad] = z
    points = np.full((4, height, width), np.nan, dtype=np.float32)  # outside every ball
    for r in range(pad, height - pad):
        for c in range(pad, width - pad):
            measured = measured_m[r, c]
            if not measured > 0.0:
                continue
            z = median_around(measured_m, r, c) if is_noisy else measured
            if abs(measured - z) <= outlier_m:
                row, column = r - pad + top, c - pad + left
                points[0, r, c], points[1, r, c] = z * (column - cx) / fx, z * (row - cy) / fy
                points[2, r, c], points[3, r, c] = z, 1.0 / measured
    return points


@njit(cache=True)
def median_around(depth_m, row, column):
    """Return the median of the 3×3 depths about a pixel.

    Opposite neighbours count as the pixel itself if one of them has no depth, so that a slope keeps its depth up to its
    border.
    """
    z = depth_m[row, column]
    a, b = opposite(depth_m[row - 1, column - 1], depth_m[row + 1, column + 1], z)
    c, d = opposite(depth_m[row - 1, column], depth_m[row + 1, column], z)
    e, f = opposite(depth_m[row - 1, column + 1], depth_m[row + 1, column - 1], z)
    g, h = opposite(depth_m[row, column - 1], depth_m[row, column + 1], z)
    # Of three sorted triples, it is the median of the largest minimum, the median of medians and the least maximum.
    low_1, middle_1, high_1 = ascending(a, b, c)
    low_2, middle_2, high_2 = ascending(d, e, f)
    low_3, middle_3, high_3 = ascending(g, h, z)
    _, middle, _ = ascending(middle_1, middle_2, middle_3)
    lowest, highest = max(low_1, low_2, low_3), min(high_1, high_2, high_3)
    return ascending(lowest, middle, highest)[1]


@njit(cache=True)
def opposite(a, b, instead):
    """Return two depths, or twice the one instead if either is missing."""
    there = a > 0.0 and b > 0.0  # not NaN
    return a if there else instead, b if there else instead


@njit(cache=True)
def ascending(a, b, c):
    """Return three numbers in ascending order."""
    a, b = min(a, b), max(a, b)
    b, c = min(b, c), max(b, c)
    return min(a, b), max(a, b), c


@njit(cache=True, fastmath={"contract", "nsz"})
def add_line(centres, points, row, shift, pad, radius_m2, step, sums):
    """Sum, for every pixel of a row, over its neighbours on one line within the ball around it.

    Args:
        centres: of the balls, from `padded`.
        points: the neighbours, from `padded`.
        row: of the pixels.
        shift: rows from the pixels down to the line.
        pad: of `padded`; the line is read this far to either side.
        radius_m2: square of the ball's radius.
        step: between the pixels that are read.
        sums: (6, w) out: number n, Σ x, Σ x², Σ b, Σ x b, Σ b², with x the columns from the pixel and b the
            difference in 1/z.
    """
    sums[:] = 0.0
    here, there = row + pad, row + pad + shift
    for dx in range(-pad, pad + 1, step):
        x = np.float32(dx)
        for j in range(sums.shape[1]):
            k = np.uint32(j + pad)
            m = np.uint32(j + pad + dx)
            away_x = points[0, there, m] - centres[0, here, k]
            away_y = points[1, there, m] - centres[1, here, k]
            away_z = points[2, there, m] - centres[2, here, k]
            b = points[3, there, m] - centres[3, here, k]
            inside = away_x * away_x + away_y * away_y + away_z * away_z <= radius_m2
            one, weighted = np.float32(1.0) if inside else np.float32(0.0), b if inside else np.float32(0.0)
            sums[0, j] += one
            sums[1, j] += x * one
            sums[2, j] += x * x * one
            sums[3, j] += weighted
            sums[4, j] += x * weighted
            sums[5, j] += weighted * weighted


def local_planes(depth_m, mask, silhouette, intrinsics, ball, sigma_inverse_per_m, measured=None):
    """Fit a plane to every object pixel's neighbours within a ball.

    A plane is linear in inverse depth over the image (1/z = N · (w, h, 1)), where triangulating cameras have constant
    noise. The ball selects the same piece of surface from every view, so that the effect of smoothing on a curved
    surface cancels between views.

    Args:
        depth_m: (h, w) z in m, NaN = missing.
        mask: (h, w) bool, object.
        silhouette: (h, w) copied into the cells: `silhouette_distance` outside the object, `rim_weights` on it.
        intrinsics: (4,) fx, fy, cx, cy in px.
        ball: around each pixel.
        sigma_inverse_per_m: sensor noise of 1/z, in 1/m.
        measured: (h, w) bool, the object pixels to which planes are fitted; the depth of others only determines where
            to look for neighbours. None: all.

    Returns:
        (h, w, 8) float32 cells, columns as above.
    """
    window = bounds(mask)
    centres = padded(depth_m, mask, intrinsics, window, ball)
    points = centres if measured is None else padded(depth_m, measured, intrinsics, window, ball)
    images = depth_m, mask, silhouette, centres, points
    cells = np.empty((*depth_m.shape, CELL_SIZE), dtype=np.float32)
    apart = np.argsort(np.arange(len(cells)) % _APART, kind="stable")  # every thread gets its share of the object
    over_rows(_local_planes, apart, cells, *images, window, intrinsics, ball, sigma_inverse_per_m, in_place=True)
    return cells


@njit(cache=True, nogil=True)
def _local_planes(
    rows, cells, depth_m, mask, silhouette, centres, points, window, intrinsics, ball, sigma_inverse_per_m
):
    width = depth_m.shape[1]
    fx, fy, cx, cy = intrinsics
    radius_m, reach, stride = ball.radius_m, ball.reach_px, ball.stride
    top, bottom, left, right = window
    line, sums = np.empty((6, right - left), dtype=np.float32), np.empty((10, right - left))
    for row in rows:
        found = cells[row]
        found[:] = 0.0
        for column in range(width):
            found[column, SILHOUETTE] = silhouette[row, column]
            if depth_m[row, column] > 0.0:
                found[column, DEPTH] = depth_m[row, column]
                found[column, KIND] = RAGGED if mask[row, column] else BACKGROUND
        if row < top or row >= bottom:
            continue
        for k in range(10):
            for j in range(right - left):
                sums[k, j] = 0.0
        for dy in range(-reach, reach + 1, stride):
            add_line(centres, points, row - top, dy, reach, np.float32(radius_m * radius_m), stride, line)
            for j in range(right - left):
                n, x, b = line[0, j], line[1, j], line[3, j]
                sums[0, j] += n
                sums[1, j] += x
                sums[2, j] += dy * n
                sums[3, j] += line[2, j]
                sums[4, j] += dy * x
                sums[5, j] += dy * dy * n
                sums[6, j] += b
                sums[7, j] += line[4, j]
                sums[8, j] += dy * b
                sums[9, j] += line[5, j]
        for column in range(left, right):
            if found[column, KIND] == RAGGED:
                w, h = (column - cx) / fx, (row - cy) / fy
                fit_plane(found[column], sums[:, column - left], w, h, fx, fy, sigma_inverse_per_m)
    return rows


@njit(cache=True)
def fit_plane(cell, sums, w, h, fx, fy, sigma_inverse_per_m):
    """Write the plane fitted to a pixel's neighbours into its cell (8,), if they determine one (method, eq. 1.1).

    Args:
        cell: with the depth of the pixel.
        sums: (10,) n, Σ x, Σ y, Σ x², Σ xy, Σ y², Σ b, Σ xb, Σ yb, Σ b² of columns and rows from the pixel and of the
            difference in 1/z.
        w: (column - cx) / fx of the pixel.
        h: (row - cy) / fy of the pixel.
        fx: focal length along rows in px.
        fy: focal length along columns in px.
        sigma_inverse_per_m: least noise of 1/z, in 1/m.
    """
    n, swx, swy, sxx, sxy, syy, sb, sxb, syb, sbb = sums
    if n < 6.0:
        return
    offset, slope_x, slope_y, leverage, determinant = solve_symmetric_3(n, swx, swy, sxx, sxy, syy, sb, sxb, syb)
    z = np.float64(cell[DEPTH])
    along = 1.0 / z + offset
    if determinant == 0.0 or along <= 0.0:
        return
    # 1/z = along + slope_x (c - column) + slope_y (r - row), turned into N · (w, h, 1).
    plane_x, plane_y = slope_x * fx, slope_y * fy
    plane_z = along - plane_x * w - plane_y * h
    norm = math.sqrt(plane_x * plane_x + plane_y * plane_y + plane_z * plane_z)
    # method, eq. 1.2
    residual = sbb - offset * sb - slope_x * sxb - slope_y * syb
    spread = max(residual / max(n - 3.0, 1.0), sigma_inverse_per_m * sigma_inverse_per_m)
    cell[NORMAL_X], cell[NORMAL_Y], cell[NORMAL_Z] = -plane_x / norm, -plane_y / norm, -plane_z / norm
    cell[DISTANCE] = 1.0 / norm
    # The distance of a point from the plane is (1 - N · p) / |N|: its noise is z times that of 1/z over |N|.
    cell[VARIANCE] = z * z * spread * leverage / (norm * norm)
    # A one-sided neighbourhood, at a silhouette or a fold, gives its pixel a high leverage.
    if n >= 8.0 and leverage * n < 1.6:
        cell[KIND] = SURFACE


@njit(cache=True)
def frontal_points(cells, mask, intrinsics, min_cosine):
    """Return the intersections of pixels' rays with their local planes, for planes that face the camera enough.

    Args:
        cells: (h, w, 8) of `local_planes`.
        mask: (h, w) bool, object.
        intrinsics: (4,) fx, fy, cx, cy in px.
        min_cosine: least cosine between a plane's normal and the direction to the camera.

    Returns:
        Points (n, 3) in m, unit normals (n, 3), rows and columns (n, 2), variances along the normals (n,) in m².
    """
    fx, fy, cx, cy = intrinsics
    top, bottom, left, right = bounds(mask)
    most = 0
    for row in range(top, bottom):
        for column in range(left, right):
            most += cells[row, column, KIND] == SURFACE
    points_m, normals = np.empty((most, 3)), np.empty((most, 3))
    pixels, variance_m2 = np.empty((most, 2), dtype=np.int64), np.empty(most)
    count = 0
    for row in range(top, bottom):
        for column in range(left, right):
            cell = cells[row, column]
            if cell[KIND] != SURFACE:
                continue
            x, y, z = np.float64(cell[NORMAL_X]), np.float64(cell[NORMAL_Y]), np.float64(cell[NORMAL_Z])
            w, h = (column - cx) / fx, (row - cy) / fy
            towards = -(x * w + y * h + z)
            length = math.sqrt(x * x + y * y + z * z)
            if towards <= min_cosine * length * math.sqrt(w * w + h * h + 1.0):
                continue
            depth_m = np.float64(cell[DISTANCE]) / towards
            points_m[count, 0], points_m[count, 1], points_m[count, 2] = w * depth_m, h * depth_m, depth_m
            normals[count, 0], normals[count, 1], normals[count, 2] = x / length, y / length, z / length
            pixels[count, 0], pixels[count, 1] = row, column
            variance_m2[count] = cell[VARIANCE]
            count += 1
    return points_m[:count], normals[:count], pixels[:count], variance_m2[:count]


_STEP, _DIAGONAL = np.float32(1.0), np.float32(math.sqrt(2.0))


@njit(cache=True)
def silhouette_distance(mask, limit_px):
    """Return the distance (h, w) float32 in px of every pixel from the mask, at most `limit_px`, by chamfer sweeps."""
    distance = np.full(mask.shape, limit_px, dtype=np.float32)
    top, bottom, left, right = bounds(mask)
    reach = math.ceil(limit_px)  # farther from the mask nothing changes
    first, last = max(top - reach, 0), min(bottom + reach, mask.shape[0]) - 1
    near = slice(max(left - reach, 0), right + reach)
    for row in range(first, last + 1):
        line = distance[row, near]
        for column in range(line.shape[0]):
            if mask[row, near.start + column]:
                line[column] = 0.0
        if row > first:
            propagate_from_row(line, distance[row - 1, near])
        propagate_along_row(line)
    for row in range(last, first - 1, -1):
        line = distance[row, near]
        if row < last:
            propagate_from_row(line, distance[row + 1, near])
        propagate_along_row(line[::-1])
    return distance


@njit(cache=True)
def propagate_from_row(line, above):
    """Propagate distances (w,) from the neighbouring row, straight and diagonally."""
    last = line.shape[0] - 1
    for column in range(1, last):
        across = min(above[column - 1], above[column + 1]) + _DIAGONAL
        line[column] = min(line[column], above[column] + _STEP, across)
    for column, inner in ((0, min(1, last)), (last, max(last - 1, 0))):
        line[column] = min(line[column], above[column] + _STEP, above[inner] + _DIAGONAL)


@njit(cache=True)
def propagate_along_row(line):
    """Propagate distances (w,) along a row.

    As a running minimum of distance minus column: each step depends on one comparison, without addition.
    """
    least = line[0]
    for column in range(1, line.shape[0]):
        place = np.float32(column)
        least = min(line[column] - place, least)
        line[column] = least + place
