"""Patches of a surface: halves of halves."""

import numba
import numpy as np


@numba.njit(cache=True)
def halved(points, halvings):
    """Return the patch number (n,) of each point (n, 3): halves of halves, each cut across its longest side.

    Args:
        points: (n, 3).
        halvings: number of cuts that part a point from any of another patch; there are 2 to this power.
    """
    order, starts = np.arange(len(points)), np.array([0, len(points)])
    for _ in range(halvings):
        cut = np.empty(2 * len(starts) - 1, dtype=np.int64)
        for number in range(len(starts) - 1):
            group = order[starts[number] : starts[number + 1]]
            best, side = -1.0, 0
            for k in range(3):
                extent = 0.0
                if len(group):
                    extent = np.max(points[group, k]) - np.min(points[group, k])
                if extent > best:
                    best, side = extent, k
            group[:] = group[np.argsort(points[group, side], kind="mergesort")]
            cut[2 * number], cut[2 * number + 1] = starts[number], starts[number] + len(group) // 2
        cut[-1] = len(points)
        starts = cut
    patches = np.empty(len(points), dtype=np.int64)
    for number in range(len(starts) - 1):
        patches[order[starts[number] : starts[number + 1]]] = number
    return patches
