"""Depth images with pixels missing at random: distance between measurements, and interpolation."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from modeler.kernels import planes
from modeler.types import BoolArray, Camera, Float32Array

ON_PLANE = 25.0  # measurements to which a plane is fitted
_UNLIKELY = 0.01  # probability that random loss leaves a hole of the radius of `gap_px`
_LEAST = 0.01  # least share; of fewer measurements no more than a few would be in reach of each other
_WIDE_PX = 10  # grids of measurements are no coarser


def measured_share(measured: BoolArray, within: BoolArray | None = None) -> float:
    """Return the share of measured pixels next to measured ones: about 1 where an image only has holes.

    Neighbours are the four adjacent pixels, or those up to 10 px away if gaps remain: measurements may form a grid.

    Args:
        measured: (h, w).
        within: (h, w) region, with all measured pixels, whose pixels count; None: the whole image.
    """
    both = either = 0
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both += 2 * np.count_nonzero(measured[one] & measured[other])
        if within is None:
            either += np.count_nonzero(measured[one]) + np.count_nonzero(measured[other])
        else:
            either += np.count_nonzero(measured[one] & within[other]) + np.count_nonzero(within[one] & measured[other])
    share = both / either if either else 1.0
    if gap_px(share) < 1.0:
        return share
    width, inside = 2 * _WIDE_PX + 1, np.ones_like(measured) if within is None else within
    seen, all_of = (
        width**2 * ndimage.uniform_filter(image.astype(np.float64), width, mode="constant")[measured].sum()
        - np.count_nonzero(measured)  # themselves
        for image in (measured, inside)
    )
    return float(seen / all_of)


def gap_px(share: float) -> float:
    """Return the radius in px of the largest gaps of random loss, for a share of measured pixels.

    A disc of n pixels holds no measurement with probability (1 - share)^n. Below 1 px there is nothing between
    measurements.
    """
    share = min(max(share, _LEAST), 1.0 - 1e-6)
    return float(np.sqrt(np.log(_UNLIKELY) / (np.pi * np.log1p(-share))))


def nearest_depth(depth_m: Float32Array, measured: BoolArray, within: BoolArray, gap: float) -> Float32Array:
    """Return depth (h, w) in which pixels between measurements have that of the nearest; NaN where there is none.

    Args:
        depth_m: (h, w) in m.
        measured: (h, w) pixels whose depth counts.
        within: (h, w) pixels that may be filled.
        gap: largest distance in px to the nearest measurement.
    """
    filled = np.where(measured, depth_m, np.float32(np.nan))
    if not measured.any():
        return filled
    nearest = np.asarray(ndimage.distance_transform_edt(~measured, return_distances=False, return_indices=True))
    away_px = np.hypot(*(nearest - np.indices(measured.shape)))
    between = within & (away_px <= gap)
    filled[between] = depth_m[nearest[0][between], nearest[1][between]]
    return filled


def closed(measured: BoolArray, gap: float) -> BoolArray:
    """Return measured pixels (h, w) and those between them: their morphological closing by a disc.

    A pixel is left out if any of dozens of empty discs contains it: with 1.5 times the radius of
    `gap_px` the probability is below 1 % again.
    """
    if not measured.any():
        return measured
    near = np.asarray(ndimage.distance_transform_edt(~measured)) <= 1.5 * gap
    return near if near.all() else measured | (np.asarray(ndimage.distance_transform_edt(near)) > 1.5 * gap)


def interpolated(depth_m: Float32Array, camera: Camera) -> Float32Array:
    """Return depth (h, w) with pixels between measurements on planes of their neighbours; dense images are unchanged.

    Args:
        depth_m: (h, w) in m; not positive or NaN = no measurement.
        camera: the camera.
    """
    measured = np.isfinite(depth_m) & (depth_m > 0.0)
    share = max(measured_share(measured), _LEAST)
    gap = gap_px(share)
    if gap < 1.0:
        return depth_m
    between = closed(measured, gap)
    guess_m = nearest_depth(depth_m, measured, between, gap)
    reach_px = np.sqrt(ON_PLANE / (np.pi * share))
    radius_m = float(reach_px * np.median(depth_m[measured]) / camera.fx)
    ball = planes.Ball(radius_m, int(np.ceil(1.2 * reach_px)), 1, noise_m=0.0)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    nothing = np.zeros(depth_m.shape, dtype=np.float32)
    cells = planes.local_planes(guess_m, between, nothing, intrinsics, ball, 1e-6, measured)
    w, h = camera.rays()
    towards = -(cells[..., planes.NORMAL_X] * w + cells[..., planes.NORMAL_Y] * h + cells[..., planes.NORMAL_Z])
    on_plane = (cells[..., planes.KIND] == planes.SURFACE) & (towards > 0.0) & ~measured
    guess_m[on_plane] = cells[on_plane, planes.DISTANCE] / towards[on_plane]
    return guess_m
