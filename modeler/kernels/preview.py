"""Kernel of the preview: what one view says of a box of voxels, added to what others said, or taken back."""

from numba import njit, prange


@njit(cache=True, parallel=True)
def tell(
    sums,
    low,
    high,
    origin,
    voxel_m,
    tau_m,
    empty_weight,
    sign,
    camera_from_object,
    lens,
    index,
    free_m,
    points,
    normals,
    weights,
    colours,
):
    """Add to the sums of a box of voxels, in place, what a view says: weight, weighted distance, weighted colour.

    The distance of a voxel to the surface seen along its pixel is measured along the surface's normal, positive
    outside, within the band ±`tau_m`; farther in front, space that is seen empty says `tau_m` with `empty_weight`.

    Args:
        sums: (x, y, z, 6) float32: Σ w, Σ w d, Σ c, Σ c red, Σ c green, Σ c blue.
        low: (3,) first voxel of the box.
        high: (3,) the one after its last.
        origin: (3,) lowest corner of all voxels in m, object frame.
        voxel_m: side of a voxel.
        tau_m: half width of the band.
        empty_weight: against 1 for a surface seen head-on.
        sign: 1 adds, -1 takes back what was added with the same arguments.
        camera_from_object: (3, 4).
        lens: (4,) fx, fy, cx, cy of the images.
        index: (h, w) int32 number of the surface point at a pixel, -1 = none.
        free_m: (h, w) float32 depth up to which the space along a pixel is seen empty, 0 = not known.
        points: (n, 3) in camera coordinates.
        normals: (n, 3).
        weights: (n,).
        colours: (n, 4) RGB and whether there is one.
    """
    pose = camera_from_object
    height, width = index.shape
    for i in prange(low[0], high[0]):
        x = origin[0] + (i + 0.5) * voxel_m
        for j in range(low[1], high[1]):
            y = origin[1] + (j + 0.5) * voxel_m
            for k in range(low[2], high[2]):
                z = origin[2] + (k + 0.5) * voxel_m
                depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
                if depth <= 0.0:
                    continue
                across = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
                down = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
                u, v = lens[0] * across / depth + lens[2], lens[1] * down / depth + lens[3]
                if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                    continue
                row, column = int(v + 0.5), int(u + 0.5)
                n = index[row, column]
                along = 2.0 * tau_m
                if n >= 0:
                    along = (
                        normals[n, 0] * (across - points[n, 0])
                        + normals[n, 1] * (down - points[n, 1])
                        + normals[n, 2] * (depth - points[n, 2])
                    )
                if abs(along) <= tau_m:
                    # What lies behind a surface is a guess that fades with depth.
                    weight = sign * weights[n] * min(1.0, 1.5 * (1.0 + along / tau_m) + 1e-3)
                    sums[i, j, k, 0] += weight
                    sums[i, j, k, 1] += weight * along
                    share = weight * colours[n, 3]
                    sums[i, j, k, 2] += share
                    for c in range(3):
                        sums[i, j, k, 3 + c] += share * colours[n, c]
                elif along > 0.0 and depth < free_m[row, column] - tau_m:
                    sums[i, j, k, 0] += sign * empty_weight
                    sums[i, j, k, 1] += sign * empty_weight * tau_m
