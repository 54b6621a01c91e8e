"""Kernel of the preview: what one view says of a box of voxels, added to what others said, or taken back."""

from numba import njit, prange

from modeler.kernels.votes import above, project


@njit(cache=True, parallel=True)
def integrate_view(
    sums, origin, voxel_m, tau_m, empty_weight, sign, pose, lens, index, free_m, points, normals, weights, colours
):
    """Add to the sums of a box of voxels, in place, what a view says: weight, weighted distance, weighted colour.

    The distance of a voxel to the surface seen along its pixel is measured along the surface's normal, positive
    outside, within the band ±`tau_m`; farther in front, space that is seen empty says `tau_m` with `empty_weight`.

    Args:
        sums: (x, y, z, 6) float32: Σ w, Σ w d, Σ c, Σ c red, Σ c green, Σ c blue.
        origin: (3,) lowest corner of the box in m, object frame.
        voxel_m: side of a voxel.
        tau_m: half width of the band.
        empty_weight: against 1 for a surface seen head-on.
        sign: 1 adds, -1 takes back what was added with the same arguments.
        pose: (3, 4) camera_from_object.
        lens: (4,) fx, fy, cx, cy of the images.
        index: (h, w) int32 number of the surface point at a pixel, -1 = none.
        free_m: (h, w) float32 depth up to which the space along a pixel is seen empty, 0 = not known.
        points: (n, 3) in the object frame.
        normals: (n, 3).
        weights: (n,).
        colours: (n, 4) RGB and whether there is one.
    """
    for i in prange(sums.shape[0]):
        x = origin[0] + (i + 0.5) * voxel_m
        for j in range(sums.shape[1]):
            y = origin[1] + (j + 0.5) * voxel_m
            for k in range(sums.shape[2]):
                z = origin[2] + (k + 0.5) * voxel_m
                u, v, depth = project(pose, lens, x, y, z)
                if not (depth > 0.0 and -0.5 <= u < index.shape[1] - 0.5 and -0.5 <= v < index.shape[0] - 0.5):
                    continue
                row, column = int(v + 0.5), int(u + 0.5)
                n = index[row, column]
                along = above(x, y, z, points, normals, n) if n >= 0 else 2.0 * tau_m
                if abs(along) <= tau_m:
                    # What lies behind a surface is a guess that fades with depth.
                    weight = sign * weights[n] * min(1.0, 1.5 * (1.0 + along / tau_m) + 1e-3)
                    share = weight * colours[n, 3]
                    sums[i, j, k, 0] += weight
                    sums[i, j, k, 1] += weight * along
                    sums[i, j, k, 2] += share
                    for c in range(3):
                        sums[i, j, k, 3 + c] += share * colours[n, c]
                elif along > 0.0 and depth < free_m[row, column] - tau_m:
                    sums[i, j, k, 0] += sign * empty_weight
                    sums[i, j, k, 1] += sign * empty_weight * tau_m
