"""Kernels of fusion: the truncated signed distance function (TSDF) on voxels, and observations of single points.

Views are stacked: `index` (f, h, w) is the index of the surface point seen at a pixel, -1 for none; `free_m` (f, h, w)
the depth up to which a pixel sees empty space, 0 if unknown. `poses` (f, 3, 4) are
camera_from_object, and `intrinsics` (f, 4) are fx, fy, cx, cy of the stacked images. Points and normals are given in
the object frame.

A view that sees a surface within the truncation band along a voxel's pixel votes with the voxel's distance above that
surface along its normal, a weight, and the index of the surface point. Equations are those of docs/method/fusion.md.
"""

import math

import numpy as np

from modeler.kernels.cache import njit
from modeler.kernels.photometric import HARMONICS, harmonics
from modeler.kernels.threads import over_rows
from modeler.kernels.votes import SAME_SIDE, above, facing, fuse_votes, project, towards

SIDE = 4  # voxels along the side of a block
HIGHLIGHT = 0.1  # scale of the Cauchy weights on log brightness above the median of the views; as `COLOUR_SIGMA`


@njit(cache=True)
def blocks_near(points, origin, block_m, reach_m, shape):
    """Return the coordinates (b, 3) of the blocks of a grid within reach of a point, in ascending order.

    Args:
        points: (n, 3) in m.
        origin: (3,) lowest corner of the grid in m.
        block_m: side of a block.
        reach_m: half the side of the cube around each point that must be covered.
        shape: (3,) blocks along each axis.
    """
    touched = np.zeros((shape[0], shape[1], shape[2]), dtype=np.bool_)
    low, high = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for i in range(len(points)):
        for k in range(3):
            low[k] = max(0, math.floor((points[i, k] - reach_m - origin[k]) / block_m))
            high[k] = min(shape[k] - 1, math.floor((points[i, k] + reach_m - origin[k]) / block_m))
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                for z in range(low[2], high[2] + 1):
                    touched[x, y, z] = True
    blocks = np.empty((int(np.sum(touched)), 3), dtype=np.int64)
    count = 0
    for x in range(shape[0]):
        for y in range(shape[1]):
            for z in range(shape[2]):
                if touched[x, y, z]:
                    blocks[count, 0], blocks[count, 1], blocks[count, 2] = x, y, z
                    count += 1
    return blocks


@njit(cache=True)
def between(image, column, row, channel):
    """Return the value of an image (h, w, c) between four pixel centres by bilinear interpolation."""
    left, top = math.floor(column), math.floor(row)
    right, bottom = column - left, row - top
    upper = (1.0 - right) * image[top, left, channel] + right * image[top, left + 1, channel]
    lower = (1.0 - right) * image[top + 1, left, channel] + right * image[top + 1, left + 1, channel]
    return (1.0 - bottom) * upper + bottom * lower


def integrate(
    blocks, origin, voxel_m, tau_m, empty_weight, views, index, free_m, poses, intrinsics, points, normals, weights
):
    """Return signed distance and weight of the voxels of some blocks, each (b, SIDE, SIDE, SIDE) float32 (eq. 12.5).

    Distances are positive outside and truncated to ±`tau_m`; weight 0 = unobserved. Values are at voxel centres:
    origin + (index + ½) voxel_m.

    Args:
        blocks: (b, 3) block coordinates.
        origin: (3,) lowest corner of the grid in m.
        voxel_m: side of a voxel.
        tau_m: half width of the truncation band.
        empty_weight: weight of a view that sees the voxel empty, relative to 1 for a surface seen head-on.
        views: (n,) the view of each surface point.
        index: (f, h, w) int32.
        free_m: (f, h, w) float32.
        poses: (f, 3, 4) camera_from_object.
        intrinsics: (f, 4).
        points: (n, 3).
        normals: (n, 3).
        weights: (n,).
    """
    stacked = views, index, free_m, poses, intrinsics, points, normals, weights
    values, totals = over_rows(_integrate, np.ascontiguousarray(blocks), origin, voxel_m, tau_m, empty_weight, *stacked)
    shape = (len(blocks), SIDE, SIDE, SIDE)
    return values.reshape(shape), totals.reshape(shape)


@njit(cache=True, nogil=True)
def _integrate(
    blocks, origin, voxel_m, tau_m, empty_weight, views, index, free_m, poses, intrinsics, points, normals, weights
):
    values = np.zeros((len(blocks), SIDE**3), dtype=np.float32)
    totals = np.zeros((len(blocks), SIDE**3), dtype=np.float32)
    positions = np.empty((SIDE**3, 3))
    for b in range(len(blocks)):
        for voxel in range(SIDE**3):
            positions[voxel, 0] = origin[0] + (blocks[b, 0] * SIDE + voxel // (SIDE * SIDE) + 0.5) * voxel_m
            positions[voxel, 1] = origin[1] + (blocks[b, 1] * SIDE + voxel // SIDE % SIDE + 0.5) * voxel_m
            positions[voxel, 2] = origin[2] + (blocks[b, 2] * SIDE + voxel % SIDE + 0.5) * voxel_m
        seen, distance, weight, number, empty = collect_votes(
            positions, tau_m, index, free_m, poses, intrinsics, points, normals, weights
        )
        for voxel in range(SIDE**3):
            if seen[voxel] > 0 or empty[voxel] > 0:
                values[b, voxel], totals[b, voxel] = fuse_votes(
                    positions[voxel],
                    seen[voxel],
                    distance[voxel],
                    weight[voxel],
                    number[voxel],
                    empty_weight * empty[voxel],
                    tau_m,
                    voxel_m,
                    views,
                    index,
                    poses,
                    intrinsics,
                    points,
                    normals,
                )
    return values, totals


@njit(cache=True)
def collect_votes(positions, tau_m, index, free_m, poses, intrinsics, points, normals, weights):
    """Return the votes on positions (m, 3) for `fuse_votes`, and the number of views that see each empty.

    These are the number of votes (m,); distance, weight and surface point of each vote, all (m, f); and (m,). Arguments
    as for `integrate`.
    """
    frames, height, width = index.shape
    distance, weight = np.empty((len(positions), frames)), np.empty((len(positions), frames))
    number = np.empty((len(positions), frames), dtype=np.int64)
    seen, empty = np.zeros(len(positions), dtype=np.int64), np.zeros(len(positions), dtype=np.int64)
    for f in range(frames):
        pose, camera = poses[f], intrinsics[f]
        for voxel in range(len(positions)):
            x, y, z = positions[voxel, 0], positions[voxel, 1], positions[voxel, 2]
            u, v, depth = project(pose, camera, x, y, z)
            if not (depth > 0.0 and -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                continue
            row, column = int(v + 0.5), int(u + 0.5)
            n = index[f, row, column]
            along = 2.0 * tau_m
            if n >= 0:
                along = (
                    normals[n, 0] * (x - points[n, 0])
                    + normals[n, 1] * (y - points[n, 1])
                    + normals[n, 2] * (z - points[n, 2])
                )
            if abs(along) <= tau_m:
                k = seen[voxel]
                distance[voxel, k], number[voxel, k] = along, n
                # eq. 12.5: the extrapolation behind a surface fades out with depth.
                weight[voxel, k] = weights[n] * min(1.0, 1.5 * (1.0 + along / tau_m) + 1e-3)
                seen[voxel] = k + 1
            elif along > 0.0 and depth < free_m[f, row, column] - tau_m:
                empty[voxel] += 1
    return seen, distance, weight, number, empty


def observe(queries, directions, tolerance_m, tau_m, *views):
    """Return the observations of oriented points by the views (eq. 12.7, 12.8 and 12.10).

    A view supports a point if it sees a surface within `tolerance_m` along the same pixel that faces the same way.
    Colours are averaged over the supporting views; those brighter than the weighted median count less, as highlights.

    Args:
        queries: (n, 3) in the object frame.
        directions: (n, 3) unit normals.
        tolerance_m: largest distance along the normal.
        tau_m: least distance of empty points from the end of the empty space.
        views: index (f, h, w) int32; free_m (f, h, w) float32; poses (f, 3, 4) camera_from_object; intrinsics (f, 4);
            points (p, 3), normals (p, 3) and weights (p,); background_m (f, h, w), see `DepthViews`; weights of their
            colours (p,); colour (f, h, w, 3) uint8;
            gains (f, 4) of red, green and blue, and the weight of a view's colours, 0 = none; shading (8, 3), the
            coefficients of the logarithm of another gain by channel; exponent of the view weights for colours.

    Returns:
        (n, 6): sum of the supporting views' weights w, number of views that see the point empty, number of supporting
        views, Σ w d and Σ w d² with d the distance of the point above the surface, and the sum of the cosines between
        normal and ray of the views that measure background there; and (n, 4) RGB with its weight.
    """
    return over_rows(_observe, np.hstack([queries, directions]), tolerance_m, tau_m, *views)


@njit(cache=True, nogil=True)
def _observe(
    queries,
    tolerance_m,
    tau_m,
    index,
    free_m,
    poses,
    intrinsics,
    points,
    normals,
    weights,
    background_m,
    colour_weights,
    colour,
    gains,
    shading,
    focus,
):
    frames, height, width = index.shape
    observed, colours = np.zeros((len(queries), 6)), np.zeros((len(queries), 4))
    shown, levels, shares = np.empty((frames, 3)), np.empty(frames), np.empty((frames, 2))
    directions = queries[:, 3:]
    for q in range(len(queries)):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        count = 0
        for f in range(frames):
            u, v, depth = project(poses[f], intrinsics[f], x, y, z)
            column, row = math.floor(u + 0.5), math.floor(v + 0.5)
            if depth <= 0.0 or not (0 <= column < width and 0 <= row < height):
                continue
            n = index[f, row, column]
            if depth < free_m[f, row, column] - tau_m:
                observed[q, 1] += 1.0
            behind_m = abs(background_m[f, row, column])
            if 0.0 < behind_m > depth - tau_m:  # eq. 12.7: the object ends before this pixel, and nothing hides it
                observed[q, 5] += max(0.0, towards(poses[f], directions, q, x, y, z))
            if n < 0:
                continue
            along = above(x, y, z, points, normals, n)
            if abs(along) > tolerance_m or facing(normals, n, directions, q) < SAME_SIDE:
                continue
            observed[q, 0] += weights[n]
            observed[q, 2] += 1.0
            observed[q, 3] += weights[n] * along
            observed[q, 4] += weights[n] * along * along
            left, top = math.floor(u), math.floor(v)
            if gains[f, 3] == 0.0 or left < 0 or top < 0 or left + 1 >= width or top + 1 >= height:
                continue
            shares[count, 0] = gains[f, 3] * colour_weights[n]
            shares[count, 1] = gains[f, 3] * colour_weights[n] ** focus  # eq. 12.10
            turned = harmonics(poses[f], normals[n, 0], normals[n, 1], normals[n, 2])
            levels[count] = 1.0
            for c in range(3):
                shade = 0.0
                for h in range(HARMONICS):
                    shade += shading[h, c] * turned[h]
                shown[count, c] = gains[f, c] * math.exp(shade) * between(colour[f], u, v, c)
                levels[count] += shown[count, c]
            count += 1
        usual = _weighted_median(levels[:count], shares[:count, 0]) if count > 1 else levels[0]
        for k in range(count):
            share = shares[k, 1] / (1.0 + (max(0.0, math.log(levels[k] / usual)) / HIGHLIGHT) ** 2)
            colours[q, 3] += share
            for c in range(3):
                colours[q, c] += share * shown[k, c]
        if colours[q, 3] > 0.0:
            for c in range(3):
                colours[q, c] = min(255.0, colours[q, c] / colours[q, 3])
    return observed, colours


@njit(cache=True, nogil=True)
def _weighted_median(values, weights):
    """Return the least of values (n,) up to which lies half of their weight (n,); 1 if there are none."""
    order, total, below = np.argsort(values), 0.5 * weights.sum(), 0.0
    for k in order:
        below += weights[k]
        if below >= total:
            return values[k]
    return 1.0


@njit(cache=True)
def disagreements(chosen, views, limit_m, index, poses, intrinsics, points, normals):
    """Return the distances (m, f) of surface points above the surface seen by each view, and its points there (m, f).

    Distances are along the normal; NaN and -1 if a view sees no surface there.

    Args:
        chosen: (m,) indices of points.
        views: (m,) the view of each.
        limit_m: largest distance along the normal to the same surface.
        index: (f, h, w) int32.
        poses: (f, 3, 4) camera_from_object.
        intrinsics: (f, 4).
        points: (n, 3).
        normals: (n, 3).
    """
    frames, height, width = index.shape
    result = np.full((len(chosen), frames), np.nan)
    rivals = np.full((len(chosen), frames), -1, dtype=np.int64)
    for q in range(len(chosen)):
        i = chosen[q]
        for f in range(frames):
            u, v, depth = project(poses[f], intrinsics[f], points[i, 0], points[i, 1], points[i, 2])
            if f == views[q] or not (depth > 0.0 and -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                continue
            n = index[f, int(v + 0.5), int(u + 0.5)]
            if n < 0:
                continue
            along = above(points[i, 0], points[i, 1], points[i, 2], points, normals, n)
            if abs(along) <= limit_m and facing(normals, n, normals, i) > SAME_SIDE:
                result[q, f], rivals[q, f] = along, n
    return result, rivals
