"""Steps on SE(3) along differences of poses: the proposals of an annealed sampler, all at once.

Poses are rows of twelve numbers, the upper three rows of their matrices; `se3` is the readable twin of the algebra.
"""

import math

import numba
import numpy as np


@numba.njit(cache=True, inline="always")
def cross(ax, ay, az, bx, by, bz):
    """Return the cross product of two vectors."""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@numba.njit(cache=True)
def rotation_vector(r):
    """Return the rotation vector (3 numbers, rad) of a rotation matrix (3, 3), by its quaternion (Shepperd 1978)."""
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    if trace > 0.0:
        real = 0.5 * math.sqrt(1.0 + trace)
        scale = 0.25 / real
        x, y, z = (r[2, 1] - r[1, 2]) * scale, (r[0, 2] - r[2, 0]) * scale, (r[1, 0] - r[0, 1]) * scale
    else:
        i = 0
        if r[1, 1] > r[0, 0]:
            i = 1
        if r[2, 2] > r[i, i]:
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        imaginary = np.empty(3)
        imaginary[i] = 0.5 * math.sqrt(max(1.0 + r[i, i] - r[j, j] - r[k, k], 1e-300))
        scale = 0.25 / imaginary[i]
        real = (r[k, j] - r[j, k]) * scale
        imaginary[j], imaginary[k] = (r[j, i] + r[i, j]) * scale, (r[k, i] + r[i, k]) * scale
        if real < 0.0:  # of the two quaternions of a rotation, the one with the shorter way
            real, imaginary = -real, -imaginary
        x, y, z = imaginary[0], imaginary[1], imaginary[2]
    length = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(length, real) / length if length > 1e-12 else 2.0
    return scale * x, scale * y, scale * z


@numba.njit(cache=True)
def logarithm(r, tx, ty, tz):
    """Return ξ (6 numbers: rad, m) of a motion given by its rotation (3, 3) and translation."""
    wx, wy, wz = rotation_vector(r)
    square = wx * wx + wy * wy + wz * wz
    if square < 1e-8:
        last = 1.0 / 12.0 + square / 720.0
    else:
        angle = math.sqrt(square)
        last = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / square
    ax, ay, az = cross(wx, wy, wz, tx, ty, tz)
    bx, by, bz = cross(wx, wy, wz, ax, ay, az)
    return wx, wy, wz, tx - 0.5 * ax + last * bx, ty - 0.5 * ay + last * by, tz - 0.5 * az + last * bz


@numba.njit(cache=True)
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


@numba.njit(cache=True)
def propose(moving, first, second, scales, jitter, centre):
    """Return moving · C · exp(scale · log(C⁻¹ first⁻¹ second C) + jitter) · C⁻¹, C the shift to `centre`.

    Args:
        moving: (m, 12) poses to be moved.
        first: (m, 12) and
        second: (m, 12) poses whose difference is the direction of each step.
        scales: (m,) lengths of the steps in units of the differences.
        jitter: (m, 6) tangents added to the steps.
        centre: (3,) point of the source, in m, about which steps turn.
    """
    moved = np.empty((len(moving), 12))
    r, t, shift = np.empty((3, 3)), np.empty(3), np.empty(3)
    for i in range(len(moving)):
        a, b, p = first[i], second[i], moving[i]
        for k in range(3):
            # Where `second` puts the centre, seen from `first`.
            t[k] = b[4 * k + 3] - a[4 * k + 3]
            for m in range(3):
                t[k] += b[4 * k + m] * centre[m]
        for k in range(3):
            shift[k] = -centre[k]
            for m in range(3):
                shift[k] += a[4 * m + k] * t[m]
                r[k, m] = a[k] * b[m] + a[4 + k] * b[4 + m] + a[8 + k] * b[8 + m]
        wx, wy, wz, ux, uy, uz = logarithm(r, shift[0], shift[1], shift[2])
        s = scales[i]
        vx, vy, vz = exponential(
            s * wx + jitter[i, 0],
            s * wy + jitter[i, 1],
            s * wz + jitter[i, 2],
            s * ux + jitter[i, 3],
            s * uy + jitter[i, 4],
            s * uz + jitter[i, 5],
            r,
        )
        t[0], t[1], t[2] = vx + centre[0], vy + centre[1], vz + centre[2]
        for k in range(3):
            for m in range(3):
                t[k] -= r[k, m] * centre[m]
        for k in range(3):
            for m in range(3):
                moved[i, 4 * k + m] = p[4 * k] * r[0, m] + p[4 * k + 1] * r[1, m] + p[4 * k + 2] * r[2, m]
            moved[i, 4 * k + 3] = p[4 * k] * t[0] + p[4 * k + 1] * t[1] + p[4 * k + 2] * t[2] + p[4 * k + 3]
    return moved
