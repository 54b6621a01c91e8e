"""Band-pass filters of an image that surface covers in part, sampled at surface points (method, eq. 7.1)."""

import math

import numpy as np

from modeler.kernels.cache import njit
from modeler.kernels.point_likelihood import HALF, ONE, VECTOR_MATHS, ZERO

_MIN_FRACTION = np.float32(1e-3)  # of a mean that is surface
_MIN_DEVIATION = 1e-6  # standard deviation of features, for images without any
_LIMIT = 3.0  # standard deviations, beyond which are 0.3 % of normal features
_ROUNDS, _TOLERANCE = 10, 1e-3  # of the fixed-point iteration between variance and limit


@njit(cache=True)
def look_up(colour, pixels, low, table, places, logs):
    """Write the pixels of surface points in a cropped image, and the logarithms of their colours.

    Args:
        colour: (h, w, 3) RGB.
        pixels: (n, 2) row and column of each point.
        low: (2,) row and column of the crop's first pixel.
        table: (256,) contribution of each channel's value to the logarithm.
        places: (n, 2) out; row and column in the crop.
        logs: (n,) out.
    """
    for j in range(pixels.shape[0]):
        row, column = pixels[j, 0], pixels[j, 1]
        places[j, 0], places[j, 1] = row - low[0], column - low[1]
        seen = colour[row, column]
        logs[j] = table[seen[0]] + table[seen[1]] + table[seen[2]]


@njit(cache=True)
def lay_out(places, colours, shading, images):
    """Write values at points into images (3, h, w), 0 elsewhere: colours (n,), shading (n,), and 1."""
    for j in range(places.shape[0]):
        row, column = places[j, 0], places[j, 1]
        images[0, row, column], images[1, row, column], images[2, row, column] = colours[j], shading[j], ONE


@njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS)
def blur(images, weights, blurred):
    """Write images blurred along both axes, with zeros beyond their borders.

    Args:
        images: (k, h, w).
        weights: (r + 1,) one half of the symmetric kernel, its centre first.
        blurred: (k, h, w) out.
    """
    count, height, width = images.shape
    reach = weights.shape[0] - 1
    line, across = np.zeros(width + 2 * reach, dtype=np.float32), np.empty((height, width), dtype=np.float32)
    for k in range(count):
        for y in range(height):
            line[reach : reach + width] = images[k, y]
            total, near = across[y], line[reach:]
            for x in range(width):
                total[x] = weights[0] * near[x]
            for r in range(1, reach + 1):
                left, right, weight = line[reach - r :], line[reach + r :], weights[r]
                for x in range(width):
                    total[x] += weight * (left[x] + right[x])
        for y in range(height):
            near = across[y]
            total = blurred[k, y]
            for x in range(width):
                total[x] = weights[0] * near[x]
            for r in range(1, reach + 1):
                weight = weights[r]
                if y >= r:
                    near = across[y - r]
                    for x in range(width):
                        total[x] += weight * near[x]
                if y + r < height:
                    near = across[y + r]
                    for x in range(width):
                        total[x] += weight * near[x]


@njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS)
def subtract_means(inner, outer, surface, band):
    """Write a band: Gaussian means over surface minus wider ones; 0 outside the surface.

    Args:
        inner: (k + 1, h, w) blurred images, the last of which is the fraction of surface.
        outer: the same with a wider blur.
        surface: (h, w) positive on the surface.
        band: (k, h, w) out.
    """
    count, height, width = band.shape
    for k in range(count):
        for y in range(height):
            for x in range(width):
                near, wide = max(inner[count, y, x], _MIN_FRACTION), max(outer[count, y, x], _MIN_FRACTION)
                difference = inner[k, y, x] / near - outer[k, y, x] / wide
                band[k, y, x] = difference if surface[y, x] > ZERO else ZERO


@njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS)
def subtract_shading(colours, shading, surface, floor, limit, valid):
    """Subtract the best-fitting multiple of the shading from colours, in place; set them to 0 where shading is large.

    Args:
        colours: (h, w) band of the colours.
        shading: (h, w) band of the shading.
        surface: (h, w) positive on the surface.
        floor: variance of the shading due to rounding.
        limit: of the shading's magnitude.
        valid: (h, w) out: whether shading is within the limit.
    """
    height, width = colours.shape
    product, power = ZERO, ZERO
    for y in range(height):
        for x in range(width):
            product += colours[y, x] * shading[y, x]
            power += shading[y, x] * shading[y, x] + (floor if surface[y, x] > ZERO else ZERO)
    share = product / power
    for y in range(height):
        for x in range(width):
            valid[y, x] = (surface[y, x] > ZERO) & (abs(shading[y, x]) <= limit)
            colours[y, x] = colours[y, x] - share * shading[y, x] if valid[y, x] else ZERO


@njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS)
def sample_layer(layer, inside, places, halvings, found):
    """Write the features of surface points in one band, interpolated linearly from the nearest cell of its image.

    Args:
        layer: (h, w) the band.
        inside: (h, w) whether each cell is valid; slopes across others are 0.
        places: (n, 2) row and column of each point, in px.
        halvings: number of times that the image was halved: a cell is 2 to this power px wide.
        found: (3, n) out: value, and derivatives by column and row in 1/px.
    """
    height, width = layer.shape
    scale = np.int32(1 << halvings)
    per_two, middle = HALF / np.float32(scale), HALF * np.float32(scale - 1)
    for j in range(places.shape[0]):
        row, column = places[j, 0] >> halvings, places[j, 1] >> halvings
        by_row, by_column = ZERO, ZERO
        if 0 < row < height - 1 and inside[row - 1, column] and inside[row + 1, column]:
            by_row = per_two * (layer[row + 1, column] - layer[row - 1, column])
        if 0 < column < width - 1 and inside[row, column - 1] and inside[row, column + 1]:
            by_column = per_two * (layer[row, column + 1] - layer[row, column - 1])
        down = np.float32(places[j, 0] - row * scale) - middle
        across = np.float32(places[j, 1] - column * scale) - middle
        found[0, j] = layer[row, column] + by_row * down + by_column * across
        found[1, j], found[2, j] = by_column, by_row


@njit(cache=True, error_model="numpy", fastmath=VECTOR_MATHS)
def winsorise(features):
    """Scale features to unit variance, and limit them to ±3 standard deviations.

    Otherwise a few dark spots could dominate the correlation. The variance is that after limiting, so that spots on
    less than a ninth of the surface are limited, larger prints are not.

    Args:
        features: (3, n) of the surface points, in place: value, and derivatives by column and row in 1/px.
    """
    count, scale, limit = features.shape[1], 0.0, np.float32(np.inf)
    for _ in range(_ROUNDS):
        total, square = 0.0, 0.0
        for j in range(count):
            value = np.float64(min(max(features[0, j], -limit), limit))
            total += value
            square += value * value
        variance = square / max(count, 1) - (total / max(count, 1)) ** 2
        last, scale = scale, max(math.sqrt(max(variance, 0.0)), _MIN_DEVIATION)
        limit = np.float32(_LIMIT * scale)
        if abs(scale - last) <= _TOLERANCE * scale:
            break
    inverse = np.float32(1.0 / scale)
    for j in range(count):
        slope = inverse if abs(features[0, j]) <= limit else ZERO
        features[0, j] = min(max(features[0, j], -limit), limit) * inverse
        features[1, j] *= slope
        features[2, j] *= slope
