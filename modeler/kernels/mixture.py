"""Gaussians on SE(3): the density of their mixtures, how far apart they lie, and which of them crowd."""

import math

import numba
import numpy as np

from modeler.kernels.moves import difference

_NEGLIGIBLE = 40.0  # nats below the best Gaussian


@numba.njit(cache=True, parallel=True, error_model="numpy")
def log_densities(poses, means, roots, log_weights, centre):
    """Return the log density (n,) at each pose, with respect to the uniform measure of rotation (rad³) and translation.

    Args:
        poses: (n, 12) upper three rows of their matrices.
        means: (k, 12) of the components, likewise.
        roots: (k, 6, 6) upper triangular R with RᵀR the precision of ξ = log(mean⁻¹ pose) about the centre.
        log_weights: (k,) of any sum of exponentials.
        centre: (3,) point in m.
    """
    log_tops = log_weights - 3.0 * math.log(2.0 * math.pi)
    for k in range(len(means)):
        for u in range(6):
            log_tops[k] += math.log(roots[k, u, u])
    result = np.empty(poses.shape[0])
    for i in numba.prange(poses.shape[0]):
        total, top, r = 0.0, -np.inf, np.empty((3, 3))
        for k in range(means.shape[0]):
            xi = difference(means[k], poses[i], centre, r)
            density = log_tops[k]
            for u in range(6):
                z = 0.0
                for v in range(u, 6):
                    z += roots[k, u, v] * xi[v]
                density -= 0.5 * z * z
            if density < top - _NEGLIGIBLE:
                continue
            narrower = (0.5 * xi[6]) ** 4
            if density > top:
                total = total * math.exp(top - density) + narrower
                top = density
            else:
                total += narrower * math.exp(density - top)
        result[i] = top + math.log(total)
    return result


@numba.njit(cache=True)
def distances(means, roots, centre):
    """Return how far each Gaussian's mean lies from each: (k, k), row i in standard deviations of the i-th Gaussian.

    Args:
        means: (k, 12) rows of the poses.
        roots: (k, 6, 6) lower triangular L with L Lᵀ the covariance of ξ about the centre.
        centre: (3,) point in m.
    """
    count = len(means)
    result, rotation, z = np.zeros((count, count)), np.empty((3, 3)), np.empty(6)
    for i in range(count):
        for j in range(count):
            xi = difference(means[i], means[j], centre, rotation)
            square = 0.0
            for k in range(6):
                z[k] = xi[k]
                for m in range(k):
                    z[k] -= roots[i, k, m] * z[m]
                z[k] /= roots[i, k, k]
                square += z[k] * z[k]
            result[i, j] = math.sqrt(square)
    return result


@numba.njit(cache=True)
def uncrowded(poses, sigmas, centre, crowd, most):
    """Return the numbers of the first poses, of each neighbourhood at most `crowd`, and at most so many in all.

    Args:
        poses: (n, 12), the best first.
        sigmas: (6,) extent of a neighbourhood: ξ about the centre within one standard deviation.
        centre: (3,) point in m.
        crowd: at most so many lie in the neighbourhood of the next.
        most: at most so many are returned.
    """
    kept, rotation = np.empty(min(len(poses), most), dtype=np.int64), np.empty((3, 3))
    count = 0
    for i in range(len(poses)):
        near = 0
        for number in range(count):
            xi = difference(poses[kept[number]], poses[i], centre, rotation)
            square = 0.0
            for k in range(6):
                square += (xi[k] / sigmas[k]) ** 2
            if square <= 1.0:
                near += 1
        if near < crowd:
            kept[count] = i
            count += 1
            if count == len(kept):
                break
    return kept[:count]
