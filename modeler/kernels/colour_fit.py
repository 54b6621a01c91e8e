"""Correlation of colours on surface that two views see, where colour is displaced against depth."""

import math

import numpy as np

from modeler.kernels.cache import njit

SCALE, SHIFT_X, SHIFT_Y, FLIP_X, FLIP_Y = 0, 1, 2, 3, 4
"""Columns of a displacement: size of things in colour relative to depth, shift in px, and 1 or -1 along both axes."""
_MIN_SQUARE = 1e-12  # of features, for images without any


@njit(cache=True, error_model="numpy", inline="always")
def _at(image, displacement, x, y):
    """Return the value of an image (h, w) where a pixel of depth is in colour, interpolated; NaN outside."""
    height, width = image.shape
    middle_x, middle_y = 0.5 * (width - 1), 0.5 * (height - 1)
    column = middle_x + displacement[FLIP_X] * (displacement[SCALE] * (x - middle_x) + displacement[SHIFT_X])
    row = middle_y + displacement[FLIP_Y] * (displacement[SCALE] * (y - middle_y) + displacement[SHIFT_Y])
    if not (0.0 <= column <= width - 1 and 0.0 <= row <= height - 1):
        return math.nan
    j, i = min(int(column), width - 2), min(int(row), height - 2)
    across, down = column - j, row - i
    above = (1.0 - across) * image[i, j] + across * image[i, j + 1]
    below = (1.0 - across) * image[i + 1, j] + across * image[i + 1, j + 1]
    return (1.0 - down) * above + down * below


@njit(cache=True, error_model="numpy")
def displaced_correlations(images, pairs, starts, places, displacements):
    """Return the correlation (m, k) of features of k pairs under m displacements; 0 if too few are in the image.

    Args:
        images: (v, h, w) features of the views.
        pairs: (k, 2) indices of the two views of each pair.
        starts: (k + 1,) where the places of each pair start.
        places: (n, 4) column and row of surface in the first view, and in the second.
        displacements: (m, 5).
    """
    found = np.zeros((displacements.shape[0], pairs.shape[0]))
    for m in range(displacements.shape[0]):
        for k in range(pairs.shape[0]):
            first, second = images[pairs[k, 0]], images[pairs[k, 1]]
            count, of_first, of_second, square_first, square_second, product = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for n in range(starts[k], starts[k + 1]):
                a = _at(first, displacements[m], places[n, 0], places[n, 1])
                b = _at(second, displacements[m], places[n, 2], places[n, 3])
                if math.isnan(a + b):
                    continue
                count += 1
                of_first += a
                of_second += b
                square_first += a * a
                square_second += b * b
                product += a * b
            if 2 * count < starts[k + 1] - starts[k]:
                continue
            square_first -= of_first * of_first / count
            square_second -= of_second * of_second / count
            product -= of_first * of_second / count
            found[m, k] = product / math.sqrt(max(square_first * square_second, _MIN_SQUARE))
    return found
