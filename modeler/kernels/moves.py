"""The algebra of SE(3), many poses at once: exponentials, logarithms, and steps along differences of poses.

Poses are rows of twelve numbers, the upper three rows of their matrices, or whole matrices; `se3` has the conventions.
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
    """Return the rotation vector (3 numbers, rad) of a rotation matrix (3, 3), by its quaternion (Shepperd 1978).

    And the cosine of half the angle a, and a / sin(a / 2).
    """
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
    return scale * x, scale * y, scale * z, real, scale


@numba.njit(cache=True)
def logarithm(r, tx, ty, tz):
    """Return ξ (6 numbers: rad, m) of a motion given by its rotation (3, 3) and translation, and a / sin(a / 2).

    a is the angle of the rotation: ξ runs wider there than the uniform measure of motions, by ((a / 2) / sin(a / 2))⁴.
    """
    wx, wy, wz, cosine, scale = rotation_vector(r)
    square = wx * wx + wy * wy + wz * wz
    if square < 1e-8:
        last = 1.0 / 12.0 + square / 720.0
    else:
        last = (1.0 - 0.5 * scale * cosine) / square
    ax, ay, az = cross(wx, wy, wz, tx, ty, tz)
    bx, by, bz = cross(wx, wy, wz, ax, ay, az)
    return wx, wy, wz, tx - 0.5 * ax + last * bx, ty - 0.5 * ay + last * by, tz - 0.5 * az + last * bz, scale


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
def difference(first, second, centre, r):
    """Return ξ = log(C⁻¹ first⁻¹ second C) for poses (12,), C the shift to `centre` (3,), as `logarithm` does.

    Room for a rotation, `r` (3, 3), is handed in.
    """
    b = second
    # Where the poses put the centre, one beside the other; then seen from `first`.
    x = b[3] - first[3] + b[0] * centre[0] + b[1] * centre[1] + b[2] * centre[2]
    y = b[7] - first[7] + b[4] * centre[0] + b[5] * centre[1] + b[6] * centre[2]
    z = b[11] - first[11] + b[8] * centre[0] + b[9] * centre[1] + b[10] * centre[2]
    for k in range(3):
        for m in range(3):
            r[k, m] = first[k] * b[m] + first[4 + k] * b[4 + m] + first[8 + k] * b[8 + m]
    return logarithm(
        r,
        first[0] * x + first[4] * y + first[8] * z - centre[0],
        first[1] * x + first[5] * y + first[9] * z - centre[1],
        first[2] * x + first[6] * y + first[10] * z - centre[2],
    )


@numba.njit(cache=True)
def turn(pose, xi, centre, r, moved):
    """Write pose · C · exp(ξ) · C⁻¹ into `moved` (12,), C the shift to `centre` (3,); room for a rotation is `r`."""
    x, y, z = exponential(xi[0], xi[1], xi[2], xi[3], xi[4], xi[5], r)
    x += centre[0] - r[0, 0] * centre[0] - r[0, 1] * centre[1] - r[0, 2] * centre[2]
    y += centre[1] - r[1, 0] * centre[0] - r[1, 1] * centre[1] - r[1, 2] * centre[2]
    z += centre[2] - r[2, 0] * centre[0] - r[2, 1] * centre[1] - r[2, 2] * centre[2]
    for k in range(0, 12, 4):
        a, b, c = pose[k], pose[k + 1], pose[k + 2]
        for m in range(3):
            moved[k + m] = a * r[0, m] + b * r[1, m] + c * r[2, m]
        moved[k + 3] = a * x + b * y + c * z + pose[k + 3]


@numba.njit(cache=True)
def turned(poses, xi, centre):
    """Return pose · C · exp(ξ) · C⁻¹ (n, 4, 4) of poses (n, 4, 4) and tangents ξ (n, 6); see `turn`."""
    moved, row, full, r = np.zeros((len(poses), 4, 4)), np.empty(12), np.empty(12), np.empty((3, 3))
    for i in range(len(poses)):
        for k in range(12):
            row[k] = poses[i, k // 4, k % 4]
        turn(row, xi[i], centre, r, full)
        for k in range(12):
            moved[i, k // 4, k % 4] = full[k]
        moved[i, 3, 3] = 1.0
    return moved


@numba.njit(cache=True)
def exponentials(xi):
    """Return the motions (n, 4, 4) of tangents (n, 6)."""
    poses = np.zeros((len(xi), 4, 4))
    for i in range(len(xi)):
        w = xi[i]
        poses[i, 0, 3], poses[i, 1, 3], poses[i, 2, 3] = exponential(w[0], w[1], w[2], w[3], w[4], w[5], poses[i])
        poses[i, 3, 3] = 1.0
    return poses


@numba.njit(cache=True)
def logarithms(poses):
    """Return the tangents (n, 6) of motions (n, 4, 4)."""
    xi = np.empty((len(poses), 6))
    for i in range(len(poses)):
        p = poses[i]
        w = logarithm(p, p[0, 3], p[1, 3], p[2, 3])
        for k in range(6):
            xi[i, k] = w[k]
    return xi


@numba.njit(cache=True)
def mean(poses, weights, start, about, iterations, tolerance):
    """Return the intrinsic mean (12,) of weighted poses, and the covariance (6, 6) of ξ = log(C⁻¹ mean⁻¹ pose C).

    Args:
        poses: (n, 12).
        weights: (n,), their sum 1.
        start: (12,) where the fixed-point iteration begins.
        about: (3,) point in m, C the shift to it.
        iterations: at most so many steps.
        tolerance: a shorter step (rad, m) is the last.
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
            xi = difference(centre, poses[i], about, r)
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
        turn(centre, first, about, r, moved)
        for k in range(12):
            centre[k] = moved[k]
    for k in range(6):
        for m in range(k):
            second[m, k] = second[k, m]
    return centre, second
