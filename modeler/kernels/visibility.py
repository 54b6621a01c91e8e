"""The visibility likelihood: points of one view against the surface, and the empty space, that the other measured."""

import math

import numba
import numpy as np

from modeler.kernels.planes import (
    BACKGROUND,
    DEPTH,
    DISTANCE,
    KIND,
    MISSING,
    NORMAL_X,
    NORMAL_Y,
    NORMAL_Z,
    SILHOUETTE,
    SURFACE,
    VARIANCE,
)

# Verdicts on one point, given by `classify`.
UNKNOWN, MATCHED, BEHIND, IN_FRONT, HIDDEN, IN_EMPTY_SPACE = 0, 1, 2, 3, 4, 5

# Rows of the points handed in, and of what `carry` makes of them.
VARIANCE_M2 = 6
X, Y, Z, FACING_X, FACING_Y, FACING_Z, FACES = 0, 1, 2, 3, 4, 5, 6

# Columns of what `log_likelihoods` returns.
LOG_LIKELIHOOD, EXPLAINED = 0, 1

MIN_AGREEMENT = 0.8
"""Least cosine between the normals of a point and of the surface that it matches."""
MAX_SIGMAS = 3.0
"""A point farther from the surface than so many standard deviations does not match it."""

# Nodes of the table of log((1 - hidden) exp(match) + hidden); below the first it is log(hidden) within 3e-6.
TABLE_LOW, TABLE_HIGH, TABLE_STEPS = -14.0, 4.0, 2304

# No flag lets the compiler assume away NaN or infinity; these three let it use multiply-add and one reciprocal.
VECTOR_MATHS = {"contract", "arcp", "nsz"}


@numba.njit(cache=True)
def match_table(hidden):
    """Return log((1 - hidden) exp(match) + hidden) at the nodes: what a point that may be hidden scores for a match."""
    table = np.empty(TABLE_STEPS + 1)
    for k in range(TABLE_STEPS + 1):
        match = TABLE_LOW + k * (TABLE_HIGH - TABLE_LOW) / TABLE_STEPS
        table[k] = math.log((1.0 - hidden) * math.exp(match) + hidden)
    return table


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS)
def carry(pose, points, intrinsics, facing, carried, pixels):
    """Carry points into the other camera: straight-line code over rows of numbers, which compilers turn into vectors.

    Args:
        pose: (12,) rows of the 3×4 matrix.
        points: (8, n) position in m, unit normal, variance along the normal in m², gain of a match (nats).
        intrinsics: (6,) fx, fy, cx, cy, width and height of the other image in px.
        facing: (2,) cosines at which a point begins to face the camera and fully does.
        carried: (7, n) out: position, normal, how much the point faces the camera (0..1).
        pixels: (n,) out: number of the pixel it falls on, row by row; -1 outside the image or behind the camera.
    """
    p0, p1, p2, p3, p4, p5, p6, p7, p8, p9, p10, p11 = pose
    fx, fy, cx, cy, width, height = intrinsics
    low, per_range = facing[0], 1.0 / (facing[1] - facing[0])
    for j in range(points.shape[1]):
        a, b, c, d, e, f = points[0, j], points[1, j], points[2, j], points[3, j], points[4, j], points[5, j]
        x = p0 * a + p1 * b + p2 * c + p3
        y = p4 * a + p5 * b + p6 * c + p7
        z = p8 * a + p9 * b + p10 * c + p11
        normal_x = p0 * d + p1 * e + p2 * f
        normal_y = p4 * d + p5 * e + p6 * f
        normal_z = p8 * d + p9 * e + p10 * f
        cosine = -(normal_x * x + normal_y * y + normal_z * z) / np.sqrt(x * x + y * y + z * z)
        per_z = 1.0 / z
        column, row = fx * x * per_z + cx + 0.5, fy * y * per_z + cy + 0.5
        inside = (z > 0.0) & (column >= 0.0) & (column < width) & (row >= 0.0) & (row < height)
        safe_column, safe_row = min(max(column, 0.0), width - 1.0), min(max(row, 0.0), height - 1.0)
        pixel = np.int32(safe_row) * np.int32(width) + np.int32(safe_column)
        carried[X, j], carried[Y, j], carried[Z, j] = x, y, z
        carried[FACING_X, j], carried[FACING_Y, j], carried[FACING_Z, j] = normal_x, normal_y, normal_z
        carried[FACES, j] = min(max((cosine - low) * per_range, 0.0), 1.0)
        pixels[j] = pixel if inside else np.int32(-1)


@numba.njit(cache=True, inline="always")
def height_over(cell, carried, j):
    """Return how far in m a carried point lies in front of the plane of a cell."""
    return (
        np.float64(cell[DISTANCE])
        + np.float64(cell[NORMAL_X]) * carried[X, j]
        + np.float64(cell[NORMAL_Y]) * carried[Y, j]
        + np.float64(cell[NORMAL_Z]) * carried[Z, j]
    )


@numba.njit(cache=True, error_model="numpy")
def score(points, carried, pixels, cells, model, table):
    """Return the log-likelihood of carried points, and how many are explained; arguments as for `log_likelihoods`."""
    blur_m, silhouette_px, dead_px, clearance_m, _, _, worst, bend, unmeasured, typical = model
    blur, log_hidden = blur_m * blur_m, table[0]
    per_step = TABLE_STEPS / (TABLE_HIGH - TABLE_LOW)
    total, explained = 0.0, 0.0
    for j in range(pixels.shape[0]):
        faces = carried[FACES, j]
        pixel = pixels[j]
        if pixel < 0 or cells[pixel, KIND] == MISSING:
            total += unmeasured * faces
            continue
        cell = cells[pixel]
        kind = cell[KIND]
        if kind == SURFACE:
            in_front = height_over(cell, carried, j)
            half_square = 0.5 * in_front * in_front / (points[VARIANCE_M2, j] + cell[VARIANCE] + blur)
            if faces > 0.0:
                agreement = (
                    carried[FACING_X, j] * cell[NORMAL_X]
                    + carried[FACING_Y, j] * cell[NORMAL_Y]
                    + carried[FACING_Z, j] * cell[NORMAL_Z]
                )
                match = typical - half_square - bend * (1.0 - agreement)
                if half_square < 0.5 * MAX_SIGMAS * MAX_SIGMAS and agreement > MIN_AGREEMENT:
                    explained += faces
                if in_front > 0.0 and match < log_hidden:
                    total += faces * max(match, -worst)  # in front of what was measured: nothing can hide it
                elif match <= TABLE_LOW:
                    total += faces * log_hidden
                else:
                    place = (match - TABLE_LOW) * per_step
                    node = min(int(place), TABLE_STEPS - 1)
                    total += faces * (table[node] + (place - node) * (table[node + 1] - table[node]))
            if faces < 1.0 and in_front > 0.0:
                total -= (1.0 - faces) * min(half_square, worst)
        elif kind == BACKGROUND:
            beyond = (cell[SILHOUETTE] - dead_px) / silhouette_px
            if beyond > 0.0 and carried[Z, j] < cell[DEPTH] - clearance_m:
                total -= min(0.5 * beyond * beyond, worst)
    return total, explained


@numba.njit(cache=True, parallel=True, error_model="numpy")
def log_likelihoods(poses, points, cells, intrinsics, model, table):
    """Return the log-likelihood of each pose, summed over the points of one view looked up in the other.

    A point that faces the other camera should lie on the surface measured there, but for a share that something
    hides or the camera missed; one that faces away should lie behind it; none may lie where the camera saw
    nothing. A point that matches as well as is typical and a hidden one both count 0 on average: turning it out of
    sight neither pays nor costs.

    The table's interpolation errs by less than 4e-6 a point.

    Args:
        poses: (m, 12) rows of the 3×4 matrices that carry the points into the other camera.
        points: (7, n) position in m, unit normal, variance along the normal in m².
        cells: (h · w, 8) of the other view, see `planes`.
        intrinsics: (6,) fx, fy, cx, cy, width and height in px of the other view.
        model: (10,) extra noise of the surfaces in m; standard deviation and dead zone of the silhouette in px;
            clearance in m from which a background is behind; the cosines at which a point begins to face the camera
            and fully does; most that one point may cost; weight of a disagreement of normals; gain (negative) of a
            point that should be seen where nothing was measured; what a typical match loses to its misfit.
        table: of `match_table` for the share of hidden points.

    Returns:
        (m, 2): log-likelihood; number of points that the other view's surface explains, each as far as it faces it.
    """
    block = 16  # poses that share one pair of buffers
    result = np.empty((poses.shape[0], 2))
    for group in numba.prange((poses.shape[0] + block - 1) // block):
        carried = np.empty((7, points.shape[1]))
        pixels = np.empty(points.shape[1], dtype=np.int32)
        for i in range(group * block, min((group + 1) * block, poses.shape[0])):
            carry(poses[i], points, intrinsics, model[4:6], carried, pixels)
            result[i, LOG_LIKELIHOOD], result[i, EXPLAINED] = score(points, carried, pixels, cells, model, table)
    return result


@numba.njit(cache=True)
def classify(pose, points, cells, intrinsics, model):
    """Return the verdict (n,) on each point under one pose (12,); arguments as for `log_likelihoods`."""
    carried, pixels = np.empty((7, points.shape[1])), np.empty(points.shape[1], dtype=np.int32)
    carry(pose, points, intrinsics, model[4:6], carried, pixels)
    verdicts = np.zeros(points.shape[1], dtype=np.int8)
    for j in range(points.shape[1]):
        if pixels[j] < 0:
            continue
        cell = cells[pixels[j]]
        if cell[KIND] == BACKGROUND:
            if cell[SILHOUETTE] > model[2] and carried[Z, j] < cell[DEPTH] - model[3]:
                verdicts[j] = IN_EMPTY_SPACE
        elif cell[KIND] == SURFACE:
            in_front = height_over(cell, carried, j)
            sigma = math.sqrt(points[VARIANCE_M2, j] + cell[VARIANCE] + model[0] * model[0])
            if in_front > 4.0 * sigma:
                verdicts[j] = IN_FRONT
            elif carried[FACES, j] > 0.5:
                verdicts[j] = MATCHED if in_front > -4.0 * sigma else BEHIND
            else:
                verdicts[j] = HIDDEN
    return verdicts


@numba.njit(cache=True)
def matched_residuals(pose, points, cells, intrinsics, model):
    """Return what surface noise explains the matched points under one pose (12,): arguments as for `log_likelihoods`.

    Returns:
        (k,) squared distance from the surface, less the variances of point and plane, in m², of the points that match.
    """
    carried, pixels = np.empty((7, points.shape[1])), np.empty(points.shape[1], dtype=np.int32)
    carry(pose, points, intrinsics, model[4:6], carried, pixels)
    squares = np.empty(points.shape[1])
    count = 0
    for j in range(points.shape[1]):
        if pixels[j] < 0 or cells[pixels[j], KIND] != SURFACE or carried[FACES, j] < 0.5:
            continue
        square = height_over(cells[pixels[j]], carried, j) ** 2
        known = points[VARIANCE_M2, j] + cells[pixels[j], VARIANCE]
        if square < 16.0 * (known + model[0] * model[0]):
            squares[count] = square - known
            count += 1
    return squares[:count]
