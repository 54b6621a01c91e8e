"""The Lie group SE(3), for many poses at once: exponentials, logarithms, retractions and means.

Poses are rows of twelve numbers, the upper three rows of their matrices, or whole matrices; `se3` has the conventions.
"""

import math

import numpy as np

from modeler.kernels.cache import njit


@njit(cache=True, inline="always")
def cross(ax, ay, az, bx, by, bz):
    """Return the cross product of two vectors."""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


_NEAR_TRACE = 2.96  # of a rotation by 0.2 rad

# asin(s) / s in powers of s², exact to the last bit for half of such an angle.
_ASIN_1, _ASIN_2, _ASIN_3, _ASIN_4 = 1.0 / 6.0, 3.0 / 40.0, 5.0 / 112.0, 35.0 / 1152.0
_ASIN_5, _ASIN_6, _ASIN_7 = 63.0 / 2816.0, 231.0 / 13312.0, 143.0 / 10240.0


@njit(cache=True)
def quaternion(r00, r01, r02, r10, r11, r12, r20, r21, r22):
    """Return x, y, z and the real part of a rotation matrix's quaternion (Shepperd 1978), and a / sin(a / 2).

    a is the angle of the rotation; of the two quaternions, the one of the smaller angle.
    """
    trace = r00 + r11 + r22
    if trace > 0.0:
        real = 0.5 * math.sqrt(1.0 + trace)
        scale = 0.25 / real
        x, y, z = (r21 - r12) * scale, (r02 - r20) * scale, (r10 - r01) * scale
        if trace > _NEAR_TRACE:
            square = x * x + y * y + z * z
            high = _ASIN_4 + square * (_ASIN_5 + square * (_ASIN_6 + square * _ASIN_7))
            low = 1.0 + square * (_ASIN_1 + square * (_ASIN_2 + square * (_ASIN_3 + square * high)))
            return x, y, z, real, 2.0 * low
    elif r00 >= r11 and r00 >= r22:
        x = 0.5 * math.sqrt(max(1.0 + r00 - r11 - r22, 1e-300))
        scale = 0.25 / x
        real, y, z = (r21 - r12) * scale, (r10 + r01) * scale, (r20 + r02) * scale
    elif r11 >= r22:
        y = 0.5 * math.sqrt(max(1.0 + r11 - r22 - r00, 1e-300))
        scale = 0.25 / y
        real, z, x = (r02 - r20) * scale, (r21 + r12) * scale, (r01 + r10) * scale
    else:
        z = 0.5 * math.sqrt(max(1.0 + r22 - r00 - r11, 1e-300))
        scale = 0.25 / z
        real, x, y = (r10 - r01) * scale, (r02 + r20) * scale, (r12 + r21) * scale
    if real < 0.0:
        x, y, z, real = -x, -y, -z, -real
    length = math.sqrt(x * x + y * y + z * z)
    return x, y, z, real, 2.0 * math.atan2(length, real) / length


@njit(cache=True, inline="always")
def logarithm(r00, r01, r02, tx, r10, r11, r12, ty, r20, r21, r22, tz):
    """Return ξ (6 numbers: rad, m) of a motion given by its upper three rows, and a / sin(a / 2).

    a is the angle of the rotation: the density of ξ relative to the uniform measure of motions is ((a/2) / sin(a/2))⁴.
    """
    x, y, z, cosine, scale = quaternion(r00, r01, r02, r10, r11, r12, r20, r21, r22)
    wx, wy, wz = scale * x, scale * y, scale * z
    square = wx * wx + wy * wy + wz * wz
    last = (1.0 - 0.5 * scale * cosine) / square if square > 1e-8 else 1.0 / 12.0 + square / 720.0
    ax, ay, az = cross(wx, wy, wz, tx, ty, tz)
    bx, by, bz = cross(wx, wy, wz, ax, ay, az)
    return wx, wy, wz, tx - 0.5 * ax + last * bx, ty - 0.5 * ay + last * by, tz - 0.5 * az + last * bz, scale


@njit(cache=True)
def exponential(wx, wy, wz, ux, uy, uz, r):
    """Write the rotation (3, 3) of ξ into `r` and return its translation."""
    square = wx * wx + wy * wy + wz * wz
    if square < 1e-8:
        first, second, third = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        angle = math.sqrt(square)
        first = math.sin(angle) / angle
        second = 2.0 * (math.sin(0.5 * angle) / angle) ** 2
        third = (1.0 - first) / square
    r[0, 0], r[1, 1], r[2, 2] = (
        1.0 - second * (wy * wy + wz * wz),
        1.0 - second * (wx * wx + wz * wz),
        1.0 - second * (wx * wx + wy * wy),
    )
    r[0, 1], r[1, 0] = second * wx * wy - first * wz, second * wx * wy + first * wz
    r[0, 2], r[2, 0] = second * wx * wz + first * wy, second * wx * wz - first * wy
    r[1, 2], r[2, 1] = second * wy * wz - first * wx, second * wy * wz + first * wx
    ax, ay, az = cross(wx, wy, wz, ux, uy, uz)
    bx, by, bz = cross(wx, wy, wz, ax, ay, az)
    return ux + second * ax + third * bx, uy + second * ay + third * by, uz + second * az + third * bz


@njit(cache=True, inline="always")
def difference(first, second, centre):
    """Return ξ = log(C⁻¹ first⁻¹ second C) for poses (12,), C the shift to `centre` (3,), as `logarithm` does.

    Written out for speed: with the rotation in an array, it takes three times as long.
    """
    a0, a1, a2, a4, a5, a6, a8, a9, a10 = (
        first[0],
        first[1],
        first[2],
        first[4],
        first[5],
        first[6],
        first[8],
        first[9],
        first[10],
    )
    b0, b1, b2, b4, b5, b6, b8, b9, b10 = (
        second[0],
        second[1],
        second[2],
        second[4],
        second[5],
        second[6],
        second[8],
        second[9],
        second[10],
    )
    # Displacement of the centre between the poses; then in the frame of `first`.
    x = second[3] - first[3] + b0 * centre[0] + b1 * centre[1] + b2 * centre[2]
    y = second[7] - first[7] + b4 * centre[0] + b5 * centre[1] + b6 * centre[2]
    z = second[11] - first[11] + b8 * centre[0] + b9 * centre[1] + b10 * centre[2]
    return logarithm(
        a0 * b0 + a4 * b4 + a8 * b8,
        a0 * b1 + a4 * b5 + a8 * b9,
        a0 * b2 + a4 * b6 + a8 * b10,
        a0 * x + a4 * y + a8 * z - centre[0],
        a1 * b0 + a5 * b4 + a9 * b8,
        a1 * b1 + a5 * b5 + a9 * b9,
        a1 * b2 + a5 * b6 + a9 * b10,
        a1 * x + a5 * y + a9 * z - centre[1],
        a2 * b0 + a6 * b4 + a10 * b8,
        a2 * b1 + a6 * b5 + a10 * b9,
        a2 * b2 + a6 * b6 + a10 * b10,
        a2 * x + a6 * y + a10 * z - centre[2],
    )


@njit(cache=True)
def differences(first, second, centre):
    """Return the `difference` (n, 6) of pairs of poses (n, 12)."""
    xi = np.empty((len(first), 6))
    for i in range(len(first)):
        one = difference(first[i], second[i], centre)
        for k in range(6):
            xi[i, k] = one[k]
    return xi


@njit(cache=True)
def retract(pose, xi, centre, r, moved):
    """Write pose · C · exp(ξ) · C⁻¹ into `moved` (12,), C the shift to `centre` (3,); `r` (3, 3) is a buffer."""
    x, y, z = exponential(xi[0], xi[1], xi[2], xi[3], xi[4], xi[5], r)
    x += centre[0] - r[0, 0] * centre[0] - r[0, 1] * centre[1] - r[0, 2] * centre[2]
    y += centre[1] - r[1, 0] * centre[0] - r[1, 1] * centre[1] - r[1, 2] * centre[2]
    z += centre[2] - r[2, 0] * centre[0] - r[2, 1] * centre[1] - r[2, 2] * centre[2]
    for k in range(0, 12, 4):
        a, b, c = pose[k], pose[k + 1], pose[k + 2]
        for m in range(3):
            moved[k + m] = a * r[0, m] + b * r[1, m] + c * r[2, m]
        moved[k + 3] = a * x + b * y + c * z + pose[k + 3]


@njit(cache=True)
def retract_all(poses, xi, centre):
    """Return pose · C · exp(ξ) · C⁻¹ (n, 4, 4) of poses (n, 4, 4) and tangents ξ (n, 6); see `retract`."""
    moved, row, full, r = np.zeros((len(poses), 4, 4)), np.empty(12), np.empty(12), np.empty((3, 3))
    for i in range(len(poses)):
        for k in range(12):
            row[k] = poses[i, k // 4, k % 4]
        retract(row, xi[i], centre, r, full)
        for k in range(12):
            moved[i, k // 4, k % 4] = full[k]
        moved[i, 3, 3] = 1.0
    return moved


@njit(cache=True)
def exponentials(xi):
    """Return the motions (n, 4, 4) of tangents (n, 6)."""
    poses = np.zeros((len(xi), 4, 4))
    for i in range(len(xi)):
        w = xi[i]
        poses[i, 0, 3], poses[i, 1, 3], poses[i, 2, 3] = exponential(w[0], w[1], w[2], w[3], w[4], w[5], poses[i])
        poses[i, 3, 3] = 1.0
    return poses


@njit(cache=True)
def logarithms(poses):
    """Return the tangents (n, 6) of motions (n, 4, 4)."""
    xi = np.empty((len(poses), 6))
    for i in range(len(poses)):
        p = poses[i]
        w = logarithm(
            p[0, 0], p[0, 1], p[0, 2], p[0, 3], p[1, 0], p[1, 1], p[1, 2], p[1, 3], p[2, 0], p[2, 1], p[2, 2], p[2, 3]
        )
        for k in range(6):
            xi[i, k] = w[k]
    return xi


@njit(cache=True)
def mean(poses, weights, start, about, iterations, tolerance):
    """Return the intrinsic mean (12,) of weighted poses, and the covariance (6, 6) of ξ = log(C⁻¹ mean⁻¹ pose C).

    Args:
        poses: (n, 12).
        weights: (n,), their sum 1.
        start: (12,) initial value of the fixed-point iteration.
        about: (3,) point in m, C the shift to it.
        iterations: largest number of steps.
        tolerance: the iteration ends at a shorter step (rad, m).
    """
    centre, moved, r = np.empty(12), np.empty(12), np.empty((3, 3))
    first, second = np.empty(6), np.empty((6, 6))
    for k in range(12):  # loops, not slices, which take seconds to compile
        centre[k] = start[k]
    for step in range(iterations + 1):
        for k in range(6):
            first[k] = 0.0
            for m in range(6):
                second[k, m] = 0.0
        for i in range(len(poses)):
            xi = difference(centre, poses[i], about)
            for k in range(6):
                part = weights[i] * xi[k]
                first[k] += part
                for m in range(k + 1):
                    second[k, m] += part * xi[m]
        square = 0.0
        for k in range(6):
            square += first[k] * first[k]
        if step == iterations or square < tolerance * tolerance:
            break
        retract(centre, first, about, r, moved)
        for k in range(12):
            centre[k] = moved[k]
    for k in range(6):
        for m in range(k):
            second[m, k] = second[k, m]
    return centre, second
