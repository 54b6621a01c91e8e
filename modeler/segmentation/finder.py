"""The object in one frame of a known scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from scipy import ndimage

from modeler.segmentation.clusters import mixed_pixels, voxel_clusters, without_specks
from modeler.segmentation.layers import planning_stride, point_image
from modeler.segmentation.noise import DepthNoise
from modeler.segmentation.scene import Scene
from modeler.types import Array, BoolArray, Camera, Float32Array

Window = tuple[slice, slice]

_ZONE_MARGIN_M = 0.1  # how far the object may stray from where it was seen
_ZONE_MARGIN_SHARE = 0.3  # of the zone's size, if that is more
_STRAY_WEIGHT = 0.2  # of what lies outside that zone
_FLATTEST_SLOPE = 0.3  # height noise is no smaller than this part of the depth noise: the support is not quite plane
_CLEARANCE_M = 0.001
_LOW_M = 0.01  # creases of the support are no higher and lie apart from the rest
_LOW_SHARE = 0.3  # of the object's height, for flat objects
_LOW_REACH_M = 0.01
_SPECK_SHARE = 0.003


@final
@dataclass(frozen=True, eq=False)
class Found:
    """What was found of the object in one frame."""

    mask: BoolArray
    """(h, w) True = object."""
    area_m2: float = 0.0
    """Area that it shows to the camera."""
    rival: float = 0.0
    """Merit of the second-best cluster as a part of the best's."""


def find(depth_m: Float32Array, camera: Camera, scene: Scene, noise: DepthNoise, *, gap_m: float) -> Found:
    """Find the object in a depth image, NaN where nothing was measured or no object may be.

    Plans on a thinned image: what is above the support and before the scenery forms clusters in space, and the one that
    has most in the object's zone is chosen. Then its pixels are taken at full resolution.
    """
    if scene.zone_m is None:
        return Found(np.zeros(depth_m.shape, dtype=np.bool_))
    chosen = _choose(depth_m, camera, scene, noise, zone_m=scene.zone_m, gap_m=gap_m)
    mask = _refine(depth_m, camera, scene, noise, chosen=chosen.mask, reach_m=_reach_m(scene.zone_m))
    return replace(chosen, mask=mask)


def _choose(
    depth_m: Float32Array, camera: Camera, scene: Scene, noise: DepthNoise, *, zone_m: Array, gap_m: float
) -> Found:
    """Return what is found in the thinned image."""
    stride = planning_stride(camera)
    thin = np.ascontiguousarray(depth_m[::stride, ::stride])
    chosen = np.zeros(thin.shape, dtype=np.bool_)
    low, high = _reach_m(zone_m)
    window = _window((thin > low[2]) & (thin < high[2]), margin=0)
    row, column = window[0].start * stride, window[1].start * stride
    points = point_image(thin[window], camera, stride=stride, row=row, column=column)
    fore, _ = _foreground(points, window, scene, noise, thinning=1)
    fore &= _inside(points, low, high)
    if not fore.any():
        return Found(chosen)
    candidates = points[fore]
    labels = voxel_clusters(candidates, low_m=low, high_m=high, gap_m=gap_m)
    in_zone = _inside(candidates, *zone_m)
    area = candidates[:, 2] ** 2 * (stride**2 / (camera.fx * camera.fy))
    merit = np.bincount(labels, area * np.where(in_zone, 1.0, _STRAY_WEIGHT))
    best = int(merit.argmax())
    chosen[window][fore] = labels == best
    rival = float(np.delete(merit, best).max(initial=0.0) / merit[best])
    return Found(chosen, float(area[labels == best].sum()), rival)


def _refine(
    depth_m: Float32Array, camera: Camera, scene: Scene, noise: DepthNoise, *, chosen: BoolArray, reach_m: Array
) -> BoolArray:
    """Return the object's pixels at full resolution, given those in the thinned image."""
    stride = planning_stride(camera)
    mask = np.zeros(depth_m.shape, dtype=np.bool_)
    rows, columns = _window(chosen, margin=2)
    near = np.asarray(ndimage.binary_dilation(chosen[rows, columns], np.ones((3, 3))), dtype=np.bool_)
    height, width = depth_m.shape
    window = (
        slice(rows.start * stride, min(rows.stop * stride, height)),
        slice(columns.start * stride, min(columns.stop * stride, width)),
    )
    depth: Float32Array = depth_m[window]
    points = point_image(depth, camera, row=window[0].start, column=window[1].start)
    fore, above_m = _foreground(points, window, scene, noise, thinning=stride)
    fore &= np.repeat(np.repeat(near, stride, axis=0), stride, axis=1)[: depth.shape[0], : depth.shape[1]]
    fore &= (depth > reach_m[0, 2]) & (depth < reach_m[1, 2])
    if not fore.any():
        return mask
    if above_m is not None:
        fore &= _not_a_crease(above_m, fore, _LOW_REACH_M * camera.fx / float(np.median(depth[fore])))
    pixel = depth / np.float32(camera.fx)
    fore &= ~mixed_pixels(depth, tolerance_m=noise.tolerance_m(depth), pixel_m=pixel)
    mask[window] = without_specks(fore, _SPECK_SHARE)
    return mask


def _inside(points: Float32Array, low: Array, high: Array) -> BoolArray:
    """Return which points (..., 3) lie in a box."""
    inside = np.ones(points.shape[:-1], dtype=np.bool_)
    for axis in range(3):
        inside &= (points[..., axis] > np.float32(low[axis])) & (points[..., axis] < np.float32(high[axis]))
    return inside


def _reach_m(zone_m: Array) -> Array:
    """Return low and high corner (2, 3) of the box the object may have strayed to, of that (2, 3) where it was seen."""
    low, high = zone_m
    margin = max(_ZONE_MARGIN_M, _ZONE_MARGIN_SHARE * float((high - low).max()))
    return np.array([low - margin, high + margin])


def _foreground(
    points: Float32Array, window: Window, scene: Scene, noise: DepthNoise, *, thinning: int
) -> tuple[BoolArray, Float32Array | None]:
    """Return what is above the support and before the scenery (h, w), and its height (h, w) where there is a support.

    Args:
        points: (h, w, 3) part of an image of points.
        window: which part.
        scene: what is known.
        noise: of the depth camera.
        thinning: pixels of the image a pixel of the scene's images.
    """
    depth = points[..., 2]
    tolerance = noise.tolerance_m(depth)
    fore, height = np.isfinite(depth), None
    if scene.plane is not None:
        rise = points @ scene.plane.normal.astype(np.float32)
        height = rise + np.float32(scene.plane.offset_m)
        slope = np.maximum(np.abs(rise / depth), np.float32(_FLATTEST_SLOPE))
        fore &= height > tolerance * slope + np.float32(_CLEARANCE_M)
    if scene.scenery_m is not None:
        rows, columns = (np.arange(part.start, part.stop) // thinning for part in window)
        fore &= depth < scene.scenery_m[rows[:, None], columns] - tolerance
    return fore, height


def _not_a_crease(height_m: Float32Array, fore: BoolArray, reach_px: float) -> BoolArray:
    """Return the pixels (h, w) that are high above the support or near some that are."""
    low = min(_LOW_M, _LOW_SHARE * float(np.percentile(height_m[fore], 95)))
    high = (fore & (height_m > low)).astype(np.uint8)
    return ndimage.maximum_filter(high, 2 * max(1, round(reach_px)) + 1) > 0


def _window(mask: BoolArray, *, margin: int) -> Window:
    """Return the part of an image that holds a mask (h, w) and a margin."""
    if not mask.any():
        return slice(0, 0), slice(0, 0)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (
        slice(max(0, int(rows[0]) - margin), min(mask.shape[0], int(rows[-1]) + 1 + margin)),
        slice(max(0, int(columns[0]) - margin), min(mask.shape[1], int(columns[-1]) + 1 + margin)),
    )
