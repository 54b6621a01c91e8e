"""Arms that hold the object: what leads out of view and, unlike the rest of a mask, does not turn from frame to frame.

An arm that touches the object has its depth, and no gap or jump separates them. But an arm keeps its direction while
the object is turned. The surface next to the edge of the image is aligned with other frames by small motions; what
agrees with them under the same motions is arm, and grows from the edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.segmentation.depth_images import HARDLY, MOSTLY, DepthNoise, is_cut, planning_stride, point_image
from modeler.types import SOME_POINTS, Array, BoolArray, Camera, Frame, spread

_SEED: Final = 0.2  # share of a mask, next to the edge of the image, that is taken for the arm at first; by hand
_TURN_RAD: Final = 0.15  # sd of an arm's turn between two frames; by hand: objects turn by more in all
_SHIFT: Final = 0.5  # likewise of its shift, as a share of the mask's size
_FRAMES: Final = 8  # with which one is compared: of 15, for half of the time
_EFFECTIVE: Final = 200.0  # of the aligned points, neighbours being alike: against the priors of turn and shift
_GROWTHS: Final = 5  # at most; by hand
_COARSEST, _FINER = 8.0, 0.7  # tolerances at first, and their ratio from step to step; by hand
_STEPS: Final = 12  # six until the tolerance is the noise's, by this ratio, and as many at it

Pixels = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _View:
    """A downsampled frame."""

    index: int
    """Of the frame."""
    points_m: Array
    """(h, w, 3), NaN where nothing was measured."""
    normals: Array
    """(h, w, 3)."""
    mask: BoolArray
    """(h, w) measured pixels of the object, and of what holds it."""

    @cached_property
    def middle_m(self) -> Array:
        """Median (3,) of the points of the mask."""
        return np.median(self.points_m[self.mask], axis=0)


@dataclass(frozen=True, eq=False)
class Arms:
    """What is known of arms that hold the object in most frames of a scene."""

    views: tuple[_View, ...]
    """Frames spread over the sequence."""
    edge: BoolArray
    """(h, w), downsampled: the edge of the field of view."""
    camera: Camera
    """Of the frames as they are, not downsampled."""
    tolerance_m: float
    """Difference in depth within which surfaces agree."""
    least_pixels: float
    """Number, downsampled, below which an object is too small."""

    @staticmethod
    def learned(
        frames: Sequence[Frame], masks: Sequence[BoolArray], edge: BoolArray, noise: DepthNoise, least_points: int
    ) -> Arms | None:
        """Return what frames show of arms; None if no arm is in most of them.

        Args:
            frames: spread over the sequence, as many as there are masks.
            masks: (h, w) of the object with what holds it.
            edge: (h, w), downsampled, of the field of view.
            noise: of the camera.
            least_points: number of pixels below which an object is too small.
        """
        views = tuple(_view(frame, mask) for frame, mask in zip(frames, masks, strict=True))
        depths_m = np.concatenate([view.points_m[view.mask][:, 2] for view in views])
        camera, tolerance_m = frames[0].camera, float(noise.tolerance_m(np.array(np.median(depths_m))))
        arms = Arms(views, edge, camera, tolerance_m, least_points / planning_stride(camera) ** 2)
        found = sum(bool(arms._arm(view).any()) for view in views)
        return arms if 2 * found > len(views) else None

    def without(self, frame: Frame, mask: BoolArray) -> BoolArray:
        """Return a mask (h, w) without arms; as it is, if there are none, or nothing else is left."""
        view = _view(frame, mask)
        arm = self._arm(view)
        if not arm.any():
            return mask
        stride, (height, width) = planning_stride(frame.camera), mask.shape
        rest: BoolArray = mask & ~np.kron(arm, np.ones((stride, stride), dtype=np.bool_))[:height, :width]
        sizes = np.bincount((labels := _labelled(ndimage.binary_opening(rest))).ravel())
        return np.asarray(labels == 1 + sizes[1:].argmax()) if len(sizes) > 1 else mask

    def _arm(self, view: _View) -> BoolArray:
        """Return the pixels (h, w), downsampled, of what leads out of view and does not turn."""
        others = spread([one for one in self.views if one.index != view.index], _FRAMES)
        arm = np.zeros_like(view.mask)
        ends = _labelled(view.mask & self.edge)
        if not others:
            return arm
        for end in range(1, int(ends.max()) + 1):
            if is_cut(view.mask, ends == end):
                arm |= self._from(view, ends == end, others)
        enough = np.count_nonzero(ndimage.binary_opening(view.mask & ~arm)) > self.least_pixels
        return arm if enough else np.zeros_like(arm)

    def _from(self, view: _View, end: BoolArray, others: Sequence[_View]) -> BoolArray:
        """Return the arm (h, w) that leads out of view at an end (h, w); empty if what is there turns, or changes."""
        seed = arm = _grown(end, view.mask, _SEED * np.count_nonzero(view.mask))
        points_m, on_seed = view.points_m[view.mask], seed[view.mask]
        low_m, middle_m, high_m = np.percentile(points_m, [2.0, 50.0, 98.0], axis=0)
        size_m = float((high_m - low_m).max())
        motions = [[np.eye(4), se3.translation(one.middle_m - middle_m)] for one in others]
        for growth in range(_GROWTHS):
            some_m = view.points_m[arm]
            some_m = some_m[:: max(len(some_m) // SOME_POINTS, 1)]
            looks = []
            for number, other in enumerate(others):
                found = [
                    self._aligned(some_m, motion, other, coarsest=1.0 if growth else _COARSEST, size_m=size_m)
                    for motion in motions[number]
                ]
                tried = [self._looks(points_m, motion, other) for motion in found]
                best = int(np.argmax([np.count_nonzero(there[on_seed]) for there, _ in tried]))
                motions[number] = [found[best]]
                there, away = (one[on_seed] for one in tried[best])
                if np.mean(there) >= MOSTLY * np.mean(there | away) > 0.0:  # surface that turns does not agree
                    looks.append(tried[best])
            if 2 * len(looks) < len(others):
                return np.zeros_like(arm)
            pieces = _labelled((_shares(view.mask, looks) > MOSTLY) | end)
            before, arm = arm, view.mask & (pieces == pieces[end][0])
            if np.mean(before[view.mask] != arm[view.mask]) < HARDLY:
                break
        return arm

    def _aligned(self, points_m: Array, motion: Array, other: _View, *, coarsest: float, size_m: float) -> Array:
        """Return the motion (4, 4) of points (n, 3) onto another view's surface: point to plane, under the priors.

        Args:
            points_m: of the arm.
            motion: the first guess.
            other: the view.
            coarsest: tolerances within which surface attracts at first.
            size_m: of the mask.
        """
        centre_m = points_m.mean(axis=0)
        precisions = np.repeat([_TURN_RAD**-2, (_SHIFT * size_m) ** -2], 3)
        reach = coarsest
        for _ in range(_STEPS):
            moved_m = se3.transform(motion, points_m)
            seen, rows, columns = self._pixels(moved_m, other)
            off_m = other.points_m[rows, columns] - moved_m
            normals = other.normals[rows, columns]
            height_m = np.sum(off_m * normals, axis=1)
            scale_m = max(reach, 1.0) * self.tolerance_m
            near = seen & other.mask[rows, columns] & (np.linalg.norm(off_m, axis=1) < 6.0 * scale_m)
            near &= np.isfinite(height_m)
            middle_m = se3.transform(motion, centre_m[None])[0]
            jacobian = np.concatenate([np.cross(moved_m - middle_m, normals), normals], axis=1)[near]
            weights = min(_EFFECTIVE / max(len(jacobian), 1), 1.0) / (scale_m**2 + height_m[near] ** 2)
            so_far = np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), middle_m - centre_m])
            information = (jacobian * weights[:, None]).T @ jacobian + np.diag(precisions)
            step = np.linalg.solve(information, jacobian.T @ (weights * height_m[near]) - precisions * so_far)
            turn = Rotation.from_rotvec(step[:3]).as_matrix() @ motion[:3, :3]
            motion = np.eye(4)
            motion[:3, :3], motion[:3, 3] = turn, middle_m + step[3:] - turn @ centre_m
            reach *= _FINER
        return motion

    def _looks(self, points_m: Array, motion: Array, other: _View) -> tuple[BoolArray, BoolArray]:
        """Return where a view has surface at points (n, 3) that are moved there, and where it sees past them."""
        moved_m = se3.transform(motion, points_m)
        seen, rows, columns = self._pixels(moved_m, other)
        behind_m = other.points_m[rows, columns, 2] - moved_m[:, 2]
        there = seen & other.mask[rows, columns] & (np.abs(behind_m) <= self.tolerance_m)
        return there, seen & ~there & ~(behind_m < -self.tolerance_m)

    def _pixels(self, points_m: Array, other: _View) -> tuple[BoolArray, Pixels, Pixels]:
        """Return whether points (n, 3) are in a view's image, and their rows and columns, downsampled."""
        height, width = other.mask.shape
        stride = planning_stride(self.camera)
        x, y, z = points_m.T
        z = np.maximum(z, 1e-6)  # behind the camera: out of view
        columns = np.rint((x / z * self.camera.fx + self.camera.cx) / stride).astype(np.int64)
        rows = np.rint((y / z * self.camera.fy + self.camera.cy) / stride).astype(np.int64)
        seen = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        return seen, np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)


def _view(frame: Frame, mask: BoolArray) -> _View:
    """Return a frame, downsampled, with the mask (h, w) of what was found in it."""
    stride = planning_stride(frame.camera)
    depth_m = np.where(frame.depth_m > 0.0, frame.depth_m, np.nan)[::stride, ::stride]
    points_m = point_image(depth_m, frame.camera, stride=stride).astype(np.float64)
    across = np.cross(np.gradient(points_m, axis=1), np.gradient(points_m, axis=0))
    normals = across / np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-30)
    return _View(frame.index, points_m, normals, np.asarray(mask[::stride, ::stride] & np.isfinite(depth_m)))


def _shares(mask: BoolArray, looks: Sequence[tuple[BoolArray, BoolArray]]) -> Array:
    """Return the share (h, w) of looks at the pixels of a mask, and their neighbours, that find surface."""
    counts = np.zeros((2, *mask.shape))
    counts[:, mask] = np.sum(looks, axis=0)
    there, away = ndimage.gaussian_filter(counts, (0.0, 1.0, 1.0))
    return np.where(mask, there / np.maximum(there + away, 1e-9), 0.0)


def _grown(start: BoolArray, mask: BoolArray, count: float) -> BoolArray:
    """Return the pixels (h, w) of a mask nearest to a part of it, at least so many, by ways within the mask."""
    grown, before = start, np.zeros_like(start)
    while np.count_nonzero(grown) < count and (grown != before).any():
        before, grown = grown, np.asarray(ndimage.binary_dilation(grown, np.ones((3, 3)), mask=mask), dtype=np.bool_)
    return grown


def _labelled(chosen: npt.NDArray[Any]) -> Pixels:
    """Number the connected pieces of pixels (h, w) from 1; 0 elsewhere."""
    labels = np.zeros(chosen.shape, dtype=np.int64)
    ndimage.label(chosen, np.ones((3, 3)), output=labels)
    return labels
