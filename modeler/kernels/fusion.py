"""Kernels of fusion: signed distances on voxels, and what the views say of single points.

Views lie side by side in stacks: `index` (f, h, w) holds the number of the surface point seen at a pixel, -1 where
there is none; `free_m` (f, h, w) the depth up to which the space along the pixel is seen to be empty, 0 where nothing
is known. `poses` (f, 3, 4) are camera_from_object and `lenses` (f, 4) are fx, fy, cx, cy of the stacked pixels. Points
and normals are given in the object frame.
"""

import math

import numpy as np
from numba import njit, prange

from modeler.kernels.votes import AGREE, above, blend, facing, project

SIDE = 4  # voxels along the side of a block


@njit(cache=True)
def blocks_near(points, origin, block_m, reach_m, shape):
    """Return the coordinates (b, 3) of the blocks of a grid that come within reach of a point, in ascending order.

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
    """Return the value of an image (h, w, c) at a place between pixel centres, bilinearly; all four must be in it."""
    left, top = math.floor(column), math.floor(row)
    right, bottom = column - left, row - top
    upper = (1.0 - right) * image[top, left, channel] + right * image[top, left + 1, channel]
    lower = (1.0 - right) * image[top + 1, left, channel] + right * image[top + 1, left + 1, channel]
    return (1.0 - bottom) * upper + bottom * lower


@njit(cache=True, parallel=True)
def integrate(
    blocks, origin, voxel_m, tau_m, empty_weight, views, index, free_m, poses, lenses, points, normals, weights
):
    """Return signed distance and weight of the voxels of some blocks, each (b, SIDE, SIDE, SIDE) float32.

    The distance of a voxel to the surface a view sees along its ray is measured along the surface's normal, positive
    outside, and kept within the band ±`tau_m`; beyond the band in front, the space seen empty votes with
    `empty_weight`. Weight 0 = seen by nobody. Values sit at voxel centres: origin + (index + ½) voxel_m.

    Args:
        blocks: (b, 3) block coordinates.
        origin: (3,) lowest corner of the grid in m.
        voxel_m: side of a voxel.
        tau_m: half width of the band.
        empty_weight: weight of a view that sees the voxel empty, against 1 for a surface seen head-on.
        views: (n,) which view each surface point is of.
        index: (f, h, w) int32.
        free_m: (f, h, w) float32.
        poses: (f, 3, 4) camera_from_object.
        lenses: (f, 4).
        points: (n, 3).
        normals: (n, 3).
        weights: (n,).
    """
    values = np.zeros((len(blocks), SIDE**3), dtype=np.float32)
    totals = np.zeros((len(blocks), SIDE**3), dtype=np.float32)
    for b in prange(len(blocks)):
        places = np.empty((SIDE**3, 3))
        for voxel in range(SIDE**3):
            places[voxel, 0] = origin[0] + (blocks[b, 0] * SIDE + voxel // (SIDE * SIDE) + 0.5) * voxel_m
            places[voxel, 1] = origin[1] + (blocks[b, 1] * SIDE + voxel // SIDE % SIDE + 0.5) * voxel_m
            places[voxel, 2] = origin[2] + (blocks[b, 2] * SIDE + voxel % SIDE + 0.5) * voxel_m
        seen, distance, weight, number, empty = collect_votes(
            places, tau_m, index, free_m, poses, lenses, points, normals, weights
        )
        for voxel in range(SIDE**3):
            if seen[voxel] > 0 or empty[voxel] > 0:
                values[b, voxel], totals[b, voxel] = blend(
                    places[voxel],
                    seen[voxel],
                    distance[voxel],
                    weight[voxel],
                    number[voxel],
                    empty_weight * empty[voxel],
                    tau_m,
                    views,
                    index,
                    poses,
                    lenses,
                    points,
                    normals,
                )
    shape = (len(blocks), SIDE, SIDE, SIDE)
    return values.reshape(shape), totals.reshape(shape)


@njit(cache=True)
def collect_votes(places, tau_m, index, free_m, poses, lenses, points, normals, weights):
    """Return the votes of the views on places (m, 3), as `votes.blend` takes them, and how many see each empty.

    These are how many votes there are (m,), and of each the distance, the weight and the surface point, all (m, f);
    then (m,). Arguments as of `integrate`.
    """
    frames, height, width = index.shape
    distance, weight = np.empty((len(places), frames)), np.empty((len(places), frames))
    number = np.empty((len(places), frames), dtype=np.int64)
    seen, empty = np.zeros(len(places), dtype=np.int64), np.zeros(len(places), dtype=np.int64)
    for f in range(frames):
        pose, lens = poses[f], lenses[f]
        for voxel in range(len(places)):
            x, y, z = places[voxel, 0], places[voxel, 1], places[voxel, 2]
            u, v, depth = project(pose, lens, x, y, z)
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
                # What lies behind a surface is a guess that fades with depth.
                weight[voxel, k] = weights[n] * min(1.0, 1.5 * (1.0 + along / tau_m) + 1e-3)
                seen[voxel] = k + 1
            elif along > 0.0 and depth < free_m[f, row, column] - tau_m:
                empty[voxel] += 1
    return seen, distance, weight, number, empty


@njit(cache=True, parallel=True)
def survey(
    queries,
    directions,
    tolerance_m,
    tau_m,
    index,
    free_m,
    poses,
    lenses,
    points,
    normals,
    weights,
    colour,
    gains,
    focus,
):
    """Return what the views say of oriented points.

    A view supports a point where it sees, along the same pixel, a surface within `tolerance_m` that faces the same way;
    it calls the point empty where it sees past it. Colours are averaged over the supporting views, the frontal ones
    first.

    Args:
        queries: (n, 3) in the object frame.
        directions: (n, 3) unit normals.
        tolerance_m: largest distance along the normal.
        tau_m: how far in front of what a view sees a point must lie to be empty.
        index: (f, h, w) int32.
        free_m: (f, h, w) float32.
        poses: (f, 3, 4) camera_from_object.
        lenses: (f, 4).
        points: (p, 3).
        normals: (p, 3).
        weights: (p,).
        colour: (f, h, w, 3) uint8.
        gains: (f, 4) factors on red, green and blue, and the say a view has in colours, 0 = it has none.
        focus: power of the weights with which views speak of colour.

    Returns:
        (n, 5): sum of the supporting views' weights w, number of views that see the point empty, number of supporting
        views, Σ w d and Σ w d² with d the distance of the point above what they see; and (n, 4) RGB with its weight.
    """
    frames, height, width = index.shape
    told, colours = np.zeros((len(queries), 5)), np.zeros((len(queries), 4))
    for q in prange(len(queries)):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        for f in range(frames):
            u, v, depth = project(poses[f], lenses[f], x, y, z)
            column, row = math.floor(u + 0.5), math.floor(v + 0.5)
            if depth <= 0.0 or not (0 <= column < width and 0 <= row < height):
                continue
            n = index[f, row, column]
            if depth < free_m[f, row, column] - tau_m:
                told[q, 1] += 1.0
            if n < 0:
                continue
            along = above(x, y, z, points, normals, n)
            if abs(along) > tolerance_m or facing(normals, n, directions, q) < AGREE:
                continue
            told[q, 0] += weights[n]
            told[q, 2] += 1.0
            told[q, 3] += weights[n] * along
            told[q, 4] += weights[n] * along * along
            left, top = math.floor(u), math.floor(v)
            if gains[f, 3] == 0.0 or left < 0 or top < 0 or left + 1 >= width or top + 1 >= height:
                continue
            share = gains[f, 3] * weights[n] ** focus
            colours[q, 3] += share
            for c in range(3):
                colours[q, c] += share * gains[f, c] * between(colour[f], u, v, c)
        if colours[q, 3] > 0.0:
            for c in range(3):
                colours[q, c] = min(255.0, colours[q, c] / colours[q, 3])
    return told, colours


@njit(cache=True)
def disagreements(chosen, views, limit_m, index, poses, lenses, points, normals):
    """Return how far above the surface of each view chosen surface points lie, and above which of its points.

    The distances (m, f) are along its normal; NaN and -1 where it is not seen.

    Args:
        chosen: (m,) numbers of points.
        views: (m,) which view each is of.
        limit_m: surface further away than this along the normal is another one.
        index: (f, h, w) int32.
        poses: (f, 3, 4) camera_from_object.
        lenses: (f, 4).
        points: (n, 3).
        normals: (n, 3).
    """
    frames, height, width = index.shape
    result = np.full((len(chosen), frames), np.nan)
    rivals = np.full((len(chosen), frames), -1, dtype=np.int64)
    for q in range(len(chosen)):
        i = chosen[q]
        for f in range(frames):
            u, v, depth = project(poses[f], lenses[f], points[i, 0], points[i, 1], points[i, 2])
            if f == views[q] or not (depth > 0.0 and -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                continue
            n = index[f, int(v + 0.5), int(u + 0.5)]
            if n < 0:
                continue
            along = above(points[i, 0], points[i, 1], points[i, 2], points, normals, n)
            if abs(along) <= limit_m and facing(normals, n, normals, i) > AGREE:
                result[q, f], rivals[q, f] = along, n
    return result, rivals
