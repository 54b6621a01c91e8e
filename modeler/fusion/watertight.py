"""Closing the mesh where no view saw surface, so that it encloses a volume."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter
from scipy.spatial import KDTree

from modeler.fusion import meshing
from modeler.fusion.depth_views import ViewBlocks
from modeler.fusion.meshing import COARSE_VOXELS, FAINT, DistanceField
from modeler.kernels import occupancy
from modeler.types import Array, BoolArray

ROUNDS = 400  # of the primal-dual iteration; with 200, the closed box has 0.3 % less volume, with 800 the same
SEAM = 4  # passes over the seam between seen and unseen surface, and rings next to it that are smoothed like weak ones
OUTVOTED = 0.1
"""Largest share of the views of a cell that may be wrong, for their poses err; with 0.05 the box is the same, with 0.2
0.2 % larger."""
OUTER_LAYERS = 3  # layers of voxels at the border of the grid that are outside: those that it is wider than the surface
BELOW_PLANE = 0.01
"""Largest share of surface points below the plane on which the object stands: of noise; halved or doubled, the box is
the same."""


def without_rejected(field: DistanceField, rejected_m: Array, kept_m: Array, reach_m: float) -> DistanceField:
    """Return the field set to unknown around rejected surface points (n, 3), unless kept ones (m, 3) are near."""
    grid, reach = field.grid, int(np.ceil(reach_m / field.grid.voxel_m)) + 1
    near = [np.zeros(grid.shape, dtype=bool) for _ in range(2)]
    for marks, points_m in zip(near, (rejected_m, kept_m), strict=True):
        voxels = np.floor((points_m - grid.origin_m) / grid.voxel_m).astype(np.int64)
        marks[tuple(np.clip(voxels, 0, grid.shape - 1).T)] = True
    size = 2 * reach + 1
    erased = maximum_filter(near[0], size=size) & np.logical_not(maximum_filter(near[1], size=size))
    weights = np.where(erased, np.float32(0.0), field.weights)
    return DistanceField(grid, field.values_m, weights)


def closed_field(field: DistanceField, seen: ViewBlocks, tau_m: float) -> DistanceField:
    """Return the field with all unknown voxels classified as outside or inside.

    What views see empty or below the support plane is outside, unless nearly all other views see surface in front of
    it. The remaining space is divided by the surface of least area that continues what was seen (method, eq. 12.12).
    The object ends at its support plane.
    """
    grid = field.grid
    stride = max(1, int(np.ceil((float(np.prod(grid.shape)) / COARSE_VOXELS) ** (1.0 / 3.0))))
    blocks, cell_m = -(-grid.shape // stride), stride * grid.voxel_m
    counts = [
        occupancy.observation_counts(
            grid.origin_m, cell_m, blocks, tau_m, some.free_m, some.poses, some.intrinsics, some.planes
        )
        for some in seen
    ]
    empty, at_surface, hidden = np.stack(counts).sum(axis=0, dtype=np.int64)[:3]
    observed = np.maximum(empty + at_surface + hidden, 1)
    seen_empty = empty > OUTVOTED * observed
    field = _without_deep_voids(field, hidden >= (1.0 - OUTVOTED) * observed, stride)
    pad = [(0, int(n)) for n in blocks * stride - grid.shape]
    known = np.pad((field.weights > 0.0).astype(np.float32), pad)
    values = np.pad(np.where(field.weights > 0.0, field.values_m, 0.0), pad)
    x, y, z = (int(n) for n in blocks)
    shares, sums = (array.reshape(x, stride, y, stride, z, stride).mean(axis=(1, 3, 5)) for array in (known, values))
    level = np.clip(sums / np.maximum(shares, 1e-6) / cell_m, -1.0, 1.0).astype(np.float32)
    sure = shares > 0.5
    outside = ~sure & (seen_empty | _outer_layers(blocks))
    fixed = sure | outside | _outer_layers(blocks)
    start = np.where(sure, level, np.where(outside, 1.0, -1.0)).astype(np.float32)
    start[_outer_layers(blocks)] = 1.0
    decided = occupancy.minimal_surface(start, fixed, ROUNDS)
    smooth = np.where(sure, decided, gaussian_filter(decided, 0.7))
    # Interpolate at voxels: the centre of voxel v lies at (v + ½) / stride - ½ cells.
    positions = [(np.arange(int(n)) + 0.5) / stride - 0.5 for n in grid.shape]
    unseen_m = np.empty(grid.shape, dtype=np.float32)
    for x, position in enumerate(positions[0]):
        at = np.meshgrid([position], positions[1], positions[2], indexing="ij")
        unseen_m[x] = map_coordinates(smooth, at, order=1, mode="nearest")[0] * cell_m
    whole = np.where(field.weights > 0.0, field.values_m, unseen_m)
    x, y, z = (grid.origin_m[axis] + (np.arange(int(n)) + 0.5) * grid.voxel_m for axis, n in enumerate(grid.shape))
    for a, b, c, offset_m in support_planes(seen, grid.corners_m, tau_m).astype(np.float32):
        # Views extrapolate the object behind its surface, also below the plane where they look down.
        np.maximum(whole, -((a * x + offset_m)[:, None, None] + (b * y)[:, None] + c * z), out=whole, dtype=np.float32)
    whole[_outer_layers(grid.shape, OUTER_LAYERS)] = tau_m
    whole[whole == 0.0] = FAINT * grid.voxel_m
    return DistanceField(grid, whole, np.maximum(field.weights, np.float32(FAINT)))


def support_planes(seen: ViewBlocks, corners_m: Array, tau_m: float) -> Array:
    """Return normals and offsets (k, 4) of the planes on which the object stood, in the object frame.

    Planes of different views are the same if they are less than `tau_m` apart all over the box with `corners_m`
    (8, 3). A plane seen by a few views alone, or with surface points below it, is left out.
    """
    planes = np.concatenate([some.planes for some in seen])
    planes = planes[np.isfinite(planes).all(axis=1)]
    heights_m = corners_m @ planes[:, :3].T + planes[:, 3]
    found, remaining = [], np.arange(len(planes))
    while len(remaining):
        alike = np.abs(heights_m[:, remaining] - heights_m[:, remaining[:1]]).max(axis=0) < tau_m
        plane = np.median(planes[remaining[alike]], axis=0)
        plane /= np.linalg.norm(plane[:3])
        below = float(np.mean(seen.thinned(lambda views, plane=plane: views.points_m @ plane[:3] + plane[3]) < -tau_m))
        if np.count_nonzero(alike) > OUTVOTED * seen.count and below < BELOW_PLANE:
            found.append(plane)
        remaining = remaining[~alike]
    return np.reshape(found, (-1, 4))


def cleaned(
    vertices_m: Array,
    triangles: meshing.Triangles,
    shown_m: Array,
    weak: BoolArray,
    sigmas_m: Array,
    *,
    voxel_m: float,
    passes: int,
) -> tuple[Array, meshing.Triangles, BoolArray]:
    """Return vertices (v, 3) and triangles (t, 3) of the largest component, smoothed, and which (v,) views saw.

    Args:
        vertices_m: (v, 3) of closed surfaces.
        triangles: (t, 3).
        shown_m: (n, 3) vertices that the views saw.
        weak: (n,) which of these have weak support.
        sigmas_m: (n,) their standard deviations.
        voxel_m: side of a voxel.
        passes: of smoothing seen surface; unseen surface is smoothed more.
    """
    triangles = triangles[meshing.solid_pieces(vertices_m, triangles)]
    used, triangles = meshing.used_vertices(triangles, len(vertices_m))
    vertices_m = vertices_m[used]
    away_m, nearest = KDTree(shown_m).query(vertices_m, distance_upper_bound=voxel_m)
    shown = away_m < voxel_m
    means = meshing.neighbour_means(triangles, len(vertices_m))
    vertices_m = meshing.taubin_smoothed(vertices_m, means, passes)
    vertices_m = meshing.laplacian_smoothed(vertices_m, means, ~shown, meshing.PASSES)
    # Support is weak along the seam.
    seam = meshing.dilated(shown, triangles, 1) & meshing.dilated(~shown, triangles, 1)
    vertices_m = meshing.laplacian_smoothed(vertices_m, means, seam, SEAM)
    rough = meshing.dilated(seam, triangles, SEAM) | (shown & np.append(weak, False)[nearest])
    vertices_m = meshing.taubin_smoothed(vertices_m, means, meshing.WEAK_PASSES, rough)
    limits_m = np.where(shown, np.append(sigmas_m, 0.0)[nearest], 0.0)
    return meshing.without_relief(vertices_m, triangles, limits_m), triangles, shown


def _without_deep_voids(field: DistanceField, deep: BoolArray, stride: int) -> DistanceField:
    """Return the field set to unknown where it is positive (empty) deep behind the surface.

    Args:
        field: as measured.
        deep: (x, y, z) cells of `stride` voxels with surface in front of them in nearly all views.
        stride: voxels along a cell.
    """
    inside = tuple(slice(int(n)) for n in field.grid.shape)
    deep = deep.repeat(stride, 0).repeat(stride, 1).repeat(stride, 2)[inside]
    weights = np.where(deep & (field.values_m > 0.0), np.float32(0.0), field.weights)
    return DistanceField(field.grid, field.values_m, weights)


def _outer_layers(shape: npt.NDArray[np.int64], layers: int = 1) -> BoolArray:
    """Return which cells of a grid lie in the outermost layers."""
    shell = np.ones(shape, dtype=bool)
    shell[layers:-layers, layers:-layers, layers:-layers] = False
    return shell
