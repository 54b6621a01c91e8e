"""A model rendered into the view that registration compares a frame with."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.kernels import planes
from modeler.system.pictures import raycaster, tensor
from modeler.types import Array, BoolArray, Camera, Frame, ObjectModel, Plane, RayImage, area_vectors_m2
from modeler.views import Sensor

if TYPE_CHECKING:
    import open3d as o3d

_MARGIN = 0.35  # of a rendered image beside the model, as a share of the model's width: poses nearby fall into it
FINE_PX, COARSE_PX = 200.0, 64.0
"""Width of the model in an image: finer ones do not make poses more precise; enough for a search."""
MOST_PX = 2.0 * FINE_PX
"""Width of a rendered model at most; in poses near that of a frame of about `FINE_PX` it is narrower."""
_FAR = 100.0  # times the object's distance: depth beside a model, where nothing is
_MISSING_SHARE = 0.33  # of a closed model's surface; half a ball, as what was seen from one side, lacks a third


@dataclass(frozen=True, eq=False)
class ModelRenderer:
    """Renders a model as a depth camera would see it, without noise.

    Surface that no view saw says nothing, nor does what is seen through a hole. Beside the outline of a model that is
    closed but for small parts, such as the side it stood on, space is free; beside others, nothing is known.
    """

    model: ObjectModel
    """The model, in m."""

    @property
    def has_surface(self) -> bool:
        """Whether there is any surface that a view saw."""
        return bool(self._seen.any())

    @cached_property
    def centre_m(self) -> Array:
        """Middle (3,) of the box around the surface, in the model frame."""
        return 0.5 * (self._seen_m.min(axis=0) + self._seen_m.max(axis=0))

    @cached_property
    def radius_m(self) -> float:
        """Radius of the sphere about the centre that contains the surface."""
        return float(np.linalg.norm(self._seen_m - self.centre_m, axis=1).max())

    @cached_property
    def sigma_m(self) -> float:
        """Median standard deviation of the surface along its normal; 0 where it is not known."""
        sigmas_m = self.model.vertex_sigmas_m
        known = np.zeros(0) if sigmas_m is None else sigmas_m[np.isfinite(sigmas_m)]
        return float(np.median(known)) if len(known) else 0.0

    @cached_property
    def closed(self) -> bool:
        """Whether next to nothing of the surface is missing.

        The vector areas of a closed surface sum to 0; what they sum to is the area of the plane hole that is left.
        """
        vectors_m2 = area_vectors_m2(self.model.vertices_m, self.model.triangles[self._seen])
        hole_m2 = float(np.linalg.norm(vectors_m2.sum(axis=0)))
        return hole_m2 <= _MISSING_SHARE * (hole_m2 + float(np.linalg.norm(vectors_m2, axis=1).sum()))

    def view(
        self,
        camera_from_model: Array,
        camera: Camera,
        sensor: Sensor,
        *,
        most_px: float = MOST_PX,
        index: int = -1,
        time_s: float = 0.0,
        plane: Plane | None = None,
    ) -> RayImage:
        """Return the view of the model in a pose, in camera coordinates; without surface points if none faces it.

        Args:
            camera_from_model: (4, 4).
            camera: intrinsics of the frame that it is compared with.
            sensor: of that frame, whose smoothing the model gets, unless it was fused from smoothed views.
            most_px: width of the model in the image at most.
            index: frame number of the view.
            time_s: time of the view.
            plane: support plane of the view.
        """
        camera, step = self._cropped(camera_from_model, camera, most_px)
        depth_m, seen, unknown, hits = self._cast(camera_from_model, camera)
        colour = None
        if self.model.vertex_colours is not None:
            colour = hits.image(np.rint(hits.interpolated(self.model.vertex_colours)).astype(np.uint8), depth_m.shape)
        frame = Frame(index, time_s, depth_m, camera, seen, colour, unknown)
        smoothing = sensor.smoothing if self.model.vertex_sigmas_m is None else 0.0
        exact = replace(
            sensor,
            smoothing=smoothing,
            noise_area_px=sensor.noise_area_px / step**2,
            pattern_share=0.0,
            sigma_inverse_per_m=0.0,
        )
        view = exact.ray_image(frame, plane)
        view = replace(view, sigma_focal=0.0, range_noise_m=self.sigma_m, rendered=True)
        if self._sigmas_m is None:
            return view
        return _with_variances(view, hits.image(hits.interpolated(self._sigmas_m) ** 2, depth_m.shape))

    def silhouette(self, camera_from_model: Array, camera: Camera, stride: int = 1) -> tuple[BoolArray, Array]:
        """Return where (h, w) the model covers the image, and its depth (h, w) in m there, infinite elsewhere.

        Args:
            camera_from_model: (4, 4).
            camera: of the image.
            stride: of the pixels that are cast, each of which stands for a square of as many.
        """
        w, h = (axis[::stride, ::stride] for axis in camera.rays())
        hits = self._scene.cast_rays(tensor(_rays(camera_from_model, w, h)))
        depth_m = hits["t_hit"].numpy()
        depth_m = np.repeat(np.repeat(depth_m, stride, axis=0), stride, axis=1)[: camera.height, : camera.width]
        return np.isfinite(depth_m), depth_m.astype(np.float64)

    def around(self, camera_from_model: Array, camera: Camera, radii: float) -> tuple[slice, slice]:
        """Return the rows and columns of an image within some radii of the model in a pose (4, 4), maybe none."""
        (x, y, z), near_m = self._place(camera_from_model)
        reach = radii * self.radius_m / near_m
        rows, columns = (
            slice(*np.clip([focal * (at - reach) + middle, focal * (at + reach) + middle + 1.0], 0, size).astype(int))
            for at, focal, middle, size in (
                (y / z, camera.fy, camera.cy, camera.height),
                (x / z, camera.fx, camera.cx, camera.width),
            )
        )
        return rows, columns

    def _place(self, camera_from_model: Array) -> tuple[tuple[float, float, float], float]:
        """Return the model's middle before the camera in a pose (4, 4), and the depth of what is nearest, in m."""
        x, y, z = se3.transform(camera_from_model, self.centre_m[None])[0]
        near_m = max(z - self.radius_m, 0.2 * self.radius_m)
        return (x, y, max(z, near_m)), near_m

    def _cropped(self, camera_from_model: Array, camera: Camera, most_px: float) -> tuple[Camera, float]:
        """Return the part of a camera's image around the model, at most so fine as is of use, and its pixels' width."""
        (x, y, z), near_m = self._place(camera_from_model)
        across, down = (2.0 * self.radius_m * focal / near_m for focal in (camera.fx, camera.fy))
        step = max(max(across, down) / most_px, 1.0)
        left, top = (
            camera.fx * x / z + camera.cx - (0.5 + _MARGIN) * across,
            camera.fy * y / z + camera.cy - (0.5 + _MARGIN) * down,
        )
        left, top = np.floor(left), np.floor(top)
        width, height = (int(np.ceil((1.0 + 2.0 * _MARGIN) * size / step)) for size in (across, down))
        cropped = Camera(
            width, height, camera.fx / step, camera.fy / step, (camera.cx - left) / step, (camera.cy - top) / step
        )
        return cropped, step

    def _cast(
        self, camera_from_model: Array, camera: Camera
    ) -> tuple[npt.NDArray[np.float32], BoolArray, BoolArray, _Hits]:
        """Return depth (h, w) in m, where seen surface is, where nothing is known, and where rays meet the surface."""
        shape, window = (camera.height, camera.width), self._window(camera_from_model, camera)
        rays = _rays(camera_from_model, *(axis[window] for axis in camera.rays()))
        found = self._scene.cast_rays(tensor(rays))
        near_m = found["t_hit"].numpy()
        met = np.isfinite(near_m)
        rows, columns = np.nonzero(met)
        triangle = found["primitive_ids"].numpy()[met]
        second, third = found["primitive_uvs"].numpy()[met].T
        corners = self.model.triangles[triangle]
        hits = _Hits(rows + window[0].start, columns + window[1].start, corners, second, third)
        facing = np.sum(found["primitive_normals"].numpy()[met] * rays[met][:, 3:], axis=1) < 0.0
        seen = hits.image(facing & self._seen[triangle], shape)
        depth_m = np.full(shape, _FAR * np.linalg.norm(camera_from_model[:3, 3]), dtype=np.float32)
        depth_m[hits.rows, hits.columns] = near_m[met]
        unknown = hits.image(np.ones(len(rows), dtype=bool), shape) & ~seen if self.closed else ~seen
        return depth_m, seen, unknown, hits

    def _window(self, camera_from_model: Array, camera: Camera) -> tuple[slice, slice]:
        """Return the rows and columns of an image in which the model may be."""
        corners = se3.transform(camera_from_model, self._corners_m)
        if corners[:, 2].min() <= 0.0:
            return slice(0, camera.height), slice(0, camera.width)
        x, y = corners[:, 0] / corners[:, 2], corners[:, 1] / corners[:, 2]
        ends = [
            np.clip([np.floor(place.min()), np.ceil(place.max()) + 1], 0, size).astype(int)
            for place, size in ((camera.fy * y + camera.cy, camera.height), (camera.fx * x + camera.cx, camera.width))
        ]
        return slice(*ends[0]), slice(*ends[1])

    @cached_property
    def _corners_m(self) -> Array:
        """Corners (8, 3) of the box around the model."""
        ends = self.model.vertices_m.min(axis=0), self.model.vertices_m.max(axis=0)
        return np.array(list(itertools.product(*zip(*ends, strict=True))))

    @cached_property
    def _sigmas_m(self) -> Array | None:
        """Standard deviation (v,) of vertices along their normals, 0 where unknown; None without any."""
        sigmas_m = self.model.vertex_sigmas_m
        return None if sigmas_m is None else np.where(np.isfinite(sigmas_m), sigmas_m, 0.0)

    @cached_property
    def _seen(self) -> BoolArray:
        """(t,) triangles of surface that was seen."""
        sigmas_m = self.model.vertex_sigmas_m
        if sigmas_m is None:
            return np.ones(len(self.model.triangles), dtype=bool)
        return np.asarray(np.isfinite(sigmas_m)[self.model.triangles].all(axis=1), dtype=bool)

    @cached_property
    def _seen_m(self) -> Array:
        return self.model.vertices_m[np.unique(self.model.triangles[self._seen])]

    @cached_property
    def _scene(self) -> o3d.t.geometry.RaycastingScene:
        return raycaster(self.model.vertices_m, self.model.triangles)


@dataclass(frozen=True, eq=False)
class _Hits:
    """Where rays meet the surface of a model."""

    rows: npt.NDArray[np.int64]
    """(n,) of the pixels."""
    columns: npt.NDArray[np.int64]
    """(n,) of the pixels."""
    corners: npt.NDArray[np.int64]
    """(n, 3) vertices of the triangles."""
    second: npt.NDArray[np.float32]
    """(n,) weight of the second vertex."""
    third: npt.NDArray[np.float32]
    """(n,) weight of the third."""

    def interpolated(self, values: np.ndarray) -> Array:
        """Return values (n, …) of vertices (v, …) where rays meet the surface."""
        one, two, three = (values[corner].astype(np.float64) for corner in self.corners.T)
        second, third = (weight.reshape(-1, *[1] * (values.ndim - 1)) for weight in (self.second, self.third))
        return one + second * (two - one) + third * (three - one)

    def image(self, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Return an image (h, w, …) of values (n, …), 0 elsewhere."""
        found = np.zeros((*shape, *values.shape[1:]), dtype=values.dtype)
        found[self.rows, self.columns] = values
        return found


def _rays(camera_from_model: Array, w: Array, h: Array) -> npt.NDArray[np.float32]:
    """Return origins and directions (…, 6) in the model frame of rays of unit depth through w and h (…)."""
    model_from_camera = se3.inverse(camera_from_model)
    turned = np.stack([w, h, np.ones_like(w)], axis=-1) @ model_from_camera[:3, :3].T
    origins = np.broadcast_to(model_from_camera[:3, 3], turned.shape)
    return np.concatenate([origins, turned], axis=-1).astype(np.float32)


def _with_variances(view: RayImage, variances_m2: Array) -> RayImage:
    """Return a view whose surface has these variances (h, w) in m² besides its own."""
    cells = view.layers["cells"].copy()
    cells[..., planes.VARIANCE] += np.where(cells[..., planes.KIND] == planes.SURFACE, variances_m2, 0.0)
    of_points = view.layers["variance_m2"] + variances_m2[view.pixels[:, 0], view.pixels[:, 1]]
    return replace(view, layers={**view.layers, "cells": cells, "variance_m2": of_points})
