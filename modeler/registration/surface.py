"""Which points of a view's surface stand for it, and what the match of each is worth."""

import numpy as np

from modeler.kernels import planes
from modeler.rays import surface_points
from modeler.registration.posterior import intrinsics
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
        (n, 8): position in m, unit normal, variance along the normal in m², a gain of 0.
    """
    total = len(view.points_m)
    stride = max(total / count, 1.0)
    picks = np.arange(min(count, total)) * stride + rng.random() * stride
    chosen = np.minimum(picks.astype(np.int64), total - 1)
    variance = np.asarray(view.layers["variance_m2"], dtype=np.float64)[chosen, None]
    points = np.hstack([view.points_m[chosen], view.normals[chosen], variance, np.zeros((len(chosen), 1))])
    # In random order, so that every stride through them is again spread over the object.
    return points[rng.permutation(len(points))]


def relief_m(view: RayImage, points: Array, reaches: tuple[float, ...]) -> Array:
    """Return how far (n,) in m the surface around each point is from going on smoothly.

    Heights over the tangent plane are read at half and at the whole of a distance. On a plane, a cylinder or a sphere
    they grow with its square, so that the near one predicts the far one; what it misses is relief. Directions in which
    the surface ends say nothing.

    Args:
        view: whose image is looked up.
        points: (n, 8) of that view, as `spread_points` gives them.
        reaches: the distances, as shares of the object's size.
    """
    size_m = float(np.sqrt(np.sum(np.var(view.points_m, axis=0))))
    relief = np.zeros(len(points))
    for reach in reaches:
        misses = []
        for angle in np.arange(8) * np.pi / 4:
            near, far = (heights_m(view, points, angle, share * reach * size_m) for share in (0.5, 1.0))
            misses.append((4.0 * near - far) / 3.0)
        squares = np.square(np.stack(misses))
        known = np.isfinite(squares)
        mean = np.where(known, squares, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        # The weights with which three planes enter a miss add up to the variance of about three of them.
        relief = np.maximum(relief, np.sqrt(np.maximum(mean - 3.0 * points[:, 6], 0.0)))
    return relief


def heights_m(view: RayImage, points: Array, angle_rad: float, distance_m: float) -> Array:
    """Return the height (n,) over points' tangent planes of the surface at an offset in the image; NaN without any."""
    camera = view.frame.camera
    cells = view.layers["cells"]
    x, y, z = points[:, :3].T
    column = np.rint(camera.cx + camera.fx * (x + distance_m * np.cos(angle_rad)) / z).astype(np.int64)
    row = np.rint(camera.cy + camera.fy * (y + distance_m * np.sin(angle_rad)) / z).astype(np.int64)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    found = inside & (cells[row, column, planes.KIND] == planes.SURFACE)
    there, _ = surface_points(cells, row[found], column[found], intrinsics(view))
    height_m = np.full(len(points), np.nan)
    height_m[found] = np.sum((there - points[found, :3]) * points[found, 3:6], axis=1)
    return height_m
