"""Which points of a view's surface stand for it."""

import numpy as np

from modeler.types import Array, RayImage


def measured_share(view: RayImage) -> float:
    """Return the share of pixels around the surface points that carry a measurement: low for very sparse images."""
    rows_, columns = view.pixels[:: max(len(view.pixels) // 500, 1)].T
    height, width = view.frame.depth_m.shape
    steps = np.arange(-2, 3)
    near_rows = np.clip(rows_[:, None, None] + steps[:, None], 0, height - 1)
    near_columns = np.clip(columns[:, None, None] + steps, 0, width - 1)
    return float(np.mean(view.frame.depth_m[near_rows, near_columns] > 0))


def spread_points(view: RayImage, count: int, rng: np.random.Generator) -> Array:
    """Return `count` surface points, or all if fewer, evenly spread over the image.

    Returns:
        (n, 7): position in m, unit normal, variance along the normal in m².
    """
    total = len(view.points_m)
    stride = max(total / count, 1.0)
    picks = np.arange(min(count, total)) * stride + rng.random() * stride
    chosen = np.minimum(picks.astype(np.int64), total - 1)
    variance = np.asarray(view.layers["variance_m2"], dtype=np.float64)[chosen, None]
    points = np.hstack([view.points_m[chosen], view.normals[chosen], variance])
    # In random order, so that every stride through them is again spread over the object.
    return points[rng.permutation(len(points))]
