"""Observed surface of an object, and where unseen surface may be: cells of a grid that stands on the table.

A cell that no view observed as free space or as surface may hold surface. Unknown space behind an object extends far;
surface is expected only in the upright cylinder about the observed surface, as objects are about as deep as wide.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import KDTree

from modeler import se3
from modeler.fusion.depth_views import free_of, window
from modeler.kernels.occupancy import observation_counts
from modeler.types import Array, BoolArray, Camera, RayImage, Solution
from modeler.views import Sensor

IntArray = npt.NDArray[np.intp]
CELLS = 40  # across the object: cells of 2 to 3 mm on objects of 10 cm, as wide as the balls that smooth them
_MARGIN_PX = 1  # around a pixel: silhouettes mix foreground and background
_NEIGHBOURS, _REACH = 50, 7.0  # cells by which normals are smoothed, and how far apart at most, in cells
_THINNED = 2  # every so many cells take part in smoothing, which halves the time
_ALIKE = np.cos(np.radians(50.0))  # between normals of one face: edges stay
_SURFACE_WITHIN, _SURFACE_BEYOND = 1.15, 0.24
"""Cells of new surface that a view shows per cell of hidden space seen head-on, fitted to 48 shapes of the tuning half
(docs/method/suggestion.md). Slanted surface is larger than the area that it covers in a view."""
STEPS = 24  # of 15°: turns that determine the visible surface, twice as near as those that change it much


@dataclass(frozen=True, eq=False)
class Stand:
    """The table's normal through the middle of the observed surface, about which an object is turned."""

    object_from_stand: Array
    """(4, 4): z up, its origin on the table below the middle."""
    radius_m: float
    """Of the upright cylinder that contains the observed surface."""
    height_m: float
    """Of that cylinder."""

    @property
    def up(self) -> Array:
        """Unit normal (3,) of the table in the object frame."""
        return self.object_from_stand[:3, 2]

    def turned(self, angle_rad: float) -> Array:
        """Return the motion (4, 4) in the object frame of a right-handed turn about the upward normal."""
        turn = se3.exp(np.array([0.0, 0.0, angle_rad, 0.0, 0.0, 0.0]))
        return self.object_from_stand @ turn @ se3.inverse(self.object_from_stand)

    @classmethod
    def of(cls, views: Mapping[int, RayImage], solution: Solution) -> Stand:
        """Return the stand of posed views; without a plane up is opposite to the first image's columns."""
        poses = {frame: pose for frame, pose in solution.trajectory.items() if frame in views}
        points_m = np.concatenate([se3.transform(pose, views[k].points_m) for k, pose in poses.items()])
        planes = [(poses[k], views[k].plane) for k in poses]
        normals = [pose[:3, :3] @ plane.normal for pose, plane in planes if plane is not None]
        up = np.sum(normals, axis=0) if normals else -poses[min(poses)][:3, 1]
        up = up / np.linalg.norm(up)
        across = poses[min(poses)][:3, 0] - (poses[min(poses)][:3, 0] @ up) * up
        across = across / np.linalg.norm(across)
        axes = np.column_stack([across, np.cross(up, across), up])
        local_m = points_m @ axes
        floors_m = [(p[:3, 3] @ up) - plane.offset_m for p, plane in planes if plane is not None]
        floor_m = float(np.mean(floors_m)) if floors_m else float(local_m[:, 2].min())
        centre_m, radius_m = enclosing_circle(local_m[:, :2])
        pose = np.eye(4)
        pose[:3, :3] = axes
        pose[:3, 3] = axes @ np.append(centre_m, floor_m)
        return cls(pose, radius_m, max(float(local_m[:, 2].max()) - floor_m, 1e-3))


def enclosing_circle(points_m: Array) -> tuple[Array, float]:
    """Return centre (2,) and radius of the smallest circle around points (n, 2), to about 1 %.

    By steps of 1 / k towards the farthest point (Badoiu and Clarkson 2003).
    """
    some = points_m[:: max(len(points_m) // 2000, 1)]
    centre_m = some.mean(axis=0)
    for k in range(2, 100):
        farthest = some[np.argmax(np.sum((some - centre_m) ** 2, axis=1))]
        centre_m = centre_m + (farthest - centre_m) / k
    return centre_m, float(np.sqrt(np.max(np.sum((points_m - centre_m) ** 2, axis=1))))


@dataclass(frozen=True, eq=False)
class SurfaceCells:
    """Cells with observed surface, and cells that may hold unseen surface."""

    stand: Stand
    """Pose of the object on its table."""
    cell_m: float
    """Side of a cell."""
    points_m: Array
    """(c, 3) in the object frame: the surface in a cell, smoothed, or a cell's middle."""
    normals: Array
    """(c, 3) unit normals: of the points in a cell, or towards free space."""
    seen: BoolArray
    """(c,) whether a view has points in the cell."""
    near: BoolArray
    """(x, y, z) whether a cell of the grid, on its table, holds seen surface or touches a cell that does."""
    under: BoolArray
    """(c,) whether the cell is unseen surface on which the object stands."""
    beyond: BoolArray
    """(c,) whether a cell may hold unseen surface, but farther from the stand's axis than any seen at that height."""
    normal_variance: float
    """Variance, in each tangent direction, of the noise that smoothed normals share with those of a view."""

    @classmethod
    def of(cls, views: Mapping[int, RayImage], solution: Solution, stand: Stand) -> SurfaceCells:
        """Return the cells of posed views."""
        cell_m = max(2.0 * stand.radius_m, stand.height_m) / CELLS
        shape, origin_m = _grid(stand, cell_m)
        frames = [frame for frame in solution.trajectory if frame in views]
        stand_from_object = se3.inverse(stand.object_from_stand)
        found, patch_cells = np.zeros((7, int(np.prod(shape)))), []
        for frame in frames:
            pose = stand_from_object @ solution.trajectory[frame]
            points_m = se3.transform(pose, views[frame].points_m)
            numbers, inside = _numbers(points_m, origin_m, cell_m, shape)
            patch_cells.append(len(np.unique(numbers)) / max(views[frame].patches, 1.0))
            normals = views[frame].normals[inside] @ pose[:3, :3].T
            for k, values in enumerate((*points_m[inside].T, *normals.T, np.ones(len(normals)))):
                found[k] += np.bincount(numbers, values, found.shape[1])
        seen = (found[6] > 0).reshape(tuple(shape))
        unseen, outward = _unseen(views, solution, stand, (origin_m, cell_m, shape), seen)
        near = np.asarray(ndimage.binary_dilation(seen, np.ones((3, 3, 3))), dtype=bool)
        bottom = np.zeros_like(unseen)
        bottom[:, :, 0] = (unseen | seen)[:, :, 0] | np.any(seen, axis=2)
        unseen &= ~near
        holding = np.flatnonzero(found[6])
        mean_m, mean_normals, shared = smoothed(
            found[:3, holding].T / found[6, holding, None], found[3:6, holding].T, cell_m, float(np.mean(patch_cells))
        )
        kinds = unseen & ~bottom, bottom
        places = [np.argwhere(kind) for kind in kinds]
        outwards = _unit(outward[kinds[0]])
        middles_m = origin_m + (np.concatenate(places) + 0.5) * cell_m
        counts = np.array([len(holding), *(len(some) for some in places)])
        local_m = np.concatenate([mean_m, middles_m])
        directions = np.concatenate([mean_normals, outwards, np.tile([0.0, 0.0, -1.0], (counts[2], 1))])
        return cls(
            stand,
            cell_m,
            se3.transform(stand.object_from_stand, local_m),
            directions @ stand.object_from_stand[:3, :3].T,
            np.repeat([True, False, False], counts),
            near,
            np.repeat([False, False, True], counts),
            _beyond(local_m, counts[0], cell_m),
            shared,
        )

    def visible(self, camera_from_object: Array) -> IntArray:
        """Return which cells (k,) a camera at a pose (4, 4) sees well enough for points."""
        return self.looked_at(camera_from_object)[0]

    def looked_at(self, camera_from_object: Array) -> tuple[IntArray, Array]:
        """Return which cells (k,) a camera at a pose (4, 4) sees well enough for points, and the surface there (k,).

        The second is the expected surface there in cells, 1 for observed surface. For hidden space it depends on how
        much of the view a cell covers, and on whether surface is expected there: in front of the back of observed
        surface, or as near to the axis as observed surface at that height (method, eq. 14.5).
        """
        points_m = se3.transform(camera_from_object, self.points_m)
        normals = self.normals @ camera_from_object[:3, :3].T
        depth_m = points_m[:, 2]
        pitch = self.cell_m / float(np.median(depth_m))
        rays = points_m[:, 1::-1] / depth_m[:, None]
        corner = rays.min(axis=0) - pitch
        size = np.ceil((rays.max(axis=0) - corner) / pitch).astype(np.intp) + 2
        near_m, back_m = np.full(tuple(size), np.inf), np.full(tuple(size), -np.inf)
        place = np.floor((rays - corner) / pitch).astype(np.intp)
        np.minimum.at(near_m, tuple(place.T), depth_m)
        covered = ndimage.minimum_filter(near_m, size=2)  # a cell covers up to two of the raster each way
        near_m = np.minimum(near_m, np.where(np.isfinite(covered), covered + self.cell_m, np.inf))
        cosine = -np.sum(points_m * normals, axis=1) / np.linalg.norm(points_m, axis=1)
        visible = np.flatnonzero(
            (depth_m <= near_m[tuple(place.T)] + 1.5 * self.cell_m) & (cosine >= Sensor.min_cosine)
        )
        away = self.seen & (cosine < 0.0)
        np.maximum.at(back_m, tuple(place[away].T), depth_m[away])
        back_m = ndimage.maximum_filter(back_m, size=3)
        solid = back_m[tuple(place[visible].T)] > depth_m[visible] + 1.5 * self.cell_m
        likely = solid | ~self.beyond[visible]
        surface = np.where(likely, _SURFACE_WITHIN, _SURFACE_BEYOND) * cosine[visible]
        return visible, np.where(self.seen[visible] | self.under[visible], 1.0, surface)

    def at(self, points_m: Array) -> tuple[IntArray, IntArray]:
        """Return which cells of seen surface (k,) hold or touch points of a view, and one point (m,) of each new cell.

        Args:
            points_m: (n, 3) in the object frame; those that are in no seen cell, nor touch one, are new surface.
        """
        shape, origin_m = _grid(self.stand, self.cell_m)
        stand_from_object = se3.inverse(self.stand.object_from_stand)
        local_m = se3.transform(stand_from_object, points_m)
        numbers, inside = _numbers(local_m, origin_m, self.cell_m, shape)
        known = np.zeros(len(points_m), dtype=bool)
        known[inside] = self.near.ravel()[numbers]
        _, first = np.unique(np.floor(local_m[~known] / self.cell_m), axis=0, return_index=True)
        hit = np.zeros(int(np.prod(shape)), dtype=bool)
        hit[numbers] = True
        hit = np.asarray(ndimage.binary_dilation(hit.reshape(tuple(shape)), np.ones((3, 3, 3))), dtype=bool)
        mine, _ = _numbers(se3.transform(stand_from_object, self.points_m), origin_m, self.cell_m, shape)
        return np.flatnonzero(hit.ravel()[mine] & self.seen), np.flatnonzero(~known)[first]

    def around(self, object_from_camera: Array) -> BoolArray:
        """Return which cells (c,) a camera sees at any turn of the object on its table."""
        seen = np.zeros(len(self.points_m), dtype=bool)
        for step in range(STEPS):
            turned = self.stand.turned(2.0 * np.pi * step / STEPS) @ object_from_camera
            seen[self.visible(se3.inverse(turned))] = True
        return seen

    @cached_property
    def depth_sd_m(self) -> float:
        """Standard deviation of where unseen surface lies, anywhere between the cylinder and its axis."""
        return self.stand.radius_m / np.sqrt(12.0)


def smoothed(points_m: Array, normals: Array, cell_m: float, patch: float) -> tuple[Array, Array, float]:
    """Return points (n, 3) and unit normals (n, 3) smoothed over neighbours that face the same way, and their noise.

    The third is the variance in each tangent direction of the noise that remains in the normals.

    Predictions look points up in the images that they come from: with the images' noise they would match too well, and
    a can's spin would appear to be determined. Normals are fitted as linear functions of the place, so
    that round surfaces stay round.

    Args:
        points_m: means over cells.
        normals: sums over cells.
        cell_m: side of a cell.
        patch: cells in a patch of surface within which noise is shared.
    """
    normals = _unit(normals)
    some = np.random.default_rng(0).permutation(len(points_m))[: -(-len(points_m) // _THINNED)]
    count = min(_NEIGHBOURS, len(some))
    _, near = KDTree(points_m[some]).query(points_m, k=count, distance_upper_bound=_REACH * cell_m)
    near = near.reshape(len(points_m), count)
    there = some[np.minimum(near, len(some) - 1)]
    alike = np.sum(normals[there] * normals[:, None], axis=2) >= _ALIKE
    weights = (alike & (near < len(some))).astype(np.float64)
    offsets = (points_m[there] - points_m[:, None]) / (_REACH * cell_m)
    design = np.concatenate([np.ones((*offsets.shape[:2], 1)), offsets], axis=2)
    weighted = np.swapaxes(design * weights[:, :, None], 1, 2)
    gram = weighted @ design + 1e-3 * np.diag([1.0, count, count, count])  # where neighbours lie on a line
    found = np.linalg.solve(gram, weighted @ normals[there])
    mean = _unit(found[:, 0])
    close = weights * (np.sum(offsets**2, axis=2) < 0.25)
    heights_m = _REACH * cell_m * np.sum(offsets * mean[:, None], axis=2)
    off_m = np.sum(close * heights_m, axis=1) / np.maximum(close.sum(axis=1), 1.0)
    # Of noise of variance v, k patches leave v / k; the residuals' is v (1 - 1 / k). Their median passes over edges.
    residual = float(np.median(np.sum((normals - mean) ** 2, axis=1))) / (2.0 * np.log(2.0))
    patches = _THINNED * float(np.median(weights.sum(axis=1))) / patch
    return points_m + off_m[:, None] * mean, mean, residual / max(patches - 1.0, 0.5)


def _beyond(local_m: Array, seen: int, cell_m: float) -> BoolArray:
    """Return which cells (c,), the first of which were seen, are farther from the axis than those at that height."""
    layer = np.maximum(np.floor(local_m[:, 2] / cell_m).astype(np.intp), 0)
    radius_m = np.hypot(local_m[:, 0], local_m[:, 1])
    farthest_m = np.full(layer.max() + 1, -np.inf)
    np.maximum.at(farthest_m, layer[:seen], radius_m[:seen])
    return (radius_m > farthest_m[layer] + cell_m) & (np.arange(len(layer)) >= seen)


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _grid(stand: Stand, cell_m: float) -> tuple[IntArray, Array]:
    """Return cells along each axis (3,) and the lowest corner (3,) of the grid around a stand's cylinder."""
    side = int(np.ceil(stand.radius_m / cell_m)) + 2
    layers = int(np.ceil(stand.height_m / cell_m)) + 2
    return np.array([2 * side, 2 * side, layers], dtype=np.intp), np.array([-side * cell_m, -side * cell_m, 0.0])


def _numbers(points_m: Array, origin_m: Array, cell_m: float, shape: IntArray) -> tuple[IntArray, BoolArray]:
    """Return the number of the cell of each point (n, 3) that is inside the grid, and which are."""
    place = np.floor((points_m - origin_m) / cell_m).astype(np.intp)
    place[:, 2] = np.maximum(place[:, 2], 0)  # noise puts what stands on the table below it
    inside = np.all((place >= 0) & (place < shape), axis=1)
    x, y, z = place[inside].T
    return (x * shape[1] + y) * shape[2] + z, inside


def _unseen(
    views: Mapping[int, RayImage],
    solution: Solution,
    stand: Stand,
    grid: tuple[Array, float, IntArray],
    seen: BoolArray,
) -> tuple[BoolArray, Array]:
    """Return which cells (x, y, z) may hold unseen surface, and directions (x, y, z, 3) out of it.

    These are hidden cells next to free ones: hidden surface there would be the first that a camera sees.
    """
    origin_m, cell_m, shape = grid
    frames = [frame for frame in solution.trajectory if frame in views]
    sigma_m = float(np.median([views[frame].sigma_r_m for frame in frames]))
    margin_m = 0.5 * np.sqrt(3.0) * cell_m + 2.0 * sigma_m
    poses = [se3.inverse(solution.trajectory[frame]) @ stand.object_from_stand for frame in frames]
    ends_m = origin_m + np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T * shape * cell_m
    free, intrinsics = [], []
    for frame, pose in zip(frames, poses, strict=True):
        view, where = views[frame], window(views[frame], pose, ends_m)
        free.append(_free_m(view, where, margin_m))
        intrinsics.append(_cropped(view.frame.camera, where))
    size = np.max([part.shape for part in free], axis=0)
    stacked = np.zeros((len(free), *size), dtype=np.float32)
    for number, part in enumerate(free):
        stacked[number, : part.shape[0], : part.shape[1]] = part
    counts = observation_counts(
        origin_m,
        cell_m,
        shape,
        margin_m,
        stacked,
        np.stack([pose[:3] for pose in poses]),
        np.array(intrinsics),
        np.full((len(frames), 4), np.nan),
    )
    x, y = (origin_m[k] + (np.arange(shape[k]) + 0.5) * cell_m for k in range(2))
    outside = np.broadcast_to((np.hypot(x[:, None], y) > stand.radius_m + cell_m)[:, :, None], tuple(shape))
    empty = ((counts[0] > 0) | outside) & ~seen
    empty[:, :, -1] = True
    hidden = ~empty & (counts[1] == 0)
    padded = np.pad(empty, 1, constant_values=True)
    padded[:, :, 0] = False  # the table
    touching = np.asarray(ndimage.binary_dilation(padded), dtype=bool)[1:-1, 1:-1, 1:-1]
    smooth = ndimage.gaussian_filter(padded.astype(np.float32), 1.0)
    outward = np.stack([np.gradient(smooth, axis=k) for k in range(3)], axis=-1)
    return hidden & touching & ~seen, outward[1:-1, 1:-1, 1:-1].astype(np.float64)


def _free_m(view: RayImage, where: tuple[slice, slice], margin_m: float) -> npt.NDArray[np.float32]:
    """Return the depth (h, w) up to which a window of a view is free space; on background, all of it."""
    depth_m = view.frame.depth_m[where]
    free_m = free_of(depth_m, _MARGIN_PX)
    if view.frame.mask is None:
        return free_m
    width = 2 * _MARGIN_PX + 1
    around = np.asarray(ndimage.maximum_filter(view.frame.mask[where], size=width, mode="nearest"), dtype=bool)
    background = (free_m > 0.0) & ~around
    return np.where(background, depth_m + np.float32(1.5 * margin_m), free_m)


def _cropped(camera: Camera, where: tuple[slice, slice]) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx - where[1].start, camera.cy - where[0].start
