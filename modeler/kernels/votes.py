"""Kernels that weigh what views say of one place: which side of the object they speak of, and whom not to believe.

Each view that sees a surface within reach along the place's pixel has a vote: how far the place lies above that
surface, along its normal; the vote's weight; and the number of the surface point. Views lie side by side as `fusion`
has them.
"""

from numba import njit

AGREE = 0.3  # cosine between normals above which two votes speak of the same side of the object
MANY = 3  # times as many votes as are of one mind must contradict them to silence them


@njit(cache=True)
def project(pose, lens, x, y, z):
    """Return column, row (px) and depth (m) of a point of the object frame; depth <= 0 behind the camera."""
    depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
    if depth <= 0.0:
        return -1.0, -1.0, depth
    u = lens[0] * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth + lens[2]
    v = lens[1] * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth + lens[3]
    return u, v, depth


# `fusion.collect_votes`, `blend` and `dominant_vote`, which do little else, write the next two out: calls would cost
# a fifth of their time.
@njit(cache=True)
def above(x, y, z, points, normals, n):
    """Return how far a place lies above the surface at point `n`, along its normal."""
    return normals[n, 0] * (x - points[n, 0]) + normals[n, 1] * (y - points[n, 1]) + normals[n, 2] * (z - points[n, 2])


@njit(cache=True)
def facing(first, i, second, k):
    """Return the cosine between unit vector `i` of some and unit vector `k` of others."""
    return first[i, 0] * second[k, 0] + first[i, 1] * second[k, 1] + first[i, 2] * second[k, 2]


@njit(cache=True)
def blend(place, seen, distance, weight, number, emptiness, tau_m, views, index, poses, lenses, points, normals):
    """Return signed distance and weight of a place from its votes. Weights of rejected votes become 0.

    Only votes for the side of the object that the dominant vote is for are averaged, see `dominant_vote`. A vote that
    many contradict is rejected, see `occluding_votes`: a few pixels at a grazing angle, off along their rays by far
    more than the noise, seem to look out from within the object.

    Args:
        place: (3,) in the object frame.
        seen: how many votes there are.
        distance: (f,) of the place above the surface of each vote.
        weight: (f,) of each.
        number: (f,) surface point of each.
        emptiness: weight with which views see the place empty.
        tau_m: half width of the band.
        views: (n,) which view each surface point is of.
        index: (f, h, w) int32.
        poses: (f, 3, 4) camera_from_object.
        lenses: (f, 4).
        points: (n, 3).
        normals: (n, 3).
    """
    remaining = seen
    while True:
        best = dominant_vote(seen, distance, weight, number, normals, tau_m)
        if best < 0:
            return tau_m, emptiness
        side = number[best]
        total, value, voices = emptiness, emptiness * tau_m, 0
        for k in range(seen):
            n = number[k]
            cosine = (
                normals[side, 0] * normals[n, 0] + normals[side, 1] * normals[n, 1] + normals[side, 2] * normals[n, 2]
            )
            if cosine > AGREE and weight[k] > 0.0:
                total += weight[k]
                value += weight[k] * distance[k]
                voices += 1
        if remaining < (1 + MANY) * voices:
            return value / total, total
        against = occluding_votes(
            best, place, seen, distance, weight, number, views, index, poses, lenses, points, normals
        )
        if against < MANY * voices:
            return value / total, total
        for k in range(seen):
            if weight[k] > 0.0 and facing(normals, side, normals, number[k]) > AGREE:
                weight[k] = 0.0
                remaining -= 1


@njit(cache=True)
def dominant_vote(seen, distance, weight, number, normals, tau_m):
    """Return which vote sets the side of the object that votes speak of, -1 = none; arguments as of `blend`.

    A view that sees a place in front of a surface knows that it is empty; one that sees it behind only supposes that it
    is full. The nearest surface sets the side, and an opposing view that looks at the place from the front takes over:
    so walls thinner than the band stay walls.
    """
    best, best_score = -1, 0.0
    for k in range(seen):
        score = weight[k] * (1.01 - abs(distance[k]) / tau_m)
        if score > best_score:
            best, best_score = k, score
    if best < 0 or distance[best] >= 0.0:
        return best
    side, other, other_score = number[best], best, 0.3 * best_score
    for k in range(seen):
        n = number[k]
        cosine = normals[side, 0] * normals[n, 0] + normals[side, 1] * normals[n, 1] + normals[side, 2] * normals[n, 2]
        score = weight[k] * (1.01 - abs(distance[k]) / tau_m)
        if distance[k] > 0.0 and cosine < AGREE and score > other_score:
            other, other_score = k, score
    return other


@njit(cache=True)
def occluding_votes(best, place, seen, distance, weight, number, views, index, poses, lenses, points, normals):
    """Return how many votes for other sides see surface on the way between a place and the view of the best vote.

    Whoever sees the back of a wall looks at it from behind. Arguments as of `blend`.
    """
    side = number[best]
    pose = poses[views[side]]
    x = -(pose[0, 0] * pose[0, 3] + pose[1, 0] * pose[1, 3] + pose[2, 0] * pose[2, 3])  # the camera's place
    y = -(pose[0, 1] * pose[0, 3] + pose[1, 1] * pose[1, 3] + pose[2, 1] * pose[2, 3])
    z = -(pose[0, 2] * pose[0, 3] + pose[1, 2] * pose[1, 3] + pose[2, 2] * pose[2, 3])
    count = 0
    for k in range(seen):
        n = number[k]
        if not (weight[k] > 0.0 and distance[k] < 0.0) or facing(normals, side, normals, n) > AGREE:
            continue
        height_m = above(x, y, z, points, normals, n)
        if height_m <= 0.0:
            continue
        share = distance[k] / (distance[k] - height_m)  # of the way to the camera, as far as the surface
        a, b, c = (
            place[0] + share * (x - place[0]),
            place[1] + share * (y - place[1]),
            place[2] + share * (z - place[2]),
        )
        u, v, depth = project(poses[views[n]], lenses[views[n]], a, b, c)
        if depth <= 0.0 or not (-0.5 <= u < index.shape[2] - 0.5 and -0.5 <= v < index.shape[1] - 0.5):
            continue
        m = index[views[n], int(v + 0.5), int(u + 0.5)]
        if m >= 0 and facing(normals, m, normals, n) > AGREE:
            count += abs(above(a, b, c, points, normals, m)) < -distance[k]
    return count
