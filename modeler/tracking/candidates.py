"""Where an object may be in a frame without a mask: pieces of the scene of about its size, off tables and walls."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from scipy import ndimage
from scipy.spatial import distance

from modeler import se3
from modeler.segmentation import DepthNoise, Segmenter
from modeler.segmentation.depth_images import (
    JUMP_SHARE,
    mixed_pixels,
    pieces,
    planning_stride,
    point_image,
    without_specks,
)
from modeler.segmentation.planes import (
    LEAST_SHARE,
    choose_support,
    dominant_planes,
    fit_beside,
    heights,
)
from modeler.tracking.rendering import ModelRenderer
from modeler.types import Array, BoolArray, Camera, Float32Array, Frame, Plane
from modeler.views.rays import part_of

_SCENERY = 0.7  # squares of the model's width: larger planes are tables and walls; a cube's face is a third of one
_GRAZING = 0.05  # least cosine of a plane with the line of sight, below which its area is not known
_LEAST, _MOST = 0.15, 1.3  # extent of a piece, in widths of the model
_AROUND = 1.1  # radii of the model around the seed of a part of a larger piece
_REACH = 0.15  # radii of the model by which it may have moved beyond its prediction
_SPARSE = 100  # pixels of a piece between which ways are looked for
_BARE = 0.03  # radii of the model by which a registered pose may be off: 0.05 leaves a quarter of what hides a boot
_REST = 0.05  # share of a mask up to which what hides the object does not matter
CLOSE: Final = 2.0
"""Radii of the model around it that show whether a plane is wider than it."""


@dataclass(frozen=True, eq=False)
class Things:
    """What a frame shows, apart from tables and walls."""

    frame: Frame
    """The frame, without depth of occluders."""
    points: Float32Array
    """(h, w, 3) its points, NaN where nothing was measured."""
    off: BoolArray
    """(h, w) what is measured off tables and walls, and on no edge between surfaces."""
    scenery: Array
    """(k, 4) normals and offsets of tables and walls, the largest first."""
    noise: DepthNoise
    """Of the depth camera."""

    def support(self, mask: BoolArray) -> Plane | None:
        """Return the table that what a mask (h, w) shows stands on, if one is seen."""
        body = self.points[mask & np.isfinite(self.points[..., 2])]
        chosen = choose_support(self.scenery, body, self._thin, self.noise)
        return None if chosen is None else self._planes[tuple(chosen)]

    @cached_property
    def _planes(self) -> dict[tuple[float, ...], Plane | None]:
        """The scenery with its uncertainty."""
        return {
            tuple(plane): fit_beside(self._thin, self._thin, guess=plane, noise=self.noise) for plane in self.scenery
        }

    @cached_property
    def _thin(self) -> Float32Array:
        """Some of the points (n, 3)."""
        stride = planning_stride(self.frame.camera)
        thin = self.points[::stride, ::stride]
        return thin[np.isfinite(thin[..., 2])]


@dataclass(frozen=True)
class CandidateFinder:
    """Finds pieces of a frame that may be the object."""

    most: int = 8
    """Most pieces, those whose size is most like the model's."""
    noise: DepthNoise = field(default_factory=DepthNoise)
    """Expected noise of the depth camera."""

    def things(self, frame: Frame, renderer: ModelRenderer, whole: Camera | None = None) -> Things:
        """Return what a frame shows off planes that are wider than the model.

        Args:
            frame: without depth of occluders.
            renderer: of the model.
            whole: camera of the frame that it is a part of, if it is. Planes that cover too little of the whole are no
                scenery: in a part, some of them cut through several things.
        """
        depth_m = np.where(frame.depth_m > 0.0, frame.depth_m, np.float32(np.nan)).astype(np.float32)
        points, whole = point_image(depth_m, frame.camera), whole or frame.camera
        tolerance_m, stride = self.noise.tolerance_m(depth_m), planning_stride(whole)
        pixel_m = (depth_m / frame.camera.fx).astype(np.float32)
        left: BoolArray = np.isfinite(depth_m) & ~mixed_pixels(depth_m, tolerance_m=tolerance_m, pixel_m=pixel_m)
        off, thin, scenery = left.copy(), points[::stride, ::stride], list[Array]()
        least_share = LEAST_SHARE * whole.width * whole.height / depth_m.size
        for plane in dominant_planes(thin, self.noise, least_share=least_share):
            # Off the larger planes, which small ones meet: a face of a box is not as wide as the table.
            on = left & (np.abs(heights(points, plane)) < tolerance_m)
            left &= ~on
            area_m2 = _areas_m2(thin, plane[:3], frame.camera, stride)
            labels = pieces(thin[..., 2], on[::stride, ::stride])
            areas = np.bincount(labels.ravel(), np.where(labels > 0, area_m2, 0.0).ravel())
            large = np.flatnonzero(areas > _SCENERY * (2.0 * renderer.radius_m) ** 2)
            if len(large):
                wide = np.asarray(ndimage.binary_dilation(np.isin(labels, large), iterations=2), dtype=np.bool_)
                wide = np.repeat(np.repeat(wide, stride, axis=0), stride, axis=1)[: off.shape[0], : off.shape[1]]
                off &= ~(on & wide)
                scenery.append(plane)
        return Things(frame, points, off, np.array(scenery).reshape(-1, 4), self.noise)

    def masks(self, things: Things, renderer: ModelRenderer) -> list[BoolArray]:
        """Return masks (h, w), the likeliest first."""
        width_m, points = 2.0 * renderer.radius_m, things.points
        labels = pieces(things.frame.depth_m, things.off)
        counts = np.bincount(labels.ravel())
        wholes, found = list[BoolArray](), list[tuple[bool, float, BoolArray]]()
        for label in np.flatnonzero(counts >= Segmenter.min_points):
            if label == 0:
                continue
            piece = labels == label
            for part in self._parts(piece, points, renderer):
                whole = part is piece
                if np.count_nonzero(part) >= Segmenter.min_points:
                    extent = _extent_m(points[part]) / width_m
                    if _LEAST < extent < _MOST:
                        found.append((not whole, abs(np.log(extent)), without_specks(part)))
                        wholes += [part] * whole
        for joined in _joined(wholes, points, _MOST * width_m):
            found.append((False, abs(np.log(_extent_m(points[joined]) / width_m)), without_specks(joined)))
        found.sort(key=lambda one: one[:2])  # whole pieces first
        return [mask for _, _, mask in found[: self.most]]

    def bared(
        self, things: Things, mask: BoolArray, camera_from_model: Array, renderer: ModelRenderer
    ) -> BoolArray | None:
        """Return a mask (h, w) without what hides the model in a registered pose (4, 4); None if nothing does.

        What hides it is apart from it in depth; surface that goes on is no reason to leave it out.
        """
        bare = self.near(things.frame, camera_from_model, renderer, things, reach=_BARE)
        rest = mask & ~bare
        if not bare.any() or np.count_nonzero(rest) < _REST * np.count_nonzero(mask):
            return None
        depth_m = things.points[..., 2]
        steps_m = np.concatenate(
            [
                np.abs(depth_m[one] - depth_m[other])[(bare[one] & rest[other]) | (rest[one] & bare[other])]
                for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1]))
            ]
        )
        goes_on = len(steps_m) and np.median(steps_m) < JUMP_SHARE * np.median(depth_m[bare])
        return None if goes_on else bare

    def near(
        self,
        frame: Frame,
        camera_from_model: Array,
        renderer: ModelRenderer,
        things: Things | None = None,
        *,
        reach: float = _REACH,
    ) -> BoolArray:
        """Return the mask (h, w) of what is near the model in a pose (4, 4), and not part of tables and walls.

        Args:
            frame: without depth of occluders.
            camera_from_model: (4, 4).
            renderer: of the model.
            things: of the frame, if they are known.
            reach: radii of the model by which what is near may be off its surface, twice that in depth.
        """
        mask = np.zeros(frame.depth_m.shape, dtype=bool)
        window = renderer.around(camera_from_model, frame.camera, CLOSE)
        if mask[window].size:
            part = part_of(frame, *window)
            off = self.things(part, renderer, frame.camera).off if things is None else things.off[window]
            mask[window] = without_specks(off & _close(part, camera_from_model, renderer, reach))
        return mask

    def _parts(self, piece: BoolArray, points: np.ndarray, renderer: ModelRenderer) -> Iterator[BoolArray]:
        """Yield a piece; if it is larger than the model, what of it is around each of some seeds far from each other.

        The seeds are those of farthest-point sampling: what is held or leans on something is not a piece by itself.
        """
        places = points[piece]
        low_m, high_m = np.percentile(places, [2.0, 98.0], axis=0)
        if np.linalg.norm(high_m - low_m) < _MOST * 2.0 * renderer.radius_m:
            yield piece
            return
        some = places[:: max(len(places) // 2000, 1)]
        distance_m, seed = np.full(len(some), np.inf), int(np.argmin(np.linalg.norm(some - some.mean(axis=0), axis=1)))
        for _ in range(self.most):
            around = piece.copy()
            around[piece] = np.linalg.norm(places - some[seed], axis=1) < _AROUND * renderer.radius_m
            yield around
            distance_m = np.minimum(distance_m, np.linalg.norm(some - some[seed], axis=1))
            seed = int(np.argmax(distance_m))
            if distance_m[seed] < renderer.radius_m:
                return


def _close(frame: Frame, camera_from_model: Array, renderer: ModelRenderer, reach: float) -> BoolArray:
    """Return the pixels (h, w) of a frame that are near the model in a pose (4, 4), see `CandidateFinder.near`."""
    centre_m = se3.transform(camera_from_model, renderer.centre_m[None])[0]
    reach_m = reach * renderer.radius_m
    reach_px = max(round(reach_m * frame.camera.fx / max(float(centre_m[2]), 1e-3)), 1)
    covered, depth_m = renderer.silhouette(camera_from_model, frame.camera, 2)
    rows, columns = np.nonzero(covered)
    if not len(rows):
        return covered
    window = (
        slice(max(rows.min() - 2 * reach_px, 0), rows.max() + 2 * reach_px + 1),
        slice(max(columns.min() - 2 * reach_px, 0), columns.max() + 2 * reach_px + 1),
    )
    size = 2 * reach_px + 1
    nearest = ndimage.minimum_filter(depth_m[window], size)
    farthest = -ndimage.minimum_filter(np.where(covered[window], -depth_m[window], np.inf), size)
    seen_m, close = frame.depth_m[window], np.zeros_like(covered)
    close[window] = (seen_m > nearest - 2.0 * reach_m) & (seen_m < farthest + 2.0 * reach_m)
    return close


def _extent_m(points: np.ndarray) -> float:
    """Return the diagonal of the box around points (n, 3) but for a few."""
    low_m, high_m = np.percentile(points, [2.0, 98.0], axis=0)
    return float(np.linalg.norm(high_m - low_m))


def _joined(some: list[BoolArray], points: np.ndarray, most_m: float) -> list[BoolArray]:
    """Return unions (h, w) of pieces that may be parts of one thing, which something hides between them.

    Args:
        some: pieces (h, w).
        points: (h, w, 3) of the frame.
        most_m: largest extent of a union.
    """
    places = [np.argwhere(piece) for piece in some]
    places = [place[:: max(len(place) // _SPARSE, 1)] for place in places]
    linked = np.zeros((len(some), len(some)), dtype=bool)
    for one in range(len(some)):
        for other in range(one):
            linked[one, other] = linked[other, one] = _hidden_between(places[one], places[other], points[..., 2])
    unions = set[frozenset[int]]()
    for first in range(len(some)):
        union = {first}
        while True:
            further = [k for k in np.flatnonzero(linked[list(union)].any(axis=0)) if k not in union]
            joined = [np.concatenate([places[k] for k in (*union, one)]) for one in further]
            extents_m = [_extent_m(points[tuple(place.T)]) for place in joined]
            if not further or min(extents_m) > most_m:
                break
            union.add(int(further[int(np.argmin(extents_m))]))
        if len(union) > 1:
            unions.add(frozenset(union))
    return [np.any([some[k] for k in sorted(union)], axis=0) for union in sorted(unions, key=sorted)]


def _hidden_between(one: np.ndarray, other: np.ndarray, depth_m: np.ndarray) -> bool:
    """Return whether most of the shortest way in an image (h, w) between pixels (n, 2) and others (m, 2) is hidden.

    What is hidden was not measured, or is nearer than both of its ends.
    """
    apart = distance.cdist(one, other)
    ends = np.unravel_index(np.argmin(apart), apart.shape)
    start, end = one[ends[0]], other[ends[1]]
    way = np.rint(np.linspace(start, end, int(apart[ends]) + 2)[1:-1]).astype(int)
    between_m = depth_m[tuple(way.T)]
    nearest_m = min(depth_m[tuple(start)], depth_m[tuple(end)])
    return float(np.mean(~(between_m >= nearest_m))) > 0.5


def _areas_m2(points: np.ndarray, normal: Array, camera: Camera, stride: int) -> np.ndarray:
    """Return the areas (…) in m² of pixels on a plane.

    Args:
        points: (…, 3) of every `stride`-th pixel.
        normal: (3,) of the plane.
        camera: of the image.
        stride: pixels from one to the next.
    """
    slants = np.maximum(np.abs(points / points[..., 2:] @ normal.astype(np.float32)), _GRAZING)
    return (stride * points[..., 2]) ** 2 / (camera.fx * camera.fy) / slants
