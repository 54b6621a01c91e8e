"""Kernels of fusion: the votes of views on the signed distance of one position, and the side that they speak of.

Arrays are those of `kernels.tsdf`. Equations are those of docs/method/fusion.md.
"""

import math

from modeler.kernels.cache import njit

SAME_SIDE = 0.3  # least cosine between normals on the same side of the object; chosen by hand
THINNEST = 0.75  # half the least thickness of sheets, in voxels: two sides in one and a half are resolved
OUTWEIGHED = 0.2  # weight of free space, relative to that of votes, which moves nothing; measured: left-out views
ROBUST_ROUNDS = 3  # of reweighting the votes of a voxel, from their mean; more change little
MAJORITY = 3  # a side is rejected if this many times as many votes contradict it; chosen by hand


@njit(cache=True)
def project(pose, camera, x, y, z):
    """Return column, row (px) and depth (m) of a point of the object frame; depth <= 0 behind the camera."""
    depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
    if depth <= 0.0:
        return -1.0, -1.0, depth
    u = camera[0] * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth + camera[2]
    v = camera[1] * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth + camera[3]
    return u, v, depth


# `collect_votes`, `fuse_votes` and `dominant_vote` inline the next two functions by hand: calls would take a fifth of
# their time.
@njit(cache=True)
def above(x, y, z, points, normals, n):
    """Return the distance of a position above the surface at point `n`, along its normal."""
    return normals[n, 0] * (x - points[n, 0]) + normals[n, 1] * (y - points[n, 1]) + normals[n, 2] * (z - points[n, 2])


@njit(cache=True)
def facing(first, i, second, k):
    """Return the cosine between unit vectors `first[i]` and `second[k]`."""
    return first[i, 0] * second[k, 0] + first[i, 1] * second[k, 1] + first[i, 2] * second[k, 2]


@njit(cache=True)
def towards(pose, directions, q, x, y, z):
    """Return the cosine between direction `q` and that from a position of the object frame to a view's camera."""
    along = square = 0.0
    for k in range(3):
        ray = pose[k, 0] * x + pose[k, 1] * y + pose[k, 2] * z + pose[k, 3]
        turned = pose[k, 0] * directions[q, 0] + pose[k, 1] * directions[q, 1] + pose[k, 2] * directions[q, 2]
        along, square = along - turned * ray, square + ray * ray
    return along / math.sqrt(square)


@njit(cache=True)
def fuse_votes(
    position,
    seen,
    distance,
    weight,
    number,
    emptiness,
    tau_m,
    voxel_m,
    views,
    index,
    poses,
    intrinsics,
    points,
    normals,
):
    """Return the signed distance and weight of a position from its votes (eq. 12.6). Rejected votes get weight 0.

    Only votes on the same side of the object as the dominant vote are averaged. Where errors bring both sides of a
    sheet closer than a mesh can have them, or swap them, the sheet has its least thickness about their middle. A side
    is rejected if most votes see surface between it and its view: a few pixels at grazing angles, with errors along
    their rays far beyond the noise, seem to look out from within the object.

    Args:
        position: (3,) in the object frame.
        seen: number of votes.
        distance: (f,) above the surface of each vote.
        weight: (f,) of each.
        number: (f,) surface point of each.
        emptiness: sum of the weights of the views that see the position empty.
        tau_m: half width of the truncation band.
        voxel_m: side of a voxel.
        views: (n,) the view of each surface point.
        index: (f, h, w) int32.
        poses: (f, 3, 4) camera_from_object.
        intrinsics: (f, 4).
        points: (n, 3).
        normals: (n, 3).
    """
    remaining, scale_m = seen, robust_scale_m(tau_m, voxel_m)
    while True:
        best = dominant_vote(seen, distance, weight, number, normals, tau_m)
        if best < 0:
            return tau_m, emptiness
        side = number[best]
        total, value, agreeing = 0.0, 0.0, 0
        behind, behind_value = 0.0, 0.0
        for k in range(seen):
            n = number[k]
            cosine = (
                normals[side, 0] * normals[n, 0] + normals[side, 1] * normals[n, 1] + normals[side, 2] * normals[n, 2]
            )
            if cosine > SAME_SIDE and weight[k] > 0.0:
                total += weight[k]
                value += weight[k] * distance[k]
                agreeing += 1
            elif cosine < -SAME_SIDE and weight[k] > 0.0:
                behind += weight[k]
                behind_value += weight[k] * distance[k]
        mean = value / total
        for _ in range(ROBUST_ROUNDS):
            share = value = 0.0
            for k in range(seen):
                if weight[k] > 0.0 and facing(normals, side, normals, number[k]) > SAME_SIDE:
                    robust = weight[k] / (1.0 + ((distance[k] - mean) / scale_m) ** 2)
                    share += robust
                    value += robust * distance[k]
            mean = value / share
        value = total * mean
        if behind > 0.0:  # below eq. 12.6
            other = behind_value / behind
            if -2.0 * THINNEST * voxel_m < mean + other < tau_m - 2.0 * voxel_m:
                value = total * (0.5 * abs(mean - other) - THINNEST * voxel_m)
        # eq. 12.5: what few views see through does not move surface that more see.
        excess = max(0.0, emptiness - OUTWEIGHED * total)
        result = (value + excess * tau_m) / (total + excess), total + excess
        if remaining < (1 + MAJORITY) * agreeing:
            return result
        against = occluding_votes(
            best, position, seen, distance, weight, number, views, index, poses, intrinsics, points, normals
        )
        if against < MAJORITY * agreeing:
            return result
        for k in range(seen):
            if weight[k] > 0.0 and facing(normals, side, normals, number[k]) > SAME_SIDE:
                weight[k] = 0.0
                remaining -= 1


@njit(cache=True)
def robust_scale_m(tau_m, voxel_m):
    """Return the scale of Cauchy weights of the votes of a band: 2.385 sd of a view, of 95 % efficiency (eq. 12.4)."""
    return max(2.385 * math.sqrt(0.5) * 0.5 * (tau_m - 3.0 * voxel_m), 0.1 * voxel_m)


@njit(cache=True)
def dominant_vote(seen, distance, weight, number, normals, tau_m):
    """Return the vote that decides on which side of the object a position is, -1 = none; arguments as for `fuse_votes`.

    A view that sees a position in front of a surface observes free space; one that sees it behind a surface only
    extrapolates solid. The nearest surface decides, unless an opposing view sees the position in front of its surface:
    this preserves walls thinner than the band.
    """
    best, best_score = -1, 0.0
    for k in range(seen):
        score = weight[k] * (1.01 - abs(distance[k]) / tau_m)  # eq. 12.6
        if score > best_score:
            best, best_score = k, score
    if best < 0 or distance[best] >= 0.0:
        return best
    side, other, other_score = number[best], best, 0.3 * best_score
    for k in range(seen):
        n = number[k]
        cosine = normals[side, 0] * normals[n, 0] + normals[side, 1] * normals[n, 1] + normals[side, 2] * normals[n, 2]
        score = weight[k] * (1.01 - abs(distance[k]) / tau_m)
        if distance[k] > 0.0 and cosine < SAME_SIDE and score > other_score:
            other, other_score = k, score
    return other


@njit(cache=True)
def occluding_votes(best, position, seen, distance, weight, number, views, index, poses, intrinsics, points, normals):
    """Return the number of votes for other sides that see surface between a position and the camera of the best vote.

    Arguments as for `fuse_votes`.
    """
    side = number[best]
    pose = poses[views[side]]
    x = -(pose[0, 0] * pose[0, 3] + pose[1, 0] * pose[1, 3] + pose[2, 0] * pose[2, 3])  # the camera's position
    y = -(pose[0, 1] * pose[0, 3] + pose[1, 1] * pose[1, 3] + pose[2, 1] * pose[2, 3])
    z = -(pose[0, 2] * pose[0, 3] + pose[1, 2] * pose[1, 3] + pose[2, 2] * pose[2, 3])
    count = 0
    for k in range(seen):
        n = number[k]
        if not (weight[k] > 0.0 and distance[k] < 0.0) or facing(normals, side, normals, n) > SAME_SIDE:
            continue
        height_m = above(x, y, z, points, normals, n)
        if height_m <= 0.0:
            continue
        share = distance[k] / (distance[k] - height_m)  # of the way to the camera, up to the surface
        a, b, c = (
            position[0] + share * (x - position[0]),
            position[1] + share * (y - position[1]),
            position[2] + share * (z - position[2]),
        )
        u, v, depth = project(poses[views[n]], intrinsics[views[n]], a, b, c)
        if depth <= 0.0 or not (-0.5 <= u < index.shape[2] - 0.5 and -0.5 <= v < index.shape[1] - 0.5):
            continue
        m = index[views[n], int(v + 0.5), int(u + 0.5)]
        if m >= 0 and facing(normals, m, normals, n) > SAME_SIDE:
            count += abs(above(a, b, c, points, normals, m)) < -distance[k]
    return count
