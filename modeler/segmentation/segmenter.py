"""The segmenter: frames without masks get one, and every frame gets its support plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from modeler.segmentation.bare import clean, is_island, shows_object_alone
from modeler.segmentation.clusters import edge_of
from modeler.segmentation.finder import Found, find
from modeler.segmentation.layers import planning_stride, point_image, take_apart, times_as_noisy
from modeler.segmentation.noise import DepthNoise
from modeler.segmentation.planes import choose_support, dominant_planes, fit_beside, surroundings
from modeler.segmentation.scene import Scene, learn
from modeler.types import BoolArray, Float32Array, Frame, InputError, Outcome, Plane, Segmentation

_RIVAL = 0.4  # of the best cluster's merit: from here on the choice is unsure
_CUT_SHARE = 0.1  # of the mask's width; more on the edge of the image means that the object is cut off
_AREA_FACTOR = 2.5  # by which the visible area may leave the range it had in the scene
_AGREEING_SHARE = 0.5  # of what stood still, for the scene to hold in a frame
_NOISIEST = 3.0  # times the noise that is expected; where depth changes more from frame to frame, the camera moves
_PLANE_SHARE = 0.02  # of the surroundings of a masked object that a plane must cover
_LOOSE_SHARE = 0.15  # of a mask on that plane: more of it than the rim of an object, seen from anywhere


@final
@dataclass(frozen=True)
class Segmenter:
    """Tells the object from its support and surroundings in the frames of a depth camera.

    The camera is taken to stand still while the object turns or moves between frames. Where that is not so, or the
    object does not move, a frame is judged by what stands at its centre. Where nothing but an island on no support was
    measured, all of it is the object.
    """

    roi: tuple[int, int, int, int] | None = None
    """Region in which the object is: x0 y0 x1 y1 in px, x1 and y1 outside it; None = the whole image."""
    max_depth_m: float | None = None
    """Depth beyond which nothing is the object in m; None = no limit."""
    min_points: int = 200
    """Pixels below which an object is too small to register."""
    gap_m: float = 0.012
    """Parts of the object that are this close in m belong together across holes in the image."""
    noise: DepthNoise = field(default_factory=DepthNoise)
    """Noise that is expected of the depth camera; up to three times as much is told from a camera that moves."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        if self.roi is not None and not (0 <= self.roi[0] < self.roi[2] and 0 <= self.roi[1] < self.roi[3]):
            raise InputError(
                f"--roi {' '.join(map(str, self.roi))} is empty; give X0 Y0 X1 Y1 with X0 < X1 and Y0 < Y1."
            )
        if self.max_depth_m is not None and not self.max_depth_m > 0.0:
            raise InputError(f"--max-depth-m {self.max_depth_m:g} leaves nothing; give a positive depth in m.")

    def scene(self, frames: Sequence[Frame]) -> Scene:
        """Learn what stands still, where the object is and what it stands on.

        Args:
            frames: a dozen or fewer, spread over the sequence; those with masks and those of another size than the
                first are left out.
        """
        shown = [frame for frame in frames if frame.mask is None]
        shown = [frame for frame in shown if frame.depth_m.shape == shown[0].depth_m.shape]
        if not shown:
            return Scene()
        if shows_object_alone([_measured(frame) for frame in shown], shown[0].camera, self.noise):
            return Scene(alone=True)
        scene = self._learn(shown)
        if scene.zone_m is None or not scene.still:
            return scene
        # A second look: whole masks say better than what moved where the object is and how large it looks.
        looks = [(frame, self._find(frame, scene)) for frame in shown]
        looks = [(frame, look) for frame, look in looks if np.count_nonzero(look.mask) >= self.min_points]
        if not looks:
            return scene
        boxes = np.array([np.percentile(_points(frame)[look.mask], [0.5, 99.5], axis=0) for frame, look in looks])
        areas, rivals = [look.area_m2 for _, look in looks], [look.rival for _, look in looks]
        zone = np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
        sure = scene.sure and float(np.median(rivals)) < _RIVAL
        return replace(scene, zone_m=zone, areas_m2=(min(areas), max(areas)), sure=sure)

    def segment(self, frame: Frame, scene: Scene) -> Segmentation:
        """Return the object's mask and its support plane in a frame. Failure is the outcome, never an exception.

        A frame's own mask is kept, within region and greatest depth; it is unsure where it holds much of the support.
        """
        if frame.mask is not None:
            mask = frame.mask & self._allowed(frame.depth_m)
            few = np.count_nonzero(mask & (frame.depth_m > 0.0)) < self.min_points
            plane = None if few else self._plane_beside(frame, mask)
            loose = plane is not None and self._share_on(plane, frame, mask) > _LOOSE_SHARE
            outcome = Outcome.UNSURE_MASK if loose else Outcome.CONVERGED
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
        count = np.count_nonzero(found.mask)
        if count < self.min_points:
            return Segmentation(found.mask, scene.plane, Outcome.TOO_FEW_POINTS)
        sure = scene.sure and (scene.still or scene.plane is not None) and found.rival < _RIVAL
        if scene.areas_m2 is not None:
            sure &= scene.areas_m2[0] / _AREA_FACTOR < found.area_m2 < scene.areas_m2[1] * _AREA_FACTOR
        sure &= np.count_nonzero(found.mask & edge_of(frame.depth_m > 0.0)) < _CUT_SHARE * np.sqrt(count)
        return Segmentation(found.mask, scene.plane, Outcome.CONVERGED if sure else Outcome.UNSURE_MASK)

    def _learn(self, frames: Sequence[Frame]) -> Scene:
        """Return what frames without masks say about the scene, if their camera stands still."""
        camera, depths_m, noise = frames[0].camera, [_measured(frame) for frame in frames], self.noise
        layers, noisier = take_apart(depths_m, camera, noise), None
        if layers.camera_moves:  # or is its depth noisier than expected?
            factor = times_as_noisy(depths_m, camera, noise)
            noisier = noise = noise.times(factor)
            layers = layers if factor > _NOISIEST else take_apart(depths_m, camera, noise)
        if layers.camera_moves:
            return Scene()
        stride = planning_stride(camera)
        allowed = self._allowed(layers.front_m[..., 2], stride)
        scene = learn(layers, allowed, noise, least_points=self.min_points / stride**2)
        return replace(scene, still=len(frames) > 1, noise=noisier)

    def _find(self, frame: Frame, scene: Scene) -> Found:
        """Return the object in a frame without a mask."""
        return find(self._kept(frame), frame.camera, scene, scene.noise or self.noise, gap_m=self.gap_m)

    def _kept(self, frame: Frame) -> Float32Array:
        """Return the depth (h, w) within region and greatest depth, NaN elsewhere."""
        depth = _measured(frame)
        depth[~self._allowed(depth)] = np.nan
        return depth

    def _allowed(self, depth_m: Float32Array, stride: int = 1) -> BoolArray:
        """Return the pixels (h, w) of a thinned depth image that region and greatest depth leave."""
        allowed = np.ones(depth_m.shape, dtype=np.bool_) if self.max_depth_m is None else ~(depth_m > self.max_depth_m)
        if self.roi is not None:
            x0, y0, x1, y1 = (-(-edge // stride) for edge in self.roi)
            inside = np.zeros_like(allowed)
            inside[y0:y1, x0:x1] = True
            allowed &= inside
        return allowed

    def _holds(self, frame: Frame, scene: Scene) -> bool:
        """Return whether what stood still is where it was, or hidden."""
        stride = planning_stride(frame.camera)
        depth = _measured(frame)[::stride, ::stride]
        if scene.still_m is None or scene.still_m.shape != depth.shape:
            return False
        off = depth - scene.still_m
        agreeing = np.count_nonzero(np.abs(off) < 2.0 * (scene.noise or self.noise).tolerance_m(depth))
        return bool(agreeing >= _AGREEING_SHARE * np.count_nonzero(np.isfinite(off)))

    def _share_on(self, plane: Plane, frame: Frame, mask: BoolArray) -> float:
        """Return how much of what is measured within a mask belongs to the plane that the object stands on."""
        stride = planning_stride(frame.camera)
        points = _points(frame, stride)
        points = points[mask[::stride, ::stride] & np.isfinite(points[..., 2])].astype(np.float64)
        return float(np.mean(np.abs(plane.height_m(points)) < self.noise.tolerance_m(points[:, 2])))

    def _plane_beside(self, frame: Frame, mask: BoolArray) -> Plane | None:
        """Return the support that is seen around a masked object, if any is."""
        stride = planning_stride(frame.camera)
        points, found = _points(frame, stride), mask[::stride, ::stride]
        around = surroundings(points, found)
        seen = points.copy()
        seen[~around] = np.nan
        planes = dominant_planes(seen, self.noise, least_share=_PLANE_SHARE * float(around.mean()), prefer_level=True)
        body, ground = points[found & np.isfinite(points[..., 2])], points[around]
        guess = choose_support(planes, body, ground, self.noise)
        return None if guess is None else fit_beside(ground, body, guess=guess, noise=self.noise)


def _measured(frame: Frame) -> Float32Array:
    """Return a copy of the depth (h, w) with NaN for everything that is no measurement."""
    return np.where(frame.depth_m > 0.0, frame.depth_m, np.float32(np.nan)).astype(np.float32, copy=False)


def _points(frame: Frame, stride: int = 1) -> Float32Array:
    """Return the thinned points (h, w, 3) of a frame."""
    return point_image(_measured(frame)[::stride, ::stride], frame.camera, stride=stride)
