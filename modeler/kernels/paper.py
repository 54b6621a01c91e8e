"""The likelihood of Wüthrich et al. (ICRA 2012) as written: eq. pbd, with the sum over all pixels."""

import math

import numba
import numpy as np

NEVER = -np.inf


@numba.njit(cache=True)
def ray_jacobian(point):
    """Return Q = ∂(w, h, r)/∂(x, y, z) (3, 3) at a point (3,) (paper, appendix)."""
    x, y, z = point
    r = math.sqrt(x * x + y * y + z * z)
    jacobian = np.zeros((3, 3))
    jacobian[0, 0], jacobian[0, 2] = 1.0 / z, -x / (z * z)
    jacobian[1, 1], jacobian[1, 2] = 1.0 / z, -y / (z * z)
    jacobian[2, 0], jacobian[2, 1], jacobian[2, 2] = x / r, y / r, z / r
    return jacobian


@numba.njit(cache=True)
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


@numba.njit(cache=True)
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


@numba.njit(cache=True)
def spread(first, second, third, noise):
    """Return J L Jᵀ + L with J = first · second · third, all (3, 3); loops, as a library's product takes far longer."""
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


@numba.njit(cache=True)
def point_coefficients(point_b, point_in_a, rotation, noise):
    """Return D (3 numbers: ww, wh, hh), v (3) and K2 of one point (paper, appendix).

    Args:
        point_b: (3,) the point seen from B.
        point_in_a: (3,) the same point carried into A's camera.
        rotation: (3, 3) R⁻¹, which takes directions in B to A.
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


@numba.njit(cache=True)
def point_density(point_b, pose, ranges_m, intrinsics, noise, reach_sigmas):
    """Return p(b_j | M_A, T) of one point, up to a constant (paper, eq. pbd).

    Args:
        point_b: (3,) surface point in B's camera, m.
        pose: (12,) rows of the 3×4 matrix that carries B into A.
        ranges_m: (h, w) range r of every pixel of A; 0 = no measurement, which forbids nothing.
        intrinsics: (4,) fx, fy, cx, cy of A in px.
        noise: (3, 3) L.
        reach_sigmas: pixels farther than so many lateral standard deviations are passed over; inf = none.
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
                # erfc keeps its digits where 1 + erf would cancel; from 27.3 on it is 0 in double precision.
                total += math.exp(-exponent) * math.erfc(-behind)
    return k2 * total


@numba.njit(cache=True, parallel=True)
def log_likelihoods(poses, points_b, ranges_m, intrinsics, noise, options):
    """Return log p(P_B | M_A, T) (m,) for poses (paper, eq. P_B), -inf where a sample is rejected early.

    Args:
        poses: (m, 12) rows of the 3×4 matrices that carry B into A.
        points_b: (n, 3) surface points of B in m.
        ranges_m: (h, w) range of every pixel of A, 0 = no measurement.
        intrinsics: (4,) fx, fy, cx, cy of A in px.
        noise: (3, 3) L, the sensor's covariance in ray coordinates.
        options: (2,) reach in lateral standard deviations (inf = all pixels); density, as a share of K2, below
            which a point rejects the sample (0 = only where it vanishes).
    """
    result = np.empty(poses.shape[0])
    # In units of K2 for a point that is not turned, so that the threshold is a number of pixels, not of 1/m.
    unit = 1.0 / math.sqrt(inverse_3(2.0 * noise)[1])
    for i in numba.prange(poses.shape[0]):
        total = 0.0
        for j in range(points_b.shape[0]):
            density = point_density(points_b[j], poses[i], ranges_m, intrinsics, noise, options[0])
            if density <= options[1] * unit:
                total = NEVER
                break
            total += math.log(density)
        result[i] = total
    return result
