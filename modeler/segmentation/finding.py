"""Search for the object in one depth image of a known scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from modeler.segmentation.depth_images import (
    FEW,
    LEAST_PIECE,
    MOST,
    STRAY_WEIGHT,
    DepthNoise,
    Labels,
    mixed_pixels,
    pieces,
    planning_stride,
    point_image,
    voxel_clusters,
    window_of,
    without_specks,
)
from modeler.segmentation.scene import Scene
from modeler.types import Array, BoolArray, Camera, Float32Array, Frame, Plane

Window = tuple[slice, slice]
_ZONE_MARGIN_SHARE = 0.3
"""Share of the zone's size, if that is more; with 0.15 and 0.6, masks have an IoU of 0.999 with these."""
_ZONE_MARGIN = 0.14
"""Distance from the object's zone at which it may still be, as a share of its distance; halved or doubled, masks of a
plant have an IoU of 0.94 and 0.93 with these, others of 0.999 and more."""
_FLATTEST_SLOPE = 0.3  # least ratio of height noise to depth noise: supports are not exactly planar
_MOVED = 0.028  # of an object's outline between the frames from which its scene is learned, as a share of its distance
_GAP_FLOORS = 15.0  # least gap in noise floors, 12 mm: nearby, the parts of a plush toy are as far apart
_CREASE = 0.014
"""Creases of the support are at most so high, and so far from the object, as a share of its distance; halved or
doubled, masks of a plant have an IoU of 0.99 and 0.94 with these, others of 0.997 and more."""
AREA_FACTOR = 2.5
"""Factor by which the visible area may leave its range in the scene; with 1.25 a plant's mask is unsure, with 5
none."""


@dataclass(frozen=True, eq=False)
class Found:
    """The object in one frame."""

    mask: BoolArray
    """(h, w) True = object."""
    area_m2: float = 0.0
    """Area visible to the camera."""
    rival: float = 0.0
    """Score of the second-best cluster relative to the best."""
    goes_on: bool = False
    """Whether it continues beyond the object's region, like an arm that touches the object."""


def find(
    depth_m: Float32Array,
    camera: Camera,
    scene: Scene,
    noise: DepthNoise,
    *,
    gap: float,
    occluder: BoolArray | None = None,
) -> Found:
    """Find the object in a depth image, NaN where nothing was measured or no object may be.

    Points above the support and in front of the background are clustered at low resolution. The cluster with the
    largest area in the object's zone is chosen, with those that an occluder separates from it, and refined.
    """
    if scene.zone_m is None:
        return Found(np.zeros(depth_m.shape, dtype=np.bool_))
    gap_m = max(gap * _distance_m(scene.zone_m), _GAP_FLOORS * noise.floor_m)
    chosen = _choose(depth_m, camera, scene, noise, zone_m=scene.zone_m, gap_m=gap_m, occluder=occluder)
    mask = _refine(depth_m, camera, scene, noise, chosen=chosen.mask, reach_m=_reach_m(scene.zone_m), gap_m=gap_m)
    return replace(chosen, mask=mask)


@dataclass(frozen=True, eq=False)
class _Part:
    """The part of a downsampled depth image whose depths the object may have."""

    window: Window
    """Which part."""
    points: Float32Array
    """(h, w, 3)."""
    above: BoolArray
    """(h, w) what is above the support and in front of the background."""
    inside: BoolArray
    """(h, w) what is where the object may be."""
    on_edge: BoolArray
    """(h, w) the edge of the field of view."""
    pixel_m2: Float32Array
    """(h, w) area of a pixel."""
    reach_m: Array
    """(2, 3) low and high corner of where the object may be."""
    gap_m: float
    """Largest gap between parts of one thing."""

    @property
    def depth_m(self) -> Float32Array:
        """(h, w)."""
        return self.points[..., 2]

    def clusters(self, fore: BoolArray) -> Labels:
        """Label the pixels of a region (h, w) by what is one thing in space, (n,)."""
        return voxel_clusters(self.points[fore], low_m=self.reach_m[0], high_m=self.reach_m[1], gap_m=self.gap_m)

    @cached_property
    def outside(self) -> BoolArray:
        """(h, w) what is above the support where the object cannot be, without mixed pixels along outlines."""
        return np.asarray(ndimage.binary_opening(self.above & ~self.inside, np.ones((2, 2))), dtype=np.bool_)

    def next_to(self, region: BoolArray) -> BoolArray:
        """Return the pixels (h, w) next to those of a region, without a depth jump between them."""
        depth_m = self.depth_m
        low_m = ndimage.minimum_filter(np.where(region, depth_m, np.float32(np.inf)), 3)
        high_m = ndimage.maximum_filter(np.where(region, depth_m, np.float32(-np.inf)), 3)
        found: BoolArray = (depth_m > low_m - self.gap_m) & (depth_m < high_m + self.gap_m)
        return found

    def static(self, scene: Scene, noise: DepthNoise) -> BoolArray:
        """Return the pixels (h, w) that show what all frames show."""
        if scene.still_m is None:
            return np.zeros(self.above.shape, dtype=np.bool_)
        return np.abs(self.depth_m - scene.still_m[self.window]) < noise.tolerance_m(self.depth_m)


def _part(
    depth_m: Float32Array, camera: Camera, scene: Scene, noise: DepthNoise, *, zone_m: Array, gap_m: float
) -> _Part:
    """Return the part of a depth image (h, w) at the depths at which the object may be."""
    stride = planning_stride(camera)
    thin = np.ascontiguousarray(depth_m[::stride, ::stride])
    reach_m = _reach_m(zone_m)
    window = window_of((thin > reach_m[0, 2]) & (thin < reach_m[1, 2]), margin=0)
    row, column = window[0].start * stride, window[1].start * stride
    points = point_image(thin[window], camera, stride=stride, row=row, column=column)
    above, _ = _foreground(points, window, scene, noise, thinning=1)
    pixel_m2 = points[..., 2] ** 2 * (stride**2 / (camera.fx * camera.fy))
    on_edge = scene.edge[window] if scene.edge is not None else np.zeros_like(above)
    return _Part(window, points, above, _inside(points, *reach_m), on_edge, pixel_m2, reach_m, gap_m)


def _choose(
    depth_m: Float32Array,
    camera: Camera,
    scene: Scene,
    noise: DepthNoise,
    *,
    zone_m: Array,
    gap_m: float,
    occluder: BoolArray | None,
) -> Found:
    """Return the object in the downsampled image."""
    stride = planning_stride(camera)
    chosen = np.zeros(depth_m[::stride, ::stride].shape, dtype=np.bool_)
    part = _part(depth_m, camera, scene, noise, zone_m=zone_m, gap_m=gap_m)
    fore = part.above & part.inside
    if not fore.any():
        return Found(chosen)
    arm = _arm(part, scene, zone_m)
    fore &= ~arm
    if not fore.any():
        return Found(chosen)
    labels, in_zone = part.clusters(fore), _inside(part.points[fore], *zone_m)
    labels = _split(labels, _mostly(~in_zone, labels), part.depth_m, fore)
    area_m2, static = part.pixel_m2[fore], part.static(scene, noise)[fore]
    merit = np.bincount(labels, area_m2 * np.where(in_zone, 1.0, STRAY_WEIGHT))
    merit[_many(part.on_edge[fore], labels)] *= STRAY_WEIGHT
    merit[_mostly(static, labels)] *= STRAY_WEIGHT
    best = int(merit.argmax())
    chosen[part.window][fore] = labels == best
    blocking = chosen.copy() if occluder is None else chosen | occluder[::stride, ::stride]
    blocking[part.window] |= arm
    if scene.areas_m2 is None:  # what moves shows the zone only roughly
        margin_m = _ZONE_MARGIN_SHARE * float(np.ptp(zone_m, axis=0).max())
        in_zone = _inside(part.points[fore], zone_m[0] - margin_m, zone_m[1] + margin_m) & ~static
    own = _joined(best, labels, in_zone, _beside(blocking)[part.window][fore])
    chosen[part.window][fore] = own[labels]
    rival = float(merit[~own].max(initial=0.0) / merit[best])
    goes_on = _many(part.next_to(part.above & ~fore)[fore], (~own[labels]).astype(np.int32))[0]
    return Found(chosen, float(area_m2[own[labels]].sum()), rival, goes_on=bool(goes_on))


def _mostly(chosen: BoolArray, labels: Labels) -> BoolArray:
    """Return which labels (k,) most of whose pixels (n,) are chosen."""
    return np.bincount(labels, chosen) > 0.5 * np.bincount(labels)


def _many(ends: BoolArray, labels: Labels) -> BoolArray:
    """Return which labels (k,) so many of whose pixels (n,) are at an end that they continue there."""
    return np.bincount(labels, ends) > FEW * np.sqrt(np.bincount(labels))


def _arm(part: _Part, scene: Scene, zone_m: Array) -> BoolArray:
    """Return the pixels (h, w) of an arm that may touch the object (docs/method/segmentation.md).

    It leads out of view, or out of where the object may be, and is nearer than the object ever was; where arms are in
    most frames, it may also be what leads out of view above the support.
    """
    fore, none = part.above & part.inside, np.zeros_like(part.above)
    ends = fore & (part.next_to(part.outside) | part.on_edge)
    if not ends.any():
        return none
    labels, in_zone, suspect = part.clusters(fore), fore & _inside(part.points, *zone_m), none.copy()
    suspect[fore] = _many(ends[fore], labels)[labels]
    hovering = _hovering(part, suspect, ends, scene.plane) if scene.arms and scene.plane else none
    if scene.nearest_m is None or scene.areas_m2 is None:
        return hovering
    nearest_m = scene.nearest_m[part.window] - part.gap_m
    for without in (hovering, none) if hovering.any() else (none,):
        for nearer in _in_front(part, suspect & ~without, nearest_m):
            arm = without | nearer
            # If less than the object is left, it was removed as well.
            if part.pixel_m2[in_zone & ~arm].sum() > scene.areas_m2[0] / AREA_FACTOR:
                return arm
    return none


def _hovering(part: _Part, suspect: BoolArray, ends: BoolArray, support: Plane) -> BoolArray:
    """Return the suspect pixels (h, w) of pieces that lead out of view and do not reach down to the support."""
    parts = pieces(part.depth_m, suspect | part.outside, part.gap_m)
    leads_out = _many((ends | part.outside).ravel(), parts.ravel())
    lowest_m = ndimage.minimum(support.height_m(part.points.astype(np.float64)), parts, np.arange(len(leads_out)))
    arms = leads_out & (np.asarray(lowest_m) > part.gap_m)
    arms[0] = False
    arm: BoolArray = suspect & arms[parts]
    return arm | (suspect & (parts == 0) & part.next_to(arm))


def _in_front(part: _Part, suspect: BoolArray, nearest_m: Float32Array) -> tuple[BoolArray, BoolArray]:
    """Return the suspect pixels (h, w) nearer than the object ever was: with pieces that mostly are, and alone.

    Args:
        part: of a depth image.
        suspect: (h, w) pixels of something that leads on to where the object cannot be.
        nearest_m: (h, w) least depth of the object.
    """
    nearer = suspect & (part.depth_m < nearest_m)
    parts = pieces(part.depth_m, suspect | part.outside, part.gap_m)
    mostly = _mostly((nearer | part.outside).ravel(), parts.ravel())
    mostly[0] = False
    return nearer | (suspect & mostly[parts]), nearer


def _split(labels: Labels, chosen: BoolArray, depth_m: Float32Array, fore: BoolArray) -> Labels:
    """Return labels (n,) with the chosen clusters split at depth jumps: an arm may touch the object.

    Args:
        labels: (n,) of the pixels in `fore`.
        chosen: (k,) which clusters.
        depth_m: (h, w).
        fore: (h, w) which pixels are labelled.
    """
    if not chosen.any():
        return labels
    within = np.zeros_like(fore)
    within[fore] = chosen[labels]
    parts = pieces(depth_m, within)[fore]
    at_jump = chosen[labels] & (parts == 0)  # of either piece; each is left to itself
    parts[at_jump] = parts.max() + 1 + np.arange(np.count_nonzero(at_jump))
    return np.where(parts > 0, len(chosen) + parts, labels).astype(np.int32)


def _beside(region: BoolArray) -> Labels:
    """Label the pieces (h, w) of a region, and the pixels within 2 px of them; 0 elsewhere."""
    near = np.asarray(ndimage.binary_dilation(region, np.ones((3, 3)), iterations=2), dtype=np.bool_)
    labels = np.zeros(near.shape, dtype=np.int32)
    ndimage.label(near, output=labels)
    return labels


def _joined(best: int, labels: Labels, in_zone: BoolArray, neighbours: Labels) -> BoolArray:
    """Return the object's clusters (k,): the best, and those next to it or an occluder that are mostly in its zone.

    Args:
        best: number of a cluster.
        labels: (n,) of points.
        in_zone: (n,) whether they are where the object is in other frames.
        neighbours: (n,) piece of best cluster and occluder next to them; 0 = none.
    """
    own_pieces = np.unique(neighbours[labels == best])
    touching = np.bincount(labels[np.isin(neighbours, own_pieces)], minlength=int(labels.max()) + 1) > 0
    sizes = np.bincount(labels)
    own: BoolArray = touching & _mostly(in_zone, labels)
    own &= sizes > LEAST_PIECE * sizes[best]
    own[best] = True
    return own


def _refine(
    depth_m: Float32Array,
    camera: Camera,
    scene: Scene,
    noise: DepthNoise,
    *,
    chosen: BoolArray,
    reach_m: Array,
    gap_m: float,
) -> BoolArray:
    """Return the object's pixels at full resolution: those near the downsampled ones at a similar depth."""
    stride = planning_stride(camera)
    mask = np.zeros(depth_m.shape, dtype=np.bool_)
    rows, columns = window_of(chosen, margin=2)
    own_m = np.where(chosen, depth_m[::stride, ::stride], np.float32(np.nan))[rows, columns]
    low_m = ndimage.minimum_filter(np.nan_to_num(own_m, nan=np.inf), 3) - np.float32(gap_m)
    high_m = ndimage.maximum_filter(np.nan_to_num(own_m, nan=-np.inf), 3) + np.float32(gap_m)
    height, width = depth_m.shape
    window = (
        slice(rows.start * stride, min(rows.stop * stride, height)),
        slice(columns.start * stride, min(columns.stop * stride, width)),
    )
    depth: Float32Array = depth_m[window]
    points = point_image(depth, camera, row=window[0].start, column=window[1].start)
    fore, above_m = _foreground(points, window, scene, noise, thinning=stride)
    low_m, high_m = (
        np.repeat(np.repeat(limit_m, stride, axis=0), stride, axis=1)[: depth.shape[0], : depth.shape[1]]
        for limit_m in (low_m, high_m)
    )
    fore &= (depth > low_m) & (depth < high_m)
    fore &= (depth > reach_m[0, 2]) & (depth < reach_m[1, 2])
    if not fore.any():
        return mask
    if above_m is not None:
        fore &= _not_a_crease(above_m, fore, _CREASE * float(np.median(depth[fore])), camera.fx * _CREASE)
    pixel = depth / np.float32(camera.fx)
    fore &= ~mixed_pixels(depth, tolerance_m=noise.tolerance_m(depth), pixel_m=pixel)
    mask[window] = without_specks(fore)
    return mask


def _inside(points: Float32Array, low: Array, high: Array) -> BoolArray:
    """Return which points (..., 3) lie in a box."""
    inside = np.ones(points.shape[:-1], dtype=np.bool_)
    for axis in range(3):
        inside &= (points[..., axis] > np.float32(low[axis])) & (points[..., axis] < np.float32(high[axis]))
    return inside


def _reach_m(zone_m: Array) -> Array:
    """Return the zone (2, 3), low and high corner, extended by how far the object may have left it."""
    low, high = zone_m
    margin = max(_ZONE_MARGIN * _distance_m(zone_m), _ZONE_MARGIN_SHARE * float((high - low).max()))
    return np.array([low - margin, high + margin])


def _foreground(
    points: Float32Array, window: Window, scene: Scene, noise: DepthNoise, *, thinning: int
) -> tuple[BoolArray, Float32Array | None]:
    """Return what is above the support and in front of the background (h, w), and heights (h, w) if there is a support.

    Args:
        points: (h, w, 3) part of an image of points.
        window: which part.
        scene: the scene.
        noise: of the depth camera.
        thinning: downsampling of the scene's images relative to the points.
    """
    depth = points[..., 2]
    tolerance = noise.tolerance_m(depth)
    fore, height = np.isfinite(depth), None
    if scene.plane is not None:
        rise = points @ scene.plane.normal.astype(np.float32)
        height = rise + np.float32(scene.plane.offset_m)
        slope = np.maximum(np.abs(rise / depth), np.float32(_FLATTEST_SLOPE))
        fore &= height > tolerance * slope + np.float32(noise.floor_m)
    if scene.scenery_m is not None:
        rows, columns = (np.arange(part.start, part.stop) // thinning for part in window)
        fore &= depth < scene.scenery_m[rows[:, None], columns] - tolerance
    return fore, height


def _distance_m(zone_m: Array) -> float:
    """Return the depth of the middle of a zone (2, 3)."""
    return float(zone_m[:, 2].mean())


def _not_a_crease(height_m: Float32Array, fore: BoolArray, highest_m: float, reach_px: float) -> BoolArray:
    """Return the pixels (h, w) that are high above the support or near some that are."""
    low = min(highest_m, MOST * float(np.percentile(height_m[fore], 95)))
    high = (fore & (height_m > low)).astype(np.uint8)
    near: BoolArray = ndimage.maximum_filter(high, 2 * max(1, round(reach_px)) + 1) > 0
    return np.asarray(ndimage.binary_fill_holes(near), dtype=np.bool_)  # a crease surrounds the object


def nearest_seen_m(frames: Sequence[Frame], masks: Sequence[BoolArray]) -> Float32Array:
    """Return the least depth (h, w), downsampled, at which the object was near a pixel; infinite where it never was."""
    stride = planning_stride(frames[0].camera)
    seen = [mask & (frame.depth_m > 0.0) for frame, mask in zip(frames, masks, strict=True)]
    depths_m = [np.where(own, frame.depth_m, np.float32(np.inf)) for frame, own in zip(frames, seen, strict=True)]
    nearest = np.stack([depth_m[::stride, ::stride] for depth_m in depths_m]).min(axis=0).astype(np.float32)
    reach_px = round(_MOVED * frames[0].camera.fx / stride)
    return np.asarray(ndimage.minimum_filter(nearest, 2 * reach_px + 1), dtype=np.float32)
