"""Classification of unseen space: observations of grid cells, and the surface of least area that closes gaps."""

import math

import numpy as np

from modeler.kernels.cache import njit
from modeler.kernels.threads import over_rows
from modeler.kernels.votes import project


def observation_counts(origin, cell_m, shape, margin_m, free_m, poses, intrinsics, planes):
    """Return the numbers of views that see grid cells empty, at a surface, and hidden behind one, (3, x, y, z) uint16.

    A cell below the view's support plane counts as empty.

    Args:
        origin: (3,) lowest corner of the grid in m.
        cell_m: side of a cell; its centre is tested.
        shape: (3,) cells along each axis.
        margin_m: least distance of empty cells from the end of the empty space, or below the plane.
        free_m: (f, h, w) float32 depth up to which a pixel sees empty space, 0 = unknown.
        poses: (f, 3, 4) camera_from_object.
        intrinsics: (f, 4) fx, fy, cx, cy.
        planes: (f, 4) normal and offset in the object frame, NaN if no plane is seen.
    """
    layers = np.arange(shape[0])
    return over_rows(
        _observation_counts, layers, origin, cell_m, shape, margin_m, free_m, poses, intrinsics, planes
    ).transpose(1, 0, 2, 3)


@njit(cache=True, nogil=True)
def _observation_counts(layers, origin, cell_m, shape, margin_m, free_m, poses, intrinsics, planes):
    frames, height, width = free_m.shape
    counts = np.zeros((layers.shape[0], 3, shape[1], shape[2]), dtype=np.uint16)
    for i in range(layers.shape[0]):
        x = origin[0] + (layers[i] + 0.5) * cell_m
        for j in range(shape[1]):
            y = origin[1] + (j + 0.5) * cell_m
            for k in range(shape[2]):
                z = origin[2] + (k + 0.5) * cell_m
                for f in range(frames):
                    if planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z + planes[f, 3] < -margin_m:
                        counts[i, 0, j, k] += 1
                        continue
                    u, v, depth = project(poses[f], intrinsics[f], x, y, z)
                    if depth > 0.0 and -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5:
                        free = free_m[f, int(v + 0.5), int(u + 0.5)]
                        if free > 0.0:
                            counts[i, int(depth >= free - margin_m) + int(depth > free + margin_m), j, k] += 1
    return counts


def minimal_surface(start, fixed, rounds):
    """Return the field (x, y, z) of least total variation with the given fixed values (eq. 12.12).

    Its zero level set has the least area: the total variation of a field that jumps between -1 and 1 is twice the area
    of the jump. Solved by the primal-dual algorithm of Chambolle and Pock 2011 ("A first-order primal-dual algorithm
    for convex problems with applications to imaging", algorithm 1 with θ = 1).

    Args:
        start: (x, y, z) float32 in [-1, 1].
        fixed: (x, y, z) bool; the outermost cells must be fixed.
        rounds: number of iterations.
    """
    u, ahead = start.copy(), start.copy()
    if len(start) < 3:  # all cells are outermost
        return u
    slopes = [np.zeros_like(start) for _ in range(3)]
    step = np.float32(1.0 / math.sqrt(12.0))  # τ σ ‖∇‖² <= 1, with ‖∇‖² <= 12 in three dimensions
    for _ in range(rounds):
        over_rows(_ascend, np.arange(len(start) - 1), *slopes, ahead, step, in_place=True)
        over_rows(_descend, np.arange(1, len(start) - 1), u, ahead, *slopes, fixed, step, in_place=True)
    return u


@njit(cache=True, nogil=True)
def _ascend(layers, px, py, pz, ahead, step):
    """Dual step in successive layers: ascend the field's gradient, and project the slopes to unit length, in place."""
    ny, nz = ahead.shape[1:]
    for i in range(layers[0], layers[-1] + 1):
        for j in range(ny - 1):
            for k in range(nz - 1):
                here = ahead[i, j, k]
                a = px[i, j, k] + step * (ahead[i + 1, j, k] - here)
                b = py[i, j, k] + step * (ahead[i, j + 1, k] - here)
                c = pz[i, j, k] + step * (ahead[i, j, k + 1] - here)
                size = a * a + b * b + c * c
                if size > 1.0:
                    size = np.float32(1.0) / np.float32(math.sqrt(size))
                    a, b, c = a * size, b * size, c * size
                px[i, j, k], py[i, j, k], pz[i, j, k] = a, b, c
    return layers


@njit(cache=True, nogil=True)
def _descend(layers, u, ahead, px, py, pz, fixed, step):
    """Primal step in successive layers: descend the slopes' divergence where u is not fixed; u and ahead in place."""
    ny, nz = u.shape[1:]
    for i in range(layers[0], layers[-1] + 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                if fixed[i, j, k]:
                    continue
                divergence = (
                    px[i, j, k] - px[i - 1, j, k] + py[i, j, k] - py[i, j - 1, k] + pz[i, j, k] - pz[i, j, k - 1]
                )
                old = u[i, j, k]
                new = min(np.float32(1.0), max(np.float32(-1.0), old + step * divergence))
                u[i, j, k] = new
                ahead[i, j, k] = np.float32(2.0) * new - old
    return layers
