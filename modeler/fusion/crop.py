"""One view cut to the object, with small planes where registration makes no surface point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter

from modeler import se3
from modeler.kernels.surfels import surfels
from modeler.types import Array, RayImage

GREY = 128  # colour of what no view with colour sees
SMOOTHED = 0.5  # noise of a surface point, smoothed over its neighbours, against that of its pixel
STEEPEST_RAD = 1.40  # a step between neighbouring pixels steeper than this (80°) is an edge, not a surface


@dataclass(frozen=True, eq=False)
class Crop:
    """One view cut to a window: its images there, and the surface points seen in it, in camera coordinates."""

    index: npt.NDArray[np.int32]
    """(h, w) number of the surface point at a pixel, -1 = none."""
    free_m: npt.NDArray[np.float32]
    """(h, w), and the next: as in `DepthViews`."""
    beside_m: npt.NDArray[np.float32]
    colour: npt.NDArray[np.uint8] | None
    """(h, w, 3) RGB."""
    lens: Array
    """(4,) fx, fy, cx, cy of the window's pixels."""
    points_m: Array
    """(n, 3)."""
    normals: Array
    """(n, 3) unit normals."""
    weights: Array
    """(n,) 1 = seen head-on, away from edges."""
    colours: npt.NDArray[np.uint8]
    """(n, 3) RGB of the points."""


def colours_at(view: RayImage) -> npt.NDArray[np.uint8]:
    """Return the RGB (n, 3) of a view's surface points, grey where the view has no colour."""
    return _sampled(view.frame.colour, view.pixels)


def _sampled(colour: npt.NDArray[np.uint8] | None, pixels: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    """Return the RGB (n, 3) of pixels (n, 2), grey without an image."""
    if colour is None:
        return np.full((len(pixels), 3), GREY, dtype=np.uint8)
    return colour[pixels[:, 0], pixels[:, 1]]


def window(view: RayImage, camera_from_object: Array, corners_m: Array) -> tuple[slice, slice]:
    """Return the rows and columns in which a box, given by its corners, is seen."""
    camera = view.frame.camera
    x, y, z = se3.transform(camera_from_object, corners_m).T
    if np.any(z <= 0.0):  # the box reaches behind the camera
        return slice(0, camera.height), slice(0, camera.width)
    columns, rows = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    top, bottom = (int(n) for n in np.clip([np.floor(rows.min()), np.ceil(rows.max()) + 1.0], 0, camera.height))
    left, right = (int(n) for n in np.clip([np.floor(columns.min()), np.ceil(columns.max()) + 1.0], 0, camera.width))
    return slice(top, bottom), slice(left, right)


def crop(view: RayImage, where: tuple[slice, slice], *, margin_px: int, min_cosine: float, edge_weight: float) -> Crop:
    """Crop a view to a window.

    Where the view has no surface point, at silhouettes, on thin parts and at flat angles, small planes through the
    measured depth stand in.
    """
    frame, camera = view.frame, view.frame.camera
    corner = np.array([where[0].start, where[1].start])
    depth_m = frame.depth_m[where]
    colour = None if frame.colour is None else frame.colour[where]
    measured = np.isfinite(depth_m) & (depth_m > 0.0)
    mask = measured if frame.mask is None else measured & frame.mask[where]
    lens = np.array([camera.fx, camera.fy, camera.cx - corner[1], camera.cy - corner[0]])

    pixels = view.pixels - corner
    inside = np.all((pixels >= 0) & (pixels < depth_m.shape), axis=1)
    rest = mask.copy()
    rest[tuple(pixels[inside].T)] = False
    others = np.argwhere(rest)
    points_m, normals = surfels(depth_m, others, mask, lens, view.sigma_r_m, np.tan(STEEPEST_RAD))
    found = np.any(normals != 0.0, axis=1)
    pixels = np.concatenate([pixels[inside], others[found]])
    points_m = np.concatenate([view.points_m[inside], points_m[found]])
    normals = np.concatenate([view.normals[inside], normals[found]])

    # An edge is where a neighbour is no part of the object, or too far away for a surface in between.
    far = maximum_filter(np.where(mask, depth_m, -np.inf), size=3)
    near = minimum_filter(np.where(mask, depth_m, np.inf), size=3)
    with np.errstate(invalid="ignore"):
        step = far - near > 2.0 * depth_m / camera.fx * np.tan(STEEPEST_RAD) + 4.0 * view.sigma_r_m
    edges = step | np.logical_not(minimum_filter(mask, size=3))
    cosine = -np.sum(points_m * normals, axis=1) / np.linalg.norm(points_m, axis=1)
    weights = cosine * np.where(edges[tuple(pixels.T)], edge_weight, 1.0)
    kept = cosine >= min_cosine
    pixels = pixels[kept]
    index = np.full(depth_m.shape, -1, dtype=np.int32)
    index[tuple(pixels.T)] = np.arange(len(pixels))
    around = np.asarray(maximum_filter(mask, size=2 * margin_px + 1, mode="nearest"), dtype=bool)
    return Crop(
        index=index,
        free_m=free_of(depth_m, margin_px),
        beside_m=np.where(measured & ~around, depth_m, 0.0).astype(np.float32),
        colour=colour,
        lens=lens,
        points_m=points_m[kept],
        normals=normals[kept],
        weights=weights[kept],
        colours=_sampled(colour, pixels),
    )


def free_of(depth_m: npt.NDArray[np.float32], margin_px: int) -> npt.NDArray[np.float32]:
    """Return up to which depth (h, w) the space along pixels is seen empty: as far as all around each are, 0 = unknown.

    Args:
        depth_m: (h, w), not positive or NaN where nothing is measured, which forbids nothing.
        margin_px: how far around.
    """
    measured = np.isfinite(depth_m) & (depth_m > 0.0)
    reach_m = minimum_filter(np.where(measured, depth_m, np.inf), size=2 * margin_px + 1, mode="nearest")
    return np.where(measured, reach_m, 0.0).astype(np.float32)


def pose_variances(part: Crop, covariance: Array | None, sigma_r_m: float) -> Array:
    """Return the variances (n,) of points along their normals that the pose's error makes, against a pixel's own.

    Args:
        part: a view.
        covariance: (6, 6) of its object_from_camera; None: exact.
        sigma_r_m: the pixels' noise along the ray.
    """
    if covariance is None:
        return np.zeros(len(part.points_m))
    # A pose moved by ξ = (ω, v) moves a point p along its normal n by ω · (p × n) + v · n.
    rows = np.concatenate([np.cross(part.points_m, part.normals), part.normals], axis=1)
    return np.einsum("ni,ij,nj->n", rows, covariance, rows) / (SMOOTHED * sigma_r_m) ** 2
