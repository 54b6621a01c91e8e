"""The growing model: a TSDF to which views are added one by one, and again where their poses have changed."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.fusion import meshing
from modeler.fusion.depth_views import GREY, free_of, posed_views
from modeler.fusion.fuser import Fuser
from modeler.fusion.meshing import crossed
from modeler.kernels import marching_cubes, tsdf
from modeler.types import Array, ObjectModel, RayImage

KNOWN = 0.02  # least weight of a known voxel; far above what rounding leaves when a view is removed
MARGIN = 8  # pixels around the object in which empty space is integrated, and voxels by which the box is enlarged
BULK = (0.005, 0.995)  # points outside these quantiles do not enlarge the box

Corner = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class _Integrated:
    """The pose and box with which a view was integrated."""

    object_from_camera: Array
    low: Corner
    high: Corner
    """The box at that time, in voxels: the view is missing from what was added to it since."""
    corners_m: Array
    """(8, 3) of a box in camera coordinates around what the view sees of the object."""
    view: RayImage
    """The view, for when it is removed."""


@dataclass(frozen=True, eq=False)
class IncrementalTsdf:
    """A coarse model for previews.

    Each voxel holds sums over the views (Curless and Levoy 1996), so that a view whose pose has changed can be removed
    and integrated again without touching the others (Dai et al. 2017, "BundleFusion", section 5).
    """

    fuser: Fuser
    """Parameters."""
    voxel_m: float = 0.0
    """Side of a voxel; 0 = no view yet."""
    low: Corner = (0, 0, 0)
    """Lowest corner of the box, in voxels from the origin of the object frame."""
    sums: npt.NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0, 0, 6), dtype=np.float32))
    """(x, y, z, 6), see `tsdf.integrate_view`."""
    integrated: Mapping[int, _Integrated] = field(default_factory=dict)
    """By frame number."""

    def updated(self, views: Mapping[int, RayImage], trajectory: Mapping[int, Array]) -> IncrementalTsdf:
        """Return the model with new views added, those without a pose removed, and those that moved most moved.

        Args:
            views: by frame number.
            trajectory: object_from_camera (4, 4) by frame number.

        Raises:
            InputError: if no view with surface points has a pose.
        """
        pairs = {view.index: (view, pose) for view, pose in posed_views(views, trajectory) if len(view.points_m)}
        # As many points as the viewer shows of an object.
        voxel_m = self.voxel_m or 2.5 * self.fuser.voxel_side_m(list(pairs.values()))
        after = self if self.voxel_m else replace(self, voxel_m=voxel_m)
        new = [frame for frame in pairs if frame not in self.integrated]
        moved_m = _shifts_m(pairs, self.integrated)
        moved = sorted((frame for frame in moved_m if moved_m[frame] > 0.5 * voxel_m), key=lambda k: -moved_m[k])
        moved = moved[: self.fuser.preview_moves]
        gone = [frame for frame in self.integrated if frame not in pairs]
        if not (new or moved or gone):
            return self
        low, high = after._box([pairs[frame] for frame in (*new, *moved)])
        if np.prod(np.subtract(high, low), dtype=np.float64) > self.fuser.preview_limit:
            return IncrementalTsdf(self.fuser, 1.5 * voxel_m).updated(views, trajectory)
        after, integrated = after._enlarged(low, high), dict(self.integrated)
        for frame in (*gone, *moved):
            after._integrate(integrated.pop(frame), -1.0)
        for frame in (*new, *moved):
            view, object_from_camera = pairs[frame]
            integrated[frame] = _Integrated(object_from_camera, low, high, _corners_m(view), view)
            after._integrate(integrated[frame], 1.0)
        return replace(after, integrated=integrated)

    @property
    def tau_m(self) -> float:
        """Half width of the truncation band."""
        return 3.0 * self.voxel_m

    def model(self) -> ObjectModel:
        """Return the surface as a mesh, and its vertices as the cloud."""
        weights = self.sums[..., 0].copy()
        weights[weights < KNOWN] = 0.0
        for axis in range(3):
            np.moveaxis(weights, axis, 0)[[0, -1]] = 0.0
        values = np.divide(self.sums[..., 1], weights, out=np.zeros_like(weights), where=weights > 0.0)
        positions, triangles = marching_cubes.extract(values, weights, crossed(values))
        shown = triangles[meshing.large_pieces(positions, triangles)]
        used, shown = meshing.used_vertices(shown, len(positions))
        positions = positions[used]
        vertices_m = (np.array(self.low) + positions + 0.5) * self.voxel_m
        normals = meshing.normals_of(vertices_m, shown)
        colours = self._colours(positions)
        return ObjectModel(
            points_m=vertices_m,
            normals=normals,
            colours=colours,
            vertices_m=vertices_m,
            triangles=shown,
            vertex_normals=normals,
            vertex_colours=colours,
        )

    def _colours(self, positions: Array) -> npt.NDArray[np.uint8] | None:
        """Return the RGB (n, 3) of the voxels nearest to positions in voxels; None if no view has colour."""
        if not np.any(self.sums[..., 2] > KNOWN):
            return None
        cells = self.sums[tuple(np.rint(positions).astype(np.int64).T)]
        share = cells[:, 2:3]
        mean = np.where(share > KNOWN, cells[:, 3:] / np.maximum(share, KNOWN), GREY)
        return np.clip(np.rint(mean), 0.0, 255.0).astype(np.uint8)

    def _box(self, pairs: list[tuple[RayImage, Array]]) -> tuple[Corner, Corner]:
        """Return the corners, in voxels, of a box around the model and the surface points of these views."""
        lows = [np.array(self.low)] if self.sums.size else []
        highs = [np.array(self.low) + self.sums.shape[:3]] if self.sums.size else []
        border, unit_m = self.tau_m + 2.0 * self.voxel_m, MARGIN * self.voxel_m
        for view, pose in pairs:
            low_m, high_m = np.quantile(se3.transform(pose, view.points_m), BULK, axis=0)
            lows.append(MARGIN * np.floor((low_m - border) / unit_m).astype(np.int64))
            highs.append(MARGIN * np.ceil((high_m + border) / unit_m).astype(np.int64))
        return _corner(np.min(lows, axis=0)), _corner(np.max(highs, axis=0))

    def _enlarged(self, low: Corner, high: Corner) -> IncrementalTsdf:
        """Return the model with a copy of its sums in a larger box."""
        sums = np.zeros((*np.subtract(high, low), 6), dtype=np.float32)
        if self.sums.size:
            x, y, z = np.subtract(self.low, low)
            nx, ny, nz = self.sums.shape[:3]
            sums[x : x + nx, y : y + ny, z : z + nz] = self.sums
        return replace(self, low=low, sums=sums)

    def _integrate(self, at: _Integrated, sign: float) -> None:
        """Add a view to the sums in place (sign 1), or remove it (sign -1)."""
        view = at.view
        index, free_m, intrinsics = _images(view, self.fuser.margin_px)
        cosine = -np.sum(view.points_m * view.normals, axis=1) / np.linalg.norm(view.points_m, axis=1)
        colours = np.ones((len(view.points_m), 4))
        colours[:, :3] = GREY if view.frame.colour is None else view.frame.colour[tuple(view.pixels.T)]
        colours[:, 3] = view.frame.colour is not None
        tsdf.integrate_view(
            self.sums,
            np.subtract((at.low, at.high), self.low),
            np.array(at.low) * self.voxel_m,
            self.voxel_m,
            self.tau_m,
            self.fuser.empty_weight,
            sign,
            se3.inverse(at.object_from_camera)[:3],
            intrinsics,
            index,
            free_m,
            se3.transform(at.object_from_camera, view.points_m),
            view.normals @ at.object_from_camera[:3, :3].T,
            np.where(cosine >= self.fuser.min_cosine, cosine, 0.0),
            colours,
        )


@dataclass(eq=False)
class Preview:
    """The model of a run in progress, made on request, also from several threads."""

    fuser: Fuser
    """Parameters."""

    def __post_init__(self) -> None:
        """Start without views."""
        self._tsdf, self._model, self._lock = IncrementalTsdf(self.fuser), None, threading.Lock()

    def model(self, views: Mapping[int, RayImage], trajectory: Mapping[int, Array]) -> ObjectModel | None:
        """Return the model of views, incrementally from the last request; None without views.

        Args:
            views: by frame number.
            trajectory: object_from_camera (4, 4) by frame number; views without a pose are left out.

        Raises:
            InputError: if no view with surface points has a pose.
        """
        if not views:
            return None
        with self._lock:
            before, self._tsdf = self._tsdf, self._tsdf.updated(views, trajectory)
            if self._model is None or self._tsdf is not before:
                self._model = self._tsdf.model()
            return self._model


def _corner(numbers: npt.NDArray[np.int64]) -> Corner:
    return int(numbers[0]), int(numbers[1]), int(numbers[2])


def _images(view: RayImage, margin_px: int) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32], Array]:
    """Return a view's surface point numbers, free depth and intrinsics, cropped to the object."""
    camera, depth_m = view.frame.camera, view.frame.depth_m
    low = np.maximum(view.pixels.min(axis=0) - MARGIN, 0)
    high = np.minimum(view.pixels.max(axis=0) + MARGIN + 1, depth_m.shape)
    cropped = depth_m[low[0] : high[0], low[1] : high[1]]
    index = np.full(cropped.shape, -1, dtype=np.int32)
    index[tuple((view.pixels - low).T)] = np.arange(len(view.pixels))
    intrinsics = np.array([camera.fx, camera.fy, camera.cx - low[1], camera.cy - low[0]])
    return index, free_of(cropped, margin_px), intrinsics


def _shifts_m(pairs: Mapping[int, tuple[RayImage, Array]], integrated: Mapping[int, _Integrated]) -> dict[int, float]:
    """Return the largest displacement of what each view sees due to the change of its pose since it was integrated."""
    frames = [frame for frame in pairs if frame in integrated]
    if not frames:
        return {}
    moved = np.stack([pairs[frame][1] - integrated[frame].object_from_camera for frame in frames])
    corners_m = np.stack([integrated[frame].corners_m for frame in frames])
    shifts_m = corners_m @ np.swapaxes(moved[:, :3, :3], 1, 2) + moved[:, None, :3, 3]
    return dict(zip(frames, np.linalg.norm(shifts_m, axis=2).max(axis=1).tolist(), strict=True))


def _corners_m(view: RayImage) -> Array:
    """Return the corners (8, 3) of a box in camera coordinates around the surface points of a view."""
    ends = np.stack([view.points_m.min(axis=0), view.points_m.max(axis=0)])
    return ends[np.indices((2, 2, 2)).reshape(3, 8).T, np.arange(3)]
