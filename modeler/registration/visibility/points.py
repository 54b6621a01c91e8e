"""Surface points of a view for the likelihood: which are chosen, and their layout."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from modeler.kernels import planes
from modeler.types import Array, Camera, RayImage

IntArray = npt.NDArray[np.int64]

OWN_RIM = 9  # column of `point_rows`: the weight in the view of the points


def spread_points(view: RayImage, count: int, rng: np.random.Generator) -> IntArray:
    """Return the indices of `count` surface points, or of all if fewer, evenly spread over the image.

    They are taken along a space-filling curve, so that every stride through them is again evenly spread and results
    depend little on the choice of points.
    """
    total = len(view.points_m)
    stride = max(total / count, 1.0)
    picks = np.arange(min(count, total)) * stride + rng.random() * stride
    return view.along_curve[np.minimum(picks.astype(np.int64), total - 1)]


def points_of(view: RayImage, chosen: IntArray) -> Array:
    """Return the `point_rows` of a view's surface points with these indices."""
    variances_m2 = np.asarray(view.layers["variance_m2"][chosen], dtype=np.float64)
    rows, columns = view.pixels[chosen].T
    rims = np.asarray(view.layers["cells"][rows, columns, planes.RIM], dtype=np.float64)
    return point_rows(view.points_m[chosen], view.normals[chosen], variances_m2, view.frame.camera, rims)


def point_rows(
    points_m: Array, normals: Array, variances_m2: Array, camera: Camera, rims: Array | None = None
) -> Array:
    """Return points (n, 10) for a `DirectedLikelihood`.

    Args:
        points_m: (n, 3) in the frame of the view that shows them.
        normals: (n, 3) unit normals.
        variances_m2: (n,) along the normals.
        camera: of that view.
        rims: (n,) weights of errors near the silhouette; 0 if not given.
    """
    pixels = points_m[:, :2] / points_m[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    rims = np.zeros(len(points_m)) if rims is None else rims
    return np.hstack([points_m, normals, variances_m2[:, None], pixels, rims[:, None]])
