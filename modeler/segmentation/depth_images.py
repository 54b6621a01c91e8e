"""Depth images: their noise, their points, what moves between them, and their connected pieces.

`depths_m` are n images (h, w) in m of one camera, NaN where nothing was measured; `noise` is what is expected of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.special import ndtri

from modeler.significance import SIGMAS
from modeler.types import Array, BoolArray, Camera, Float32Array

MOST = 0.5  # the majority of pixels, frames or a rim; half of a flat object's height
MOSTLY = 0.7  # of the measurements at a static pixel agree; of the frames show the object alone, or an arm in place
NEARLY_ALL = 0.98  # of an object is in front of a wall, and above its support
FEW = 0.1  # of a mask's width on the image's edge truncate it; of a pile stand on its lid; are below a support
LEAST_PIECE = FEW  # of the largest: noise along edges, and false depth around limbs, have pieces of up to 6 %
STRAY_WEIGHT = FEW  # of pieces that extend from the image's edge, as arms and people do, or lie outside the zone
LEAST_PIXELS = 100  # of an object, or of a plane: fewer tell little of their shape
HARDLY = 0.01  # share of measurements in a blind band, and at the edge of an image that shows an object alone
_PLANNING_WIDTH_PX = 320
"""Images are downsampled to about this width for planning; with 160 and 640, masks have an IoU of 0.994 and more with
these."""
CELL_PX = 5  # of the downsampled image: blocks that stereo matches are about as wide
_OUTLIERS_IN = 7
"""One measurement in this many may be false; where more lie before the background, something moved. With 3 or 14, masks
of ten sequences are the same."""
_RIM_SHARE = 0.05  # of the image's width: wide enough for second differences of pixels that are `CELL_PX` apart
_FREE_RIM = 0.4  # share of the rim that a near object and the arm that holds it leave free
_FEW_FRAMES = 4  # with more frames, evidence from a single frame is ignored; with 2 or 8, masks are the same to 0.1 %
Labels = npt.NDArray[np.int32]
JUMP_SHARE: Final = 0.03
"""Relative depth difference of neighbours beyond which they lie on two surfaces. With 0.015 and 0.06, masks of a plant
have an IoU of 0.77 and 0.95 with these, and of six two and four another outcome."""
_GRID_CELLS = 80  # largest number of voxels along a side; with 40 or 160, masks of ten sequences are the same to 0.1 %
_GRAZING = np.tan(np.radians(85.0))  # surfaces at a more grazing angle are indistinguishable from mixed pixels
_SPECK_SHARE = 0.003
"""Share of a mask; smaller pieces are removed; halved or doubled, masks have an IoU of 0.986 and more with these."""


@dataclass(frozen=True)
class DepthNoise:
    """Depth noise of a consumer camera: a floor, and a term that grows with the square of the depth.

    The default quadratic part is that of the first Kinect (Khoshelham and Elberink, Sensors 2012, eq. 10).
    """

    floor_m: float = 0.0008
    """Standard deviation at close range in m: quantisation and texture."""
    quadratic_per_m: float = 0.0014
    """Growth of the standard deviation with depth squared in m per m²."""

    def sigma_m(self, depth_m: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the standard deviation of measurements at `depth_m`, of the same shape and type."""
        return np.sqrt(self.floor_m**2 + (self.quadratic_per_m * depth_m * depth_m) ** 2)

    def tolerance_m(self, depth_m: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the difference beyond which two measurements at `depth_m` are two surfaces: 3 sigma plus a floor."""
        return SIGMAS * self.sigma_m(depth_m) + self.floor_m

    def scaled(self, factor: float) -> DepthNoise:
        """Return the noise multiplied by a factor at all depths."""
        return DepthNoise(factor * self.floor_m, factor * self.quadratic_per_m)

    def times(self, factor: float, depth_m: float) -> DepthNoise:
        """Return the noise that is larger by a factor of at least 1 at a depth: the part that grows with depth is."""
        whole_m = factor * float(self.sigma_m(np.array(depth_m)))
        return DepthNoise(self.floor_m, float(np.sqrt(max(whole_m**2 - self.floor_m**2, 0.0))) / depth_m**2)


@dataclass(frozen=True, eq=False)
class Layers:
    """Background and foreground of several frames of a static camera, downsampled."""

    back_m: Float32Array
    """(h, w, 3) the background: the farthest surface on which frames agree, in camera coordinates."""
    front_m: Float32Array
    """(h, w, 3) the typical foreground; the background where there is none."""
    rays: Float32Array
    """(h, w, 3) points at depth 1 m."""
    moved: BoolArray
    """(h, w) True where something appears in front of the background."""
    still: BoolArray
    """(h, w) True where almost all frames show the background."""
    front_share: Float32Array
    """(h, w) share of the measurements in front of the background."""

    @property
    def changes_widely(self) -> bool:
        """Whether much of the image changes: the camera moves, noise is larger than expected, or the object is near."""
        return bool(np.count_nonzero(self.moved) > MOST * np.count_nonzero(np.isfinite(self.back_m[..., 2])))


def planning_stride(camera: Camera) -> int:
    """Return the stride by which images of a camera are downsampled for planning."""
    return max(1, round(camera.width / _PLANNING_WIDTH_PX))


def point_image(
    depth_m: Float32Array, camera: Camera, *, stride: int = 1, row: int = 0, column: int = 0
) -> Float32Array:
    """Return the points (h, w, 3) of a depth image, downsampled by `stride`, that starts at a row and column."""
    w = ((np.arange(depth_m.shape[1]) * stride + column - camera.cx) / camera.fx).astype(np.float32)
    h = ((np.arange(depth_m.shape[0]) * stride + row - camera.cy) / camera.fy).astype(np.float32)
    points = np.empty((*depth_m.shape, 3), dtype=np.float32)
    np.multiply(w, depth_m, out=points[..., 0])
    np.multiply(h[:, None], depth_m, out=points[..., 1])
    points[..., 2] = depth_m
    return points


def separate_layers(depths_m: Sequence[Float32Array], camera: Camera, noise: DepthNoise) -> Layers:
    """Separate background and foreground in depth images (n of (h, w), NaN = no measurement) of a static camera."""
    stride = planning_stride(camera)
    stack, readings = _sorted(depths_m, stride)
    frames = len(stack)
    spare = np.where(readings > 2, np.maximum(readings // _OUTLIERS_IN, 1), 0)
    reference = np.take_along_axis(stack, np.maximum(readings - 1 - spare, 0)[None], axis=0)[0]
    agree = np.abs(stack - reference) < noise.tolerance_m(reference)
    agreeing = agree.sum(axis=0)
    back = np.where(agree, stack, np.float32(0.0)).sum(axis=0) / np.maximum(agreeing, 1).astype(np.float32)
    back[agreeing == 0] = np.nan
    enough = 2 if frames > _FEW_FRAMES else 1
    nearer = (stack < back - noise.tolerance_m(back)).sum(axis=0)
    share = (nearer / np.maximum(readings, 1)).astype(np.float32)
    often = (share >= 1.0 / _OUTLIERS_IN) & (nearer >= enough)
    moved: BoolArray = np.asarray(ndimage.binary_opening(often, np.ones((3, 3))), dtype=np.bool_)
    front = np.where(moved, np.take_along_axis(stack, (nearer // 2)[None], axis=0)[0], back)
    back[agreeing < min(2, frames - 1)] = np.nan
    still = (agreeing >= np.maximum(enough, MOSTLY * readings)) & ~moved
    back, front, rays = (point_image(depth, camera, stride=stride) for depth in (back, front, np.ones_like(back)))
    return Layers(back, front, rays, moved, still, share)


def change_at_rim(depths_m: Sequence[Float32Array], camera: Camera, noise: DepthNoise) -> float:
    """Return the ratio of the depth's spread over frames to `noise` that most of the image's rim exceeds.

    Most is all but what a near object leaves free there, and no less than that of the whole rim: before nothing, an arm
    that holds the object is all that the rim shows.
    """
    spreads, pixels = _spreads_at_rim(depths_m, camera, noise)
    least = max((1.0 - _FREE_RIM) * len(spreads), _FREE_RIM * pixels)
    return float(np.sort(spreads)[::-1][int(least)]) if least < len(spreads) else 0.0


def noise_over_frames(depths_m: Sequence[Float32Array], camera: Camera, noise: DepthNoise) -> float:
    """Return the ratio of the depth's spread over frames to `noise`, the median at the image's rim; 1 if not known.

    The camera stands still.
    """
    spreads, _ = _spreads_at_rim(depths_m, camera, noise)
    return float(np.median(spreads)) if len(spreads) and len(depths_m) > _FEW_FRAMES else 1.0


def _spreads_at_rim(depths_m: Sequence[Float32Array], camera: Camera, noise: DepthNoise) -> tuple[Array, int]:
    """Return the spread of the depth over frames at pixels of the rim, in units of `noise`, and the rim's size."""
    stack, readings = _sorted([at_rim(depth_m) for depth_m in depths_m], planning_stride(camera))
    often = readings > MOST * len(stack)
    quarters = [(np.float32(share) * (readings - 1)).round().astype(np.int64) for share in (0.25, 0.5, 0.75)]
    low, middle, high = (np.take_along_axis(stack, place[None], axis=0)[0][often] for place in quarters)
    apart = 2.0 * ndtri(0.75)  # standard deviations from the lower to the upper quartile of a Gaussian
    return (high - low) / (apart * noise.sigma_m(middle)), int(np.count_nonzero(_rim(often.shape)))


def noise_within(depths_m: Sequence[Float32Array], camera: Camera, noise: DepthNoise) -> float:
    """Return the ratio of the depth's noise within single images to `noise`: the median over all pixels.

    Second differences along rows are free of planes; those of pixels some way apart, of noise that neighbours share.
    """
    stride, ratios = planning_stride(camera), []
    for whole_m in depths_m:
        depth_m = whole_m[::stride, ::stride]
        left, middle, right = (depth_m[:, k : depth_m.shape[1] - 2 * CELL_PX + k] for k in (0, CELL_PX, 2 * CELL_PX))
        bent = np.abs(left - 2.0 * middle + right) / noise.sigma_m(middle)
        ratios.append(bent[np.isfinite(bent)])
    bent = np.concatenate(ratios)
    return float(np.median(bent) / (np.sqrt(6.0) * ndtri(0.75))) if len(bent) else 1.0


def at_rim(depth_m: Float32Array) -> Float32Array:
    """Return a depth image (h, w) with NaN elsewhere than at its rim."""
    return np.where(_rim(depth_m.shape), depth_m, np.float32(np.nan))


def _rim(shape: tuple[int, ...]) -> BoolArray:
    """Return the pixels at the rim of an image of a shape (h, w)."""
    rim, margin = np.ones(shape, dtype=np.bool_), max(1, round(_RIM_SHARE * shape[1]))
    rim[margin:-margin, margin:-margin] = False
    return rim


def _sorted(depths_m: Sequence[Float32Array], stride: int) -> tuple[Float32Array, npt.NDArray[np.int64]]:
    """Return the sorted measurements (n, h, w) of each downsampled pixel, NaN last, and their numbers."""
    stack = np.sort(np.stack([depth[::stride, ::stride] for depth in depths_m]), axis=0)
    return stack, np.isfinite(stack).sum(axis=0)


def pieces(depth_m: Float32Array, within: BoolArray, jump_m: float | None = None) -> Labels:
    """Label the connected pieces (h, w) of a region, split at depth jumps; 0 = outside it or at a jump.

    Args:
        depth_m: (h, w).
        within: (h, w) the region.
        jump_m: the least jump; None: a share of the depth.
    """
    kept = within.copy()
    limit = np.float32(JUMP_SHARE) * depth_m if jump_m is None else np.full_like(depth_m, jump_m)
    kept[:-1] &= ~(np.abs(depth_m[1:] - depth_m[:-1]) > limit[1:])
    kept[:, :-1] &= ~(np.abs(depth_m[:, 1:] - depth_m[:, :-1]) > limit[:, 1:])
    return _label(kept)


def voxel_clusters(points: npt.NDArray[np.floating], *, low_m: Array, high_m: Array, gap_m: float) -> Labels:
    """Label points (n, 3) by connected components in space.

    Args:
        points: (n, 3), all within the box.
        low_m: (3,) lower corner of the box.
        high_m: (3,) upper corner of the box.
        gap_m: voxel size, about the largest gap that is bridged; larger where the box would have too many voxels.

    Returns:
        (n,) labels from 1.
    """
    side = max(gap_m, float((high_m - low_m).max()) / _GRID_CELLS)
    cell = ((points - low_m.astype(points.dtype)) / points.dtype.type(side)).astype(np.int32)
    filled = np.zeros(tuple(((high_m - low_m) / side).astype(np.int64) + 2), dtype=np.bool_)
    filled[cell[:, 0], cell[:, 1], cell[:, 2]] = True
    return _label(filled, structure=ndimage.generate_binary_structure(3, 3))[cell[:, 0], cell[:, 1], cell[:, 2]]


def mixed_pixels(depth_m: Float32Array, *, tolerance_m: Float32Array, pixel_m: Float32Array) -> BoolArray:
    """Return the mixed pixels (h, w): nearer than one neighbour and farther than another, both by a jump.

    Args:
        depth_m: (h, w), NaN = no measurement.
        tolerance_m: (h, w) difference that noise explains.
        pixel_m: (h, w) width of a pixel on a surface at that depth.
    """
    missing = ~np.isfinite(depth_m)
    jump = np.maximum(tolerance_m, np.float32(_GRAZING) * pixel_m)
    nearest = ndimage.minimum_filter(np.where(missing, np.float32(np.inf), depth_m), 3)
    farthest = ndimage.maximum_filter(np.where(missing, np.float32(-np.inf), depth_m), 3)
    return (depth_m - nearest > jump) & (farthest - depth_m > jump)


def without_specks(mask: BoolArray, least_share: float = _SPECK_SHARE) -> BoolArray:
    """Return a mask (h, w) without structures one pixel wide and without pieces below a share of its pixels."""
    count = np.pad(mask.astype(np.uint8), 1)
    count = count[:-2] + count[1:-1] + count[2:]
    mask = mask & (count[:, :-2] + count[:, 1:-1] + count[:, 2:] >= 4)
    labels = _label(mask)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return (sizes >= max(1.0, least_share * sizes.sum()))[labels]


def edge_of(seen: BoolArray) -> BoolArray:
    """Return the pixels (h, w) at the edge of the field of view, where objects may be truncated.

    These are the edges of the image and of bands in which the sensor is blind. The edge of a background without
    measurements is different: an object that crosses it is not truncated.
    """
    return _outermost(seen) | _outermost(seen.T).T


def is_cut(mask: BoolArray, edge: BoolArray | None) -> bool:
    """Return whether a mask (h, w) extends beyond the field of view with such an edge, which may be downsampled."""
    if edge is None:
        return False
    stride = round(len(mask) / len(edge))
    thin = mask[::stride, ::stride]
    return bool(np.count_nonzero(thin & edge) >= FEW * np.sqrt(np.count_nonzero(thin)))


def _outermost(seen: BoolArray) -> BoolArray:
    """Return pixels (h, w) of the first and last row, and of the first and last row with enough measurements."""
    edge = np.zeros_like(seen)
    rows = np.flatnonzero(seen.mean(axis=1) > MOST)
    if len(rows):
        first, last = int(rows[0]), int(rows[-1])
        beyond = np.pad(seen, ((1, 1), (0, 0)))
        if _blind(seen[:first]):
            edge[first] = ~beyond[first]
        if _blind(seen[last + 1 :]):
            edge[last] |= ~beyond[last + 2]
    edge[[0, -1]] = True
    return edge & seen


def _blind(rows: BoolArray) -> bool:
    """Return whether rows (h, w) hold only isolated measurements; beyond a table's edge an object may still be seen."""
    return not rows.size or bool(rows.mean() < HARDLY)


def _label(mask: BoolArray, structure: BoolArray | None = None) -> Labels:
    """Label the connected pieces of a mask from 1, 0 = outside."""
    labels = np.zeros(mask.shape, dtype=np.int32)
    ndimage.label(mask, structure=structure, output=labels)
    return labels


def window_of(mask: BoolArray, *, margin: int) -> tuple[slice, slice]:
    """Return the part of an image that holds a mask (h, w) and a margin."""
    if not mask.any():
        return slice(0, 0), slice(0, 0)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (
        slice(max(0, int(rows[0]) - margin), min(mask.shape[0], int(rows[-1]) + 1 + margin)),
        slice(max(0, int(columns[0]) - margin), min(mask.shape[1], int(columns[-1]) + 1 + margin)),
    )
