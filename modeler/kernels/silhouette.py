"""The distance of pixels from an object's silhouette."""

import math

import numba
import numpy as np

from modeler.kernels.planes import bounds

_STEP, _DIAGONAL = np.float32(1.0), np.float32(math.sqrt(2.0))


@numba.njit(cache=True)
def silhouette_distance(mask, limit_px):
    """Return the distance (h, w) float32 in px of every pixel from the mask, cut at `limit_px`; by chamfer sweeps."""
    distance = np.full(mask.shape, limit_px, dtype=np.float32)
    top, bottom, left, right = bounds(mask)
    reach = math.ceil(limit_px)  # farther from the mask nothing changes
    first, last = max(top - reach, 0), min(bottom + reach, mask.shape[0]) - 1
    near = slice(max(left - reach, 0), right + reach)
    for row in range(first, last + 1):
        line = distance[row, near]
        for column in range(line.shape[0]):
            if mask[row, near.start + column]:
                line[column] = 0.0
        if row > first:
            take_over(line, distance[row - 1, near])
        run_along(line)
    for row in range(last, first - 1, -1):
        line = distance[row, near]
        if row < last:
            take_over(line, distance[row + 1, near])
        run_along(line[::-1])
    return distance


@numba.njit(cache=True)
def take_over(line, above):
    """Lower distances (w,) to what the neighbouring row hands on, straight and across."""
    last = line.shape[0] - 1
    for column in range(1, last):
        across = min(above[column - 1], above[column + 1]) + _DIAGONAL
        line[column] = min(line[column], above[column] + _STEP, across)
    for column, inner in ((0, min(1, last)), (last, max(last - 1, 0))):
        line[column] = min(line[column], above[column] + _STEP, above[inner] + _DIAGONAL)


@numba.njit(cache=True)
def run_along(line):
    """Hand distances (w,) on from each pixel to the next.

    As the least of distance less place so far: what each step waits for is one comparison, and no addition.
    """
    least = line[0]
    for column in range(1, line.shape[0]):
        place = np.float32(column)
        least = min(line[column] - place, least)
        line[column] = least + place
