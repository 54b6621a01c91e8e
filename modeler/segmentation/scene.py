"""Scene learned from several frames: the static background, the object's zone, and its support."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from modeler.segmentation.arms import Arms
from modeler.segmentation.background_colour import BackgroundColour
from modeler.segmentation.depth_images import (
    FEW,
    HARDLY,
    LEAST_PIECE,
    MOST,
    MOSTLY,
    NEARLY_ALL,
    STRAY_WEIGHT,
    DepthNoise,
    Labels,
    Layers,
    edge_of,
    mixed_pixels,
    pieces,
    planning_stride,
    point_image,
    without_specks,
)
from modeler.segmentation.planes import (
    choose_support,
    dominant_planes,
    fit_beside,
    heights,
    outline,
    parallel,
    surroundings,
    upright,
)
from modeler.significance import QUORUM
from modeler.types import Array, BoolArray, Camera, Float32Array, Plane
from modeler.views.range_noise import RangeNoise

_NEIGHBOUR_SIZES = 0.5
"""Distance, in sizes of the largest moving piece, within which its other parts move; with 0.25 and 1, masks of a plant
have an IoU of 0.89 and 0.95 with these, of cap and two more 1.00."""
RIVAL = 0.3  # ratio of the score of what else may be the object from which it is ambiguous: 0.4 chooses of two alike


@dataclass(frozen=True, eq=False)
class Scene:
    """Scene learned from several frames. With an empty scene, each frame is segmented separately."""

    plane: Plane | None = None
    """The support plane, where one was found."""
    still_m: Float32Array | None = None
    """(h, w), downsampled: depth of the static background; NaN where there is none."""
    scenery_m: Float32Array | None = None
    """(h, w), downsampled: depth of walls and static things, at and beyond which there is no object; else infinite."""
    zone_m: Array | None = None
    """(2, 3) low and high corner, in camera coordinates, of the box in which the object was seen."""
    nearest_m: Float32Array | None = None
    """(h, w), downsampled: the least depth at which the object was seen, infinite where it never was; None: unknown."""
    edge: BoolArray | None = None
    """(h, w), downsampled: the edge of the field of view, where objects may be truncated."""
    arms: bool = False
    """Whether arms that touch the object are in most frames."""
    leads_out: bool = False
    """Whether the object leads out of view in most frames: the image cuts it off, or an arm is taken for part of it."""
    held: Arms | None = None
    """What holds the object and leads out of view in most frames."""
    areas_m2: tuple[float, float] | None = None
    """Least and greatest area that the object showed to the camera."""
    sure: bool = True
    """Whether object and support plane are unambiguous."""
    still: bool = False
    """Whether camera and background are static, so that the scene holds for other frames."""
    camera_moves: bool = False
    """Whether so much changes from frame to frame that the camera itself must move."""
    reach_m: float = 0.0
    """Distance from the object's middle within which a moving camera sees what stands still beside it; 0: unknown."""
    alone: bool = False
    """Whether the frames show nothing but the object."""
    noise: DepthNoise | None = None
    """Noise of the depth camera, where it exceeds what was expected."""
    background: BackgroundColour | None = None
    """Colours of what stands still behind the object; None where frames have no colour, or are few."""
    range_noise: RangeNoise | None = None
    """Noise statistics of the camera from planes around the object; None without enough planar surface."""

    @property
    def finds_masks(self) -> bool:
        """Whether masks are found, not given."""
        return self.alone or self.zone_m is not None

    @property
    def doubts(self) -> tuple[str, ...]:
        """What may be wrong with the capture, in words."""
        if self.camera_moves:
            return (
                "the camera seems to move: what stands at the middle of each image is taken for the object, which lies "
                "still; give masks, `roi` or `max_depth_m` where that is something else",
            )
        if self.leads_out and self.plane is None:
            return ("what moves leads out of the image, and nothing carries it: give masks if a hand holds it",)
        return ()


def scene_frames(indices: Sequence[int], before: Sequence[int] = ()) -> tuple[int, ...]:
    """Return the numbers of 15 frames at most, spread evenly over a sequence, from which to learn its scene.

    Args:
        indices: numbers of all its frames.
        before: those from which it was learned before more frames came: they are kept, so that views of earlier frames
            stay the same, unless some are gone or they are less than half as many as there can be now.
    """
    places = np.linspace(0, len(indices) - 1, min(15, len(indices))).round()
    kept = 2 * len(before) >= len(places) and {*before} <= {*indices}
    return tuple(before) if kept else tuple(indices[place] for place in places.astype(np.int64).tolist())


def learn(layers: Layers, allowed: BoolArray, noise: DepthNoise, *, least_points: float) -> Scene:
    """Return the scene that layers show.

    Args:
        layers: of one frame or several.
        allowed: (h, w) where the object may be.
        noise: of the depth camera.
        least_points: pixels of the downsampled image below which motion is ignored.
    """
    found, sure = _moving_object(layers, allowed)
    moves = bool(np.count_nonzero(found) >= least_points)
    planes = dominant_planes(layers.back_m, noise, prefer_level=moves)
    guess: Array | None = None
    if moves:
        ground = layers.back_m[layers.still & surroundings(layers.front_m, found)]
        guess = choose_support(planes, layers.front_m[found], ground, noise)
    else:
        guess, found, sure = _standing_object(planes, layers.back_m, allowed, noise)
    still = np.where(layers.still, layers.back_m[..., 2], np.float32(np.nan))
    if not found.any():
        return Scene(still_m=still)
    edge = edge_of(np.isfinite(layers.front_m[..., 2]))
    zone = np.percentile(layers.front_m[found], [1.0, 99.0], axis=0).astype(np.float64)
    plane = None
    if guess is not None:
        ground = layers.back_m[layers.still & surroundings(layers.front_m, found)]
        plane = fit_beside(ground, layers.front_m[found], guess=guess, noise=noise)
    guess = None if plane is None else guess
    return Scene(plane, still, _scenery(layers, found, planes, guess, noise), zone, edge=edge, sure=sure)


def _moving_object(layers: Layers, allowed: BoolArray) -> tuple[BoolArray, bool]:
    """Find the moving piece with the highest score (large, near, central), and moving pieces next to it.

    Returns:
        Its pixels (h, w), and whether no other moving piece scores nearly as high.
    """
    depth = layers.front_m[..., 2]
    labels = pieces(depth, layers.moved & allowed)
    merit = _central(labels, depth, layers.front_share)
    cut = np.bincount(labels[edge_of(np.isfinite(depth))], minlength=len(merit)) >= QUORUM
    merit[cut] *= STRAY_WEIGHT
    if merit.max() <= 0.0:
        return np.zeros_like(layers.moved), True
    low, high = np.percentile(layers.front_m[labels == int(merit.argmax())], [2.0, 98.0], axis=0)
    margin = _NEIGHBOUR_SIZES * float(np.linalg.norm(high - low))
    near = ((layers.front_m > low - margin) & (layers.front_m < high + margin)).all(axis=-1)
    elsewhere = _central(np.where(near, 0, labels), depth, layers.front_share)
    elsewhere[cut[: len(elsewhere)]] *= STRAY_WEIGHT
    elsewhere[elsewhere <= LEAST_PIECE * merit.max()] = 0.0  # specks of noise are no other object, however many
    regions = np.zeros(depth.shape, dtype=np.int32)
    ndimage.label(layers.moved & allowed & near, output=regions)
    merit_of = _central(regions, depth, layers.front_share)
    large = merit_of > LEAST_PIECE * merit_of.max()
    return large[regions], bool(elsewhere.sum() < RIVAL * merit.sum())


def _standing_object(
    planes: Array, points: Float32Array, allowed: BoolArray, noise: DepthNoise
) -> tuple[Array | None, BoolArray, bool]:
    """Find, in one image, the central support plane and what stands on it.

    Goes through the parallel planes that face up, from the lowest to the highest that still carries a large part of
    what stands on the one below: from floor to table to turntable, but not to the lid of a box.

    Returns:
        The support (4,), or None if there is no plane; the pixels (h, w) of the object; and whether there was only
        one candidate plane.
    """
    depth = points[..., 2]
    support, found, levels_used = None, np.zeros(depth.shape, dtype=np.bool_), 0
    facing = upright(planes)
    levels = planes[facing] if facing.any() else planes[:1]
    if len(levels) == 0:
        return None, found, False
    levels = levels[parallel(levels, levels[0])]
    tolerance = noise.tolerance_m(depth)
    free = allowed.copy()
    walls = _beyond_image(planes, points[edge_of(np.isfinite(depth))], noise)
    walls &= ~facing if facing.any() else np.arange(len(planes)) > 0
    for plane in planes[walls]:
        free &= ~(np.abs(heights(points, plane)) < tolerance)
    for level in levels[np.argsort(-levels[:, 3])]:
        labels = pieces(depth, free & (heights(points, level) > tolerance))
        merit = _central(labels, depth, np.ones_like(depth))
        piece = labels == int(merit.argmax())
        off_plane = np.count_nonzero(found & (np.abs(heights(points, level)) > tolerance))
        if merit.max() > 0.0 and np.count_nonzero(piece) > FEW * off_plane:
            support, found, levels_used = level, piece, levels_used + 1
    return support, found, levels_used == 1


def _central(labels: Labels, depth_m: Float32Array, weight: Float32Array) -> npt.NDArray[np.float64]:
    """Return the score of each label, 0 for label 0: its area, weighted towards the image's centre and near depths."""
    rows, columns = (np.linspace(-1.0, 1.0, n, dtype=np.float32) for n in labels.shape)
    centred = np.exp(-2.0 * (rows[:, None] ** 2 + columns**2))
    merit = np.bincount(labels.ravel(), np.where(labels > 0, weight * centred / depth_m**2, 0.0).ravel())
    merit[0] = 0.0
    return merit.astype(np.float64)


def _beyond_image(planes: Array, rim: Float32Array, noise: DepthNoise) -> BoolArray:
    """Return which planes (k, 4), largest first, extend beyond the image, on whose rim the static points (n, 3) are.

    A point is on one plane, the largest: a small one would else have all those at which it cuts others.
    """
    tolerance_m, free, beyond = noise.tolerance_m(rim[:, 2]), np.ones(len(rim), dtype=np.bool_), []
    for plane in planes:
        on = free & (np.abs(heights(rim, plane)) < tolerance_m)
        beyond.append(np.count_nonzero(on) > FEW * len(rim))
        free &= ~on | (not beyond[-1])
    return np.array(beyond, dtype=np.bool_)


def _scenery(layers: Layers, found: BoolArray, planes: Array, support: Array | None, noise: DepthNoise) -> Float32Array:
    """Return the depth (h, w) at and beyond which there is no object, infinite where unknown.

    A static piece above the support that lies within the image may belong to the object: the middle of a mug on a
    turntable looks static, and only its handle moves. Walls do not, planes behind all that moves that extend beyond the
    image, or are larger next to the object than behind it. They continue behind the object.
    """
    back = layers.back_m[..., 2]
    tolerance_m, rim = noise.tolerance_m(back), layers.back_m[edge_of(np.isfinite(back)) & layers.still]
    body, body_tolerance_m = layers.front_m[found], noise.tolerance_m(layers.front_m[found][:, 2])
    above, around = layers.still & ~found, layers.still & ~outline(found)
    if support is not None:
        over_m = heights(layers.back_m, support)
        above &= over_m > tolerance_m
        around &= np.abs(over_m) > tolerance_m
        rim[np.abs(heights(rim, support)) < noise.tolerance_m(rim[:, 2])] = np.nan
    labels = pieces(back, above)
    outside = np.bincount(labels[edge_of(np.isfinite(back))], minlength=int(labels.max()) + 1) >= QUORUM
    outside[0] = False
    depth = np.where(outside[labels], back, np.float32(np.inf))
    for plane, goes_on in zip(planes, _beyond_image(planes, rim, noise), strict=True):
        level = support is not None and bool(parallel(plane[None], support)[0])  # the support, or the top of a box
        if level or np.mean(heights(body, plane) > -body_tolerance_m) < NEARLY_ALL:
            continue
        in_front_m = heights(layers.back_m, plane)
        on = around & (np.abs(in_front_m) < tolerance_m)
        if np.count_nonzero(on) < np.count_nonzero(found) and not goes_on:
            continue
        facing = layers.rays @ plane[:3].astype(np.float32)
        behind = np.float32(plane[3]) / np.maximum(-facing, np.float32(1e-6))
        standing = np.where(in_front_m < tolerance_m, back, depth)
        depth = np.where(layers.still, standing, np.minimum(depth, behind))
    return depth


def shows_object_alone(depths_m: Sequence[Float32Array], camera: Camera, noise: DepthNoise) -> bool:
    """Return whether depth images (n of (h, w), NaN = no measurement) show an object without background or support."""
    alone = [is_island(depth) and not _supported(depth, camera, noise) for depth in depths_m if _seen(depth).any()]
    return bool(alone) and sum(alone) >= MOSTLY * len(alone)


def is_island(depth_m: Float32Array) -> bool:
    """Return whether the measurements (h, w) form an island: under half of the image, hardly any at its edge."""
    seen = _seen(depth_m)
    border = np.concatenate([seen[0], seen[-1], seen[1:-1, 0], seen[1:-1, -1]])
    return bool(seen.mean() < MOST and border.mean() < HARDLY)


def clean(depth_m: Float32Array, camera: Camera, noise: DepthNoise) -> BoolArray:
    """Return the measured pixels (h, w) without specks and mixed pixels."""
    mixed = mixed_pixels(depth_m, tolerance_m=noise.tolerance_m(depth_m), pixel_m=depth_m / np.float32(camera.fx))
    return without_specks(_seen(depth_m) & ~mixed)


def _seen(depth_m: Float32Array) -> BoolArray:
    return np.isfinite(depth_m)


def _supported(depth_m: Float32Array, camera: Camera, noise: DepthNoise) -> bool:
    """Return whether a plane that faces up carries something, and has little below it."""
    stride = planning_stride(camera)
    points = point_image(depth_m[::stride, ::stride], camera, stride=stride)
    planes = dominant_planes(points, noise)
    seen = points[np.isfinite(points[..., 2])]
    tolerance = noise.tolerance_m(seen[:, 2])
    for plane in planes[upright(planes)]:
        height = heights(seen, plane)
        above, below = np.mean(height > tolerance), np.mean(height < -tolerance)
        if above > HARDLY and below < FEW and 1.0 - above - below > FEW:
            return True
    return False
