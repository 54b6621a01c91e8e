"""The visibility likelihood: points of one view against the surface, and the empty space, that the other measured."""

import math
from typing import NamedTuple

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
from modeler.kernels.projection import (
    FACES,
    FACING_X,
    FACING_Y,
    FACING_Z,
    HALF,
    ONE,
    SHOWS,
    VARIANCE_M2,
    VECTOR_MATHS,
    ZERO,
    FloatArray,
    X,
    Y,
    Z,
    buffers,
    invert,
    look,
)

# Verdicts on one point, given by `classify`.
UNKNOWN, MATCHED, BEHIND, IN_FRONT, HIDDEN, IN_EMPTY_SPACE = 0, 1, 2, 3, 4, 5

# Columns of what `log_likelihoods` returns.
LOG_LIKELIHOOD, EXPLAINED = 0, 1

MIN_AGREEMENT = np.float32(0.8)
"""Least cosine between the normals of a point and of the surface that it matches."""
MAX_SIGMAS = np.float32(3.0)
"""A point farther from the surface than so many standard deviations does not match it."""

LOOSE_SIGMAS = 4.0
"""Where points are judged and not weighed they match as far as this: what may be noise is not held against a pose."""

# Nodes of the table of log((1 - hidden) exp(match) + hidden); below the first it is log(hidden) within 3e-6.
TABLE_LOW, TABLE_HIGH, TABLE_STEPS = np.float32(-14.0), np.float32(4.0), 2304
_PER_STEP = np.float32(TABLE_STEPS / (TABLE_HIGH - TABLE_LOW))

_OF_SURFACE, _OF_BACKGROUND, _OF_NOTHING = np.float32(SURFACE), np.float32(BACKGROUND), np.float32(MISSING)


class LikelihoodParameters(NamedTuple):
    """What the likelihood takes for granted in one direction; all float32."""

    blur_m: np.float32
    """Extra noise of the surfaces."""
    silhouette_px: np.float32
    """Standard deviation of the silhouette."""
    dead_band_px: np.float32
    """Beside the silhouette so much is no one's."""
    clearance_m: np.float32
    """From so far behind a point, a background is behind it."""
    max_point_cost: np.float32
    """Most that one point may cost (nats)."""
    normal_cost: np.float32
    """Cost (nats) of normals at right angles."""
    unmeasured_gain: np.float32
    """Gain (negative, nats) of a point that should be seen where nothing was measured."""
    typical_misfit: np.float32
    """What a typical match loses to its misfit (nats)."""
    table: FloatArray
    """Of `match_table` for the share of hidden points."""


@numba.njit(cache=True)
def match_table(hidden):
    """Return log((1 - hidden) exp(match) + hidden) at the nodes: what a point that may be hidden scores for a match."""
    table = np.empty(TABLE_STEPS + 1, dtype=np.float32)
    for k in range(TABLE_STEPS + 1):
        match = TABLE_LOW + k * (TABLE_HIGH - TABLE_LOW) / TABLE_STEPS
        table[k] = math.log((1.0 - hidden) * math.exp(match) + hidden)
    return table


@numba.njit(cache=True, inline="always")
def height_over(carried, found, j):
    """Return how far in m a carried point lies in front of the plane of its cell."""
    return (
        found[DISTANCE, j]
        + found[NORMAL_X, j] * carried[X, j]
        + found[NORMAL_Y, j] * carried[Y, j]
        + found[NORMAL_Z, j] * carried[Z, j]
    )


@numba.njit(cache=True, inline="always")
def agreement_of(carried, found, j):
    """Return the cosine between the normals of a carried point and of the plane of its cell."""
    return (
        found[NORMAL_X, j] * carried[FACING_X, j]
        + found[NORMAL_Y, j] * carried[FACING_Y, j]
        + found[NORMAL_Z, j] * carried[FACING_Z, j]
    )


@numba.njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS, forceinline=True)
def score(points, carried, found, parameters):
    """Return the log-likelihood of carried points, and how many are explained: all cases of every point, then a choice.

    Args:
        points: (7, n), see `Projection`.
        carried: (8, n) and
        found: (8, n), see `projection.look`.
        parameters: see `LikelihoodParameters`.
    """
    table, max_point_cost = parameters.table, parameters.max_point_cost
    log_hidden, last = table[0], np.int32(TABLE_STEPS - 1)
    total, explained = ZERO, ZERO
    for j in range(points.shape[1]):
        faces, kind = carried[FACES, j], found[KIND, j]
        in_front = height_over(carried, found, j)
        agreement = agreement_of(carried, found, j)
        variance = points[VARIANCE_M2, j] + found[VARIANCE, j] + parameters.blur_m * parameters.blur_m
        half_square = HALF * in_front * in_front / variance
        match = parameters.typical_misfit - half_square - parameters.normal_cost * (ONE - agreement)
        matches = (half_square < HALF * MAX_SIGMAS * MAX_SIGMAS) & (agreement > MIN_AGREEMENT)
        place = (min(max(match, TABLE_LOW), TABLE_HIGH) - TABLE_LOW) * _PER_STEP
        node = min(np.int32(place), last)
        low, high = table[np.uint32(node)], table[np.uint32(node + np.int32(1))]
        seen = low + (place - np.float32(node)) * (high - low)
        # In front of what was measured nothing can hide it.
        seen = max(match, -max_point_cost) if (in_front > ZERO) & (match < log_hidden) else seen
        on_surface = faces * seen - ((ONE - faces) * min(half_square, max_point_cost) if in_front > ZERO else ZERO)
        beyond = max((found[SILHOUETTE, j] - parameters.dead_band_px) / parameters.silhouette_px, ZERO)
        in_the_way = carried[Z, j] < found[DEPTH, j] - parameters.clearance_m
        in_the_open = -min(HALF * beyond * beyond, max_point_cost) if in_the_way else ZERO
        gain = on_surface if kind == _OF_SURFACE else ZERO
        gain = in_the_open if kind == _OF_BACKGROUND else gain
        gain = parameters.unmeasured_gain * carried[SHOWS, j] if kind == _OF_NOTHING else gain
        total += gain
        explained += faces if (kind == _OF_SURFACE) & matches else ZERO
    return total, explained


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def compare(pose, forward, backward, forward_parameters, backward_parameters, room):
    """Return the log-likelihood of one pose (12,) and the number of explained points; see `log_likelihoods`.

    Room is handed in: the `buffers` of either direction, and (12,).
    """
    there, back, inverse = room
    look(pose, forward, there[0], there[1], there[2])
    total, explained = score(forward.points, there[0], there[2], forward_parameters)
    invert(pose, inverse)
    look(inverse, backward, back[0], back[1], back[2])
    more, further = score(backward.points, back[0], back[2], backward_parameters)
    return np.float64(total) + np.float64(more), np.float64(explained) + np.float64(further)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def log_likelihoods(poses, forward, backward, forward_parameters, backward_parameters):
    """Return the log-likelihood of each pose, summed over the points of two views, each looked up in the other.

    A point that faces the other camera should lie on the surface measured there, but for a share that something
    hides or the camera missed (surface seen at a flat angle it often misses); one that faces away should lie behind
    it; none may lie where the camera saw nothing. A point that matches as well as is typical and a hidden one both
    count 0 on average: turning it out of sight neither pays nor costs.

    In single precision a point errs by less than 1e-4 nats, unless it falls within 1e-3 px of a pixel's border and
    may be looked up on the other side.

    Args:
        poses: (m, 12) float64 rows of the 3×4 matrices that carry the points of `forward` into the other camera.
        forward: the `Projection` of one view's points in the other, and
        backward: that of the other's in the one.
        forward_parameters: the `LikelihoodParameters` of the one direction, and
        backward_parameters: of the other.

    Returns:
        (m, 2): log-likelihood; number of points that the other view's surface explains, each as far as it faces it.
    """
    block = 16  # poses that share one set of buffers
    result = np.empty((poses.shape[0], 2))
    for group in numba.prange((poses.shape[0] + block - 1) // block):
        room = buffers(forward), buffers(backward), np.empty(12)
        for i in range(group * block, min((group + 1) * block, poses.shape[0])):
            result[i, LOG_LIKELIHOOD], result[i, EXPLAINED] = compare(
                poses[i], forward, backward, forward_parameters, backward_parameters, room
            )
    return result


@numba.njit(cache=True)
def classify(pose, projection, parameters):
    """Return the verdict (n,) on each point of a `Projection` under one pose (12,), by a `LikelihoodParameters`."""
    carried, pixels, found = buffers(projection)
    look(pose, projection, carried, pixels, found)
    verdicts = np.zeros(pixels.shape[0], dtype=np.int8)
    for j in range(pixels.shape[0]):
        if found[KIND, j] == BACKGROUND:
            if (
                found[SILHOUETTE, j] > parameters.dead_band_px
                and carried[Z, j] < found[DEPTH, j] - parameters.clearance_m
            ):
                verdicts[j] = IN_EMPTY_SPACE
        elif found[KIND, j] == SURFACE:
            in_front = height_over(carried, found, j)
            variance = projection.points[VARIANCE_M2, j] + found[VARIANCE, j] + parameters.blur_m * parameters.blur_m
            if in_front > LOOSE_SIGMAS * math.sqrt(variance):
                verdicts[j] = IN_FRONT
            elif carried[FACES, j] > 0.5:
                verdicts[j] = MATCHED if in_front > -LOOSE_SIGMAS * math.sqrt(variance) else BEHIND
            else:
                verdicts[j] = HIDDEN
    return verdicts


@numba.njit(cache=True)
def excess(pose, projection, blur_m):
    """Return what surface noise explains the matched points of a `Projection` under one pose (12,).

    Returns:
        Sum in m² of the squared distances from the surface, less the variances of point and plane, over the points that
        are no farther than `LOOSE_SIGMAS` standard deviations, of which `blur_m` is a part; and how many they are.
    """
    carried, pixels, found = buffers(projection)
    look(pose, projection, carried, pixels, found)
    total, count = 0.0, 0
    for j in range(pixels.shape[0]):
        if found[KIND, j] != SURFACE or carried[FACES, j] < 0.5:
            continue
        square = np.float64(height_over(carried, found, j)) ** 2
        known = np.float64(projection.points[VARIANCE_M2, j]) + np.float64(found[VARIANCE, j])
        if square < LOOSE_SIGMAS * LOOSE_SIGMAS * (known + blur_m * blur_m):
            total += square - known
            count += 1
    return total, count
