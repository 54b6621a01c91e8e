"""The visibility likelihood: points of one view against the surface and the free space measured by the other.

Single precision resolves 0.1 µm at a distance of 1 m, and one instruction processes sixteen points.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from modeler.kernels.cache import njit
from modeler.kernels.planes import (
    BACKGROUND,
    CELL_SIZE,
    DEPTH,
    DISTANCE,
    KIND,
    MISSING,
    NORMAL_X,
    NORMAL_Y,
    NORMAL_Z,
    RIM,
    SILHOUETTE,
    SURFACE,
    VARIANCE,
)

# Classes of a point, see `classify`.
UNKNOWN, MATCHED, BEHIND, IN_FRONT, HIDDEN, IN_EMPTY_SPACE, IN_SUPPORT = CLASSES = 0, 1, 2, 3, 4, 5, 6

MIN_AGREEMENT = np.float32(0.8)
"""Least cosine between the normals of a point and of the surface that it matches."""
MAX_SIGMAS = np.float32(3.0)
"""Largest distance of a match from the surface in standard deviations."""
LOOSE_SIGMAS = 4.0
"""The same for `classify`: possible noise is not counted as a contradiction."""
HIDDEN_SIGMAS = np.float32(6.0)
"""Distance behind the surface in standard deviations from which on a point is hidden, and no inexact match."""

# Nodes of the table of log((1 - hidden) exp(match) + hidden); below the first it is log(hidden) within 3e-6.
TABLE_LOW, TABLE_HIGH, TABLE_STEPS = np.float32(-14.0), np.float32(4.0), 2304
_PER_STEP = np.float32(TABLE_STEPS / (TABLE_HIGH - TABLE_LOW))

_OF_SURFACE, _OF_BACKGROUND, _OF_NOTHING = np.float32(SURFACE), np.float32(BACKGROUND), np.float32(MISSING)

# The flags allow fused multiply-add, reciprocals and any order of summation; NaN and infinity stay valid. Functions
# that a kernel calls are inlined (`forceinline`): separately compiled copies could sum in another order, so that a
# newly compiled kernel would not return the same bits as a cached one.
VECTOR_MATHS = {"contract", "arcp", "nsz", "reassoc"}
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)  # a plain 0.5 would promote to double precision
MATCH_LIMIT, HIDDEN_FROM = HALF * MAX_SIGMAS * MAX_SIGMAS, HALF * HIDDEN_SIGMAS * HIDDEN_SIGMAS

# Rows of the points, and of `transform_points`.
VARIANCE_M2, COLUMN, ROW = 6, 7, 8
X, Y, Z, POINT_NORMAL_X, POINT_NORMAL_Y, POINT_NORMAL_Z, FACING, COVERAGE, PATTERN = 0, 1, 2, 3, 4, 5, 6, 7, 8
TRANSFORMED_ROWS = 9

FloatArray = npt.NDArray[np.float32]


class Projection(NamedTuple):
    """One direction of a comparison: points of one view, and the camera and cells of the other."""

    points: FloatArray
    """(9, n) position in m, unit normal, variance along the normal in m², and column and row in px in its own view."""
    cells: FloatArray
    """(h · w, 8) of the other view, see `planes`."""
    camera: FloatArray
    """(6,) fx, fy, cx, cy, width and height in px of the other view."""
    cosines: FloatArray
    """(4,) cosines between which f rises from 0 to 1, and g (method, eq. 4.2)."""
    pattern: FloatArray
    """(2,) fraction χ of the variance common to both views at the same pixel, and 1/R² in 1/px² (eq. 4.9)."""
    rim_m2: np.float32
    """Variance in m² of errors near silhouettes (eq. 4.8); that of the points is part of their variances."""


@njit(cache=True, forceinline=True)
def invert(pose, inverse):
    """Write the inverse of a pose (12,), the rows of a 3×4 matrix, into `inverse` (12,)."""
    for k in range(3):
        inverse[4 * k + 3] = 0.0
        for m in range(3):
            inverse[4 * k + m] = pose[4 * m + k]
            inverse[4 * k + 3] -= pose[4 * m + k] * pose[4 * m + 3]


@njit(cache=True, forceinline=True)
def write_transform(pose, backward, transform):
    """Write the rows of the 3×4 matrix that takes points of one view to the other into `transform` (12,).

    Args:
        pose: (12,) target_from_source; with a 13th number, the factor F of the true focal length over that of both
            views, whose coordinates x and y are to be divided by it. The transform is then S⁻¹ T S, S = diag(1/F, 1/F,
            1), from points as they are to points as they are (method, eq. 10.1).
        backward: whether the points are the target's.
        transform: out.
    """
    if backward:
        invert(pose, transform)
    else:
        for k in range(12):
            transform[k] = pose[k]
    if pose.shape[0] > 12:
        for k in (2, 3, 6, 7):
            transform[k] *= pose[12]
        for k in (8, 9):
            transform[k] /= pose[12]


@njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def transform_points(pose, projection, transformed, pixels):
    """Transform points into the other camera (method, eq. 4.2): branch-free code, which compilers vectorise.

    Args:
        pose: (12,) rows of the 3×4 matrix.
        projection: the points and the other camera.
        transformed: (9, n) out: position, normal, visibility f (0..1), expected coverage g (0..1) of surface as steep,
            and the fraction c of a match's variance that is common to both views (eq. 4.9).
        pixels: (n,) out: index of the pixel on which it falls, row by row; -1 outside the image or behind the camera.
    """
    p0, p1, p2, p3 = np.float32(pose[0]), np.float32(pose[1]), np.float32(pose[2]), np.float32(pose[3])
    p4, p5, p6, p7 = np.float32(pose[4]), np.float32(pose[5]), np.float32(pose[6]), np.float32(pose[7])
    p8, p9, p10, p11 = np.float32(pose[8]), np.float32(pose[9]), np.float32(pose[10]), np.float32(pose[11])
    points, (fx, fy, cx, cy, width, height) = projection.points, projection.camera
    low, per_range = projection.cosines[0], ONE / (projection.cosines[1] - projection.cosines[0])
    flat, per_turn = projection.cosines[2], ONE / (projection.cosines[3] - projection.cosines[2])
    share, per_square = projection.pattern[0], projection.pattern[1]
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
        transformed[X, j], transformed[Y, j], transformed[Z, j] = x, y, z
        transformed[POINT_NORMAL_X, j], transformed[POINT_NORMAL_Y, j], transformed[POINT_NORMAL_Z, j] = (
            normal_x,
            normal_y,
            normal_z,
        )
        transformed[FACING, j] = min(max((cosine - low) * per_range, ZERO), ONE)
        transformed[COVERAGE, j] = min(max((abs(cosine) - flat) * per_turn, ZERO), ONE)
        across, down = column - HALF - points[COLUMN, j], row - HALF - points[ROW, j]
        correlation = max(ONE - (across * across + down * down) * per_square, ZERO)
        transformed[PATTERN, j] = share * correlation * correlation
        pixels[j] = pixel if inside else np.int32(-1)


@njit(cache=True, forceinline=True)
def fetch_cells(count, pixels, cells, rim_m2, looked_up):
    """Copy the cells at the first `pixels` (n,) into columns of `looked_up` (8, n); `MISSING` outside the image.

    Variances are copied with those of errors near the silhouette.
    """
    for j in range(count):
        cell = np.uint32(max(pixels[j], np.int32(0)))
        for k in range(CELL_SIZE):
            looked_up[k, j] = cells[cell, k]
        if pixels[j] < 0:
            looked_up[KIND, j] = MISSING
    for j in range(count):
        rim = looked_up[RIM, j] if looked_up[KIND, j] == _OF_SURFACE else ZERO
        looked_up[VARIANCE, j] += rim_m2 * rim * rim


@njit(cache=True, forceinline=True)
def project(pose, projection, transformed, pixels, looked_up):
    """Transform points by a pose (12,) and look up their cells: `transform_points`, then `fetch_cells`.

    The buffers may be longer than there are points.
    """
    transform_points(pose, projection, transformed, pixels)
    fetch_cells(projection.points.shape[1], pixels, projection.cells, projection.rim_m2, looked_up)


@njit(cache=True, forceinline=True)
def buffers(count):
    """Return buffers for `project` of n = `count` points: transformed points (9, n), pixels (n,), cells (8, n)."""
    transformed, pixels = np.empty((TRANSFORMED_ROWS, count), dtype=np.float32), np.empty(count, dtype=np.int32)
    return transformed, pixels, np.empty((CELL_SIZE, count), dtype=np.float32)


class LikelihoodParameters(NamedTuple):
    """Parameters of one direction (method, eq. 4.2 to 4.5); all float32."""

    blur_m: np.float32
    """Noise b of the surfaces."""
    silhouette_px: np.float32
    """Standard deviation of the silhouette."""
    clearance_m: np.float32
    """Distance in front of the background from which on a point contradicts it."""
    max_point_cost: np.float32
    """Upper bound K of the cost of one point (nats)."""
    max_steep_cost: np.float32
    """The same of steep surface before the background (nats)."""
    normal_cost: np.float32
    """Cost κ of normals at right angles (nats)."""
    unmeasured_gain: np.float32
    """Log-likelihood (nats) of a point that should be seen where nothing was measured."""
    typical_misfit: np.float32
    """Misfit μ of a typical match (nats)."""
    support: FloatArray
    """(5,) support plane: unit normal, offset in m, inverse standard deviation of heights above it in 1/m; else 0."""
    table: FloatArray
    """`match_table` of η."""


@njit(cache=True)
def match_table(hidden):
    """Return log((1 - hidden) exp(match) + hidden) at the nodes (method, eq. 4.3)."""
    table = np.empty(TABLE_STEPS + 1, dtype=np.float32)
    for k in range(TABLE_STEPS + 1):
        match = TABLE_LOW + k * (TABLE_HIGH - TABLE_LOW) / TABLE_STEPS
        table[k] = math.log((1.0 - hidden) * math.exp(match) + hidden)
    return table


@njit(cache=True, inline="always")
def plane_distance(transformed, looked_up, j):
    """Return the signed distance r in m of a transformed point from the plane of its cell, positive in front."""
    return (
        looked_up[DISTANCE, j]
        + looked_up[NORMAL_X, j] * transformed[X, j]
        + looked_up[NORMAL_Y, j] * transformed[Y, j]
        + looked_up[NORMAL_Z, j] * transformed[Z, j]
    )


@njit(cache=True, inline="always")
def normal_agreement(transformed, looked_up, j):
    """Return the cosine between the normals of a transformed point and of the plane of its cell."""
    return (
        looked_up[NORMAL_X, j] * transformed[POINT_NORMAL_X, j]
        + looked_up[NORMAL_Y, j] * transformed[POINT_NORMAL_Y, j]
        + looked_up[NORMAL_Z, j] * transformed[POINT_NORMAL_Z, j]
    )


@njit(cache=True, inline="always")
def depth_below(transformed, parameters, j):
    """Return the depth of a transformed point below the support, beyond the clearance (method, eq. 4.5), in sd."""
    support = parameters.support
    height_m = (
        support[0] * transformed[X, j]
        + support[1] * transformed[Y, j]
        + support[2] * transformed[Z, j]
        + support[3]
        + parameters.clearance_m
    )
    return max(-height_m * support[4], ZERO)


@njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def sum_over_points(points, transformed, looked_up, parameters):
    """Return the log-likelihood of transformed points, and the number explained (method, eq. 4.3 to 4.5).

    All cases are evaluated for every point, and one is selected: code without branches is vectorised.

    Args:
        points: (9, n), see `Projection`.
        transformed: (9, n), see `project`.
        looked_up: (8, n), see `project`.
        parameters: see `LikelihoodParameters`.
    """
    table, max_point_cost = parameters.table, parameters.max_point_cost
    log_hidden, last = table[0], np.int32(TABLE_STEPS - 1)
    total, explained = ZERO, ZERO
    for j in range(points.shape[1]):
        faces, kind = transformed[FACING, j], looked_up[KIND, j]
        in_front = plane_distance(transformed, looked_up, j)
        agreement = normal_agreement(transformed, looked_up, j)
        variance = points[VARIANCE_M2, j] + looked_up[VARIANCE, j] + parameters.blur_m * parameters.blur_m
        half_square = HALF * in_front * in_front / variance
        # With the expected deficit due to the fixed pattern, which is the same in both views (eq. 4.9).
        misfit = half_square + HALF * transformed[PATTERN, j]
        match = parameters.typical_misfit - misfit - parameters.normal_cost * (ONE - agreement)
        matches = (half_square < MATCH_LIMIT) & (agreement > MIN_AGREEMENT)
        position = (min(max(match, TABLE_LOW), TABLE_HIGH) - TABLE_LOW) * _PER_STEP
        node = min(np.int32(position), last)
        low, high = table[np.uint32(node)], table[np.uint32(node + np.int32(1))]
        seen = low + (position - np.float32(node)) * (high - low)
        decided = min(max((half_square - MATCH_LIMIT) / (HIDDEN_FROM - MATCH_LIMIT), ZERO), ONE)
        seen = seen if in_front > ZERO else (ONE - decided) * seen
        # A point in front of the measured surface cannot be occluded.
        seen = max(match, -max_point_cost) if (in_front > ZERO) & (match < log_hidden) else seen
        on_surface = faces * seen - ((ONE - faces) * min(half_square, max_point_cost) if in_front > ZERO else ZERO)
        beyond = looked_up[SILHOUETTE, j] / parameters.silhouette_px
        contradicts = transformed[Z, j] < looked_up[DEPTH, j] - parameters.clearance_m
        covered = transformed[COVERAGE, j]
        most = covered * max_point_cost + (ONE - covered) * parameters.max_steep_cost
        on_background = -min(HALF * beyond * beyond, most) if contradicts else ZERO
        gain = on_surface if kind == _OF_SURFACE else ZERO
        gain = on_background if kind == _OF_BACKGROUND else gain
        gain = parameters.unmeasured_gain * covered * faces if kind == _OF_NOTHING else gain
        below = depth_below(transformed, parameters, j)
        total += max(gain - HALF * below * below, -max_point_cost)
        explained += faces if (kind == _OF_SURFACE) & matches else ZERO
    return total, explained


@njit(cache=True)
def classify(pose, projection, parameters):
    """Return the class (n,) of each point of a `Projection` under one pose (12,)."""
    transformed, pixels, looked_up = buffers(projection.points.shape[1])
    project(pose, projection, transformed, pixels, looked_up)
    classes = np.zeros(pixels.shape[0], dtype=np.int8)
    for j in range(pixels.shape[0]):
        if looked_up[KIND, j] == BACKGROUND:
            if transformed[Z, j] < looked_up[DEPTH, j] - parameters.clearance_m:
                classes[j] = IN_EMPTY_SPACE
        elif looked_up[KIND, j] == SURFACE:
            in_front = plane_distance(transformed, looked_up, j)
            variance = (
                projection.points[VARIANCE_M2, j] + looked_up[VARIANCE, j] + parameters.blur_m * parameters.blur_m
            )
            if in_front > LOOSE_SIGMAS * math.sqrt(variance):
                classes[j] = IN_FRONT
            elif transformed[FACING, j] > 0.5:
                classes[j] = MATCHED if in_front > -LOOSE_SIGMAS * math.sqrt(variance) else BEHIND
            else:
                classes[j] = HIDDEN
        if depth_below(transformed, parameters, j) > LOOSE_SIGMAS:
            classes[j] = IN_SUPPORT
    return classes


@njit(cache=True)
def residual_excess(pose, projection, rims, blur_m):
    """Return the equations for the excess of squared residuals over their variances under one pose (12,).

    Least squares for b² and the variance of errors near silhouettes (method, eq. 4.7 and 4.8), over the points that
    face the camera and are within `LOOSE_SIGMAS` standard deviations.

    Args:
        pose: rows of the 3×4 matrix.
        projection: the points and the other view.
        rims: (n,) weights of errors near the silhouette of the points' own view.
        blur_m: least noise of the surfaces with which points are selected.

    Returns:
        (3, 3): sums of products of the factors of b², of those of the variance near silhouettes, and of the excess in
            m²: normal equations, matrix | right side, and the sum of squares below them.
    """
    transformed, pixels, looked_up = buffers(projection.points.shape[1])
    project(pose, projection, transformed, pixels, looked_up)
    sums, rim_m2 = np.zeros((3, 3)), np.float64(projection.rim_m2)
    for j in range(pixels.shape[0]):
        if looked_up[KIND, j] != SURFACE or transformed[FACING, j] < 0.5:
            continue
        square = np.float64(plane_distance(transformed, looked_up, j)) ** 2
        known = np.float64(projection.points[VARIANCE_M2, j]) + np.float64(looked_up[VARIANCE, j])
        if square < LOOSE_SIGMAS * LOOSE_SIGMAS * (known + blur_m * blur_m):
            apart = 1.0 - np.float64(transformed[PATTERN, j])
            rim = rims[j] ** 2 + np.float64(looked_up[RIM, j]) ** 2
            excess = square - apart * (known - rim_m2 * rim)
            sums[0, 0] += apart * apart
            sums[0, 1] += apart * rim
            sums[1, 1] += rim * rim
            sums[0, 2] += apart * excess
            sums[1, 2] += rim * excess
            sums[2, 2] += excess * excess
    sums[1, 0], sums[2, 0], sums[2, 1] = sums[0, 1], sums[0, 2], sums[1, 2]
    return sums
