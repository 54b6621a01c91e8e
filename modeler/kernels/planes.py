"""Local planes of a depth image, and the distance to the object's silhouette."""

import math

import numba
import numpy as np

# Columns of a cell, the 32 bytes a likelihood reads for one pixel (float32).
NORMAL_X, NORMAL_Y, NORMAL_Z = 0, 1, 2  # unit normal n of the local plane, towards the camera
DISTANCE = 3  # of the plane from the camera, m: n · p + distance is how far p lies in front of it
VARIANCE = 4  # of that distance at the pixel, m²
KIND = 5  # one of the four below
DEPTH = 6  # measured z, m
SILHOUETTE = 7  # distance of a pixel outside the object from its silhouette, px
CELL_SIZE = 8

MISSING, SURFACE, RAGGED, BACKGROUND = 0.0, 1.0, 2.0, 3.0  # RAGGED: object, but no plane to be trusted


@numba.njit(cache=True)
def solve_symmetric_3(a00, a01, a02, a11, a12, a22, b0, b1, b2):
    """Solve a symmetric 3×3 system by Cramer's rule.

    Returns:
        (x0, x1, x2, first diagonal element of the inverse, determinant); the determinant is 0 where it is singular.
    """
    c00 = a11 * a22 - a12 * a12
    c01 = a02 * a12 - a01 * a22
    c02 = a01 * a12 - a02 * a11
    determinant = a00 * c00 + a01 * c01 + a02 * c02
    if determinant <= 1e-12 * a00 * a11 * a22:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    c11 = a00 * a22 - a02 * a02
    c12 = a01 * a02 - a00 * a12
    c22 = a00 * a11 - a01 * a01
    scale = 1.0 / determinant
    return (
        scale * (c00 * b0 + c01 * b1 + c02 * b2),
        scale * (c01 * b0 + c11 * b1 + c12 * b2),
        scale * (c02 * b0 + c12 * b1 + c22 * b2),
        scale * c00,
        determinant,
    )


@numba.njit(cache=True, parallel=True)
def local_planes(depth_m, mask, intrinsics, ball, sigma_inverse):
    """Fit a plane to every object pixel's neighbours within a ball.

    A plane is linear in inverse depth over the image (1/z = N · (w, h, 1)), and the noise of a triangulating camera
    is even there. The ball keeps the neighbourhood the same piece of surface from wherever it is seen, so that what
    smoothing does to a curved surface is the same in both views and cancels.

    Args:
        depth_m: (h, w) z in m, NaN = missing.
        mask: (h, w) bool, object.
        intrinsics: (4,) fx, fy, cx, cy in px.
        ball: radius in m; largest half-width of its window in px; step between the pixels that are read.
        sigma_inverse: sensor noise of 1/z, in 1/m.

    Returns:
        (h, w, 8) float32 cells, columns as above; the silhouette column is left at 0.
    """
    height, width = depth_m.shape
    fx, fy, cx, cy = intrinsics
    radius_m, max_radius_px, stride = ball
    cells = np.zeros((height, width, CELL_SIZE), dtype=np.float32)
    for row in numba.prange(height):
        for column in range(width):
            z = depth_m[row, column]
            if not z > 0.0:
                continue
            cells[row, column, DEPTH] = z
            if not mask[row, column]:
                cells[row, column, KIND] = BACKGROUND
                continue
            cells[row, column, KIND] = RAGGED
            w0, h0 = (column - cx) / fx, (row - cy) / fy
            reach = min(math.ceil(radius_m * max(fx, fy) / z), max_radius_px)
            n = swx = swy = sxx = sxy = syy = sb = sxb = syb = sbb = 0.0
            inverse0 = 1.0 / z
            for dr in range(-reach, reach + 1, stride):
                r = row + dr
                if r < 0 or r >= height:
                    continue
                for dc in range(-reach, reach + 1, stride):
                    c = column + dc
                    if c < 0 or c >= width or not mask[r, c]:
                        continue
                    zi = depth_m[r, c]
                    if not zi > 0.0:
                        continue
                    dx = zi * (c - cx) / fx - z * w0
                    dy = zi * (r - cy) / fy - z * h0
                    dz = zi - z
                    if dx * dx + dy * dy + dz * dz > radius_m * radius_m:
                        continue
                    x, y, b = dc * 1.0, dr * 1.0, 1.0 / zi - inverse0
                    n += 1.0
                    swx += x
                    swy += y
                    sxx += x * x
                    sxy += x * y
                    syy += y * y
                    sb += b
                    sxb += x * b
                    syb += y * b
                    sbb += b * b
            if n < 6.0:
                continue
            offset, slope_x, slope_y, leverage, determinant = solve_symmetric_3(
                n, swx, swy, sxx, sxy, syy, sb, sxb, syb
            )
            if determinant == 0.0:
                continue
            # 1/z = inverse0 + offset + slope_x (c - column) + slope_y (r - row), turned into N · (w, h, 1).
            plane_x, plane_y = slope_x * fx, slope_y * fy
            plane_z = inverse0 + offset - plane_x * w0 - plane_y * h0
            norm = math.sqrt(plane_x * plane_x + plane_y * plane_y + plane_z * plane_z)
            along = inverse0 + offset
            if along <= 0.0:
                continue
            residual = sbb - offset * sb - slope_x * sxb - slope_y * syb
            spread = max(residual / max(n - 3.0, 1.0), sigma_inverse * sigma_inverse)
            cells[row, column, NORMAL_X] = -plane_x / norm
            cells[row, column, NORMAL_Y] = -plane_y / norm
            cells[row, column, NORMAL_Z] = -plane_z / norm
            cells[row, column, DISTANCE] = 1.0 / norm
            # The distance of a point from the plane is (1 - N · p) / |N|: its noise is z times that of 1/z over |N|.
            cells[row, column, VARIANCE] = z * z * spread * leverage / (norm * norm)
            # A lopsided neighbourhood is the rim of a silhouette or a fold: its plane leans on one side only.
            if n >= 8.0 and leverage * n < 1.6:
                cells[row, column, KIND] = SURFACE
    return cells


@numba.njit(cache=True)
def silhouette_distance(mask, limit_px):
    """Return the distance (h, w) float32 in px of every pixel from the mask, cut at `limit_px`; by chamfer sweeps."""
    height, width = mask.shape
    distance = np.empty((height, width), dtype=np.float32)
    for row in range(height):
        for column in range(width):
            best = 0.0 if mask[row, column] else limit_px
            if best > 0.0 and column > 0:
                best = min(best, distance[row, column - 1] + 1.0)
            if best > 0.0 and row > 0:
                best = min(best, row_above(distance[row - 1], column))
            distance[row, column] = best
    for row in range(height - 1, -1, -1):
        for column in range(width - 1, -1, -1):
            best = distance[row, column]
            if best > 0.0 and column + 1 < width:
                best = min(best, distance[row, column + 1] + 1.0)
            if best > 0.0 and row + 1 < height:
                best = min(best, row_above(distance[row + 1], column))
            distance[row, column] = best
    return distance


@numba.njit(cache=True, inline="always")
def row_above(line, column):
    """Return the least distance that a neighbouring row (w,) hands on to a pixel at `column`."""
    best = line[column] + 1.0
    if column > 0:
        best = min(best, line[column - 1] + math.sqrt(2.0))
    if column + 1 < len(line):
        best = min(best, line[column + 1] + math.sqrt(2.0))
    return best
