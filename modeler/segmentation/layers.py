"""The frames of a still camera taken apart: what is behind, and what comes in front of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from modeler.segmentation.noise import DepthNoise
from modeler.types import BoolArray, Camera, Float32Array

_PLANNING_WIDTH_PX = 320  # images are thinned to about this for planning
_OUTLIERS_IN = 7  # one reading in so many may lie behind the backdrop by mistake
_FEW_FRAMES = 4  # with more, nothing is believed that only one frame says
_STILL_SHARE = 0.7  # of the readings that agree, for a pixel to be called still
_MOVED_SHARE = 0.15  # of the readings that lie in front of the backdrop, for a pixel to be called moved
_MOVING_CAMERA_SHARE = 0.5  # of the image that changes: the camera moves, not the object
_QUARTERS_APART = 1.35  # standard deviations from the lower to the upper quartile of a Gaussian


@final
@dataclass(frozen=True, eq=False)
class Layers:
    """What a few frames of a still camera show, thinned."""

    back_m: Float32Array
    """(h, w, 3) the backdrop: the farthest surface that frames agree on, in camera coordinates."""
    front_m: Float32Array
    """(h, w, 3) what typically comes in front of it; the backdrop where nothing does."""
    rays: Float32Array
    """(h, w, 3) points at depth 1 m."""
    moved: BoolArray
    """(h, w) True where things come in front of the backdrop."""
    still: BoolArray
    """(h, w) True where almost all frames see the backdrop."""
    front_share: Float32Array
    """(h, w) share of the readings in front of the backdrop."""

    @property
    def camera_moves(self) -> bool:
        """Whether so much of the image changes that it must be the camera that moves."""
        seen = np.count_nonzero(np.isfinite(self.back_m[..., 2]))
        return bool(np.count_nonzero(self.moved) > _MOVING_CAMERA_SHARE * max(1, seen))


def planning_stride(camera: Camera) -> int:
    """Return by how much images of a camera are thinned for planning."""
    return max(1, round(camera.width / _PLANNING_WIDTH_PX))


def point_image(
    depth_m: Float32Array, camera: Camera, *, stride: int = 1, row: int = 0, column: int = 0
) -> Float32Array:
    """Return the points (h, w, 3) of a depth image that was thinned by `stride` and starts at a row and column."""
    w = ((np.arange(depth_m.shape[1]) * stride + column - camera.cx) / camera.fx).astype(np.float32)
    h = ((np.arange(depth_m.shape[0]) * stride + row - camera.cy) / camera.fy).astype(np.float32)
    points = np.empty((*depth_m.shape, 3), dtype=np.float32)
    np.multiply(w, depth_m, out=points[..., 0])
    np.multiply(h[:, None], depth_m, out=points[..., 1])
    points[..., 2] = depth_m
    return points


def take_apart(depths_m: Sequence[Float32Array], camera: Camera, noise: DepthNoise) -> Layers:
    """Take depth images (n of (h, w), NaN = no measurement) of a still camera apart."""
    stride = planning_stride(camera)
    stack, readings = _sorted(depths_m, stride)
    frames = len(stack)
    spare = np.where(readings > 2, np.maximum(readings // _OUTLIERS_IN, 1), 0)
    reference = np.take_along_axis(stack, np.maximum(readings - 1 - spare, 0)[None], axis=0)[0]
    agree = np.abs(stack - reference) < noise.tolerance_m(reference)
    agreeing = agree.sum(axis=0)
    back = np.where(agree, stack, np.float32(0.0)).sum(axis=0) / np.maximum(agreeing, 1).astype(np.float32)
    back[agreeing == 0] = np.nan
    believed = 2 if frames > _FEW_FRAMES else 1
    nearer = (stack < back - noise.tolerance_m(back)).sum(axis=0)
    share = (nearer / np.maximum(readings, 1)).astype(np.float32)
    often = (share >= _MOVED_SHARE) & (nearer >= believed)
    moved: BoolArray = np.asarray(ndimage.binary_opening(often, np.ones((3, 3))), dtype=np.bool_)
    front = np.where(moved, np.take_along_axis(stack, (nearer // 2)[None], axis=0)[0], back)
    back[agreeing < min(2, frames - 1)] = np.nan
    still = (agreeing >= np.maximum(believed, _STILL_SHARE * readings)) & ~moved
    back, front, rays = (point_image(depth, camera, stride=stride) for depth in (back, front, np.ones_like(back)))
    return Layers(back, front, rays, moved, still, share)


def times_as_noisy(depths_m: Sequence[Float32Array], camera: Camera, noise: DepthNoise) -> float:
    """Return how many times as much as `noise` the depth at a pixel is spread over the frames: the median of all.

    Args:
        depths_m: (n of (h, w), NaN = no measurement) of a camera that may stand still.
        camera: the camera.
        noise: what is expected of it.
    """
    stack, readings = _sorted(depths_m, planning_stride(camera))
    often = readings > _FEW_FRAMES
    if not often.any():
        return 1.0
    quarters = [(np.float32(share) * (readings - 1)).round().astype(np.int64) for share in (0.25, 0.5, 0.75)]
    low, middle, high = (np.take_along_axis(stack, place[None], axis=0)[0][often] for place in quarters)
    return float(np.median((high - low) / (_QUARTERS_APART * noise.sigma_m(middle))))


def _sorted(depths_m: Sequence[Float32Array], stride: int) -> tuple[Float32Array, npt.NDArray[np.int64]]:
    """Return the readings (n, h, w) of each pixel, thinned, least first and NaN last, and how many there are."""
    stack = np.sort(np.stack([depth[::stride, ::stride] for depth in depths_m]), axis=0)
    return stack, np.isfinite(stack).sum(axis=0)
