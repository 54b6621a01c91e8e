"""The model while frames still come: it grows by a view at a time, and follows the poses where they move."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.fusion import surface
from modeler.fusion.crop import GREY, colours_at, free_of
from modeler.fusion.views import posed
from modeler.kernels import isosurface, preview
from modeler.kernels.pieces import PIECES
from modeler.types import Array, ObjectModel, RayImage

if TYPE_CHECKING:
    from modeler.fusion.fuser import Fuser

KNOWN = 0.02  # weight from which on something is known of a voxel; what taking a view back leaves is far less
MARGIN_PX = 8  # what a view saw empty is used so far around the object
UNIT = 8  # the box grows by so many voxels
BULK = (0.005, 0.995)  # points outside these quantiles do not stretch the box

Corner = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class _Place:
    """Where a view was added."""

    object_from_camera: Array
    low: Corner
    high: Corner
    """The box of that time, in voxels: what has grown since does not know of the view."""
    corners_m: Array
    """(8, 3) of a box in camera coordinates around what the view sees of the object."""


@dataclass(frozen=True, eq=False)
class IncrementalTsdf:
    """A coarse model that is kept up to date.

    Each voxel holds plain sums over the views (Curless and Levoy 1996), so that a view whose pose has moved is taken
    back and added anew without touching the others (Dai et al. 2017, "BundleFusion", section 5).
    """

    fuser: Fuser
    """Parameters."""
    voxel_m: float = 0.0
    """Side of a voxel; 0 = no view yet."""
    low: Corner = (0, 0, 0)
    """Lowest corner of the box: that many voxels from the origin of the object frame."""
    sums: npt.NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0, 0, 6), dtype=np.float32))
    """(x, y, z, 6), see `modeler.kernels.preview`."""
    places: Mapping[int, _Place] = field(default_factory=dict)
    """By frame number."""

    def to(self, views: Mapping[int, RayImage], trajectory: Mapping[int, Array]) -> IncrementalTsdf:
        """Return the model with new views added, and with those carried along whose poses have moved most.

        Args:
            views: by frame number; those without a pose are left out.
            trajectory: object_from_camera (4, 4) by frame number.

        Raises:
            InputError: where no view with surface points has a pose.
        """
        pairs = {view.index: (view, pose) for view, pose in posed(views, trajectory) if len(view.points_m)}
        voxel_m = self.voxel_m or self.fuser.preview_voxels * self.fuser.side_m(list(pairs.values()))
        after = self if self.voxel_m else replace(self, voxel_m=voxel_m)
        new = [frame for frame in pairs if frame not in self.places]
        moved_m = _shifts_m(pairs, self.places)
        moved = sorted((frame for frame in moved_m if moved_m[frame] > 0.5 * voxel_m), key=lambda k: -moved_m[k])
        moved = moved[: self.fuser.preview_moves]
        gone = [frame for frame in self.places if frame not in pairs and frame in views]
        if not (new or moved or gone):
            return self
        low, high = after._box([pairs[frame] for frame in (*new, *moved)])
        if np.prod(np.subtract(high, low)) > self.fuser.preview_limit:
            return IncrementalTsdf(self.fuser, 1.5 * voxel_m).to(views, trajectory)
        after, places = after._grown(low, high), dict(self.places)
        for frame in (*gone, *moved):
            after._integrate(views[frame], places.pop(frame), -1.0)
        for frame in (*new, *moved):
            places[frame] = _Place(pairs[frame][1], low, high, _corners_m(pairs[frame][0]))
            after._integrate(pairs[frame][0], places[frame], 1.0)
        return replace(after, places=places)

    @property
    def tau_m(self) -> float:
        """Half width of the band around the surface within which distances are measured."""
        return 3.0 * self.voxel_m

    def model(self) -> ObjectModel:
        """Return the surface as a mesh, and its vertices as the cloud."""
        weights = self.sums[..., 0].copy()
        weights[weights < KNOWN] = 0.0
        for axis in range(3):
            np.moveaxis(weights, axis, 0)[[0, -1]] = 0.0
        known = weights > 0.0
        values = np.where(known, self.sums[..., 1] / np.where(known, weights, 1.0), 0.0).astype(np.float32)
        places, triangles = isosurface.extract(values, weights, np.argwhere(known), PIECES)
        shown = triangles[surface.large_pieces(places, triangles, self.fuser.min_piece)]
        used, shown = surface.compacted(shown, len(places))
        places = places[used]
        vertices_m = (np.array(self.low) + places + 0.5) * self.voxel_m
        normals = surface.normals_of(vertices_m, shown)
        colours = self._colours(places)
        return ObjectModel(
            points_m=vertices_m,
            normals=normals,
            colours=colours,
            vertices_m=vertices_m,
            triangles=shown,
            vertex_normals=normals,
            vertex_colours=colours,
        )

    def _colours(self, places: Array) -> npt.NDArray[np.uint8] | None:
        """Return the RGB (n, 3) of the voxels nearest to places in voxels, None where there is no colour at all."""
        if not np.any(self.sums[..., 2] > KNOWN):
            return None
        cells = self.sums[tuple(np.rint(places).astype(np.int64).T)]
        share = cells[:, 2:3]
        mean = np.where(share > KNOWN, cells[:, 3:] / np.maximum(share, KNOWN), GREY)
        return np.clip(np.rint(mean), 0.0, 255.0).astype(np.uint8)

    def _box(self, pairs: list[tuple[RayImage, Array]]) -> tuple[Corner, Corner]:
        """Return the corners, in voxels, of a box that holds the model and what these views see of the surface."""
        lows = [np.array(self.low)] if self.sums.size else []
        highs = [np.array(self.low) + self.sums.shape[:3]] if self.sums.size else []
        border, unit_m = self.tau_m + 2.0 * self.voxel_m, UNIT * self.voxel_m
        for view, pose in pairs:
            low_m, high_m = np.quantile(se3.transform(pose, view.points_m), BULK, axis=0)
            lows.append(UNIT * np.floor((low_m - border) / unit_m).astype(np.int64))
            highs.append(UNIT * np.ceil((high_m + border) / unit_m).astype(np.int64))
        return _corner(np.min(lows, axis=0)), _corner(np.max(highs, axis=0))

    def _grown(self, low: Corner, high: Corner) -> IncrementalTsdf:
        """Return the model with sums of its own, in a box that holds that of before."""
        sums = np.zeros((*np.subtract(high, low), 6), dtype=np.float32)
        if self.sums.size:
            x, y, z = np.subtract(self.low, low)
            nx, ny, nz = self.sums.shape[:3]
            sums[x : x + nx, y : y + ny, z : z + nz] = self.sums
        return replace(self, low=low, sums=sums)

    def _integrate(self, view: RayImage, place: _Place, sign: float) -> None:
        """Add to the sums, in place, what a view says from its place, or take it back."""
        index, free_m, lens = _images(view, self.fuser.margin_px)
        cosine = -np.sum(view.points_m * view.normals, axis=1) / np.linalg.norm(view.points_m, axis=1)
        colours = np.ones((len(view.points_m), 4))
        colours[:, :3] = colours_at(view)
        colours[:, 3] = view.frame.colour is not None
        box = tuple(slice(*ends) for ends in np.subtract((place.low, place.high), self.low).T)
        preview.integrate_view(
            self.sums[box],
            np.array(place.low) * self.voxel_m,
            self.voxel_m,
            self.tau_m,
            self.fuser.empty_weight,
            sign,
            se3.inverse(place.object_from_camera)[:3],
            lens,
            index,
            free_m,
            se3.transform(place.object_from_camera, view.points_m),
            view.normals @ place.object_from_camera[:3, :3].T,
            np.where(cosine >= self.fuser.min_cosine, cosine, 0.0),
            colours,
        )


def _corner(numbers: npt.NDArray[np.int64]) -> Corner:
    return int(numbers[0]), int(numbers[1]), int(numbers[2])


def _images(view: RayImage, margin_px: int) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32], Array]:
    """Return a view's number of the surface point at a pixel, its empty space, and its lens, cut to the object."""
    camera, depth_m = view.frame.camera, view.frame.depth_m
    low = np.maximum(view.pixels.min(axis=0) - MARGIN_PX, 0)
    high = np.minimum(view.pixels.max(axis=0) + MARGIN_PX + 1, depth_m.shape)
    cut = depth_m[low[0] : high[0], low[1] : high[1]]
    index = np.full(cut.shape, -1, dtype=np.int32)
    index[tuple((view.pixels - low).T)] = np.arange(len(view.pixels))
    lens = np.array([camera.fx, camera.fy, camera.cx - low[1], camera.cy - low[0]])
    return index, free_of(cut, margin_px), lens


def _shifts_m(pairs: Mapping[int, tuple[RayImage, Array]], places: Mapping[int, _Place]) -> dict[int, float]:
    """Return by how much, at most, the pose of each view has moved what the view sees since it was added."""
    frames = [frame for frame in pairs if frame in places]
    if not frames:
        return {}
    moved = np.stack([pairs[frame][1] - places[frame].object_from_camera for frame in frames])
    corners_m = np.stack([places[frame].corners_m for frame in frames])
    shifts_m = corners_m @ np.swapaxes(moved[:, :3, :3], 1, 2) + moved[:, None, :3, 3]
    return dict(zip(frames, np.linalg.norm(shifts_m, axis=2).max(axis=1).tolist(), strict=True))


def _corners_m(view: RayImage) -> Array:
    """Return the corners (8, 3) of a box in camera coordinates around what a view sees of the object."""
    ends = np.stack([view.points_m.min(axis=0), view.points_m.max(axis=0)])
    return ends[np.indices((2, 2, 2)).reshape(3, 8).T, np.arange(3)]
