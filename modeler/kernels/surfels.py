"""Small planes through the pixels of a depth image."""

import math

import numpy as np
from numba import njit


@njit(cache=True)
def surfels(depth_m, wanted, mask, lens, sigma_m, max_slope):
    """Fit a small plane at pixels, fit for silhouettes and thin parts: where little is known it turns to the camera.

    The neighbours are the object's pixels in a window of 5×5 that a surface no steeper than `max_slope` can reach. A
    pixel with fewer than three of them hangs in the air and gets none.

    Args:
        depth_m: (h, w) z in m, NaN = missing.
        wanted: (n, 2) row and column.
        mask: (h, w) bool, object.
        lens: (4,) fx, fy, cx, cy.
        sigma_m: noise of z.
        max_slope: tangent of the steepest angle between surface and image plane.

    Returns:
        Points (n, 3) and unit normals (n, 3) in camera coordinates; normals are 0 where there is none.
    """
    height, width = depth_m.shape
    points, normals = np.zeros((len(wanted), 3)), np.zeros((len(wanted), 3))
    for q in range(len(wanted)):
        row, column = wanted[q, 0], wanted[q, 1]
        z = depth_m[row, column]
        if not z > 0.0:
            continue
        step_x, step_y = z / lens[0], z / lens[1]
        sxx = sxy = syy = sxz = syz = 0.0
        near = 0
        for r in range(max(0, row - 2), min(height, row + 3)):
            for c in range(max(0, column - 2), min(width, column + 3)):
                if not mask[r, c] or (r == row and c == column):
                    continue
                x, y, dz = (c - column) * step_x, (r - row) * step_y, depth_m[r, c] - z
                if not abs(dz) <= max_slope * math.sqrt(x * x + y * y) + 2.0 * sigma_m:
                    continue
                sxx, sxy, syy, sxz, syz = sxx + x * x, sxy + x * y, syy + y * y, sxz + x * dz, syz + y * dz
                near += abs(r - row) <= 1 and abs(c - column) <= 1
        if near < 3:
            continue
        # A slope of 1 costs as much as a misfit of one noise: with few neighbours the plane faces the camera.
        ridge = sigma_m * sigma_m + 0.1 * step_x * step_x
        sxx, syy = sxx + ridge, syy + ridge
        determinant = sxx * syy - sxy * sxy
        p, q_ = (syy * sxz - sxy * syz) / determinant, (sxx * syz - sxy * sxz) / determinant
        w, h = (column - lens[2]) / lens[0], (row - lens[3]) / lens[1]
        # With z = z0 + p dx + q dy over the pixel offsets, and x = w z: the tangents give the normal.
        along = 1.0 + p * w + q_ * h
        length = math.sqrt(p * p + q_ * q_ + along * along)
        points[q, 0], points[q, 1], points[q, 2] = w * z, h * z, z
        normals[q, 0], normals[q, 1], normals[q, 2] = p / length, q_ / length, -along / length
    return points, normals
