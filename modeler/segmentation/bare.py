"""Depth images of the object and nothing else: before a background out of reach, or cut out by whoever made them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modeler.segmentation.clusters import mixed_pixels, without_specks
from modeler.segmentation.layers import planning_stride, point_image
from modeler.segmentation.noise import DepthNoise
from modeler.segmentation.plane_fit import heights
from modeler.segmentation.planes import dominant_planes, upright
from modeler.types import BoolArray, Camera, Float32Array

_MOST = 0.5  # of the image's pixels; more are a scene
_ON_BORDER = 0.005  # of the pixels along the image's edge; more are a scene that goes on
_ON_PLANE, _ABOVE, _BELOW = 0.1, 0.01, 0.2  # of the points: at least, at least and at most where a plane is a support
_MOSTLY = 0.7  # of the frames
_SPECK_SHARE = 0.003  # of the island; smaller pieces are none of it


def shows_object_alone(depths_m: Sequence[Float32Array], camera: Camera, noise: DepthNoise) -> bool:
    """Return whether depth images (n of (h, w), NaN = no measurement) show an island in emptiness, on no support."""
    alone = [is_island(depth) and not _supported(depth, camera, noise) for depth in depths_m if _seen(depth).any()]
    return bool(alone) and sum(alone) >= _MOSTLY * len(alone)


def is_island(depth_m: Float32Array) -> bool:
    """Return whether what was measured (h, w) hardly reaches the edge of the image, and is not most of it."""
    seen = _seen(depth_m)
    border = np.concatenate([seen[0], seen[-1], seen[1:-1, 0], seen[1:-1, -1]])
    return bool(seen.mean() < _MOST and border.mean() < _ON_BORDER)


def clean(depth_m: Float32Array, camera: Camera, noise: DepthNoise) -> BoolArray:
    """Return the pixels (h, w) of an island but for specks and those that mix two surfaces."""
    mixed = mixed_pixels(depth_m, tolerance_m=noise.tolerance_m(depth_m), pixel_m=depth_m / np.float32(camera.fx))
    return without_specks(_seen(depth_m) & ~mixed, _SPECK_SHARE)


def _seen(depth_m: Float32Array) -> BoolArray:
    return np.isfinite(depth_m)


def _supported(depth_m: Float32Array, camera: Camera, noise: DepthNoise) -> bool:
    """Return whether one of the planes that face up has something on it, and little below: its own side."""
    stride = planning_stride(camera)
    points = point_image(depth_m[::stride, ::stride], camera, stride=stride)
    planes = dominant_planes(points, noise)
    seen = points[np.isfinite(points[..., 2])]
    tolerance = noise.tolerance_m(seen[:, 2])
    for plane in planes[upright(planes)]:
        height = heights(seen, plane)
        above, below = np.mean(height > tolerance), np.mean(height < -tolerance)
        if above > _ABOVE and below < _BELOW and 1.0 - above - below > _ON_PLANE:
            return True
    return False
