"""Fusion of posed depth views into a point cloud and a mesh."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.fusion import meshing, watertight
from modeler.fusion.depth_views import (
    GREY,
    SMOOTHED,
    Cropping,
    DepthViews,
    ViewBlocks,
    disagreement,
    one_by_one,
    posed_views,
    thinning,
    view_blocks,
)
from modeler.fusion.meshing import DistanceField, VoxelGrid, filled, grid_around, measured
from modeler.fusion.support import Exposure, ViewSupport, exposure_of, view_support
from modeler.kernels import point_clouds
from modeler.system.processes import in_parallel
from modeler.types import Array, BoolArray, InputError, ObjectModel, RayImage

# Exponents of the view weights for colours: an average of views for vertices, nearly one view for textures, where an
# average blurs. With 2 or 8 for 4, vertices of the box have the same colours; with 4 for 16, print blurs.
SOFT, SHARP = 4.0, 16.0
CONFIRMED = 2  # views that see the same surface: thin parts that one view alone sees are errors along its outline
HALVES = np.array([0.36, 0.48, 0.8])  # a direction that divides others in two halves: any one along no axis
MIN_NEIGHBOURS = 6  # points of the cloud with fewer in 27 cells of two voxels are outliers; a plane has some 36
PREVIEW_VIEWS, PREVIEW_POINTS = 100, 60_000  # at most: more take longer, and look the same
FINEST_PX = 0.01  # smallest voxel, in pixel footprints: a hundred voxels per pixel resolve nothing


@dataclass(frozen=True)
class Fuser:
    """Fuse views into a cloud and a mesh.

    The mesh is the zero level set of a truncated signed distance function (TSDF; Curless and Levoy 1996, "A volumetric
    method for building complex models from range images") on voxels near the surface (docs/method/fusion.md).
    """

    voxel_m: float | None = None
    """Side of a voxel in m; None: the footprint of a pixel, or half the sensor's noise if that is larger."""
    max_voxels: int = 192**3
    """Memory bound: voxels are enlarged until the object's box holds at most this many."""
    min_cosine: float = 0.15
    """Surface points seen at a smaller cosine between normal and ray (81°) are not used. With 0.3, 0.57 instead of
    0.58 % of the box's surface lie in free space."""
    edge_weight: float = 0.1
    """Weight of pixels next to a silhouette or depth step, relative to 1: they mix foreground and background. With 0.05
    and 0.2, 0.54 and 0.69 % of the box's surface lie in free space, not 0.58."""
    margin_px: int = 2
    """A pixel carves only as deep as all its neighbours within this distance at most, which preserves silhouettes; in
    views of well-known poses within 1 px."""
    empty_weight: float = 0.3
    """Weight of a view that sees a voxel as free space, relative to 1 for a view that sees surface there head-on. With
    0.15 and 0.6, left-out views of the box are as far away to 0.2 %."""
    min_support: float = 0.03
    """Smallest sum of view weights of a mesh vertex. With 0.015 and 0.06, 0.68 and 0.54 % of the box's surface lie in
    free space, not 0.58."""
    closing: int = 3
    """Gaps narrower than about twice this many voxels are closed; wider unseen regions stay open. With 2 and 6, 0.56
    and 0.72 % of the box's surface lie in free space, not 0.58."""
    opening: int = 2
    """Spikes and strips along open borders narrower than about twice this many voxels are removed. With 1 and 4, 0.62
    and 0.51 % of the box's surface lie in free space, not 0.58."""
    fairing: int = 10
    """Passes of Taubin smoothing. With 5 and 20, left-out views of the box are as far away to 0.3 %."""

    def fuse(
        self,
        views: Mapping[int, RayImage],
        trajectory: Mapping[int, Array],
        covariances: Mapping[int, Array] | None = None,
    ) -> ObjectModel:
        """Return the cloud and the open mesh.

        Observed free space is carved, unobserved surface stays open, and only pixels of the object become surface.

        Args:
            views: by frame number; views without a pose are left out.
            trajectory: object_from_camera (4, 4) by frame number.
            covariances: (6, 6) of the poses by frame number, which reduce the weights of uncertain views. Poses
                without one count as exact.

        Raises:
            InputError: if no view with surface points has a pose, or the voxel size is out of range.
        """
        return self.volume(views, trajectory, covariances).model()

    def volume(
        self,
        views: Mapping[int, RayImage],
        trajectory: Mapping[int, Array],
        covariances: Mapping[int, Array] | None = None,
    ) -> FusionVolume:
        """Return the views and voxels from which models are made; arguments as for `fuse`."""
        pairs = posed_views(views, trajectory)
        noise_m = float(np.median([view.sigma_r_m for view, _ in pairs]))
        voxel_m = self.voxel_side_m(pairs)
        grid = grid_around(
            _some_points(pairs),
            voxel_m=voxel_m,
            border_m=3.0 * voxel_m + 2.0 * noise_m,
            max_voxels=self.max_voxels,
        )
        cropping = Cropping(self.margin_px, self.min_cosine, self.edge_weight)
        seen = view_blocks(pairs, grid.corners_m, cropping, covariances)
        limit_m = 0.05 * float(np.linalg.norm(grid.shape)) * grid.voxel_m
        spread_m, sigma_m = disagreement(seen, limit_m) or (noise_m, SMOOTHED * noise_m)
        tau_m = 3.0 * grid.voxel_m + 2.0 * spread_m  # eq. 12.4
        near_m = grid.voxel_m + 2.0 * spread_m
        multipath_m = float(np.median([view.multipath_m for view, _ in one_by_one(pairs)]))
        return FusionVolume(self, seen.carving(tau_m), grid, tau_m, near_m, sigma_m, _smoothing_m2(pairs), multipath_m)

    def preview(self, views: Mapping[int, RayImage], trajectory: Mapping[int, Array]) -> ObjectModel | None:
        """Return a coarse cloud for a run in progress, quickly, its points as vertices too, but without triangles.

        Takes and raises the same as `fuse`; None without views.
        """
        if not views:
            return None
        frames = [frame for frame in sorted(views) if frame in trajectory and len(views[frame].points_m)]
        frames = frames[:: -max(math.ceil(len(frames) / PREVIEW_VIEWS), 1)]  # the newest among them
        pairs = posed_views({frame: views[frame] for frame in frames}, trajectory)[::-1]
        step = math.ceil(sum(len(view.points_m) for view, _ in pairs) / PREVIEW_POINTS)
        clouds = [_posed_points(view, pose, step) for view, pose in one_by_one(pairs)]
        points_m, attributes, weights = (np.concatenate(parts) for parts in zip(*clouds, strict=True))
        points_m, attributes = voxel_means(
            [(points_m, attributes, weights)],
            _extent_m(points_m)[None],
            voxel_m=2.5 * self.voxel_side_m(pairs),  # as many points as the viewer shows of an object
            max_voxels=self.max_voxels,
        )
        normals, share = attributes[:, :3], attributes[:, 6:]
        colours = None
        if share.any():
            mean = np.where(share > 0.0, attributes[:, 3:6] / np.maximum(share, 1e-9), GREY)
            colours = np.rint(mean).astype(np.uint8)
        triangles = np.zeros((0, 3), dtype=np.int64)
        return ObjectModel(points_m, normals, colours, points_m, triangles, normals, colours)

    def voxel_side_m(self, pairs: list[tuple[RayImage, Array]]) -> float:
        """Return the side of a voxel before the memory bound is applied.

        Raises:
            InputError: if `voxel_m` is not a length that the views resolve.
        """
        step = thinning(sum(len(view.points_m) for view, _ in pairs))
        footprint_m = np.concatenate([view.points_m[::step, 2] / view.frame.camera.fx for view, _ in one_by_one(pairs)])
        pixel_m = float(np.median(footprint_m))
        if self.voxel_m is None:
            return max(pixel_m, 0.5 * float(np.median([view.sigma_r_m for view, _ in pairs])))
        if not FINEST_PX * pixel_m <= self.voxel_m < np.inf:
            raise InputError(
                f"voxel size {self.voxel_m:g} m is out of range: a pixel covers {pixel_m:.2g} m of this object; "
                f"give at least {FINEST_PX * pixel_m:.1g} m, or leave it out"
            )
        return self.voxel_m


@dataclass(frozen=True, eq=False)
class FusionVolume:
    """Posed views and the voxels around the object."""

    fuser: Fuser
    """Parameters."""
    views: ViewBlocks
    """The views."""
    grid: VoxelGrid
    """The voxels."""
    tau_m: float
    """Half width of the truncation band."""
    near_m: float
    """Largest distance along the normal between observations of the same surface."""
    sigma_m: float
    """Standard deviation of a surface point seen head-on by one view."""
    smoothing_m2: float = 0.0
    """Variance of the kernel over which the views' surface is smoothed, along either axis in the surface."""
    multipath_m: float = 0.0
    """Standard deviation of smooth errors of depth that are alike in all views."""

    def model(self, *, watertight: bool = False) -> ObjectModel:
        """Return the cloud and the mesh.

        Args:
            watertight: close the mesh with surface that no view saw; the standard deviation of its vertices is inf.
        """
        mesh, (points, point_normals, colours) = in_parallel(lambda: self._mesh(watertight=watertight), self._cloud)
        vertices, triangles, seen = mesh
        normals = meshing.normals_of(vertices, triangles)
        at_vertices = self.support(vertices, normals)
        coloured = self.views.coloured
        known = at_vertices.coloured & seen
        flattened_m = meshing.flattened_m(vertices, triangles, normals, self.smoothing_m2)
        variances_m2 = at_vertices.sigmas_m**2 + flattened_m**2 + self.multipath_m**2  # eq. 12.9
        return ObjectModel(
            points_m=points,
            normals=point_normals,
            colours=colours if coloured else None,
            vertices_m=vertices,
            triangles=triangles,
            vertex_normals=normals,
            vertex_colours=meshing.filled_colours(at_vertices.colours, known, vertices) if coloured else None,
            vertex_views=np.where(seen, at_vertices.views, 0),
            vertex_sigmas_m=np.where(seen, np.sqrt(variances_m2), np.inf),
        )

    def support(self, points_m: Array, normals: Array) -> ViewSupport:
        """Return what the views observe at oriented points (n, 3) of the object frame."""
        return self._support(points_m, normals, self.exposure)

    def texture_colours(
        self, points_m: Array, normals: Array, unseen: npt.NDArray[np.uint8]
    ) -> tuple[npt.NDArray[np.uint8], BoolArray]:
        """Return the RGB (n, 3) of surface points (n, 3) from the most frontal and sharpest views, and which they see.

        Args:
            points_m: (n, 3) in the object frame.
            normals: (n, 3) unit.
            unseen: (n, 3) RGB of those that no view with colour sees.
        """
        found = self._support(points_m, normals, self.exposure, focus=SHARP)
        return np.where(found.coloured[:, None], found.colours, unseen), found.coloured

    @property
    def pixel_m(self) -> float:
        """Length on the surface that a pixel of the views covers."""
        depth_m = float(np.median(self.views.thinned(_ranges_m)))
        return depth_m / float(np.median(np.concatenate([block.intrinsics[:, 0] for block in self.views])))

    @cached_property
    def exposure(self) -> Exposure:
        """What makes the views' colours alike."""
        return exposure_of(self.views, tau_m=self.tau_m, near_m=self.near_m)

    def _support(self, points_m: Array, normals: Array, exposure: Exposure, *, focus: float = SOFT) -> ViewSupport:
        return view_support(
            self.views,
            points_m,
            normals,
            tau_m=self.tau_m,
            near_m=self.near_m,
            sigma_m=self.sigma_m,
            exposure=exposure,
            focus=focus,
        )

    def _supported(self, found: ViewSupport) -> BoolArray:
        """Return which points (n,) have more support than views that see them empty, or background in their place."""
        against = self.fuser.empty_weight * found.empty_views + self.fuser.edge_weight * found.background
        return found.weight > against  # eq. 12.7

    def _cloud(self) -> tuple[Array, Array, npt.NDArray[np.uint8]]:
        """Return the merged points (n, 3), their normals (n, 3) and colours (n, 3)."""
        points, normals = voxel_means(
            ((block.points_m, block.normals, block.weights) for block in self.views),
            np.array([_extent_m(block.points_m) for block in self.views]),
            voxel_m=self.grid.voxel_m,
            max_voxels=8 * self.fuser.max_voxels,
        )
        found = self.support(points, normals)
        kept = self._supported(found) & ~_outliers(points, 2.0 * self.grid.voxel_m)
        return points[kept], normals[kept], found.colours[kept]

    def _mesh(self, *, watertight: bool) -> tuple[Array, meshing.Triangles, BoolArray]:
        """Return vertices (v, 3) and triangles (t, 3) of the surface, and which vertices the views support."""
        field = measured(self.grid, self.views, tau_m=self.tau_m, empty_weight=self.fuser.empty_weight)
        for _ in range(self.fuser.closing):
            field = filled(field)
        vertices, triangles = meshing.extracted_mesh(field)
        kept, confirmed, weak, sigmas_m = self._kept(vertices, triangles)
        shown = triangles[np.all(kept[triangles], axis=1)]
        large = meshing.large_pieces(vertices, shown)
        shown = shown[large | meshing.confirmed_pieces(vertices, shown, confirmed, self.near_m**2)]
        used, compact = meshing.used_vertices(shown, len(vertices))
        if watertight:
            return self._closed_mesh(field, vertices, used, weak, sigmas_m)
        means = meshing.neighbour_means(compact, len(used))
        smooth = meshing.laplacian_smoothed(vertices[used], means, np.isinf(sigmas_m[used]), meshing.PASSES)
        smooth = meshing.taubin_smoothed(smooth, means, self.fuser.fairing)
        smooth = meshing.taubin_smoothed(smooth, means, meshing.WEAK_PASSES, weak[used])
        return meshing.without_relief(smooth, compact, sigmas_m[used]), compact, np.ones(len(used), dtype=bool)

    def _kept(self, vertices: Array, triangles: meshing.Triangles) -> tuple[BoolArray, BoolArray, BoolArray, Array]:
        """Return which vertices (v,) are surface, which of these are confirmed, which are weak, and their sd in m.

        The sd is inf where closing a gap alone makes them surface.

        Surface is supported, not seen empty by several views, and does not fold over at a border; more than one view
        confirms it; weak is what has little support.
        """
        normals = meshing.normals_of(vertices, triangles)
        found = self._support(vertices, normals, Exposure.blind(self.views.count))
        # Closing gaps in the support must not add what several views see empty.
        empty = found.empty_views * self.fuser.empty_weight > found.weight + self.fuser.empty_weight
        seen = (found.weight > self.fuser.min_support) & self._supported(found)  # eq. 12.7
        marked = meshing.gaps_closed(seen, triangles, self.fuser.closing) & ~empty
        # At silhouettes the zero level set folds over: views extrapolate the object one band behind its surface.
        loose = meshing.folded(vertices, normals, seen, marked & ~seen)
        marked = meshing.without_loose_border(marked, loose, triangles)
        usual = float(np.median(found.weight[marked])) if marked.any() else 0.0
        confirmed = marked & seen & (found.views >= CONFIRMED)
        kept = meshing.spikes_removed(marked, triangles, self.fuser.opening) | confirmed
        return kept, confirmed, found.weight < meshing.WEAK * usual, np.where(seen, found.sigmas_m, np.inf)

    def _closed_mesh(
        self,
        field: DistanceField,
        vertices: Array,
        used: npt.NDArray[np.int64],
        weak: BoolArray,
        sigmas_m: Array,
    ) -> tuple[Array, meshing.Triangles, BoolArray]:
        """Return the watertight mesh: vertices, triangles, and which vertices the views support."""
        unused = np.ones(len(vertices), dtype=bool)
        unused[used] = False
        field = watertight.without_rejected(field, vertices[unused], vertices[used], self.tau_m)
        return watertight.cleaned(
            *meshing.extracted_mesh(watertight.closed_field(field, self.views, self.tau_m)),
            vertices[used],
            weak[used],
            sigmas_m[used],
            voxel_m=self.grid.voxel_m,
            passes=self.fuser.fairing,
        )


def downsampled(
    points_m: Array, normals: Array, weights: Array, *, voxel_m: float, max_voxels: int
) -> tuple[Array, Array]:
    """Average points (n, 3) with normals (n, 3) over voxels; see `voxel_means`."""
    box_m = _extent_m(points_m)[None]
    return voxel_means([(points_m, normals, weights)], box_m, voxel_m=voxel_m, max_voxels=max_voxels)


def voxel_means(
    clouds: Iterable[tuple[Array, Array, Array]], boxes_m: Array, *, voxel_m: float, max_voxels: int
) -> tuple[Array, Array]:
    """Average the oriented points of several clouds over voxels, those on opposite sides of a sheet apart.

    Args:
        clouds: of each, points (n, 3), attributes (n, 3 + k), of which the first three are the normal, and weights
            (n,).
        boxes_m: (k, 2, 3) lowest and highest corners of boxes that hold them.
        voxel_m: side of a voxel.
        max_voxels: voxels are enlarged until the box of all boxes has at most this many.

    Returns:
        Points (m, 3) and attributes (m, 3 + k) with unit normals, in the order in which the points enter the voxels.
    """
    low, high = boxes_m[:, 0].min(axis=0), boxes_m[:, 1].max(axis=0)
    while np.prod(np.ceil((high - low) / voxel_m) + 1.0) > max_voxels:
        voxel_m *= 1.25
    shape = (np.ceil((high - low) / voxel_m) + 1.0).astype(np.int64)
    voxels, sums = np.zeros(0, dtype=np.int64), None
    halves = (side for cloud in clouds for side in _sides(*cloud))
    for half, (points_m, attributes, weights) in halves:
        cells, count = point_clouds.voxel_numbers(points_m, low, voxel_m, shape)
        some, totals = point_clouds.voxel_sums(cells, count, weights, np.concatenate([points_m, attributes], axis=1))
        firsts = np.empty(count, dtype=np.int64)
        firsts[cells[::-1]] = np.arange(len(cells))[::-1]  # the last assignment counts
        places = np.floor((points_m[firsts] - low) / voxel_m).astype(np.int64)
        voxels = np.concatenate([voxels, 2 * np.ravel_multi_index(tuple(places.T), tuple(shape)) + half])
        some = np.concatenate([some, totals[:, None]], axis=1)
        voxels, sums = _summed(voxels, some if sums is None else np.concatenate([sums, some]))
    assert sums is not None
    means = sums[:, :-1] / sums[:, -1:]
    lengths = np.linalg.norm(means[:, 3:6], axis=1)
    means[:, 3:6] /= np.maximum(lengths, 1e-300)[:, None]
    kept = lengths > 0.1  # the rest has no normal
    return means[kept, :3], means[kept, 3:]


def _sides(points_m: Array, attributes: Array, weights: Array) -> Iterator[tuple[int, tuple[Array, Array, Array]]]:
    """Yield the oriented points of either half of all directions, so that both sides of a sheet do not cancel."""
    ahead = attributes[:, :3] @ HALVES > 0.0
    for half, chosen in enumerate((ahead, ~ahead)):
        yield half, (points_m[chosen], attributes[chosen], weights[chosen])


def _posed_points(view: RayImage, object_from_camera: Array, step: int) -> tuple[Array, Array, Array]:
    """Return some points (n, 3) of a view; normals, RGB and whether it has colour (n, 7); and weights (n,)."""
    points_m = se3.transform(object_from_camera, view.points_m[::step])
    normals = view.normals[::step] @ object_from_camera[:3, :3].T
    colour, (rows, columns) = view.frame.colour, view.pixels[::step].T
    rgb = np.zeros_like(points_m) if colour is None else colour[rows, columns]
    coloured = np.full((len(points_m), 1), colour is not None)
    return points_m, np.concatenate([normals, rgb, coloured], axis=1), np.ones(len(points_m))


def _summed(keys: npt.NDArray[np.int64], values: Array) -> tuple[npt.NDArray[np.int64], Array]:
    """Return distinct keys, in the order in which they first appear, and the sums of the values (n, c) of each."""
    _, firsts, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(firsts)
    ranks = np.empty(len(order), dtype=np.int64)
    ranks[order] = np.arange(len(order))
    sums = np.zeros((len(order), values.shape[1]))
    np.add.at(sums, ranks[inverse], values)
    return keys[firsts[order]], sums


def _extent_m(points_m: Array) -> Array:
    """Return the lowest and highest corners (2, 3) of the box around points (n, 3)."""
    return np.stack([points_m.min(axis=0), points_m.max(axis=0)])


def _some_points(pairs: list[tuple[RayImage, Array]]) -> Array:
    """Return surface points (n, 3) of all views in the object frame, enough for quantiles."""
    step = thinning(sum(len(view.points_m) for view, _ in pairs))
    return np.concatenate([se3.transform(pose, view.points_m[::step]) for view, pose in one_by_one(pairs)])


def _smoothing_m2(pairs: list[tuple[RayImage, Array]]) -> float:
    """Return the variance in m², along either axis, of the kernel over which views are smoothed (method, eq. 12.9).

    Sensors smooth surface as they smooth its noise, whose autocorrelation has the area 4π s² for a Gaussian of sd s.
    """
    moments_m2 = [
        view.error_area_px * (float(np.median(view.points_m[:, 2])) / view.frame.camera.fx) ** 2
        for view, _ in one_by_one(pairs)
        if len(view.points_m)
    ]
    return float(np.median(moments_m2)) / (4.0 * np.pi)


def _ranges_m(views: DepthViews) -> Array:
    """Return the distance (n,) of each surface point from its camera."""
    turns, shifts = views.poses[:, :, :3], views.poses[:, :, 3]
    centres_m = -np.einsum("fji,fj->fi", turns, shifts)[views.views]
    return np.linalg.norm(views.points_m - centres_m, axis=1)


def _outliers(points_m: Array, cell_m: float) -> BoolArray:
    """Return which points (n,) have fewer than `MIN_NEIGHBOURS` points, themselves included, in 27 cells around."""
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    shape = (np.ceil((high - low) / cell_m) + 1.0).astype(np.int64)
    return point_clouds.neighbour_counts(points_m, low, cell_m, shape) < MIN_NEIGHBOURS
