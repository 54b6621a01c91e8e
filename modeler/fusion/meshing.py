"""The truncated signed distance function (TSDF) on a voxel grid, and its mesh: extraction, selection, smoothing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from modeler.fusion.depth_views import ViewBlocks
from modeler.kernels import marching_cubes, relief, tsdf
from modeler.types import Array, BoolArray, area_vectors_m2, areas_m2

LEAST_NEIGHBOURS = 15  # of the 26 around a voxel that fill it: more than half, so that open borders do not grow
COARSE_VOXELS = 64**3  # of models whose shape need only be about right
FAINT = 1e-3  # weight, of a voxel that is filled say: next to nothing against an observation


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Cubic voxels over a box of the object frame, whole blocks along each axis."""

    origin_m: Array
    """(3,) lowest corner."""
    voxel_m: float
    """Side of a voxel."""
    blocks: npt.NDArray[np.int64]
    """(3,) blocks of `tsdf.SIDE` voxels along each axis."""

    @property
    def shape(self) -> npt.NDArray[np.int64]:
        """(3,) voxels along each axis."""
        return self.blocks * tsdf.SIDE

    @property
    def corners_m(self) -> Array:
        """(8, 3) corners of the box."""
        size_m = self.shape * self.voxel_m
        return self.origin_m + size_m * np.array([[c >> 2 & 1, c >> 1 & 1, c & 1] for c in range(8)])


def grid_around(points_m: Array, *, voxel_m: float, border_m: float, max_voxels: int) -> VoxelGrid:
    """Return the grid around points (n, 3) and a border; its voxels are enlarged until it holds at most `max_voxels`.

    Outliers do not enlarge the box: it ends half its size beyond the central 98 % of the points.
    """
    low, high = np.quantile(points_m, [0.01, 0.99], axis=0)
    slack = 0.5 * (high - low) + border_m
    low = np.maximum(low - slack, points_m.min(axis=0)) - border_m
    high = np.minimum(high + slack, points_m.max(axis=0)) + border_m
    voxel_m = max(voxel_m, float(np.prod(high - low) / max_voxels) ** (1.0 / 3.0))
    # One unknown voxel on each side, so that kernels may look at neighbours without bounds checks.
    blocks = np.ceil((high - low) / voxel_m + 2.0).astype(np.int64) // tsdf.SIDE + 1
    origin = 0.5 * (low + high) - 0.5 * blocks * tsdf.SIDE * voxel_m
    return VoxelGrid(origin, voxel_m, blocks)


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Signed distance on the voxels of a grid near the surface."""

    grid: VoxelGrid
    """The voxels."""
    values_m: npt.NDArray[np.float32]
    """(x, y, z) distance at voxel centres, positive outside."""
    weights: npt.NDArray[np.float32]
    """(x, y, z) weight; 0 = unknown."""

    @cached_property
    def cells(self) -> npt.NDArray[np.int64]:
        """(n, 3) cells that the surface may cross, see `crossed`."""
        return crossed(self.values_m)


def measured(grid: VoxelGrid, views: ViewBlocks, *, tau_m: float, empty_weight: float) -> DistanceField:
    """Return the signed distance measured by the views, within ±`tau_m` of the surface (method, eq. 12.5).

    The distances that several blocks of views measure are averaged by their weights.
    """
    block_m = tsdf.SIDE * grid.voxel_m
    near = np.zeros(grid.blocks, dtype=bool)
    for some in views:
        near[tuple(tsdf.blocks_near(some.points_m, grid.origin_m, block_m, tau_m, grid.blocks).T)] = True
    voxels = voxels_where(near)
    distance, weight = (np.zeros((len(voxels), *(tsdf.SIDE,) * 3), dtype=np.float32) for _ in range(2))
    for some in views:
        value, share = tsdf.integrate(
            voxels, grid.origin_m, grid.voxel_m, tau_m, empty_weight, some.views, *some.lookup
        )
        weight += share
        distance += np.divide(share, weight, out=np.ones_like(share), where=weight > 0.0) * (value - distance)
    x, y, z = (int(n) for n in grid.blocks)
    values, weights = (np.zeros(grid.shape, dtype=np.float32) for _ in range(2))
    for image, of_blocks in ((values, distance), (weights, weight)):
        by_block = image.reshape(x, tsdf.SIDE, y, tsdf.SIDE, z, tsdf.SIDE).transpose(0, 2, 4, 1, 3, 5)  # a view
        by_block[near] = of_blocks
    for axis in range(3):
        np.moveaxis(weights, axis, 0)[[0, -1]] = 0.0
    return DistanceField(grid, values, weights)


def voxels_where(mask: BoolArray) -> npt.NDArray[np.int64]:
    """Return the voxels (n, 3) where a mask (x, y, z) is true, in ascending order: faster than `np.argwhere`."""
    return np.stack(np.unravel_index(np.flatnonzero(mask), mask.shape), axis=1)


def filled(field: DistanceField) -> DistanceField:
    """Return the field with unknown voxels filled whose neighbours are mostly known: the mean of these."""
    cells, means = marching_cubes.fill(field.values_m, field.weights, LEAST_NEIGHBOURS)
    if not len(cells):
        return field
    values, weights = field.values_m.copy(), field.weights.copy()
    values[tuple(cells.T)] = means
    weights[tuple(cells.T)] = FAINT
    return DistanceField(field.grid, values, weights)


def crossed(values_m: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """Return the cells (n, 3), by their lowest voxel, in ascending order, whose eight voxels differ in sign."""
    inside = values_m < 0.0
    some, every = inside, inside
    for axis in range(3):
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        some = some[tuple(low)] | some[tuple(high)]
        every = every[tuple(low)] & every[tuple(high)]
    return voxels_where(some & ~every)


Triangles = npt.NDArray[np.int64]

RAYLEIGH_MEDIAN = 1.1774  # of the length of two independent normal variables of variance 1
COLOUR_NEIGHBOURS = 6
"""Vertices whose colours are interpolated where none was observed: those around a vertex of a regular mesh."""
NORMAL_NEIGHBOURS = 12
"""Supported vertices whose normals are compared with an unsupported one's; with 6, 0.59 % of the box lie in free space,
not 0.58, and with 24 it is the same."""
FOLD_RAD = 0.7
"""A surface that turns by more within a few voxels folds over; with 0.35 and 1.4, 0.55 and 0.60 % of the box lie in
free space, not 0.58."""
WEAK = 0.2
"""Vertices with less than this share of the median support are weak; with 0.1 and 0.4, 0.59 % of the box lie in free
space, not 0.58."""
WEAK_PASSES = 40  # of smoothing weak vertices; with 20 and 80, 0.59 % of the box lie in free space, with 40 0.58
PASSES = 60  # of fitting vertices to normals, and of smoothing unseen ones: with half as many, a box is 0.2 % larger
PINCH_DEPTH = 1e-2
"""How far inside a voxel is put to resolve a pinch, in voxels; halved or doubled, the box is the same to 0.1 %."""
EDGE = 4.685  # sd of the differences between neighbouring normals that make an edge: Tukey's, of 95 % efficiency
FLATTENING_PASSES = 50
"""At most, which bounds time, of the smoothing that shows how smoothed views flatten surface: it ends where it has
spread as far as theirs. A carton reaches the bound; what is missing of the spread scales the displacement then."""
GUIDE_PASSES = 10
"""Of smoothing normals before edges are sought: some three triangles far; insensitive, as `DIFFUSION_PASSES`."""
DIFFUSION_PASSES = 200
"""Of normals over neighbouring triangles, some 15 of them far; with 100 or 400, left-out views of the box differ by
1.5 %."""


def without_pinches(field: DistanceField) -> DistanceField:
    """Return the field with sheets of the zero level set joined that touch along an edge."""
    values, cells = field.values_m, field.cells
    # Voxels are only ever put inside, so that this ends.
    while len(voxels := marching_cubes.pinched_voxels(values, field.weights, cells)):
        if values is field.values_m:
            values = values.copy()
        values[tuple(voxels.T)] = -PINCH_DEPTH * field.grid.voxel_m
        # Only cells around a changed voxel, and those that share a face with them, can have new pinches.
        around = (voxels[:, None] - np.indices((2, 2, 2)).reshape(3, -1).T).reshape(-1, 3)
        cells = np.unique(np.concatenate([around, *(around - side for side in np.eye(3, dtype=np.int64))]), axis=0)
        cells = cells[cells.min(axis=1) >= 0]
    if values is field.values_m:
        return field
    return DistanceField(field.grid, values, field.weights)


def extracted_mesh(field: DistanceField) -> tuple[Array, Triangles]:
    """Return vertices (v, 3) in m and triangles (t, 3) of the zero level set; no edge has more than two triangles."""
    field = without_pinches(field)
    vertices, triangles = marching_cubes.extract(field.values_m, field.weights, field.cells)
    return field.grid.origin_m + (vertices + 0.5) * field.grid.voxel_m, triangles


def normals_of(vertices_m: Array, triangles: Triangles) -> Array:
    """Return unit normals (v, 3): the mean of the triangles around each vertex by area."""
    areas = area_vectors_m2(vertices_m, triangles)
    sums = np.stack(
        [
            np.bincount(triangles.ravel(), weights=np.repeat(areas[:, c], 3), minlength=len(vertices_m))
            for c in range(3)
        ],
        axis=1,
    )
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(lengths > 0.0, sums / np.maximum(lengths, 1e-300), [0.0, 0.0, 1.0])


def large_pieces(vertices_m: Array, triangles: Triangles) -> BoolArray:
    """Return which triangles (t,) belong to connected components of at least 1 % of the largest one's area."""
    if not len(triangles):
        return np.zeros(0, dtype=bool)
    piece = _piece(triangles, len(vertices_m))
    area = np.bincount(piece, weights=areas_m2(vertices_m, triangles))
    return (area >= 0.01 * area.max())[piece]


def confirmed_pieces(vertices_m: Array, triangles: Triangles, confirmed: BoolArray, least_m2: float) -> BoolArray:
    """Return which triangles (t,) belong to connected components of which an area of at least `least_m2` is confirmed.

    Args:
        vertices_m: (v, 3).
        triangles: (t, 3).
        confirmed: (v,) which vertices are; a triangle is, if all of its vertices are.
        least_m2: least area.
    """
    if not len(triangles):
        return np.zeros(0, dtype=bool)
    piece = _piece(triangles, len(vertices_m))
    areas = areas_m2(vertices_m, triangles) * np.all(confirmed[triangles], axis=1)
    return (np.bincount(piece, weights=areas) >= least_m2)[piece]


def solid_pieces(vertices_m: Array, triangles: Triangles) -> BoolArray:
    """Return which triangles (t,) belong to the closed component of the largest volume."""
    if not len(triangles):
        return np.zeros(0, dtype=bool)
    piece = _piece(triangles, len(vertices_m))
    volume = np.bincount(piece, weights=np.linalg.det(vertices_m[triangles] - vertices_m.mean(axis=0)))
    return piece == np.argmax(volume)


def _piece(triangles: Triangles, count: int) -> npt.NDArray[np.int64]:
    """Return the number of the connected component of each triangle (t,)."""
    ones = np.ones(2 * len(triangles), dtype=bool)
    pairs = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    links = coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(links, directed=False)[1][triangles[:, 0]]


def boundary_edges(triangles: Triangles) -> npt.NDArray[np.int64]:
    """Return the boundary edges (e, 2): those of one triangle only."""
    one, other = triangles.ravel(), triangles[:, [1, 2, 0]].ravel()
    low, high = np.minimum(one, other), np.maximum(one, other)
    size = int(high.max(initial=-1)) + 1
    uses = coo_array((np.ones(len(low), dtype=np.int64), (low, high)), shape=(size, size)).tocsr()
    first = np.repeat(np.arange(size), np.diff(uses.indptr))
    return np.stack([first, uses.indices], axis=1, dtype=np.int64)[uses.data == 1]


def dilated(marked: BoolArray, triangles: Triangles, rings: int) -> BoolArray:
    """Return which vertices (v,) are marked or within `rings` edges of a marked one (dilation)."""
    found = marked.copy()
    for _ in range(rings):
        found[triangles[np.any(found[triangles], axis=1)]] = True
    return found


def gaps_closed(marked: BoolArray, triangles: Triangles, rings: int) -> BoolArray:
    """Return which vertices (v,) are marked or in gaps up to twice `rings` wide (morphological closing)."""
    # The border of the mesh counts as unmarked, so that closing does not extend to it.
    outside = ~dilated(marked, triangles, rings)
    outside[boundary_edges(triangles)] = True
    outside &= ~marked
    for _ in range(rings):
        outside[triangles[np.any(outside[triangles], axis=1)]] = True
        outside &= ~marked
    return ~outside


def folded(vertices_m: Array, normals: Array, seen: BoolArray, added: BoolArray) -> BoolArray:
    """Return which of the added vertices (v,) have a normal far from those of the nearest vertices seen."""
    chosen, found = np.flatnonzero(added), np.zeros(len(added), dtype=bool)
    if np.count_nonzero(seen) < NORMAL_NEIGHBOURS:
        return found
    near = KDTree(vertices_m[seen]).query(vertices_m[chosen], k=NORMAL_NEIGHBOURS)[1]
    mean = normals[seen][near].mean(axis=1)
    cosine = np.sum(mean * normals[chosen], axis=1)
    found[chosen] = cosine < np.cos(FOLD_RAD) * np.linalg.norm(mean, axis=1)
    return found


def without_loose_border(marked: BoolArray, loose: BoolArray, triangles: Triangles) -> BoolArray:
    """Return the marked vertices (v,) without loose ones that the border reaches over at most eight others."""
    outside = ~marked
    triangles = triangles[np.any(loose[triangles], axis=1)]
    for _ in range(8):  # without an end, the capture cap loses four vertices more
        outside[triangles[np.any(outside[triangles], axis=1)]] = True
        outside &= ~marked | loose
    return ~outside


def spikes_removed(marked: BoolArray, triangles: Triangles, rings: int) -> BoolArray:
    """Return the marked vertices (v,) without parts narrower than about twice `rings` (morphological opening)."""
    outside = ~marked
    outside[boundary_edges(triangles[np.all(marked[triangles], axis=1)])] = True
    core = ~dilated(outside, triangles, rings - 1)
    for _ in range(rings):
        core[triangles[np.any(core[triangles], axis=1)]] = True
        core &= marked
    return core


def taubin_smoothed(vertices_m: Array, means: csr_array, passes: int, only: BoolArray | None = None) -> Array:
    """Return vertices (v, 3) smoothed by a low-pass filter that does not shrink the mesh.

    Each pass is a step towards the neighbours' mean and a slightly longer one back (Taubin 1995, "A signal processing
    approach to fair surface design").

    Args:
        vertices_m: (v, 3).
        means: (v, v) from vertices to the means of their neighbours, see `neighbour_means`.
        passes: number of passes.
        only: which vertices (v,) move; None: all.
    """
    moving = slice(None) if only is None else np.flatnonzero(only)
    means, vertices_m = means[moving], vertices_m.copy()
    for step in [0.5, -0.53] * passes:  # pass band at 1 / 0.5 - 1 / 0.53 = 0.11, as Taubin proposes
        vertices_m[moving] += step * (means @ vertices_m - vertices_m[moving])
    return vertices_m


def neighbour_means(triangles: Triangles, count: int) -> csr_array:
    """Return the matrix (v, v) from `count` vertices to the means of their neighbours.

    Vertices on the boundary follow their neighbours on it alone.
    """
    border = boundary_edges(triangles)
    on_border = np.zeros(count, dtype=bool)
    on_border[border] = True
    pairs = _neighbours(triangles)
    return _means(np.concatenate([pairs[~on_border[pairs[:, 0]]], border, border[:, ::-1]]), count)


def without_relief(vertices_m: Array, triangles: Triangles, limits_m: Array) -> Array:
    """Return vertices (v, 3) of a piecewise smoother surface within given distances (method, eq. 12.13).

    Normals are averaged over neighbours that differ as their noise does; vertices are fitted to the averages.

    Args:
        vertices_m: (v, 3).
        triangles: (t, 3).
        limits_m: (v,) farthest that each vertex may move: the standard deviation of its place.
    """
    across = _across(triangles)
    first, side = np.nonzero(across >= 0)
    if not len(first):
        return vertices_m
    normals, areas = relief.facets(vertices_m, triangles)
    guide = relief.diffused(normals, normals, areas, across, np.inf, GUIDE_PASSES)
    turns = np.linalg.norm(guide[first] - guide[across[first, side]], axis=1)
    sigma = float(np.median(turns)) / RAYLEIGH_MEDIAN
    if not sigma > 0.0:
        return vertices_m
    normals = relief.diffused(normals, guide, areas, across, EDGE * sigma, DIFFUSION_PASSES)
    return relief.fitted(vertices_m, triangles, normals, limits_m, PASSES)


def flattened_m(vertices_m: Array, triangles: Triangles, normals: Array, moment_m2: float) -> Array:
    """Return how far (v,) in m smoothing over a surface moves it along its normals, by root mean square.

    The mean is over the same kernel: smoothed surface does not show where in it an edge was (method, eq. 12.9).

    Args:
        vertices_m: (v, 3).
        triangles: (t, 3).
        normals: (v, 3) unit.
        moment_m2: variance in m² of the kernel along either axis in the surface.
    """
    if not len(triangles) or moment_m2 <= 0.0:
        return np.zeros(len(vertices_m))
    corners = vertices_m[triangles]
    edge_m2 = float(np.mean(np.sum((corners - np.roll(corners, 1, axis=1)) ** 2, axis=2)))
    # The mean over a ring of radius r has a variance of r²/2 along either axis; half a step towards it, r²/4.
    passes = min(int(np.ceil(moment_m2 / (0.25 * edge_m2))), FLATTENING_PASSES)
    reached_m2 = passes * 0.25 * edge_m2
    step, scale = 0.5 * min(moment_m2 / reached_m2, 1.0), max(moment_m2 / reached_m2, 1.0)
    mean = _means(_neighbours(triangles), len(vertices_m))

    def smoothed(values: Array) -> Array:
        for _ in range(passes):
            values = values + step * (mean @ values - values)
        return values

    moved_m = scale * np.sum((smoothed(vertices_m) - vertices_m) * normals, axis=1)
    return np.sqrt(smoothed(moved_m**2))


def _across(triangles: Triangles) -> Triangles:
    """Return the triangle across each edge (t, 3) of triangles that have at most two at an edge; -1 = none."""
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys = edges[:, 0] * (edges.max(initial=0) + 1) + edges[:, 1]
    order = np.argsort(keys, kind="stable")
    twice = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    first, second = order[twice], order[twice + 1]
    across = np.full(len(edges), -1, dtype=np.int64)
    across[first], across[second] = second // 3, first // 3
    return across.reshape(-1, 3)


def laplacian_smoothed(vertices_m: Array, means: csr_array, free: BoolArray, passes: int) -> Array:
    """Return vertices (v, 3) of which the free ones are repeatedly replaced by means, see `neighbour_means`."""
    moving = np.flatnonzero(free)
    means, vertices_m = means[moving], vertices_m.copy()
    for _ in range(passes):
        vertices_m[moving] = means @ vertices_m
    return vertices_m


def _neighbours(triangles: Triangles) -> Triangles:
    """Return pairs (p, 2) of vertices with each of their neighbours, some twice."""
    pairs = np.concatenate([triangles[:, :2], triangles[:, 1:], triangles[:, [2, 0]]])
    return np.concatenate([pairs, pairs[:, ::-1]])


def _means(pairs: Triangles, count: int) -> csr_array:
    """Return the matrix (v, v) that maps vertices to the means of their neighbours."""
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
    links.data[:] = 1.0
    return csr_array(diags_array(1.0 / np.maximum(links.sum(axis=1), 1.0)) @ links)


def filled_colours(colours: npt.NDArray[np.uint8], known: BoolArray, vertices_m: Array) -> npt.NDArray[np.uint8]:
    """Return RGB (v, 3) with unknown colours interpolated from the nearest known ones by inverse distance."""
    if known.all() or np.count_nonzero(known) < COLOUR_NEIGHBOURS:
        return colours
    near_m, near = KDTree(vertices_m[known]).query(vertices_m[~known], k=COLOUR_NEIGHBOURS)
    weights = 1.0 / (near_m + 1e-6)
    spread = colours.copy()
    spread[~known] = np.rint(
        np.einsum("nk,nkc->nc", weights / weights.sum(axis=1, keepdims=True), colours[known][near])
    )
    return spread


def used_vertices(triangles: Triangles, count: int) -> tuple[npt.NDArray[np.int64], Triangles]:
    """Return which of `count` vertices the triangles use, in ascending order, and the triangles renumbered."""
    used = np.zeros(count, dtype=bool)
    used[triangles.ravel()] = True
    return np.flatnonzero(used), (np.cumsum(used) - 1)[triangles]
