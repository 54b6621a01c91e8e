"""Readable twins of the kernels: float64 NumPy, one idea a line, as slow as they like."""

import numpy as np
from scipy.special import erf

from modeler.kernels import planes


def to_ray(point):
    """(w, h, r) of a point (paper, eq. 1)."""
    x, y, z = point
    return np.array([x / z, y / z, np.linalg.norm(point)])


def ray_jacobian(point):
    """Q by central differences of the definition."""
    step = 1e-6 * np.linalg.norm(point)
    return np.stack([(to_ray(point + step * e) - to_ray(point - step * e)) / (2 * step) for e in np.eye(3)], axis=1)


def paper_density(point_b, a_from_b, ranges_m, intrinsics, noise):
    """p(b_j | M_A, T) of eq. pbd, over all pixels of A, with the appendix's Λ, K2, D and v as printed."""
    fx, fy, cx, cy = intrinsics
    point_a = a_from_b[:3, :3] @ point_b + a_from_b[:3, 3]
    if point_a[2] <= 0:
        return 0.0
    rotation = a_from_b[:3, :3].T  # the appendix's R takes A to B
    q_a, q_b = ray_jacobian(point_a), ray_jacobian(point_b)
    inv, t = np.linalg.inv, np.transpose
    lam = inv(q_a @ inv(rotation) @ inv(q_b) @ noise @ inv(t(q_b)) @ rotation @ t(q_a) + noise)
    k2 = np.linalg.det(noise + q_b @ rotation @ inv(q_a) @ noise @ inv(t(q_a)) @ t(rotation) @ t(q_b)) ** -0.5
    d = np.array(
        [
            [lam[0, 0] * lam[2, 2] - lam[2, 0] ** 2, lam[2, 2] * lam[1, 0] - lam[2, 0] * lam[2, 1]],
            [lam[2, 2] * lam[1, 0] - lam[2, 0] * lam[2, 1], lam[1, 1] * lam[2, 2] - lam[2, 1] ** 2],
        ]
    )
    d = d / lam[2, 2]
    v = np.array([lam[2, 0], lam[2, 1], lam[2, 2]]) / np.sqrt(2 * lam[2, 2])
    total = 0.0
    for row in range(ranges_m.shape[0]):
        for column in range(ranges_m.shape[1]):
            pixel = np.array([(column - cx) / fx, (row - cy) / fy, ranges_m[row, column]])
            off = to_ray(point_a) - pixel
            total += np.exp(-0.5 * off[:2] @ d @ off[:2]) * (1 + erf(v @ off))
    return k2 * total


def visibility(pose, projection, parameters):
    """Log-likelihood of one pose and number of explained points: every point in turn, as `kernels.point_likelihood`."""
    fx, fy, cx, cy, width, height = projection.camera.astype(np.float64)
    low, high, flat, steep = projection.cosines.astype(np.float64)
    share, per_square_px = projection.pattern.astype(np.float64)
    cells, points = projection.cells.reshape(int(height), int(width), -1), projection.points.T.astype(np.float64)
    blur, silhouette_px, clearance_m, max_point_cost, max_steep_cost, normal_cost, unmeasured_gain, typical_misfit = (
        map(np.float64, parameters[:8])
    )
    support = parameters.support.astype(np.float64)
    hidden = np.exp(np.float64(parameters.table[0]))
    total, explained = 0.0, 0.0
    for point in points:
        position = pose[:3, :3] @ point[:3] + pose[:3, 3]
        normal = pose[:3, :3] @ point[3:6]
        facing = -normal @ position / np.linalg.norm(position)
        faces = np.clip((facing - low) / (high - low), 0, 1)
        column = int(np.floor(fx * position[0] / position[2] + cx + 0.5))
        row = int(np.floor(fy * position[1] / position[2] + cy + 0.5))
        inside = position[2] > 0 and 0 <= row < cells.shape[0] and 0 <= column < cells.shape[1]
        cell = cells[row, column].astype(np.float64) if inside else None
        covered = np.clip((abs(facing) - flat) / (steep - flat), 0, 1)
        gain = 0.0
        if cell is None or cell[planes.KIND] == planes.MISSING:
            gain = unmeasured_gain * covered * faces
        elif cell[planes.KIND] == planes.BACKGROUND:
            beyond = cell[planes.SILHOUETTE] / silhouette_px
            if position[2] < cell[planes.DEPTH] - clearance_m:
                gain = -min(0.5 * beyond**2, covered * max_point_cost + (1 - covered) * max_steep_cost)
        elif cell[planes.KIND] == planes.SURFACE:
            plane = cell[: planes.NORMAL_Z + 1]
            in_front = plane @ position + cell[planes.DISTANCE]
            agreement = normal @ plane
            other = cell[planes.VARIANCE] + float(projection.rim_m2) * cell[planes.RIM] ** 2
            square = in_front**2 / (point[6] + other + blur**2)
            where = position[:2] / position[2] * (fx, fy) + (cx, cy)
            common = share * max(1 - per_square_px * np.sum((where - point[7:9]) ** 2), 0) ** 2
            match = typical_misfit - 0.5 * square - 0.5 * common - normal_cost * (1 - agreement)
            explained += faces * (0.5 * square < 4.5 and agreement > 0.8)
            seen = np.log((1 - hidden) * np.exp(max(match, -700)) + hidden)
            if in_front > 0 and match < np.log(hidden):
                seen = max(match, -max_point_cost)
            if in_front <= 0:
                seen *= 1 - np.clip((square - 9) / (36 - 9), 0, 1)
            gain = faces * seen
            if in_front > 0:
                gain -= (1 - faces) * min(0.5 * square, max_point_cost)
        depth_below = max(-(support[:3] @ position + support[3] + clearance_m) * support[4], 0.0)
        total += max(gain - 0.5 * depth_below**2, -max_point_cost)
    return total, explained


def local_plane(depth_m, mask, intrinsics, pixel, ball):
    """Plane N (3,) with N · p = 1 through a pixel's neighbours in a ball, by least squares in inverse depth."""
    fx, fy, cx, cy = intrinsics
    rows, columns = np.nonzero(mask & (depth_m > 0))
    z = depth_m[rows, columns]
    padded = np.pad(np.where(mask & (depth_m > 0), depth_m, np.nan), 1, constant_values=np.nan)
    around = np.stack([padded[rows + down, columns + across] for down in range(3) for across in range(3)])
    paired = np.isfinite(around) & np.isfinite(around[::-1])  # with the opposite neighbour
    outlier_m = 3.0 * ball.noise_m
    filtered = np.median(np.where(paired, around, z), axis=0) if outlier_m > ball.radius_m else z
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones(len(z))], axis=1)
    points = filtered[:, None] * rays
    centre = points[(rows == pixel[0]) & (columns == pixel[1])][0]
    near = (np.linalg.norm(points - centre, axis=1) <= ball.radius_m) & (np.abs(z - filtered) <= outlier_m)
    solution, *_ = np.linalg.lstsq(rays[near], 1 / z[near], rcond=None)
    return solution


def silhouette_distance(mask):
    """Exact Euclidean distance of every pixel from the mask."""
    rows, columns = np.nonzero(mask)
    grid = np.indices(mask.shape)
    return np.sqrt(((grid[:, :, :, None] - np.stack([rows, columns])[:, None, None, :]) ** 2).sum(axis=0).min(axis=-1))


def point_to_plane_equations(found, centre_m):
    """Twin of `gauss_newton.normal_equations` for the rows of `point_to_plane.matches` under one pose."""
    gradient, matrix = np.zeros(6), np.zeros((6, 6))
    for row in found:
        position, own, other, residual, weight = row[:3], row[3:6], row[6:9], row[9], row[10]
        if weight > 0.0:
            normal = 0.5 * (own + other)
            derivative = np.concatenate([np.cross(position - centre_m, normal), normal])
            gradient -= weight * residual * derivative
            matrix += weight * np.outer(derivative, derivative)
    return gradient, matrix
