"""The segmenter: masks for frames without one, and the support plane of every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from scipy import ndimage

from modeler.range_noise import range_noise
from modeler.segmentation.background_colour import BackgroundColour, without_background
from modeler.segmentation.depth_images import (
    DepthNoise,
    Labels,
    edge_of,
    mixed_pixels,
    noise_ratio,
    pieces,
    planning_stride,
    point_image,
    separate_layers,
    voxel_clusters,
    without_specks,
)
from modeler.segmentation.planes import choose_support, dominant_planes, fit_beside, surroundings
from modeler.segmentation.scene import Scene, clean, is_island, learn, shows_object_alone
from modeler.sparsity import interpolated
from modeler.types import Array, BoolArray, Camera, Float32Array, Frame, InputError, Outcome, Plane, Segmentation

Window = tuple[slice, slice]
_ZONE_MARGIN_M = 0.1  # distance from the object's zone at which it may still be
_ZONE_MARGIN_SHARE = 0.3  # share of the zone's size, if that is more
_MOSTLY_IN_ZONE = 0.5  # share of a piece next to the object that must be in the zone for it to be part of the object
_LEAST_PIECE = 0.07  # of the object; false depth filled in around a figure's limbs has pieces of up to 6 %
_STRAY_WEIGHT = 0.2  # weight of pixels outside the zone, and of pieces that extend from the image's edge as arms do
_FLATTEST_SLOPE = 0.3  # least ratio of height noise to depth noise: supports are not exactly planar
_CLEARANCE_M = 0.001
_LOW_M = 0.01  # creases of the support are at most so high, and apart from the object
_LOW_SHARE = 0.3  # share of the object's height, for flat objects
_LOW_REACH_M = 0.01
_SPECK_SHARE = 0.003
_RIVAL = 0.4  # ratio of the second-best cluster's score to the best's from which the choice is ambiguous
_CUT_SHARE = 0.1  # share of the mask's width on the image's edge from which the object is truncated
_AREA_FACTOR = 2.5  # factor by which the visible area may leave its range in the scene
_AGREEING_SHARE = 0.5  # share of the static background that must agree for the scene to hold in a frame
_NOISIEST = 3.0  # largest ratio to the expected noise; where depth changes more from frame to frame, the camera moves
_PLANE_SHARE = 0.02  # share of a masked object's surroundings that a support plane must cover
_LOOSE_SHARE = 0.15  # share of a mask on the support plane, beyond the rim of any object
_RING_PX = (1.5, 2.5)  # distance from a mask at which nothing of the object is left, where it is right to a pixel
_THIN_SHARE = 0.5  # share of that ring on the object's surface: beyond, most of the rim is missing
_STEEPEST_SLOPE = np.tan(np.radians(70.0))  # of surfaces that depth cameras measure


@final
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
    gap_m: float,
    occluder: BoolArray | None = None,
) -> Found:
    """Find the object in a depth image, NaN where nothing was measured or no object may be.

    Points above the support and in front of the background are clustered at low resolution. The cluster with the
    largest area in the object's zone is chosen, with those that an occluder separates from it, and refined.
    """
    if scene.zone_m is None:
        return Found(np.zeros(depth_m.shape, dtype=np.bool_))
    chosen = _choose(depth_m, camera, scene, noise, zone_m=scene.zone_m, gap_m=gap_m, occluder=occluder)
    mask = _refine(depth_m, camera, scene, noise, chosen=chosen.mask, reach_m=_reach_m(scene.zone_m), gap_m=gap_m)
    return replace(chosen, mask=mask)


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
    thin = np.ascontiguousarray(depth_m[::stride, ::stride])
    chosen = np.zeros(thin.shape, dtype=np.bool_)
    low, high = _reach_m(zone_m)
    window = _window((thin > low[2]) & (thin < high[2]), margin=0)
    row, column = window[0].start * stride, window[1].start * stride
    points = point_image(thin[window], camera, stride=stride, row=row, column=column)
    fore, _ = _foreground(points, window, scene, noise, thinning=1)
    inside = _inside(points, low, high)
    goes_on = _goes_on(points[..., 2], fore, inside, gap_m)
    fore &= inside
    if not fore.any():
        return Found(chosen)
    candidates = points[fore]
    in_zone = _inside(candidates, *zone_m)
    labels = voxel_clusters(candidates, low_m=low, high_m=high, gap_m=gap_m)
    strays = np.bincount(labels, in_zone) < _MOSTLY_IN_ZONE * np.bincount(labels)
    labels = _split(labels, strays, points[..., 2], fore)
    area = candidates[:, 2] ** 2 * (stride**2 / (camera.fx * camera.fy))
    merit = np.bincount(labels, area * np.where(in_zone, 1.0, _STRAY_WEIGHT))
    on_edge = np.bincount(labels, edge_of(np.isfinite(thin))[window][fore])
    merit[on_edge > _CUT_SHARE * np.sqrt(np.bincount(labels))] *= _STRAY_WEIGHT
    best = int(merit.argmax())
    chosen[window][fore] = labels == best
    blocking = chosen if occluder is None else chosen | occluder[::stride, ::stride]
    own = _joined(best, labels, in_zone, _beside(blocking)[window][fore])
    chosen[window][fore] = own[labels]
    rival = float(merit[~own].max(initial=0.0) / merit[best])
    ends = np.count_nonzero(goes_on[fore] & own[labels]) > _CUT_SHARE * np.sqrt(np.count_nonzero(own[labels]))
    return Found(chosen, float(area[own[labels]].sum()), rival, goes_on=bool(ends))


def _goes_on(depth_m: Float32Array, fore: BoolArray, inside: BoolArray, gap_m: float) -> BoolArray:
    """Return the pixels (h, w) at which the foreground continues from the inside of a box to its outside.

    Args:
        depth_m: (h, w).
        fore: (h, w) the foreground.
        inside: (h, w) what is in the box.
        gap_m: largest difference of depth between neighbours that are one thing.
    """
    outside = fore & ~inside
    low_m = ndimage.minimum_filter(np.where(outside, depth_m, np.float32(np.inf)), 3)
    high_m = ndimage.maximum_filter(np.where(outside, depth_m, np.float32(-np.inf)), 3)
    found: BoolArray = fore & inside & (depth_m > low_m - gap_m) & (depth_m < high_m + gap_m)
    return found


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
    own: BoolArray = touching & (np.bincount(labels, in_zone) > _MOSTLY_IN_ZONE * sizes)
    own &= sizes > _LEAST_PIECE * sizes[best]
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
    rows, columns = _window(chosen, margin=2)
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
    """Return the zone (2, 3), low and high corner, extended by how far the object may have left it."""
    low, high = zone_m
    margin = max(_ZONE_MARGIN_M, _ZONE_MARGIN_SHARE * float((high - low).max()))
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


@final
@dataclass(frozen=True)
class Segmenter:
    """Segments the object and its support plane in the frames of a depth camera.

    The camera is assumed static while the object moves between frames. Otherwise the object is what stands at the
    image's centre. If only an island without support was measured, all of it is the object.
    """

    roi: tuple[int, int, int, int] | None = None
    """Region in which the object is: x0 y0 x1 y1 in px, x1 and y1 outside it; None = the whole image."""
    max_depth_m: float | None = None
    """Largest depth of the object in m; None = no limit."""
    min_points: int = 100
    """Number of pixels below which an object is too small to register."""
    gap_m: float = 0.012
    """Largest gap in m between parts of one object."""
    noise: DepthNoise = field(default_factory=DepthNoise)
    """Expected noise of the depth camera; up to three times as much is distinguished from camera motion."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        if self.roi is not None and not (0 <= self.roi[0] < self.roi[2] and 0 <= self.roi[1] < self.roi[3]):
            raise InputError(
                f"--roi {' '.join(map(str, self.roi))} is empty; give X0 Y0 X1 Y1 with X0 < X1 and Y0 < Y1."
            )
        if self.max_depth_m is not None and not self.max_depth_m > 0.0:
            raise InputError(f"--max-depth-m {self.max_depth_m:g} is out of range; give a positive depth in m.")

    def scene(self, frames: Sequence[Frame]) -> Scene:
        """Learn the static background, the object's zone and its support.

        Args:
            frames: about a dozen, spread over the sequence; those with masks or of another size than the first are
                ignored. Where all have masks, they only provide the noise correlation of the camera.
        """
        masked = [(frame, frame.mask) for frame in frames if frame.mask is not None]
        if len(masked) == len(frames):
            return Scene(range_noise=range_noise(masked))
        shown = [frame for frame in frames if frame.mask is None]
        shown = [frame for frame in shown if frame.depth_m.shape == shown[0].depth_m.shape]
        shown = [_interpolated(frame) for frame in shown]
        if shows_object_alone([_measured(frame) for frame in shown], shown[0].camera, self.noise):
            return Scene(alone=True)
        scene = self._learn(shown)
        if scene.zone_m is None or not scene.still:
            return scene
        # A second pass: whole masks determine zone and visible area better than the moving pixels.
        looks = [(frame, self._find(frame, scene)) for frame in shown]
        looks = [(frame, look) for frame, look in looks if np.count_nonzero(look.mask) >= self.min_points]
        if not looks:
            return scene
        # An arm that touches the object in some frames makes it larger there.
        usual_m2 = float(np.median([look.area_m2 for _, look in looks]))
        looks = [(frame, look) for frame, look in looks if look.area_m2 < _AREA_FACTOR * usual_m2]
        boxes = np.array([np.percentile(_points(frame)[look.mask], [0.5, 99.5], axis=0) for frame, look in looks])
        areas, rivals = [look.area_m2 for _, look in looks], [look.rival for _, look in looks]
        zone = np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
        sure = scene.sure and float(np.median(rivals)) < _RIVAL
        frames, masks = [frame for frame, _ in looks], [look.mask for _, look in looks]
        return replace(
            scene,
            zone_m=zone,
            areas_m2=(min(areas), max(areas)),
            sure=sure,
            background=BackgroundColour.learned(frames, masks),
            range_noise=range_noise([*zip(frames, masks, strict=True)]),
        )

    def segment(self, frame: Frame, scene: Scene) -> Segmentation:
        """Return the object's mask and its support plane in a frame. Failure is the outcome, never an exception.

        A frame's own mask is kept, within region and largest depth; it is UNSURE_MASK if it covers much of the support,
        or if the object's surface continues beyond most of its rim. For sparse measurements, the mask includes the gaps
        between those of the object.
        """
        frame = _interpolated(frame)
        if frame.mask is not None:
            mask = frame.mask & self._allowed(frame.depth_m)
            few = np.count_nonzero(mask & (frame.depth_m > 0.0)) < self.min_points
            plane = None if few else self._plane_beside(frame, mask)
            loose = plane is not None and self._share_on(plane, frame, mask) > _LOOSE_SHARE
            thin = not few and self._share_beyond(plane, frame, mask) > _THIN_SHARE
            outcome = Outcome.UNSURE_MASK if loose or thin else Outcome.CONVERGED
            return Segmentation(mask, plane, Outcome.TOO_FEW_POINTS if few else outcome)
        if scene.alone:
            mask = clean(self._kept(frame), frame.camera, self.noise)
            few = np.count_nonzero(mask) < self.min_points
            sure = is_island(_measured(frame))
            outcome = Outcome.CONVERGED if sure else Outcome.UNSURE_MASK
            return Segmentation(mask, None, Outcome.TOO_FEW_POINTS if few else outcome)
        if not (scene.still and self._holds(frame, scene)):
            scene = self._learn([frame])
        found = self._find(frame, scene)
        mask = without_background(found.mask, frame, scene.background)
        count = np.count_nonzero(mask)
        if count < self.min_points:
            return Segmentation(mask, scene.plane, Outcome.TOO_FEW_POINTS)
        sure = scene.sure and (scene.still or scene.plane is not None) and found.rival < _RIVAL and not found.goes_on
        if scene.areas_m2 is not None:
            sure &= scene.areas_m2[0] / _AREA_FACTOR < found.area_m2 < scene.areas_m2[1] * _AREA_FACTOR
        sure &= np.count_nonzero(mask & edge_of(frame.depth_m > 0.0)) < _CUT_SHARE * np.sqrt(count)
        return Segmentation(mask, scene.plane, Outcome.CONVERGED if sure else Outcome.UNSURE_MASK)

    def _learn(self, frames: Sequence[Frame]) -> Scene:
        """Return the scene that frames without masks show, if their camera is static."""
        camera, depths_m, noise = frames[0].camera, [_measured(frame) for frame in frames], self.noise
        layers, noisier = separate_layers(depths_m, camera, noise), None
        if layers.changes_widely:
            factor = noise_ratio(depths_m, camera, noise)
            if factor > _NOISIEST:
                return Scene()
            noisier = noise = noise.times(factor)
            layers = separate_layers(depths_m, camera, noise)
        if layers.camera_moves:
            return Scene()
        stride = planning_stride(camera)
        allowed = self._allowed(layers.front_m[..., 2], stride)
        scene = learn(layers, allowed, noise, least_points=self.min_points / stride**2)
        return replace(scene, still=len(frames) > 1, noise=noisier)

    def _find(self, frame: Frame, scene: Scene) -> Found:
        """Return the object in a frame without a mask."""
        noise = scene.noise or self.noise
        return find(self._kept(frame), frame.camera, scene, noise, gap_m=self.gap_m, occluder=frame.occluder)

    def _kept(self, frame: Frame) -> Float32Array:
        """Return the depth (h, w) within region and largest depth, NaN elsewhere."""
        depth = _measured(frame)
        depth[~self._allowed(depth)] = np.nan
        return depth

    def _allowed(self, depth_m: Float32Array, stride: int = 1) -> BoolArray:
        """Return the pixels (h, w) of a downsampled depth image within region and largest depth."""
        allowed = np.ones(depth_m.shape, dtype=np.bool_) if self.max_depth_m is None else ~(depth_m > self.max_depth_m)
        if self.roi is not None:
            x0, y0, x1, y1 = (-(-edge // stride) for edge in self.roi)
            inside = np.zeros_like(allowed)
            inside[y0:y1, x0:x1] = True
            allowed &= inside
        return allowed

    def _holds(self, frame: Frame, scene: Scene) -> bool:
        """Return whether the static background is where it was, or occluded."""
        stride = planning_stride(frame.camera)
        depth = _measured(frame)[::stride, ::stride]
        if scene.still_m is None or scene.still_m.shape != depth.shape:
            return False
        off = depth - scene.still_m
        agreeing = np.count_nonzero(np.abs(off) < 2.0 * (scene.noise or self.noise).tolerance_m(depth))
        return bool(agreeing >= _AGREEING_SHARE * np.count_nonzero(np.isfinite(off)))

    def _share_on(self, plane: Plane, frame: Frame, mask: BoolArray) -> float:
        """Return the share of a mask's measured pixels that lie on the support plane."""
        stride = planning_stride(frame.camera)
        points = _points(frame, stride)
        points = points[mask[::stride, ::stride] & np.isfinite(points[..., 2])].astype(np.float64)
        return float(np.mean(np.abs(plane.height_m(points)) < self.noise.tolerance_m(points[:, 2])))

    def _share_beyond(self, plane: Plane | None, frame: Frame, mask: BoolArray) -> float:
        """Return the share of the pixels around a mask where its surface continues: no depth step, and no support."""
        rows, columns = _window(mask, margin=int(np.ceil(_RING_PX[1])))
        inside, depth_m = mask[rows, columns], _measured(frame)[rows, columns]
        outside = ~(inside & np.isfinite(depth_m))
        away_px = np.asarray(ndimage.distance_transform_edt(outside))
        nearest = np.asarray(ndimage.distance_transform_edt(outside, return_distances=False, return_indices=True))
        ring = (away_px > _RING_PX[0]) & (away_px <= _RING_PX[1]) & ~inside
        if frame.occluder is not None:
            ring &= ~frame.occluder[rows, columns]
        if not ring.any():
            return 0.0
        rim_m = depth_m[tuple(nearest)][ring]
        step_m = np.abs(depth_m[ring] - rim_m)
        goes_on = step_m < self.noise.tolerance_m(rim_m) + away_px[ring] * rim_m / frame.camera.fx * _STEEPEST_SLOPE
        if plane is not None:
            points = point_image(depth_m, frame.camera, row=rows.start, column=columns.start)[ring].astype(np.float64)
            goes_on &= plane.height_m(points) > self.noise.tolerance_m(points[:, 2])
        return float(goes_on.mean())

    def _plane_beside(self, frame: Frame, mask: BoolArray) -> Plane | None:
        """Return the support plane around a masked object, if one is seen."""
        stride = planning_stride(frame.camera)
        points, found = _points(frame, stride), mask[::stride, ::stride]
        around = surroundings(points, found)
        seen = points.copy()
        seen[~around] = np.nan
        planes = dominant_planes(seen, self.noise, least_share=_PLANE_SHARE * float(around.mean()), prefer_level=True)
        body, ground = points[found & np.isfinite(points[..., 2])], points[around]
        guess = choose_support(planes, body, ground, self.noise)
        return None if guess is None else fit_beside(ground, body, guess=guess, noise=self.noise)


def _interpolated(frame: Frame) -> Frame:
    """Return a frame without depth of occluders, and with interpolated depth if measurements are sparse."""
    known = frame.unoccluded
    return replace(known, depth_m=interpolated(known.depth_m, frame.camera)).unoccluded


def _measured(frame: Frame) -> Float32Array:
    """Return a copy of the depth (h, w) with NaN for missing measurements."""
    return np.where(frame.depth_m > 0.0, frame.depth_m, np.float32(np.nan)).astype(np.float32, copy=False)


def _points(frame: Frame, stride: int = 1) -> Float32Array:
    """Return the downsampled points (h, w, 3) of a frame."""
    return point_image(_measured(frame)[::stride, ::stride], frame.camera, stride=stride)
