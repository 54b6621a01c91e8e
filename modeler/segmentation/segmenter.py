"""The segmenter: masks for frames without one, and the support plane of every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from modeler.segmentation.arms import Arms
from modeler.segmentation.background_colour import BackgroundColour, without_background
from modeler.segmentation.depth_images import (
    LEAST_PIXELS,
    MOST,
    DepthNoise,
    at_rim,
    change_at_rim,
    edge_of,
    is_cut,
    noise_over_frames,
    noise_within,
    planning_stride,
    point_image,
    separate_layers,
)
from modeler.segmentation.finding import AREA_FACTOR, Found, find, nearest_seen_m
from modeler.segmentation.planes import choose_support, dominant_planes, fit_beside, surroundings
from modeler.segmentation.scene import RIVAL, Scene, clean, is_island, learn, shows_object_alone
from modeler.types import BoolArray, Float32Array, Frame, InputError, Outcome, Plane, Segmentation, checked
from modeler.views.range_noise import RangeNoise, range_noise
from modeler.views.rays import closed, gap_px, interpolated, measured_share

_CHANGES = 2.0
"""Largest ratio of the spread from frame to frame to the noise within frames at the image's rim, where this is at least
the expected one: noise of a camera that stands still is the same in both to its fixed pattern, which only lowers it."""
_LEAST_NOISE = 0.4  # of the expected noise: edges change by more than a rim; with 0.2, masks are as good
_PLANE_SHARE = 0.02  # share of a masked object's surroundings that a support plane must cover: some three `LEAST_SHARE`
_LOOSE_SHARE = 0.15  # share of a mask on the support plane, beyond the rim of any object
_REACH = 3.0  # radii of a mask about its middle: with 2, frames with other masks share less; whole images dilute it

_Look = tuple[Frame, Found]


@checked
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
    min_points: int = LEAST_PIXELS
    """Number of pixels below which an object is too small to register."""
    gap: float = 0.016
    """Largest gap between parts of one object, as a share of its distance: a dozen pixels of usual cameras."""
    noise: DepthNoise = field(default_factory=DepthNoise)
    """Expected noise of the depth camera; up to four times as much is distinguished from camera motion."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        roi = self.roi
        if roi is not None and not (len(roi) == 4 and 0 <= roi[0] < roi[2] and 0 <= roi[1] < roi[3]):
            raise InputError(f"`roi` {' '.join(map(str, roi))} is empty; give X0 Y0 X1 Y1 with X0 < X1 and Y0 < Y1.")
        if self.max_depth_m is not None and not self.max_depth_m > 0.0:
            raise InputError(f"`max_depth_m` {self.max_depth_m:g} is out of range; give a positive depth in m.")

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
        if not scene.still:
            seen = [(frame, self.segment(frame, scene).mask) for frame in shown]
            reach_m = _REACH * float(np.median([_radius_m(*one) for one in seen])) if scene.camera_moves else 0.0
            return replace(scene, range_noise=range_noise(seen), reach_m=reach_m)
        if scene.zone_m is None:
            return scene
        # A second pass: whole masks determine zone and visible area better than the moving pixels.
        looks, whole = self._looks(shown, scene)
        if not whole and looks:
            without_arms = replace(scene, arms=True)
            freed, whole = self._looks(shown, without_arms)
            if whole:
                scene, looks = without_arms, freed
        if not looks:
            return scene
        looks = whole or looks
        usual_m2 = float(np.median([look.area_m2 for _, look in looks]))
        looks = [(frame, look) for frame, look in looks if look.area_m2 < AREA_FACTOR * usual_m2]
        boxes = np.array([np.percentile(_points(frame)[look.mask], [0.5, 99.5], axis=0) for frame, look in looks])
        areas, rivals = [look.area_m2 for _, look in looks], [look.rival for _, look in looks]
        zone = np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
        sure = scene.sure and float(np.median(rivals)) < RIVAL
        frames, masks = [frame for frame, _ in looks], [look.mask for _, look in looks]
        held = None
        if not whole and scene.plane is None and scene.edge is not None:
            held = Arms.learned(frames, masks, scene.edge, scene.noise or self.noise, self.min_points)
        return replace(
            scene,
            nearest_m=nearest_seen_m(frames, masks) if whole else None,
            leads_out=not whole and held is None,
            held=held,
            zone_m=zone,
            areas_m2=(min(areas), max(areas)),
            sure=sure,
            background=BackgroundColour.learned(frames, masks),
            range_noise=range_noise([*zip(frames, masks, strict=True)]),
        )

    def segment(self, frame: Frame, scene: Scene) -> Segmentation:
        """Return the object's mask and its support plane in a frame. Failure is the outcome, never an exception.

        A frame's own mask is kept, within region and largest depth; it is CUT_OFF if it goes on beyond the image. What
        noise does not tell from the support, or from a wall behind, is left out; if that is most of the mask, it is
        kept and UNSURE_MASK, as it may show the support. For sparse measurements, the mask includes the gaps between
        those of the object. Where its own mask leaves the rim out, an object is modelled as far as it is seen.
        """
        frame = _interpolated(frame)
        if frame.mask is not None:
            mask = frame.mask & self._allowed(frame.depth_m)
            few = np.count_nonzero(mask & (frame.depth_m > 0.0)) < self.min_points
            plane = None if few else self._plane_beside(frame, mask)
            share = 0.0 if plane is None else self._share_on(plane, frame, mask, scene.range_noise)
            if plane is not None and _LOOSE_SHARE < share <= 0.5:
                mask = mask & ~self._on(plane, frame, scene.range_noise)
                # Noise leaves specks near the plane.
                near = self._on(plane, frame, scene.range_noise, reach=2.0)
                mask = mask & (~near | np.asarray(ndimage.binary_opening(mask, iterations=2), dtype=np.bool_))
            stride = planning_stride(frame.camera)
            cut = is_cut(mask, edge_of(np.isfinite(_measured(frame)[::stride, ::stride])))
            outcome = Outcome.UNSURE_MASK if share > 0.5 else Outcome.CUT_OFF if cut else Outcome.CONVERGED
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
        mask = found.mask if scene.held is None else scene.held.without(frame, found.mask)
        mask = without_background(mask, frame, scene.background)
        count = np.count_nonzero(mask)
        if count < self.min_points:
            return Segmentation(mask, scene.plane, Outcome.TOO_FEW_POINTS)
        sure = scene.sure and (scene.still or scene.plane is not None) and found.rival < RIVAL and not found.goes_on
        if scene.areas_m2 is not None:
            sure &= scene.areas_m2[0] / AREA_FACTOR < found.area_m2 < scene.areas_m2[1] * AREA_FACTOR
        whole = Outcome.CUT_OFF if is_cut(mask, scene.edge) else Outcome.CONVERGED
        return Segmentation(mask, scene.plane, whole if sure else Outcome.UNSURE_MASK)

    def with_surroundings(self, frame: Frame, found: Segmentation, scene: Scene) -> Segmentation:
        """Return a segmentation with what stands beside the object, where the camera moves about both.

        It determines the camera's motion where the object is nearly round, hardly seen, or not found.
        """
        if frame.mask is not None or scene.reach_m == 0.0:
            return found
        frame = _interpolated(frame)
        known = np.isfinite(self._kept(frame))
        if not known.any():
            return found
        points, mask = _points(frame), found.mask & known
        if not mask.any():  # what stands at the middle of the image
            height, width = known.shape
            mask[height // 3 : 2 * height // 3 + 1, width // 3 : 2 * width // 3 + 1] = True
            mask &= known
        middle_m = np.median(points[mask if mask.any() else known], axis=0)
        near: BoolArray = known & (np.linalg.norm(points - middle_m, axis=2) < scene.reach_m)
        lost = found.outcome is Outcome.TOO_FEW_POINTS and np.count_nonzero(near) >= self.min_points
        outcome = Outcome.UNSURE_MASK if lost else found.outcome
        return Segmentation(found.mask | near, self._plane_beside(frame, found.mask | near), outcome)

    def _looks(self, frames: Sequence[Frame], scene: Scene) -> tuple[list[_Look], list[_Look]]:
        """Return frames with the object found in them; and those where it does not lead out of view, if at least half.

        An arm that touches the object makes it larger, and leads out of view.
        """
        looks = [(frame, self._find(frame, scene)) for frame in frames]
        looks = [(frame, look) for frame, look in looks if np.count_nonzero(look.mask) >= self.min_points]
        whole = [(frame, look) for frame, look in looks if not (look.goes_on or is_cut(look.mask, scene.edge))]
        return looks, whole if 2 * len(whole) >= len(looks) else []

    def _learn(self, frames: Sequence[Frame]) -> Scene:
        """Return the scene that frames without masks show, if their camera is static."""
        camera, depths_m, noise = frames[0].camera, [_measured(frame) for frame in frames], self.noise
        # What is steady, such as a fixed pattern, does not move anything.
        changing = noise.scaled(min(max(noise_over_frames(depths_m, camera, noise), _LEAST_NOISE), 1.0))
        layers, noisier = separate_layers(depths_m, camera, changing), None
        if layers.changes_widely:
            rims_m = [at_rim(depth_m) for depth_m in depths_m]
            within = max(1.0, noise_within(rims_m, camera, noise))
            if change_at_rim(depths_m, camera, noise) > _CHANGES * within:
                return Scene(camera_moves=True)
            if np.isfinite(rims_m).any():
                noisier = noise = noise.times(within, float(np.nanmedian(rims_m)))
                layers = separate_layers(depths_m, camera, noise)
        stride = planning_stride(camera)
        allowed = self._allowed(layers.front_m[..., 2], stride)
        scene = learn(layers, allowed, noise, least_points=self.min_points / stride**2)
        return replace(scene, still=len(frames) > 1, noise=noisier)

    def _find(self, frame: Frame, scene: Scene) -> Found:
        """Return the object in a frame without a mask."""
        noise = scene.noise or self.noise
        return find(self._kept(frame), frame.camera, scene, noise, gap=self.gap, occluder=frame.occluder)

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
        return bool(agreeing >= MOST * np.count_nonzero(np.isfinite(off)))

    def _share_on(self, plane: Plane, frame: Frame, mask: BoolArray, seen: RangeNoise | None) -> float:
        """Return the share of a mask's measured pixels that lie on the support plane."""
        stride = planning_stride(frame.camera)
        measured = mask[::stride, ::stride] & (frame.depth_m[::stride, ::stride] > 0.0)
        return float(np.mean(self._on(plane, frame, seen, stride)[measured]))

    def _on(
        self, plane: Plane, frame: Frame, seen: RangeNoise | None, stride: int = 1, reach: float = 1.0
    ) -> BoolArray:
        """Return which pixels of a downsampled frame lie on the support plane, by `reach` times the noise of planes."""
        noise = self.noise if seen is None else DepthNoise(0.0, seen.pixel_sigma_inverse_per_m)
        points = _points(frame, stride).astype(np.float64)
        return np.asarray(np.abs(plane.height_m(points)) < reach * noise.tolerance_m(points[..., 2]))

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
    """Return a frame without depth of occluders, and with interpolated depth if measurements are sparse.

    So is a mask that holds nothing but measurements, as programs make it that segment points.
    """
    known = frame.unoccluded
    dense_m, mask = interpolated(known.depth_m, frame.camera), known.mask
    if mask is not None and dense_m is not known.depth_m:
        measured = known.depth_m > 0.0
        if not (mask & ~measured).any():
            mask = closed(mask, gap_px(measured_share(measured)))
    return replace(known, depth_m=dense_m, mask=mask).unoccluded


def _measured(frame: Frame) -> Float32Array:
    """Return a copy of the depth (h, w) with NaN for missing measurements."""
    return np.where(frame.depth_m > 0.0, frame.depth_m, np.float32(np.nan)).astype(np.float32, copy=False)


def _radius_m(frame: Frame, mask: BoolArray) -> float:
    """Return the distance in m from the middle of a mask's points within which nearly all of them are."""
    points = _points(frame)[mask & (frame.depth_m > 0.0)]
    if not len(points):
        return 0.0
    return float(np.percentile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 98.0))


def _points(frame: Frame, stride: int = 1) -> Float32Array:
    """Return the downsampled points (h, w, 3) of a frame."""
    return point_image(_measured(frame)[::stride, ::stride], frame.camera, stride=stride)
