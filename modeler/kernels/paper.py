"""The likelihood of Wüthrich et al. (ICRA 2012), its early rejection by free space, and numbered draws of poses.

The likelihood is eq. pbd as published, with the sum over all pixels. The free-space test takes a few nanoseconds and
rejects most poses with a vanishing likelihood.
"""

import math

import numpy as np

from modeler.kernels.cache import njit
from modeler.kernels.threads import over_rows

NEVER = -np.inf

STRIDE = np.uint64(64)  # random numbers reserved for each draw; the probability of needing more is 10⁻¹⁵
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FIRST_FACTOR, SECOND_FACTOR = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
SHIFT_30, SHIFT_27, SHIFT_31 = np.uint64(30), np.uint64(27), np.uint64(31)
SHIFT_43, SHIFT_22, SHIFT_11, SHIFT_1 = np.uint64(43), np.uint64(22), np.uint64(11), np.uint64(1)
LOW_21 = np.uint64((1 << 21) - 1)

X, Y, Z, MARGIN, BACKWARD = range(5)
"""Columns of a check: a surface point (3), its largest distance in front in m, and whether it is the target's."""


@njit(cache=True)
def ray_jacobian(point):
    """Return Q = ∂(w, h, r)/∂(x, y, z) (3, 3) at a point (3,) (paper, appendix)."""
    x, y, z = point
    r = math.sqrt(x * x + y * y + z * z)
    jacobian = np.zeros((3, 3))
    jacobian[0, 0], jacobian[0, 2] = 1.0 / z, -x / (z * z)
    jacobian[1, 1], jacobian[1, 2] = 1.0 / z, -y / (z * z)
    jacobian[2, 0], jacobian[2, 1], jacobian[2, 2] = x / r, y / r, z / r
    return jacobian


@njit(cache=True)
def ray_jacobian_inverse(point):
    """Return Q⁻¹ = ∂(x, y, z)/∂(w, h, r) (3, 3) at a point (3,)."""
    x, y, z = point
    r = math.sqrt(x * x + y * y + z * z)
    w, h = x / z, y / z
    jacobian = np.empty((3, 3))
    # x = w z, y = h z and z = r / √(1 + w² + h²), so that ∂z/∂w = -w z³/r² and likewise for h.
    slope = z * z * z / (r * r)
    jacobian[2, 0], jacobian[2, 1], jacobian[2, 2] = -w * slope, -h * slope, z / r
    jacobian[0, 0], jacobian[0, 1], jacobian[0, 2] = z - w * w * slope, -w * h * slope, w * z / r
    jacobian[1, 0], jacobian[1, 1], jacobian[1, 2] = -h * w * slope, z - h * h * slope, h * z / r
    return jacobian


@njit(cache=True)
def inverse_3(matrix):
    """Return the inverse (3, 3) of a symmetric positive definite matrix and its determinant."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    result = np.empty((3, 3))
    result[0, 0], result[0, 1], result[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    result[1, 0], result[1, 1], result[1, 2] = result[0, 1], a * f - c * c, b * c - a * e
    result[2, 0], result[2, 1], result[2, 2] = result[0, 2], result[1, 2], a * d - b * b
    determinant = a * result[0, 0] + b * result[0, 1] + c * result[0, 2]
    return result / determinant, determinant


@njit(cache=True)
def spread(first, second, third, noise):
    """Return J L Jᵀ + L with J = first · second · third, all (3, 3); loops are faster than library calls."""
    half, jacobian = np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                half[i, j] += first[i, k] * second[k, j]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                jacobian[i, j] += half[i, k] * third[k, j]
    for i in range(3):
        for j in range(3):
            half[i, j] = 0.0
            for k in range(3):
                half[i, j] += jacobian[i, k] * noise[k, j]
    result = noise.copy()
    for i in range(3):
        for j in range(3):
            for k in range(3):
                result[i, j] += half[i, k] * jacobian[j, k]
    return result


@njit(cache=True)
def point_coefficients(point_b, point_in_a, rotation, noise):
    """Return D (3 numbers: ww, wh, hh), v (3) and K2 of one point (paper, appendix).

    Args:
        point_b: (3,) the point in B's camera.
        point_in_a: (3,) the same point transformed to A's camera.
        rotation: (3, 3) R⁻¹, which maps directions in B to A.
        noise: (3, 3) L, the sensor's covariance in ray coordinates.
    """
    in_a = spread(ray_jacobian(point_in_a), rotation, ray_jacobian_inverse(point_b), noise)
    precision, _ = inverse_3(in_a)  # Λ
    in_b = spread(ray_jacobian(point_b), rotation.T, ray_jacobian_inverse(point_in_a), noise)
    _, determinant = inverse_3(in_b)
    last = precision[2, 2]
    return (
        precision[0, 0] - precision[2, 0] ** 2 / last,
        precision[1, 0] - precision[2, 0] * precision[2, 1] / last,
        precision[1, 1] - precision[2, 1] ** 2 / last,
        precision[2, 0] / math.sqrt(2.0 * last),
        precision[2, 1] / math.sqrt(2.0 * last),
        precision[2, 2] / math.sqrt(2.0 * last),
        1.0 / math.sqrt(determinant),
    )


@njit(cache=True)
def point_density(point_b, pose, ranges_m, intrinsics, noise, reach_sigmas):
    """Return p(b_j | M_A, T) of one point, up to a constant (paper, eq. pbd).

    Args:
        point_b: (3,) surface point in B's camera, m.
        pose: (12,) rows of the 3×4 transform from B to A.
        ranges_m: (h, w) range r of every pixel of A; 0 = no measurement, which excludes nothing.
        intrinsics: (4,) fx, fy, cx, cy of A in px.
        noise: (3, 3) L.
        reach_sigmas: pixels farther than this many lateral standard deviations are skipped; inf = none.
    """
    rotation = np.empty((3, 3))
    in_a = np.empty(3)
    for k in range(3):
        in_a[k] = pose[4 * k + 3]
        for m in range(3):
            rotation[k, m] = pose[4 * k + m]
            in_a[k] += pose[4 * k + m] * point_b[m]
    if in_a[2] <= 0.0:
        return 0.0
    d_ww, d_wh, d_hh, v_w, v_h, v_r, k2 = point_coefficients(point_b, in_a, rotation, noise)
    fx, fy, cx, cy = intrinsics
    height, width = ranges_m.shape
    w, h = in_a[0] / in_a[2], in_a[1] / in_a[2]
    r = math.sqrt(in_a[0] ** 2 + in_a[1] ** 2 + in_a[2] ** 2)
    first_row, last_row, first_column, last_column = 0, height - 1, 0, width - 1
    if reach_sigmas < 1e6:
        determinant = d_ww * d_hh - d_wh * d_wh
        reach_w = reach_sigmas * math.sqrt(d_hh / determinant)
        reach_h = reach_sigmas * math.sqrt(d_ww / determinant)
        first_column = max(math.ceil(fx * (w - reach_w) + cx), 0)
        last_column = min(math.floor(fx * (w + reach_w) + cx), width - 1)
        first_row = max(math.ceil(fy * (h - reach_h) + cy), 0)
        last_row = min(math.floor(fy * (h + reach_h) + cy), height - 1)
    limit = 0.5 * reach_sigmas * reach_sigmas
    total = 0.0
    for row in range(first_row, last_row + 1):
        dh = h - (row - cy) / fy
        for column in range(first_column, last_column + 1):
            dw = w - (column - cx) / fx
            exponent = 0.5 * (d_ww * dw * dw + 2.0 * d_wh * dw * dh + d_hh * dh * dh)
            if exponent > limit:
                continue
            behind = v_w * dw + v_h * dh + v_r * (r - ranges_m[row, column])
            if behind > 6.0:
                total += 2.0 * math.exp(-exponent)  # 2 - erfc(6) is 2 in double precision
            elif behind > -27.3:
                # erfc is accurate where 1 + erf would cancel; from 27.3 on it is 0 in double precision.
                total += math.exp(-exponent) * math.erfc(-behind)
    return k2 * total


def log_likelihoods(poses, points_b, ranges_m, intrinsics, noise, options):
    """Return log p(P_B | M_A, T) (m,) for poses (paper, eq. P_B), -inf if a sample is rejected early.

    Args:
        poses: (m, 12) rows of the 3×4 transforms from B to A.
        points_b: (n, 3) surface points of B in m.
        ranges_m: (h, w) range of every pixel of A, 0 = no measurement.
        intrinsics: (4,) fx, fy, cx, cy of A in px.
        noise: (3, 3) L, the sensor's covariance in ray coordinates.
        options: (2,) reach in lateral standard deviations (inf = all pixels); density, as a fraction of K2, below
            which a point rejects the sample (0 = only if it vanishes).
    """
    return over_rows(_log_likelihoods, poses, points_b, ranges_m, intrinsics, noise, options)


@njit(cache=True, nogil=True)
def _log_likelihoods(poses, points_b, ranges_m, intrinsics, noise, options):
    result = np.empty(poses.shape[0])
    # In units of K2 for an unrotated point, so that the threshold is a number of pixels, not of 1/m.
    unit = 1.0 / math.sqrt(inverse_3(2.0 * noise)[1])
    for i in range(poses.shape[0]):
        total = 0.0
        for j in range(points_b.shape[0]):
            density = point_density(points_b[j], poses[i], ranges_m, intrinsics, noise, options[0])
            if density <= options[1] * unit:
                total = NEVER
                break
            total += math.log(density)
        result[i] = total
    return result


@njit(cache=True, inline="always")
def mixed(counter):
    """Return 64 random bits of a counter (Steele, Lea and Flood 2014, SplitMix64)."""
    bits = (counter ^ (counter >> SHIFT_30)) * FIRST_FACTOR
    bits = (bits ^ (bits >> SHIFT_27)) * SECOND_FACTOR
    return bits ^ (bits >> SHIFT_31)


@njit(cache=True, inline="always")
def in_ball(counter):
    """Return the advanced counter and a point (3 numbers) uniform in the unit ball, on a grid of 10⁻⁶."""
    while True:
        counter += GOLDEN
        bits = mixed(counter)
        x = ((bits >> SHIFT_43) + 0.5) * 2.0**-20 - 1.0
        y = (((bits >> SHIFT_22) & LOW_21) + 0.5) * 2.0**-20 - 1.0
        z = (((bits >> SHIFT_1) & LOW_21) + 0.5) * 2.0**-20 - 1.0
        if x * x + y * y + z * z <= 1.0:
            return counter, x, y, z


@njit(cache=True)
def draw(number, seed, limits, pose):
    """Write the pose of a number: uniform over rotations up to a limit and over a ball of centroid offsets.

    Args:
        number: uint64; the same number and seed give the same pose in every thread and batch.
        seed: uint64.
        limits: (17,) sine of half the largest angle; largest offset in m; source's and target's centroid in m;
            rotation (3, 3) relative to which angles are limited.
        pose: (12,) out: rows of the 3×4 matrix of target_from_source.
    """
    counter = seed + GOLDEN * STRIDE * number
    limit = limits[0]
    least = 1.0 - limit * limit
    while True:
        # The vector part of a unit quaternion lies in a ball; uniform rotations have density ∝ 1 / w there.
        counter, x, y, z = in_ball(counter)
        x, y, z = limit * x, limit * y, limit * z
        square = 1.0 - x * x - y * y - z * z
        counter += GOLDEN
        chance = (mixed(counter) >> SHIFT_11) * 2.0**-53
        if chance * chance * square < least:
            break
    w = math.sqrt(square)
    turn = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    counter, x, y, z = in_ball(counter)
    offset = (x, y, z)
    for k in range(3):
        a, b, c = turn[k]
        pose[4 * k] = a * limits[8] + b * limits[11] + c * limits[14]
        pose[4 * k + 1] = a * limits[9] + b * limits[12] + c * limits[15]
        pose[4 * k + 2] = a * limits[10] + b * limits[13] + c * limits[16]
        pose[4 * k + 3] = (
            limits[5 + k]
            + limits[1] * offset[k]
            - (pose[4 * k] * limits[2] + pose[4 * k + 1] * limits[3] + pose[4 * k + 2] * limits[4])
        )


@njit(cache=True, inline="always")
def forbidden(check, pose, near_m, image):
    """Return whether a check's point, transformed by a pose, lies in front of every measured pixel within its reach.

    Args:
        check: (5,).
        pose: (12,) rows of target_from_source.
        near_m: (h, w) float32 `nearest_ranges` of the other view.
        image: (7,) fx, fy, cx, cy in px of a pixel of `near_m`; its width and height; and (r / z²)² up to which
            `near_m` is valid, in 1/m².
    """
    px, py, pz = check[X], check[Y], check[Z]
    if check[BACKWARD] > 0.0:
        px, py, pz = px - pose[3], py - pose[7], pz - pose[11]
        x = pose[0] * px + pose[4] * py + pose[8] * pz
        y = pose[1] * px + pose[5] * py + pose[9] * pz
        z = pose[2] * px + pose[6] * py + pose[10] * pz
    else:
        x = pose[0] * px + pose[1] * py + pose[2] * pz + pose[3]
        y = pose[4] * px + pose[5] * py + pose[6] * pz + pose[7]
        z = pose[8] * px + pose[9] * py + pose[10] * pz + pose[11]
    if z <= 0.0:
        return True
    inverse = 1.0 / z
    square = x * x + y * y + z * z
    if square * inverse * inverse * inverse * inverse > image[6]:
        return False
    column, row = image[0] * x * inverse + image[2] + 0.5, image[1] * y * inverse + image[3] + 0.5
    if not (0.0 <= column < image[4] and 0.0 <= row < image[5]):
        return True
    free_m = near_m[int(row), int(column)] - check[MARGIN]
    return free_m > 0.0 and square < free_m * free_m


@njit(cache=True, inline="always")
def passes(pose, checks, near_m, images):
    """Return whether no check forbids a pose."""
    for j in range(checks.shape[0]):
        if checks[j, BACKWARD] > 0.0:
            if forbidden(checks[j], pose, near_m[1], images[1]):
                return False
        elif forbidden(checks[j], pose, near_m[0], images[0]):
            return False
    return True


def passing(poses, checks, near_m, images):
    """Return whether poses (m, 12) pass all checks, (m,).

    Args:
        poses: rows of target_from_source.
        checks: (n, 5), the most selective first.
        near_m: target's and source's `nearest_ranges`.
        images: target's and source's image, see `forbidden`.
    """
    return over_rows(_passing, poses, checks, near_m, images)


@njit(cache=True, nogil=True)
def _passing(poses, checks, near_m, images):
    result = np.empty(poses.shape[0], dtype=np.bool_)
    for i in range(poses.shape[0]):
        result[i] = passes(poses[i], checks, near_m, images)
    return result


def drawn(numbers, seed, limits):
    """Return the poses (m, 12) of numbers (m,), see `draw`."""
    return over_rows(_drawn, numbers, seed, limits)


@njit(cache=True, nogil=True)
def _drawn(numbers, seed, limits):
    poses = np.empty((numbers.shape[0], 12))
    for i in range(numbers.shape[0]):
        draw(np.uint64(numbers[i]), seed, limits, poses[i])
    return poses


@njit(cache=True)
def verdicts(poses, checks, near_m, images):
    """Return whether each check forbids each pose, (m, n); arguments as for `passing`."""
    result = np.empty((poses.shape[0], checks.shape[0]), dtype=np.bool_)
    for i in range(poses.shape[0]):
        for j in range(checks.shape[0]):
            side = 1 if checks[j, BACKWARD] > 0.0 else 0
            result[i, j] = forbidden(checks[j], poses[i], near_m[side], images[side])
    return result


def nearest_ranges(ranges_m, reach_px):
    """Return the least range (h + 2b, w + 2a) within reach of any point that rounds to a pixel, never rounded up.

    The image is padded by the reach (a, b) in pixels; infinite if there is no measurement within reach.

    Args:
        ranges_m: (h, w) range of every pixel in m; 0 = no measurement, which excludes nothing.
        reach_px: (2,) half axes of the ellipse within reach, along columns and rows.
    """
    across, down = math.ceil(reach_px[0] + 0.5), math.ceil(reach_px[1] + 0.5)
    return over_rows(_nearest_ranges, np.arange(ranges_m.shape[0] + 2 * down), ranges_m, reach_px, across, down)


@njit(cache=True, nogil=True)
def _nearest_ranges(rows, ranges_m, reach_px, across, down):
    height, width = ranges_m.shape
    result = np.full((rows.shape[0], width + 2 * across), np.float32(np.inf))
    for i in range(rows.shape[0]):
        row = rows[i]
        for dy in range(-down, down + 1):
            other = row - down + dy
            if other < 0 or other >= height:
                continue
            # A point may be half a pixel from the one to which it rounds.
            rest = 1.0 - (max(abs(dy) - 0.5, 0.0) / reach_px[1]) ** 2
            if rest < 0.0:
                continue
            half = math.floor(reach_px[0] * math.sqrt(rest) + 0.5)
            for dx in range(-half, half + 1):
                for column in range(width):
                    value = np.float32(ranges_m[other, column] * (1.0 - 1e-6))
                    place = column + across - dx
                    if value < result[i, place]:
                        result[i, place] = value
    return result
