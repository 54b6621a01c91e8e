"""Motions drawn by number, and a test of a few nanoseconds that drops most that `paper` would reject."""

import math

import numba
import numpy as np

STRIDE = np.uint64(64)  # numbers set aside for each motion; more than 64 are asked for once in 10¹⁵
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FIRST_FACTOR, SECOND_FACTOR = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
SHIFT_30, SHIFT_27, SHIFT_31 = np.uint64(30), np.uint64(27), np.uint64(31)
SHIFT_43, SHIFT_22, SHIFT_11, SHIFT_1 = np.uint64(43), np.uint64(22), np.uint64(11), np.uint64(1)
LOW_21 = np.uint64((1 << 21) - 1)

X, Y, Z, MARGIN, BACKWARD = range(5)
"""Columns of a check: a surface point (3), how far in front it may lie in m, and whether it is the target's."""


@numba.njit(cache=True, inline="always")
def mixed(counter):
    """Return 64 random bits of a counter (Steele, Lea and Flood 2014, SplitMix64)."""
    bits = (counter ^ (counter >> SHIFT_30)) * FIRST_FACTOR
    bits = (bits ^ (bits >> SHIFT_27)) * SECOND_FACTOR
    return bits ^ (bits >> SHIFT_31)


@numba.njit(cache=True, inline="always")
def in_ball(counter):
    """Return the counter moved on and a point (3 numbers) spread evenly over the unit ball, on a grid of 10⁻⁶."""
    while True:
        counter += GOLDEN
        bits = mixed(counter)
        x = ((bits >> SHIFT_43) + 0.5) * 2.0**-20 - 1.0
        y = (((bits >> SHIFT_22) & LOW_21) + 0.5) * 2.0**-20 - 1.0
        z = (((bits >> SHIFT_1) & LOW_21) + 0.5) * 2.0**-20 - 1.0
        if x * x + y * y + z * z <= 1.0:
            return counter, x, y, z


@numba.njit(cache=True)
def draw(number, seed, spread, pose):
    """Write the motion of a number: even over rotations up to a limit and over a ball of centroid offsets.

    Args:
        number: uint64; the same number and seed give the same motion, whoever asks.
        seed: uint64.
        spread: (17,) sine of half the largest angle; largest offset in m; source's and target's centroid in m;
            rotation (3, 3) from which angles count.
        pose: (12,) rows of the 3×4 matrix that carries source into target, written to.
    """
    counter = seed + GOLDEN * STRIDE * number
    limit = spread[0]
    least = 1.0 - limit * limit
    while True:
        # The vector part of a unit quaternion lies in a ball; evenness over rotations is density 1 / w there.
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
        pose[4 * k] = a * spread[8] + b * spread[11] + c * spread[14]
        pose[4 * k + 1] = a * spread[9] + b * spread[12] + c * spread[15]
        pose[4 * k + 2] = a * spread[10] + b * spread[13] + c * spread[16]
        pose[4 * k + 3] = (
            spread[5 + k]
            + spread[1] * offset[k]
            - (pose[4 * k] * spread[2] + pose[4 * k + 1] * spread[3] + pose[4 * k + 2] * spread[4])
        )


@numba.njit(cache=True, inline="always")
def forbidden(check, pose, near_m, image):
    """Return whether a check's point, carried by a pose, lies in front of all that is measured within its reach.

    Args:
        check: (5,).
        pose: (12,) rows of target_from_source.
        near_m: (h, w) float32 `nearest_ranges` of the view that the point is carried into.
        image: (7,) fx, fy, cx, cy in px of a pixel of `near_m`; its width and height; and (r / z²)² up to which
            `near_m` holds, in 1/m².
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


@numba.njit(cache=True, inline="always")
def passes(pose, checks, near_m, images):
    """Return whether no check forbids a pose."""
    for j in range(checks.shape[0]):
        if checks[j, BACKWARD] > 0.0:
            if forbidden(checks[j], pose, near_m[1], images[1]):
                return False
        elif forbidden(checks[j], pose, near_m[0], images[0]):
            return False
    return True


@numba.njit(cache=True, parallel=True)
def passing(first, count, draws, checks, near_m, images):
    """Return which (count,) of the motions numbered from `first` no check forbids.

    Args:
        first: number of the first motion.
        count: how many.
        draws: seed (uint64) and spread (17,), see `draw`.
        checks: (n, 5), those that forbid most first.
        near_m: target's and source's `nearest_ranges`.
        images: target's and source's image, see `forbidden`.
    """
    seed, spread = draws
    result = np.empty(count, dtype=np.bool_)
    size = 4096
    for block in numba.prange((count + size - 1) // size):
        pose = np.empty(12)
        for i in range(block * size, min((block + 1) * size, count)):
            draw(np.uint64(first + i), seed, spread, pose)
            result[i] = passes(pose, checks, near_m, images)
    return result


@numba.njit(cache=True, parallel=True)
def passing_poses(poses, checks, near_m, images):
    """Return which (m,) of poses (m, 12) no check forbids; arguments as of `passing`."""
    result = np.empty(poses.shape[0], dtype=np.bool_)
    for i in numba.prange(poses.shape[0]):
        result[i] = passes(poses[i], checks, near_m, images)
    return result


@numba.njit(cache=True)
def drawn(numbers, seed, spread):
    """Return the poses (m, 12) of numbers (m,), see `draw`."""
    poses = np.empty((numbers.shape[0], 12))
    for i in range(numbers.shape[0]):
        draw(np.uint64(numbers[i]), seed, spread, poses[i])
    return poses


@numba.njit(cache=True)
def verdicts(poses, checks, near_m, images):
    """Return which (m, n) checks forbid which poses (m, 12); arguments as of `passing`."""
    result = np.empty((poses.shape[0], checks.shape[0]), dtype=np.bool_)
    for i in range(poses.shape[0]):
        for j in range(checks.shape[0]):
            side = 1 if checks[j, BACKWARD] > 0.0 else 0
            result[i, j] = forbidden(checks[j], poses[i], near_m[side], images[side])
    return result


@numba.njit(cache=True, parallel=True)
def nearest_ranges(ranges_m, reach_px):
    """Return the least range (h + 2b, w + 2a) within reach of anything that rounds to a pixel, never rounded up.

    The image is padded by as many pixels (a, b) as the reach goes beyond it; where it reaches none, all is infinite.

    Args:
        ranges_m: (h, w) range of every pixel in m; 0 = no measurement, which forbids nothing.
        reach_px: (2,) half axes of the ellipse of pixels that count, along columns and rows.
    """
    height, width = ranges_m.shape
    across, down = math.ceil(reach_px[0] + 0.5), math.ceil(reach_px[1] + 0.5)
    result = np.full((height + 2 * down, width + 2 * across), np.float32(np.inf))
    for row in numba.prange(height + 2 * down):
        for dy in range(-down, down + 1):
            other = row - down + dy
            if other < 0 or other >= height:
                continue
            # A point up to half a pixel from the one it rounds to.
            rest = 1.0 - (max(abs(dy) - 0.5, 0.0) / reach_px[1]) ** 2
            if rest < 0.0:
                continue
            half = math.floor(reach_px[0] * math.sqrt(rest) + 0.5)
            for dx in range(-half, half + 1):
                for column in range(width):
                    value = np.float32(ranges_m[other, column] * (1.0 - 1e-6))
                    place = column + across - dx
                    if value < result[row, place]:
                        result[row, place] = value
    return result
