"""What a handful of frames says about a scene: what stands still, where the object is, and what it stands on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from modeler.segmentation.clusters import Labels, edge_of, pieces
from modeler.segmentation.layers import Layers
from modeler.segmentation.noise import DepthNoise
from modeler.segmentation.plane_fit import heights
from modeler.segmentation.planes import choose_support, dominant_planes, fit_beside, parallel, surroundings, upright
from modeler.types import Array, BoolArray, Float32Array, Plane

_CARRIED_SHARE = 0.2  # of a pile that stands on its upper plane, for that to be a support and not a lid
_NEIGHBOUR_SIZES = 0.5  # how far from what moves most, in its sizes, its other parts move
_ELSEWHERE = 0.3  # of the merit of all that moves: from here on something else may be the object
_WALL_BORDER_SHARE = 0.03  # of the image's edge that lies on a plane which runs out of the image
_IN_FRONT_SHARE = 0.9  # of the object that a wall has in front of it
_TOUCHING_PX = 3


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """What is known before a frame is segmented. Of an empty scene nothing is known: each frame is judged alone."""

    plane: Plane | None = None
    """The support plane, where one was found."""
    still_m: Float32Array | None = None
    """(h, w), thinned: depth of all that stands still; NaN where there is nothing."""
    scenery_m: Float32Array | None = None
    """(h, w), thinned: depth of walls and things that stand about, at and beyond which is no object; else infinite."""
    zone_m: Array | None = None
    """(2, 3) low and high corner, in camera coordinates, of the box in which the object was seen."""
    areas_m2: tuple[float, float] | None = None
    """Least and greatest area that the object showed to the camera."""
    sure: bool = True
    """Whether there is no doubt about which thing is the object and which plane its support."""
    still: bool = False
    """Whether camera and scenery stand still, so that the scene holds for other frames."""
    alone: bool = False
    """Whether the frames show the object and nothing else."""
    noise: DepthNoise | None = None
    """Noise of the depth camera, where the frames show more of it than was expected."""


def telling(indices: Sequence[int], *, count: int = 15) -> tuple[int, ...]:
    """Return the numbers of at most `count` frames, evenly spread over a sequence, that tell what its scene is."""
    places = np.linspace(0, len(indices) - 1, min(count, len(indices))).round()
    return tuple(indices[place] for place in places.astype(np.int64).tolist())


def learn(layers: Layers, allowed: BoolArray, noise: DepthNoise, *, least_points: float) -> Scene:
    """Return what layers say about the scene.

    Args:
        layers: of one frame or several.
        allowed: (h, w) where the object may be.
        noise: of the depth camera.
        least_points: pixels of the thinned image below which a motion says nothing.
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
    zone = np.percentile(layers.front_m[found], [1.0, 99.0], axis=0).astype(np.float64)
    plane = None
    if guess is not None:
        ground = layers.back_m[layers.still & surroundings(layers.front_m, found)]
        plane = fit_beside(ground, layers.front_m[found], guess=guess, noise=noise)
    guess = None if plane is None else guess
    return Scene(plane, still, _scenery(layers, found, planes, guess, noise), zone, sure=sure)


def _moving_object(layers: Layers, allowed: BoolArray) -> tuple[BoolArray, bool]:
    """Find what moves most, nearest and most centrally, and what moves next to it.

    Returns:
        Its pixels (h, w), and whether nothing else moves nearly as much.
    """
    depth = layers.front_m[..., 2]
    labels = pieces(depth, layers.moved & allowed)
    merit = _central(labels, depth, layers.front_share)
    if merit.max() <= 0.0:
        return np.zeros_like(layers.moved), True
    low, high = np.percentile(layers.front_m[labels == int(merit.argmax())], [2.0, 98.0], axis=0)
    margin = _NEIGHBOUR_SIZES * float(np.linalg.norm(high - low))
    near = ((layers.front_m > low - margin) & (layers.front_m < high + margin)).all(axis=-1)
    elsewhere = _central(np.where(near, 0, labels), depth, layers.front_share).sum()
    return layers.moved & allowed & near, bool(elsewhere < _ELSEWHERE * merit.sum())


def _standing_object(
    planes: Array, points: Float32Array, allowed: BoolArray, noise: DepthNoise
) -> tuple[Array | None, BoolArray, bool]:
    """Find, in one image, the support at the centre and what stands on it.

    Climbs the parallel planes that face up, from the lowest to the highest that still carries a good part of what
    stands on the one below it: from the floor to the table to the turntable's plate, but not to the lid of a box.

    Returns:
        The support (4,), or None where there is no plane; the pixels (h, w) of the object; and whether that was the
        only level to choose.
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
    for wall in _walls(planes[~facing] if facing.any() else planes[1:], points, noise):
        free &= ~(np.abs(heights(points, wall)) < tolerance)
    for level in levels[np.argsort(-levels[:, 3])]:
        labels = pieces(depth, free & (heights(points, level) > tolerance))
        merit = _central(labels, depth, np.ones_like(depth))
        piece = labels == int(merit.argmax())
        beside = np.count_nonzero(found & (np.abs(heights(points, level)) > tolerance))
        if merit.max() > 0.0 and np.count_nonzero(piece) > _CARRIED_SHARE * beside:
            support, found, levels_used = level, piece, levels_used + 1
    return support, found, levels_used == 1


def _central(labels: Labels, depth_m: Float32Array, weight: Float32Array) -> npt.NDArray[np.float64]:
    """Return the merit of each label, 0 for label 0: its weight near the image's centre, nearer things first."""
    rows, columns = (np.linspace(-1.0, 1.0, n, dtype=np.float32) for n in labels.shape)
    centred = np.exp(-2.0 * (rows[:, None] ** 2 + columns**2))
    merit = np.bincount(labels.ravel(), np.where(labels > 0, weight * centred / depth_m**2, 0.0).ravel())
    merit[0] = 0.0
    return merit.astype(np.float64)


def _walls(planes: Array, points: Float32Array, noise: DepthNoise) -> list[Array]:
    """Return those planes that run out of the image."""
    edge = edge_of(np.isfinite(points[..., 2]))
    rim = points[edge]
    tolerance = noise.tolerance_m(rim[:, 2])
    least = _WALL_BORDER_SHARE * len(rim)
    return [plane for plane in planes if np.count_nonzero(np.abs(heights(rim, plane)) < tolerance) > least]


def _scenery(layers: Layers, found: BoolArray, planes: Array, support: Array | None, noise: DepthNoise) -> Float32Array:
    """Return the depth (h, w) at and beyond which is no object, infinite where that is not known.

    A still piece above the support that does not run out of the image may be the object's own: the middle of a mug on
    a turntable looks still, and only its handle moves. Without a support, nothing still is the object's. Walls with all
    of the object before them go on behind it.
    """
    back = layers.back_m[..., 2]
    above = layers.still & ~found
    if support is not None:
        above &= heights(layers.back_m, support) > noise.tolerance_m(back)
    labels = pieces(back, above)
    touching = np.bincount(labels[edge_of(np.isfinite(back))], minlength=int(labels.max()) + 1)
    outside = touching >= _TOUCHING_PX
    outside |= support is None
    outside[0] = False
    depth = np.where(outside[labels], back, np.float32(np.inf))
    body = layers.front_m[found]
    tolerance = noise.tolerance_m(body[:, 2])
    for wall in _walls(planes, layers.back_m, noise):
        is_support = support is not None and bool((wall == support).all())
        if is_support or np.mean(heights(body, wall) > -tolerance) < _IN_FRONT_SHARE:
            continue
        facing = layers.rays @ wall[:3].astype(np.float32)
        behind = np.float32(wall[3]) / np.maximum(-facing, np.float32(1e-6))
        depth = np.where(layers.still, depth, np.minimum(depth, behind))
    return depth
