"""Depth views cropped to the object, in the form in which the kernels look them up."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_fill_holes, distance_transform_edt, maximum_filter, minimum_filter

from modeler import se3
from modeler.kernels import tsdf
from modeler.kernels.point_clouds import fitted_planes
from modeler.system.disk_arrays import DiskArrays, release
from modeler.types import Array, BoolArray, Edge, InputError, RayImage, Solution

GREY = 128  # colour of points that no view with colour sees
SMOOTHED = 0.5  # noise of a surface point, smoothed over its neighbours, relative to that of its pixel
STEEPEST_RAD = 1.40  # steeper steps between neighbouring pixels (80°) are depth edges; measured: left-out views
# Pixels from an edge within which colours may be those of the background: depth and colour are aligned to some pixels.
# Measured: over six captures the colours of held-out views are predicted best with 6 to 16.
BLEEDING_PX = 10.0
SAMPLES = 20000  # points at which views are compared; with half or twice as many, the box is the same to 0.1 %
BATCH = 1 << 18  # points, or lookups of them in views, at a time, which bounds memory
BLOCK_BYTES = 64 * 2**20  # of a block of views, which bounds memory
BLOCK_VIEWS = 50  # least number in one of several blocks: views vote against outliers of others in their block
PIXEL_BYTES, POINT_BYTES = 15, 72  # of a pixel and a surface point in `DepthViews`
STATISTICS = 1 << 22  # points at most from which quantiles are taken, which bounds memory


@dataclass(frozen=True)
class Cropping:
    """Selection and weights of a view's pixels."""

    margin_px: int
    """A pixel carves only as far as all pixels within this distance, or less where the pose allows."""
    min_cosine: float
    """Points seen at a smaller cosine between normal and ray are left out."""
    edge_weight: float
    """Factor on the weight of pixels next to a silhouette or depth step."""


@dataclass(frozen=True, eq=False)
class Crop:
    """One view cropped to a window: its images, and the surface points seen in it, in camera coordinates."""

    index: npt.NDArray[np.int32]
    """(h, w) number of the surface point at a pixel, -1 = none."""
    free_m: npt.NDArray[np.float32]
    """(h, w), as in `DepthViews`."""
    background_m: npt.NDArray[np.float32]
    """(h, w), as in `DepthViews`."""
    colour: npt.NDArray[np.uint8] | None
    """(h, w, 3) RGB."""
    intrinsics: Array
    """(4,) fx, fy, cx, cy of the window's pixels."""
    points_m: Array
    """(n, 3)."""
    normals: Array
    """(n, 3) unit normals."""
    weights: Array
    """(n,) 1 = seen head-on, away from edges."""
    clearance: Array
    """(n,) distance from edges, 1 = so far away that the colours are the object's."""


def window(view: RayImage, camera_from_object: Array, corners_m: Array) -> tuple[slice, slice]:
    """Return the rows and columns in which a box, given by its corners (8, 3), is seen."""
    camera = view.frame.camera
    x, y, z = se3.transform(camera_from_object, corners_m).T
    if np.any(z <= 0.0):  # the box reaches behind the camera
        return slice(0, camera.height), slice(0, camera.width)
    columns, rows = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    top, bottom = (int(n) for n in np.clip([np.floor(rows.min()), np.ceil(rows.max()) + 1.0], 0, camera.height))
    left, right = (int(n) for n in np.clip([np.floor(columns.min()), np.ceil(columns.max()) + 1.0], 0, camera.width))
    return slice(top, bottom), slice(left, right)


def crop(view: RayImage, where: tuple[slice, slice], cropping: Cropping) -> Crop:
    """Crop a view to a window.

    Pixels of the object without a surface point (silhouettes, thin parts, grazing angles) get one from a plane fitted
    to the measured depth around them.
    """
    frame, camera = view.frame, view.frame.camera
    corner = np.array([where[0].start, where[1].start])
    depth_m = frame.depth_m[where]
    colour = None if frame.colour is None else frame.colour[where]
    measured = np.isfinite(depth_m) & (depth_m > 0.0)
    mask = measured if frame.mask is None else measured & frame.mask[where]
    intrinsics = np.array([camera.fx, camera.fy, camera.cx - corner[1], camera.cy - corner[0]])

    pixels = view.pixels - corner
    inside = np.all((pixels >= 0) & (pixels < depth_m.shape), axis=1)
    rest = mask.copy()
    rest[tuple(pixels[inside].T)] = False
    others = np.argwhere(rest)
    points_m, normals = fitted_planes(depth_m, others, mask, intrinsics, view.sigma_r_m, np.tan(STEEPEST_RAD))
    found = np.any(normals != 0.0, axis=1)
    pixels = np.concatenate([pixels[inside], others[found]])
    points_m = np.concatenate([view.points_m[inside], points_m[found]])
    normals = np.concatenate([view.normals[inside], normals[found]])

    # An edge pixel has a neighbour outside the object, or one too far away for a surface in between.
    far = maximum_filter(np.where(mask, depth_m, -np.inf), size=3)
    near = minimum_filter(np.where(mask, depth_m, np.inf), size=3)
    with np.errstate(invalid="ignore"):
        step = far - near > 2.0 * depth_m / camera.fx * np.tan(STEEPEST_RAD) + 4.0 * view.sigma_r_m
    edges = step | np.logical_not(minimum_filter(mask, size=3))
    within = np.asarray(binary_fill_holes(mask), dtype=bool) & ~step  # where depth is missing, colours may be good
    if frame.occluder is not None:  # but not where they are those of a hand
        within &= ~frame.occluder[where]
    away_px = np.asarray(distance_transform_edt(np.pad(within, 1)))[1:-1, 1:-1]
    clearance = np.minimum((away_px + 0.5) / BLEEDING_PX, 1.0)
    cosine = -np.sum(points_m * normals, axis=1) / np.linalg.norm(points_m, axis=1)
    weights = cosine * np.where(edges[tuple(pixels.T)], cropping.edge_weight, 1.0)  # eq. 12.1
    kept = cosine >= cropping.min_cosine
    pixels = pixels[kept]
    index = np.full(depth_m.shape, -1, dtype=np.int32)
    index[tuple(pixels.T)] = np.arange(len(pixels))
    around = np.asarray(maximum_filter(mask, size=2 * cropping.margin_px + 1, mode="nearest"), dtype=bool)
    return Crop(
        index=index,
        free_m=free_of(depth_m, cropping.margin_px),
        background_m=np.where(measured & ~mask, np.where(around, -depth_m, depth_m), 0.0).astype(np.float32),
        colour=colour,
        intrinsics=intrinsics,
        points_m=points_m[kept],
        normals=normals[kept],
        weights=weights[kept],
        clearance=clearance[tuple(pixels.T)],
    )


def free_of(depth_m: npt.NDArray[np.float32], margin_px: int) -> npt.NDArray[np.float32]:
    """Return the depth (h, w) up to which a pixel sees free space: the least of all pixels around it; 0 = unknown.

    Args:
        depth_m: (h, w); not positive or NaN = no measurement, which carves nothing.
        margin_px: largest distance to the pixels around.
    """
    measured = np.isfinite(depth_m) & (depth_m > 0.0)
    reach_m = minimum_filter(np.where(measured, depth_m, np.inf), size=2 * margin_px + 1, mode="nearest")
    return np.where(measured, reach_m, 0.0).astype(np.float32)


def _margin_px(view: RayImage, covariance: Array | None) -> int:
    """Return the distance in px within which all pixels around one must see past a point for it to be free.

    A pixel at an outline mixes object and background: the outline is up to half a pixel from its middle, and up to two
    standard deviations of the pose's error farther.
    """
    if covariance is None or not len(view.points_m):
        return 1
    x, y, z = view.points_m.T
    none, one = np.zeros_like(z), np.ones_like(z)
    across = np.stack([np.stack([none, z, -y, one, none, none], 1), np.stack([-z, none, x, none, one, none], 1)], 1)
    moved = np.einsum("nki,ij,nkj->nk", across / z[:, None, None], covariance, across / z[:, None, None])
    return int(np.ceil(0.5 + 2.0 * view.frame.camera.fx * float(np.sqrt(moved.mean()))))


def pose_variances(part: Crop, covariance: Array | None, sigma_r_m: float) -> Array:
    """Return the variances (n,) along the normals due to the pose's error, in units of a surface point's own variance.

    Args:
        part: a view.
        covariance: (6, 6) of its object_from_camera; None: exact.
        sigma_r_m: sd of a pixel along its ray.
    """
    if covariance is None:
        return np.zeros(len(part.points_m))
    # A perturbation ξ = (ω, v) moves a point p along its normal n by ω · (p × n) + v · n (eq. 12.2).
    rows = np.concatenate([np.cross(part.points_m, part.normals), part.normals], axis=1)
    return np.einsum("ni,ij,nj->n", rows, covariance, rows) / (SMOOTHED * sigma_r_m) ** 2


@dataclass(frozen=True, eq=False)
class DepthViews:
    """Stacked images of views and their surface points, as `modeler.kernels.tsdf` looks them up."""

    index: npt.NDArray[np.int32]
    """(f, h, w) number of the surface point at a pixel, -1 = none."""
    free_m: npt.NDArray[np.float32]
    """(f, h, w) depth up to which a pixel sees free space, 0 = unknown."""
    background_m: npt.NDArray[np.float32]
    """(f, h, w) depth of background pixels, negative where an object pixel is near, 0 elsewhere."""
    colour: npt.NDArray[np.uint8]
    """(f, h, w, 3) RGB."""
    coloured: BoolArray
    """(f,) whether the view has colour."""
    poses: Array
    """(f, 3, 4) camera_from_object."""
    intrinsics: Array
    """(f, 4) fx, fy, cx, cy of the cropped images."""
    planes: Array
    """(f, 4) normal and offset in m of the support plane in the object frame; NaN = none seen."""
    points_m: Array
    """(n, 3) surface points in the object frame."""
    normals: Array
    """(n, 3) unit normals."""
    weights: Array
    """(n,) 1 = seen head-on from the median distance, away from edges (method, eq. 12.1 to 12.3)."""
    colour_weights: Array
    """(n,) the same for their colours, which are uncertain farther from edges (method, eq. 12.10)."""
    views: npt.NDArray[np.int64]
    """(n,) the view of each point."""

    @property
    def lookup(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32], Array, Array, Array, Array, Array]:
        """Arguments common to the kernels."""
        return self.index, self.free_m, self.poses, self.intrinsics, self.points_m, self.normals, self.weights

    def only(self, view: int) -> DepthViews:
        """Return the images of one view only; the surface points of all views stay, under their numbers."""
        here = slice(view, view + 1)
        return replace(
            self,
            index=self.index[here],
            free_m=self.free_m[here],
            background_m=self.background_m[here],
            colour=self.colour[here],
            coloured=self.coloured[here],
            poses=self.poses[here],
            intrinsics=self.intrinsics[here],
            planes=self.planes[here],
        )

    def carving(self, tau_m: float) -> DepthViews:
        """Return the views with free space extended behind the background, by the band ±`tau_m`.

        Carving stops one band in front of a measured surface because its position is uncertain by as much. Where the
        background is measured, there is no object, so this margin is added back.
        """
        background_m = np.where(self.background_m > 0.0, self.background_m + np.float32(1.5 * tau_m), np.float32(0.0))
        return replace(self, free_m=np.maximum(self.free_m, background_m))


def posed_views(views: Mapping[int, RayImage], trajectory: Mapping[int, Array]) -> list[tuple[RayImage, Array]]:
    """Return the views that have a pose with object_from_camera, by ascending frame number.

    Raises:
        InputError: if no view has a pose, or none of them a surface point.
    """
    pairs = [(views[k], np.asarray(trajectory[k], dtype=np.float64)) for k in sorted(views) if k in trajectory]
    if not any(len(view.points_m) for view, _ in pairs):
        raise InputError("nothing to fuse: no view with surface points has a pose; check the masks and the trajectory")
    return pairs


def one_by_one(pairs: Iterable[tuple[RayImage, Array]]) -> Iterator[tuple[RayImage, Array]]:
    """Yield views and poses, and free the memory of each that is on disk."""
    for view, pose in pairs:
        yield view, pose
        release(view.points_m)


def depth_views(
    pairs: list[tuple[RayImage, Array]],
    corners_m: Array,
    cropping: Cropping,
    covariances: Mapping[int, Array] | None = None,
) -> DepthViews:
    """Crop views to a box and stack them; InputError if no view sees the object in the box.

    Args:
        pairs: views with object_from_camera.
        corners_m: (8, 3) corners of the box in the object frame.
        cropping: which pixels count.
        covariances: (6, 6) of object_from_camera by frame number; poses without one count as exact.
    """
    windows = [window(view, se3.inverse(pose), corners_m) for view, pose in pairs]
    size = len(pairs), *_largest(windows)
    index = np.full(size, -1, dtype=np.int32)
    free_m, background_m = np.zeros(size, dtype=np.float32), np.zeros(size, dtype=np.float32)
    colour = np.zeros((*size, 3), dtype=np.uint8)
    intrinsics, surfaces, counts = [], [], []
    for number, ((view, pose), where) in enumerate(zip(one_by_one(pairs), windows, strict=True)):
        covariance = None if covariances is None else covariances.get(view.index)
        part = crop(view, where, replace(cropping, margin_px=min(cropping.margin_px, _margin_px(view, covariance))))
        here = number, *map(slice, part.index.shape)
        index[here] = np.where(part.index >= 0, part.index + sum(counts), -1)
        free_m[here], background_m[here] = part.free_m, part.background_m
        if part.colour is not None:
            colour[here] = part.colour
        intrinsics.append(part.intrinsics)
        surfaces.append(
            (
                se3.transform(pose, part.points_m),
                part.normals @ pose[:3, :3].T,
                part.points_m[:, 2].copy(),  # a view would keep the whole crop in memory
                part.weights,
                part.clearance,
                pose_variances(part, covariance, view.sigma_r_m),
            )
        )
        counts.append(len(part.points_m))
    if sum(counts) == 0:
        raise InputError(
            "nothing to fuse: the object is seen at grazing angles only; check the masks and the trajectory"
        )
    points_m, normals, depth_m, weights, clearance, pose_noise = (
        np.concatenate(some) for some in zip(*surfaces, strict=True)
    )
    weights = weights * (np.median(depth_m) / depth_m) ** 4  # eq. 12.1: the sd of a triangulating camera grows with z²
    trust = 1.0 / (1.0 + weights * pose_noise)  # eq. 12.3
    weights *= trust / np.median(trust)
    return DepthViews(
        index=index,
        free_m=free_m,
        background_m=background_m,
        colour=colour,
        coloured=np.array([view.frame.colour is not None for view, _ in pairs]),
        poses=np.stack([se3.inverse(pose)[:3] for _, pose in pairs]),
        intrinsics=np.stack(intrinsics),
        planes=np.stack([_plane(view, pose) for view, pose in pairs]),
        points_m=points_m,
        normals=normals,
        weights=weights,
        colour_weights=weights * clearance,
        views=np.repeat(np.arange(len(pairs)), counts),
    )


def _largest(windows: Iterable[tuple[slice, slice]]) -> tuple[int, int]:
    """Return the rows and columns that hold any of some windows."""
    rows, columns = zip(*windows, strict=True)
    return max(some.stop - some.start for some in rows), max(some.stop - some.start for some in columns)


@dataclass(frozen=True, eq=False)
class ViewBlocks:
    """Views in blocks, of which one at a time needs to be in memory.

    Of n blocks, each has every n-th view, and so all sides of the object that the views see.
    """

    blocks: tuple[DepthViews, ...]
    """A single one is in memory, several are on disk."""
    disk: DiskArrays = field(default_factory=DiskArrays)
    """Where they are."""

    def __iter__(self) -> Iterator[DepthViews]:
        """Yield the blocks, and free the memory of each."""
        for block in self.blocks:
            yield block
            self.disk.release()

    @property
    def count(self) -> int:
        """Number of views."""
        return sum(len(block.index) for block in self.blocks)

    @property
    def coloured(self) -> bool:
        """Whether a view has colour."""
        return any(bool(block.coloured.any()) for block in self.blocks)

    def carving(self, tau_m: float) -> ViewBlocks:
        """Return the views with free space extended behind the background, see `DepthViews.carving`."""
        if len(self.blocks) == 1:
            return replace(self, blocks=(self.blocks[0].carving(tau_m),))
        return replace(self, blocks=tuple(_on_disk(block.carving(tau_m), self.disk, "free_m") for block in self))

    def thinned(self, values: Callable[[DepthViews], Array]) -> Array:
        """Return values (n, …) of all surface points, or of every k-th where there are more than `STATISTICS`."""
        step = thinning(sum(len(block.points_m) for block in self.blocks))
        return np.concatenate([values(block)[::step] for block in self])


def view_blocks(
    pairs: list[tuple[RayImage, Array]],
    corners_m: Array,
    cropping: Cropping,
    covariances: Mapping[int, Array] | None = None,
) -> ViewBlocks:
    """Crop views to a box and stack them, in several blocks where one would hold more than `BLOCK_BYTES`.

    Arguments and errors as for `depth_views`.
    """
    rows, columns = _largest(window(view, se3.inverse(pose), corners_m) for view, pose in pairs)
    points = sum(len(view.points_m) for view, _ in pairs)
    size = PIXEL_BYTES * len(pairs) * rows * columns + POINT_BYTES * points
    count = max(1, min(-(-size // BLOCK_BYTES), len(pairs) // BLOCK_VIEWS))
    blocks, disk = [], DiskArrays()
    for first in range(count):
        block = depth_views(pairs[first::count], corners_m, cropping, covariances)
        if count > 1:
            block = _on_disk(block, disk, *(part.name for part in fields(block)))
        blocks.append(block)
    disk.release()
    return ViewBlocks(tuple(blocks), disk)


def _on_disk(block: DepthViews, disk: DiskArrays, *names: str) -> DepthViews:
    """Return a block with some of its arrays on disk; in memory where they cannot be written."""
    try:
        return replace(block, **{name: disk.written(getattr(block, name)) for name in names})
    except OSError:
        return block


def thinning(points: int) -> int:
    """Return the stride of points used for quantiles: 1 unless they are more than `STATISTICS`."""
    return max(1, points // STATISTICS)


def _plane(view: RayImage, object_from_camera: Array) -> Array:
    """Return normal and offset (4,) of a view's support plane in the object frame, NaN where there is none."""
    if view.plane is None:
        return np.full(4, np.nan)
    normal = object_from_camera[:3, :3] @ view.plane.normal
    return np.append(normal, view.plane.offset_m - normal @ object_from_camera[:3, 3])


def disagreement(views: ViewBlocks, limit_m: float) -> tuple[float, float] | None:
    """Return robust standard deviations of the distance between the surfaces of different views, in m (eq. 12.4).

    They contain the noise of both views and the error of their poses. None if no two views see the same surface.

    Args:
        views: the views, compared within each block.
        limit_m: larger distances are between different surfaces.

    Returns:
        The standard deviation between two views, and that of one view of weight 1.
    """
    samples = SAMPLES // len(views.blocks)
    off_m, share_m = (np.concatenate(some) for some in zip(*_distances(views, samples, limit_m), strict=True))
    # eq. 12.4
    return (1.4826 * float(np.median(off_m)), 1.4826 * float(np.median(share_m))) if len(off_m) else None


def _distances(blocks: ViewBlocks, samples: int, limit_m: float) -> Iterator[tuple[Array, Array]]:
    """Yield distances between views at sampled points of each block, and the same in units given by the weights."""
    for views in blocks:
        chosen = np.arange(0, len(views.points_m), max(1, len(views.points_m) // samples))
        lookup = views.index, views.poses, views.intrinsics, views.points_m, views.normals
        for some in np.array_split(chosen, -(-len(chosen) * len(views.index) // BATCH)):
            distance_m, others = tsdf.disagreements(some, views.views[some], limit_m, *lookup)
            found = others >= 0
            mine, theirs = views.weights[some[np.nonzero(found)[0]]], views.weights[others[found]]
            off_m = np.abs(distance_m[found])
            yield off_m, off_m / np.sqrt(1.0 / mine + 1.0 / theirs)


def conditional_covariances(solution: Solution, edges: Iterable[Edge]) -> Mapping[int, Array]:
    """Return the covariance (6, 6) of each pose conditional on its neighbours in the pose graph, by frame number.

    Neighbours see the same surface. Common errors, such as drift since the first frame, do not decide which of them
    is right; errors relative to the others do.

    Args:
        solution: the poses.
        edges: all edges; those that take part in the solution count.
    """
    information: dict[int, Array] = {}
    for edge in edges:
        if not solution.takes_part(edge):
            continue
        pose = solution.pose_of(edge)
        ends = ((edge.source, pose.covariance), (edge.target, pose.inverse().covariance))
        for frame, covariance in ends:
            if frame in solution.trajectory:
                information[frame] = information.get(frame, np.zeros((6, 6))) + np.linalg.inv(covariance)
    return {frame: np.linalg.inv(matrix).astype(np.float64) for frame, matrix in information.items()}
