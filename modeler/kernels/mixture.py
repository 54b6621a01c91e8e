"""Gaussians on SE(3): densities of mixtures, Mahalanobis distances, and mixtures of two by EM."""

import math

import numpy as np

from modeler.kernels.cache import njit
from modeler.kernels.lie_group import difference
from modeler.kernels.threads import over_rows

_NEGLIGIBLE = 40.0  # nats below the best Gaussian
_ROWS = 1000  # least number of densities per thread: waking one takes as long as computing some hundred


def log_densities(poses, means, roots, widths, log_weights, centre):
    """Return the log density (n,) at each pose, with respect to the uniform measure of rotation (rad³) and translation.

    The trace of a rotation and the displacement of the centre give lower bounds of the distance from each Gaussian: the
    nearest by bound is evaluated first, then only those that may not be negligible.

    Args:
        poses: (n, 12) upper three rows of their matrices.
        means: (k, 12) of the components.
        roots: (k, 6, 6) upper triangular R with RᵀR the precision of ξ = log(mean⁻¹ pose) about the centre.
        widths: (k, 2) largest variances of a rotation and of a translation.
        log_weights: (k,), not necessarily normalised.
        centre: (3,) point in m.
    """
    least = max(_ROWS // len(means), 1)
    return over_rows(_log_densities, poses, means, roots, widths, log_weights, centre, least=least)


@njit(cache=True, nogil=True, error_model="numpy")
def _log_densities(poses, means, roots, widths, log_weights, centre):
    count = len(means)
    log_tops, bounds, places = np.empty(count), np.empty(count), np.empty((count, 3))
    for k in range(count):
        log_tops[k] = log_weights[k] - 3.0 * math.log(2.0 * math.pi)
        for u in range(6):
            log_tops[k] += math.log(roots[k, u, u])
        places[k, 0], places[k, 1], places[k, 2] = image_of_point(means[k], centre)
    result = np.empty(len(poses))
    for i in range(len(poses)):
        x, y, z = image_of_point(poses[i], centre)
        best = 0
        for k in range(count):
            square = (x - places[k, 0]) ** 2 + (y - places[k, 1]) ** 2 + (z - places[k, 2]) ** 2
            turned = max(3.0 - trace_between(means[k], poses[i]), 0.0)  # at most the square of the angle
            bounds[k] = log_tops[k] - 0.5 * max(turned / widths[k, 0], square / widths[k, 1])
            if bounds[k] > bounds[best]:
                best = k
        top, total = -math.inf, 0.0
        for turn in range(-1, count):  # one call of `log_density`: compiling is slow
            k = best if turn < 0 else turn
            if turn < 0 or (k != best and bounds[k] > top - _NEGLIGIBLE):
                density, narrower = log_density(means[k], poses[i], roots[k], log_tops[k], centre)
                if density > top:
                    total = total * math.exp(top - density) + narrower
                    top = density
                else:
                    total += narrower * math.exp(density - top)
        result[i] = top + math.log(total)
    return result


@njit(cache=True, inline="always")
def image_of_point(pose, point):
    """Return the image of a point (3,) under a pose (12,)."""
    return (
        pose[0] * point[0] + pose[1] * point[1] + pose[2] * point[2] + pose[3],
        pose[4] * point[0] + pose[5] * point[1] + pose[6] * point[2] + pose[7],
        pose[8] * point[0] + pose[9] * point[1] + pose[10] * point[2] + pose[11],
    )


@njit(cache=True, inline="always")
def trace_between(a, b):
    """Return the trace of the rotation between two poses (12,)."""
    return (
        (a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
        + (a[4] * b[4] + a[5] * b[5] + a[6] * b[6])
        + (a[8] * b[8] + a[9] * b[9] + a[10] * b[10])
    )


@njit(cache=True, inline="always")
def log_density(mean, pose, root, log_top, centre):
    """Return the log density of ξ at a pose (12,), and the factor to one with respect to the uniform measure."""
    w0, w1, w2, u0, u1, u2, scale = difference(mean, pose, centre)
    # Written out for speed: a loop over the tuple takes three times as long.
    z0 = root[0, 0] * w0 + root[0, 1] * w1 + root[0, 2] * w2 + root[0, 3] * u0 + root[0, 4] * u1 + root[0, 5] * u2
    z1 = root[1, 1] * w1 + root[1, 2] * w2 + root[1, 3] * u0 + root[1, 4] * u1 + root[1, 5] * u2
    z2 = root[2, 2] * w2 + root[2, 3] * u0 + root[2, 4] * u1 + root[2, 5] * u2
    z3 = root[3, 3] * u0 + root[3, 4] * u1 + root[3, 5] * u2
    z4, z5 = root[4, 4] * u1 + root[4, 5] * u2, root[5, 5] * u2
    square = (z0 * z0 + z1 * z1) + (z2 * z2 + z3 * z3) + (z4 * z4 + z5 * z5)
    return log_top - 0.5 * square, (0.5 * scale) ** 4


@njit(cache=True)
def mahalanobis_distances(means, roots, centre):
    """Return the distances (k, k) between means, row i in standard deviations of the i-th Gaussian.

    Args:
        means: (k, 12) rows of the poses.
        roots: (k, 6, 6) lower triangular L with L Lᵀ the covariance of ξ about the centre.
        centre: (3,) point in m.
    """
    count = len(means)
    result, z = np.zeros((count, count)), np.empty(6)
    for i in range(count):
        for j in range(count):
            xi = difference(means[i], means[j], centre)
            square = 0.0
            for k in range(6):
                z[k] = xi[k]
                for m in range(k):
                    z[k] -= roots[i, k, m] * z[m]
                z[k] /= roots[i, k, k]
                square += z[k] * z[k]
            result[i, j] = math.sqrt(square)
    return result


@njit(cache=True, error_model="numpy")
def separate_two(white, weights, members, steps, least, floor):
    """Divide weighted points between two Gaussians by expectation maximisation.

    Args:
        white: (n, 6) points.
        weights: (n,).
        members: (2, n) initial weights of the points in either Gaussian; overwritten by the final ones.
        steps: number of steps.
        least: fraction of the weight below which a Gaussian is not determined.
        floor: added to the variances.

    Returns:
        Whether both are determined.
    """
    count, total = len(weights), weights.sum()
    likely, centred = np.empty((2, count)), np.empty((6, count))
    for step in range(steps + 1):
        for of in range(2):
            share = members[of].sum()
            if share < least * total:
                return False
            if step == steps:
                continue
            for u in range(6):
                mean = 0.0
                for j in range(count):
                    mean += members[of, j] * white[j, u]
                mean /= share
                for j in range(count):
                    centred[u, j] = white[j, u] - mean
            root = np.zeros((6, 6))
            for u in range(6):
                for v in range(u + 1):
                    moment = 0.0
                    for j in range(count):
                        moment += members[of, j] * centred[u, j] * centred[v, j]
                    moment = moment / share + (floor if u == v else 0.0)
                    for k in range(v):
                        moment -= root[u, k] * root[v, k]
                    root[u, v] = math.sqrt(moment) if u == v else moment / root[v, v]
            top = math.log(share)
            for u in range(6):
                top -= math.log(root[u, u])
            likely[of] = top
            for u in range(6):
                for k in range(u):
                    for j in range(count):
                        centred[u, j] -= root[u, k] * centred[k, j]
                for j in range(count):
                    centred[u, j] /= root[u, u]
                    likely[of, j] -= 0.5 * centred[u, j] * centred[u, j]
        if step < steps:
            for j in range(count):
                first = 1.0 / (1.0 + math.exp(likely[1, j] - likely[0, j]))
                members[0, j], members[1, j] = weights[j] * first, weights[j] * (1.0 - first)
    return True
