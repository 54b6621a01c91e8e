"""Mixtures of Gaussians on SE(3): their log density at many poses."""

import math

import numba
import numpy as np

from modeler.kernels.moves import logarithm


@numba.njit(cache=True, parallel=True, error_model="numpy")
def log_densities(poses, means, roots, log_weights, centre):
    """Return the log density (n,) at each pose, with respect to the uniform measure of rotation (rad³) and translation.

    Args:
        poses: (n, 12) upper three rows of their matrices.
        means: (k, 12) of the components, likewise.
        roots: (k, 6, 6) upper triangular R with RᵀR the precision of ξ = log(mean⁻¹ pose) about the centre.
        log_weights: (k,) whose exponentials sum to 1.
        centre: (3,) point in m.
    """
    result = np.empty(poses.shape[0])
    half_dimensions = 3.0 * math.log(2.0 * math.pi)
    for i in numba.prange(poses.shape[0]):
        r, shift, xi = np.empty((3, 3)), np.empty(3), np.empty(6)
        b = poses[i]
        total, top = 0.0, -np.inf
        for k in range(means.shape[0]):
            a = means[k]
            for u in range(3):
                shift[u] = b[4 * u + 3] - a[4 * u + 3]
                for v in range(3):
                    shift[u] += b[4 * u + v] * centre[v]
            moved_x = a[0] * shift[0] + a[4] * shift[1] + a[8] * shift[2] - centre[0]
            moved_y = a[1] * shift[0] + a[5] * shift[1] + a[9] * shift[2] - centre[1]
            moved_z = a[2] * shift[0] + a[6] * shift[1] + a[10] * shift[2] - centre[2]
            for u in range(3):
                for v in range(3):
                    r[u, v] = a[u] * b[v] + a[4 + u] * b[4 + v] + a[8 + u] * b[8 + v]
            xi[0], xi[1], xi[2], xi[3], xi[4], xi[5] = logarithm(r, moved_x, moved_y, moved_z)
            density = log_weights[k] - half_dimensions
            for u in range(6):
                z = 0.0
                for v in range(u, 6):
                    z += roots[k, u, v] * xi[v]
                density += math.log(roots[k, u, u]) - 0.5 * z * z
            # ξ runs wider than the uniform measure: by (2 - 2 cos a) / a² for rotation, and as much for translation.
            square = xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2]
            if square > 1e-6:
                density -= 2.0 * math.log((2.0 - 2.0 * math.cos(math.sqrt(square))) / square)
            if density > top:
                total = total * math.exp(top - density) + 1.0
                top = density
            else:
                total += math.exp(density - top)
        result[i] = top + math.log(total)
    return result
