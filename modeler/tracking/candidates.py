"""Where an object may be in a frame without a mask: pieces of the scene of about its size, off tables and walls."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from scipy import ndimage

from modeler import se3
from modeler.segmentation import DepthNoise, Segmenter
from modeler.segmentation.depth_images import mixed_pixels, pieces, planning_stride, point_image, without_specks
from modeler.segmentation.planes import dominant_planes, heights
from modeler.tracking.rendering import ModelRenderer
from modeler.types import Array, BoolArray, Camera, Frame, Plane
from modeler.views.rays import part_of

_SCENERY = 0.7  # squares of the model's width: larger planes are tables and walls; a cube's face is a third of one
_GRAZING = 0.05  # least cosine of a plane with the line of sight, below which its area is not known
_LEAST, _MOST = 0.15, 1.3  # extent of a piece, in widths of the model
_AROUND = 1.1  # radii of the model around the seed of a part of a larger piece
_REACH = 0.15  # radii of the model by which it may have moved beyond its prediction
CLOSE: Final = 2.0
"""Radii of the model around it that show whether a plane is wider than it."""


@dataclass(frozen=True)
class CandidateFinder:
    """Finds pieces of a frame that may be the object."""

    most: int = 8
    """Most pieces, those whose size is most like the model's."""
    noise: DepthNoise = field(default_factory=DepthNoise)
    """Expected noise of the depth camera."""

    def masks(self, frame: Frame, renderer: ModelRenderer) -> list[BoolArray]:
        """Return masks (h, w), the likeliest first.

        Args:
            frame: without depth of occluders.
            renderer: of the model.
        """
        width_m, points = 2.0 * renderer.radius_m, self._points(frame)
        off = self._off_scenery(frame, points, width_m, planning_stride(frame.camera))
        labels = pieces(frame.depth_m, off)
        counts = np.bincount(labels.ravel())
        found: list[tuple[bool, float, BoolArray]] = []
        for label in np.flatnonzero(counts >= Segmenter.min_points):
            if label == 0:
                continue
            piece = labels == label
            for part in self._parts(piece, points, renderer):
                whole = part is piece
                if np.count_nonzero(part) >= Segmenter.min_points:
                    low_m, high_m = np.percentile(points[part], [2.0, 98.0], axis=0)
                    extent = float(np.linalg.norm(high_m - low_m)) / width_m
                    if _LEAST < extent < _MOST:
                        found.append((not whole, abs(np.log(extent)), without_specks(part)))
        found.sort(key=lambda one: one[:2])  # whole pieces first
        return [mask for _, _, mask in found[: self.most]]

    def is_scenery(self, plane: Plane, frame: Frame, renderer: ModelRenderer) -> bool:
        """Return whether a plane is that of a table or wall: larger than the model."""
        stride = planning_stride(frame.camera)
        thin = self._points(frame)[::stride, ::stride]
        on = thin[np.abs(plane.height_m(thin)) < self.noise.tolerance_m(thin[..., 2])]
        area_m2 = _areas_m2(on, plane.normal, frame.camera, stride).sum()
        return bool(area_m2 > _SCENERY * (2.0 * renderer.radius_m) ** 2)

    def near(self, frame: Frame, camera_from_model: Array, renderer: ModelRenderer) -> BoolArray:
        """Return the mask (h, w) of what is near the model in a pose (4, 4), and not part of tables and walls."""
        mask = np.zeros(frame.depth_m.shape, dtype=bool)
        window = renderer.around(camera_from_model, frame.camera, CLOSE)
        if mask[window].size:
            stride = planning_stride(frame.camera)
            mask[window] = self._near(part_of(frame, *window), camera_from_model, renderer, stride)
        return mask

    def _near(self, frame: Frame, camera_from_model: Array, renderer: ModelRenderer, stride: int) -> BoolArray:
        """Return `near` of the part of a frame around the pose."""
        centre_m = se3.transform(camera_from_model, renderer.centre_m[None])[0]
        reach_m = _REACH * renderer.radius_m
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
        seen_m, points = frame.depth_m[window], self._points(frame)
        close = (seen_m > nearest - 2.0 * reach_m) & (seen_m < farthest + 2.0 * reach_m)
        mask = np.zeros_like(covered)
        mask[window] = close
        return without_specks(mask & self._off_scenery(frame, points, 2.0 * renderer.radius_m, stride))

    def _points(self, frame: Frame) -> np.ndarray:
        """Return the points (h, w, 3) of a frame."""
        depth_m = np.where(frame.depth_m > 0.0, frame.depth_m, np.float32(np.nan)).astype(np.float32)
        return point_image(depth_m, frame.camera)

    def _off_scenery(self, frame: Frame, points: np.ndarray, width_m: float, stride: int) -> BoolArray:
        """Return the measured pixels (h, w) off planes that are wider than the model, and between surfaces."""
        depth_m = points[..., 2]
        tolerance_m = self.noise.tolerance_m(depth_m)
        pixel_m = (depth_m / frame.camera.fx).astype(np.float32)
        off: BoolArray = np.isfinite(depth_m) & ~mixed_pixels(depth_m, tolerance_m=tolerance_m, pixel_m=pixel_m)
        thin = points[::stride, ::stride]
        for plane in dominant_planes(thin, self.noise):
            on = np.abs(heights(points, plane)) < tolerance_m
            area_m2 = _areas_m2(thin, plane[:3], frame.camera, stride)
            labels = pieces(thin[..., 2], on[::stride, ::stride])
            areas = np.bincount(labels.ravel(), np.where(labels > 0, area_m2, 0.0).ravel())
            large = np.flatnonzero(areas > _SCENERY * width_m**2)
            if len(large):
                wide = np.asarray(ndimage.binary_dilation(np.isin(labels, large), iterations=2), dtype=np.bool_)
                wide = np.repeat(np.repeat(wide, stride, axis=0), stride, axis=1)[: off.shape[0], : off.shape[1]]
                off &= ~(on & wide)
        return off

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
            around = piece & (np.linalg.norm(points - some[seed], axis=2) < _AROUND * renderer.radius_m)
            yield around
            distance_m = np.minimum(distance_m, np.linalg.norm(some - some[seed], axis=1))
            seed = int(np.argmax(distance_m))
            if distance_m[seed] < renderer.radius_m:
                return


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
