"""Making up the surface that nobody saw, so that the model encloses a volume."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter
from scipy.spatial import KDTree

from modeler.fusion import surface
from modeler.fusion.grid import FAINT, Field, crossed
from modeler.fusion.views import DepthViews
from modeler.kernels import closing
from modeler.types import Array, BoolArray

CELLS = 80**3  # the unseen is decided on a grid of no more cells
ROUNDS = 400
SPANNING = 60  # steps towards the neighbours' mean that made-up vertices take
SETTLING = 4  # and vertices along the seam with what views show
SEAM = 4  # rings of vertices beside it that are smoothed like those that are known badly
CONTRARY = 0.1  # share of the views of a cell that may be wrong about it, for their poses are off
OUTER = 3  # layers of voxels at the border that are outside
SUNK = 0.01  # share of the points seen that may lie under a table; of more, it is not what the object stands on


def without(field: Field, rejected_m: Array, kept_m: Array, reach_m: float) -> Field:
    """Return the field that knows nothing around rejected surface points (n, 3), unless kept ones (m, 3) are near."""
    grid, reach = field.grid, int(np.ceil(reach_m / field.grid.voxel_m)) + 1
    near = [np.zeros(grid.shape, dtype=bool) for _ in range(2)]
    for marks, points_m in zip(near, (rejected_m, kept_m), strict=True):
        voxels = np.floor((points_m - grid.origin_m) / grid.voxel_m).astype(np.int64)
        marks[tuple(np.clip(voxels, 0, grid.shape - 1).T)] = True
    size = 2 * reach + 1
    forgotten = maximum_filter(near[0], size=size) & np.logical_not(maximum_filter(near[1], size=size))
    weights = np.where(forgotten, np.float32(0.0), field.weights)
    return Field(grid, field.values_m, weights, np.argwhere(weights > 0.0))


def enclosing(field: Field, seen: DepthViews, tau_m: float) -> Field:
    """Return the field with all that is unknown decided: outside or inside.

    What views look through or know to be below the table is outside, unless nearly all others have surface in front of
    it; the rest is parted where the surface between inside and outside is smallest, as a soap film across the rims of
    what was seen. Nothing reaches below a table on which the object stands.
    """
    grid = field.grid
    stride = max(1, int(np.ceil((float(np.prod(grid.shape)) / CELLS) ** (1.0 / 3.0))))
    blocks, cell_m = -(-grid.shape // stride), stride * grid.voxel_m
    empty, beside, hidden = closing.looked_through(
        grid.origin_m, cell_m, blocks, tau_m, seen.free_m, seen.poses, seen.lenses, seen.planes
    )
    asked = np.maximum(empty + beside + hidden, 1)
    open_to_view = empty > CONTRARY * asked
    field = _without_voids(field, hidden >= (1.0 - CONTRARY) * asked, stride)
    pad = [(0, int(n)) for n in blocks * stride - grid.shape]
    known = np.pad((field.weights > 0.0).astype(np.float32), pad)
    values = np.pad(np.where(field.weights > 0.0, field.values_m, 0.0), pad)
    shares, sums = (_pooled(array, blocks, stride) for array in (known, values))
    share = np.maximum(shares, 1e-6)
    level = np.clip(sums / share / cell_m, -1.0, 1.0).astype(np.float32)
    sure = shares > 0.5
    outside = ~sure & (open_to_view | _shell(blocks))
    fixed = sure | outside | _shell(blocks)
    start = np.where(sure, level, np.where(outside, 1.0, -1.0)).astype(np.float32)
    start[_shell(blocks)] = 1.0
    decided = closing.smallest(start, fixed, ROUNDS)
    smooth = np.where(sure, decided, gaussian_filter(decided, 0.7))
    # To the voxels: the centre of voxel v lies at (v + ½) / stride - ½ of a cell.
    places = [(np.arange(int(n)) + 0.5) / stride - 0.5 for n in grid.shape]
    made_up = np.empty(grid.shape, dtype=np.float32)
    for x, place in enumerate(places[0]):
        at = np.meshgrid([place], places[1], places[2], indexing="ij")
        made_up[x] = map_coordinates(smooth, at, order=1, mode="nearest")[0] * cell_m
    whole = np.where(field.weights > 0.0, field.values_m, made_up)
    x, y, z = (grid.origin_m[axis] + (np.arange(int(n)) + 0.5) * grid.voxel_m for axis, n in enumerate(grid.shape))
    for a, b, c, offset_m in tables(seen, grid.corners_m, tau_m).astype(np.float32):
        # Behind what a view sees it supposes the object, under the table too where it looks down.
        np.maximum(whole, -((a * x + offset_m)[:, None, None] + (b * y)[:, None] + c * z), out=whole, dtype=np.float32)
    whole[_shell(grid.shape, OUTER)] = tau_m
    whole[whole == 0.0] = FAINT * grid.voxel_m
    return Field(grid, whole, np.maximum(field.weights, np.float32(FAINT)), crossed(whole))


def tables(seen: DepthViews, corners_m: Array, tau_m: float) -> Array:
    """Return normals and offsets (k, 4) of the tables on which the object stands, in the object frame.

    Planes that views see are one table where they are less than `tau_m` apart all over a box, given by its corners
    (8, 3). A few views alone may err, and what reaches below a plane does not stand on it.
    """
    planes = seen.planes[np.isfinite(seen.planes).all(axis=1)]
    heights_m = corners_m @ planes[:, :3].T + planes[:, 3]
    found, left = [], np.arange(len(planes))
    while len(left):
        alike = np.abs(heights_m[:, left] - heights_m[:, left[:1]]).max(axis=0) < tau_m
        plane = np.median(planes[left[alike]], axis=0)
        plane /= np.linalg.norm(plane[:3])
        sunk = float(np.mean(seen.points_m @ plane[:3] + plane[3] < -tau_m))
        if np.count_nonzero(alike) > CONTRARY * len(seen.planes) and sunk < SUNK:
            found.append(plane)
        left = left[~alike]
    return np.reshape(found, (-1, 4))


def tidied(
    vertices_m: Array, triangles: surface.Triangles, shown_m: Array, weak: BoolArray, *, voxel_m: float, passes: int
) -> tuple[Array, surface.Triangles, BoolArray]:
    """Return vertices (v, 3) and triangles (t, 3) without bubbles, smoothed, and which vertices (v,) views show.

    Args:
        vertices_m: (v, 3) of closed surfaces.
        triangles: (t, 3).
        shown_m: (n, 3) vertices of what the views show.
        weak: (n,) which of these are known badly.
        voxel_m: side of a voxel.
        passes: of smoothing what is shown; the rest is smoothed until it spans its rims.
    """
    triangles = triangles[surface.solid_pieces(vertices_m, triangles)]
    used, triangles = surface.compacted(triangles, len(vertices_m))
    vertices_m = vertices_m[used]
    away_m, nearest = KDTree(shown_m).query(vertices_m, distance_upper_bound=voxel_m)
    shown = away_m < voxel_m
    vertices_m = surface.fair(vertices_m, triangles, passes)
    vertices_m = surface.spanned(vertices_m, triangles, ~shown, SPANNING)
    # Where views stop to see the surface they know it badly, and what is made up meets crumbs.
    seam = surface.grown(shown, triangles, 1) & surface.grown(~shown, triangles, 1)
    vertices_m = surface.spanned(vertices_m, triangles, seam, SETTLING)
    rough = surface.grown(seam, triangles, SEAM) | (shown & np.append(weak, False)[nearest])
    return surface.fair(vertices_m, triangles, surface.ROUGH, rough), triangles, shown


def _without_voids(field: Field, deep: BoolArray, stride: int) -> Field:
    """Return the field that knows nothing of emptiness (values over 0) deep behind the surface.

    Args:
        field: of all that was measured.
        deep: (x, y, z) cells of `stride` voxels that nearly all views have surface in front of.
        stride: voxels along a cell.
    """
    inside = tuple(slice(int(n)) for n in field.grid.shape)
    deep = deep.repeat(stride, 0).repeat(stride, 1).repeat(stride, 2)[inside]
    weights = np.where(deep & (field.values_m > 0.0), np.float32(0.0), field.weights)
    return Field(field.grid, field.values_m, weights, np.argwhere(weights > 0.0))


def _pooled(array: npt.NDArray[np.floating], blocks: npt.NDArray[np.int64], stride: int) -> npt.NDArray[np.floating]:
    """Return the means of blocks of `stride` along each axis."""
    x, y, z = (int(n) for n in blocks)
    return array.reshape(x, stride, y, stride, z, stride).mean(axis=(1, 3, 5))


def _shell(shape: npt.NDArray[np.int64], layers: int = 1) -> BoolArray:
    """Return which cells of a grid lie in the outermost layers."""
    shell = np.ones(shape, dtype=bool)
    shell[layers:-layers, layers:-layers, layers:-layers] = False
    return shell
