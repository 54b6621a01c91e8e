"""The visibility likelihood: points of one view against the surface, and the empty space, that the other measured."""

import math

import numba
import numpy as np

from modeler.kernels.planes import (
    BACKGROUND,
    DEPTH,
    KIND,
    MISSING,
    PLANE_X,
    PLANE_Y,
    PLANE_Z,
    SIGMA,
    SILHOUETTE,
    SURFACE,
)

# Verdicts on one point, counted by `classify`.
UNKNOWN, MATCHED, BEHIND, IN_FRONT, HIDDEN, IN_EMPTY_SPACE = 0, 1, 2, 3, 4, 5


@numba.njit(cache=True, inline="always")
def place(pose, point, intrinsics, shape):
    """Carry a point into the other camera.

    Returns:
        (row, column, x, y, z): the pixel it falls on (row -1 where outside the image or behind the camera), and
        where.
    """
    z = pose[8] * point[0] + pose[9] * point[1] + pose[10] * point[2] + pose[11]
    x = pose[0] * point[0] + pose[1] * point[1] + pose[2] * point[2] + pose[3]
    y = pose[4] * point[0] + pose[5] * point[1] + pose[6] * point[2] + pose[7]
    if z <= 0.0:
        return -1, -1, x, y, z
    column = math.floor(intrinsics[0] * x / z + intrinsics[2] + 0.5)
    row = math.floor(intrinsics[1] * y / z + intrinsics[3] + 0.5)
    if column < 0 or column >= shape[1] or row < 0 or row >= shape[0]:
        return -1, -1, x, y, z
    return row, column, x, y, z


@numba.njit(cache=True, inline="always")
def facing_cosine(pose, point, x, y, z):
    """Return the cosine between a carried point's normal and the direction to the camera."""
    mx = pose[0] * point[3] + pose[1] * point[4] + pose[2] * point[5]
    my = pose[4] * point[3] + pose[5] * point[4] + pose[6] * point[5]
    mz = pose[8] * point[3] + pose[9] * point[4] + pose[10] * point[5]
    return -(mx * x + my * y + mz * z) / math.sqrt(x * x + y * y + z * z)


@numba.njit(cache=True, inline="always")
def against_surface(pose, point, x, y, z, cell):
    """Compare a carried point with the plane measured at its pixel.

    Returns:
        (distance in front of the plane in m, cosine between the two normals).
    """
    mx = pose[0] * point[3] + pose[1] * point[4] + pose[2] * point[5]
    my = pose[4] * point[3] + pose[5] * point[4] + pose[6] * point[5]
    mz = pose[8] * point[3] + pose[9] * point[4] + pose[10] * point[5]
    plane_x, plane_y, plane_z = np.float64(cell[PLANE_X]), np.float64(cell[PLANE_Y]), np.float64(cell[PLANE_Z])
    scale = 1.0 / math.sqrt(plane_x * plane_x + plane_y * plane_y + plane_z * plane_z)
    in_front = (1.0 - plane_x * x - plane_y * y - plane_z * z) * scale
    return in_front, -(mx * plane_x + my * plane_y + mz * plane_z) * scale


@numba.njit(cache=True, parallel=True)
def log_likelihoods(poses, points, cells, intrinsics, model):
    """Return the log-likelihood of each pose, summed over the points of one view looked up in the other.

    A point that faces the other camera should lie on the surface measured there, but for a share that something
    hides or the camera missed; one that faces away should lie behind it; none may lie where the camera saw
    nothing. Scores are normalised so that on smooth surface, which goes on as anyone would guess, a point that
    matches within its noise and a hidden one both count 0 on average: turning it out of sight neither pays nor
    costs. Where the surface has relief a match is a coincidence, and counts as one.

    Args:
        poses: (m, 12) rows of the 3×4 matrices that carry the points into the other camera.
        points: (n, 8) position in m, unit normal, variance along the normal in m², gain of a match (nats).
        cells: (h, w, 8) of the other view, see `planes`.
        intrinsics: (4,) fx, fy, cx, cy in px of the other view.
        model: (10,) extra noise of the surfaces in m; standard deviation and dead zone of the silhouette in px;
            clearance in m from which a background is behind; the cosines at which a point begins to face the camera
            and fully does; share of hidden points; most that one point may cost; weight of a disagreement of
            normals; gain (negative) of a point that should be seen where nothing was measured.
    """
    shape = cells.shape
    blur_m, silhouette_px, dead_px, clearance_m, low, high, hidden, worst, bend, unmeasured = model
    blur = blur_m * blur_m
    log_hidden, matched = math.log(hidden), 1.0 - hidden
    result = np.empty(poses.shape[0])
    for i in numba.prange(poses.shape[0]):
        pose = poses[i]
        total = 0.0
        for j in range(points.shape[0]):
            point = points[j]
            row, column, x, y, z = place(pose, point, intrinsics, shape)
            if row < 0 or cells[row, column, KIND] == MISSING:
                total += unmeasured * min(max((facing_cosine(pose, point, x, y, z) - low) / (high - low), 0.0), 1.0)
                continue
            cell = cells[row, column]
            kind = cell[KIND]
            if kind == BACKGROUND:
                beyond = np.float64(cell[SILHOUETTE]) - dead_px
                if beyond > 0.0 and z < cell[DEPTH] - clearance_m:
                    beyond /= silhouette_px
                    total -= min(0.5 * beyond * beyond, worst)
            elif kind == SURFACE:
                in_front, agreement = against_surface(pose, point, x, y, z, cell)
                spread = np.float64(cell[SIGMA])
                square = in_front * in_front / (point[6] + spread * spread + blur)
                faces = min(max((facing_cosine(pose, point, x, y, z) - low) / (high - low), 0.0), 1.0)
                if faces > 0.0:
                    match = 0.5 + point[7] - 0.5 * square - bend * (1.0 - agreement)
                    if in_front > 0.0 and match < log_hidden:
                        total += faces * max(match, -worst)  # in front of what was measured: nothing can hide it
                    elif match < -30.0:
                        total += faces * log_hidden
                    else:
                        total += faces * math.log(matched * math.exp(match) + hidden)
                if faces < 1.0 and in_front > 0.0:
                    total -= (1.0 - faces) * min(0.5 * square, worst)
        result[i] = total
    return result


@numba.njit(cache=True)
def classify(pose, points, cells, intrinsics, model):
    """Return the verdict (n,) on each point under one pose (12,); arguments as for `log_likelihoods`."""
    shape = cells.shape
    blur_m, _, dead_px, clearance_m, low, high, _, _, _, _ = model
    verdicts = np.zeros(points.shape[0], dtype=np.int8)
    for j in range(points.shape[0]):
        row, column, x, y, z = place(pose, points[j], intrinsics, shape)
        if row < 0:
            continue
        cell = cells[row, column]
        if cell[KIND] == MISSING:
            continue
        if cell[KIND] == BACKGROUND:
            if cell[SILHOUETTE] > dead_px and z < cell[DEPTH] - clearance_m:
                verdicts[j] = IN_EMPTY_SPACE
        elif cell[KIND] == SURFACE:
            in_front, _ = against_surface(pose, points[j], x, y, z, cell)
            sigma = math.sqrt(points[j, 6] + cell[SIGMA] * cell[SIGMA] + blur_m * blur_m)
            if in_front > 4.0 * sigma:
                verdicts[j] = IN_FRONT
            elif facing_cosine(pose, points[j], x, y, z) > 0.5 * (low + high):
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
    shape = cells.shape
    low, high = model[4], model[5]
    squares = np.empty(points.shape[0])
    count = 0
    for j in range(points.shape[0]):
        row, column, x, y, z = place(pose, points[j], intrinsics, shape)
        if row < 0 or cells[row, column, KIND] != SURFACE:
            continue
        cell = cells[row, column]
        if facing_cosine(pose, points[j], x, y, z) < 0.5 * (low + high):
            continue
        in_front, _ = against_surface(pose, points[j], x, y, z, cell)
        spread = np.float64(cell[SIGMA])
        known = points[j, 6] + spread * spread
        if in_front * in_front < 16.0 * (known + model[0] * model[0]):
            squares[count] = in_front * in_front - known
            count += 1
    return squares[:count]
