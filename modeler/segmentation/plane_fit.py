"""One plane fitted to points, with an uncertainty that can be believed."""

from __future__ import annotations

from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from modeler.types import Array, BoolArray, Plane

Real = TypeVar("Real", bound=np.floating[Any])

# What no residual shows: between the axis of a turntable and the normal of its plate, measured with three consumer
# cameras, lay 3, 4 and 13 mrad.
_SYSTEMATIC_TILT_RAD = 0.005
_SYSTEMATIC_OFFSET_M = 0.0005
_SYSTEMATIC_SHARE = 0.001  # scale error of the depth, as a part of the distance to the foot
_MIN_POINTS = 50
_TRIM = 3.0  # standard deviations
_ROUNDING_M = 1e-6
_BLOCKS_ACROSS = (3, 6, 12)  # correlation lengths tried, as parts of the longer side
_LEAST_BLOCKS = 6


def heights(points: npt.NDArray[Real], plane: Array) -> npt.NDArray[Real]:
    """Return the heights (...) of points (..., 3) above a plane (4,) of normal and offset, in the points' precision."""
    return cast("npt.NDArray[Real]", points @ plane[:3].astype(points.dtype) + points.dtype.type(plane[3]))


def fit_plane(
    points: Array, *, sigma_m: Array | float, guess: Array | None = None, foot_m: Array | None = None
) -> Plane | None:
    """Fit the plane that most of the points lie on, by trimmed least squares.

    Depth errors are correlated between pixels, so thousands of points are worth far fewer. The covariance is the
    sandwich estimator over spatial blocks (Liang and Zeger, Biometrika 1986), with the block size that gives most, and
    what a slow warp adds; on top comes what no residual can show, the camera's calibration.

    Args:
        points: (n, 3) in camera coordinates, m.
        sigma_m: (n,) or one number: noise of the points across the plane; points beyond three of them are left out.
        guess: (4,) normal and offset near which the plane lies; None = start from all points.
        foot_m: (3,) where the object stands, for which the offset's uncertainty holds; None = the points' centre.

    Returns:
        The plane with its normal towards the camera, or None where too few points agree or they lie on a line.
    """
    if len(points) < _MIN_POINTS:
        return None
    sigma = np.broadcast_to(np.asarray(sigma_m, dtype=np.float64), len(points))
    found = _trimmed(points, sigma, guess)
    if found is None:
        return None
    plane, inlier = found
    near, weight = points[inlier], sigma[inlier] ** -2.0
    centre = np.average(near, axis=0, weights=weight)
    axes = np.linalg.svd(plane[None, :3])[2][1:]
    uv = (near - centre) @ axes.T
    residual = heights(near, plane)
    narrow = np.sqrt(max(np.linalg.eigvalsh(np.cov(uv.T))[0], 0.0))
    if narrow < _TRIM * residual.std() or narrow < _ROUNDING_M:
        return None
    covariance = _sandwich(uv, residual, weight) + _warp(uv, residual, weight)
    foot = centre if foot_m is None else foot_m
    at_foot = np.append((foot - centre) @ axes.T, 1.0)
    tilt = np.linalg.eigvalsh(covariance[:2, :2])[-1] + _SYSTEMATIC_TILT_RAD**2
    share = _SYSTEMATIC_SHARE * float(np.linalg.norm(foot))
    offset = at_foot @ covariance @ at_foot + _SYSTEMATIC_OFFSET_M**2 + share**2
    return Plane(plane[:3], float(plane[3]), float(np.sqrt(tilt)), float(np.sqrt(offset)))


def _trimmed(points: Array, sigma: Array, guess: Array | None) -> tuple[Array, BoolArray] | None:
    """Return the plane (4,) of the points (n, 3) that agree and which (n,) these are; None where they are too few."""
    weight, widths = sigma**-2.0, [1.0] * 4
    if guess is None:
        # Trim from the outside in: start at the scale the points show, end at the noise.
        plane = least_squares(points, weight)
        shown = 1.5 * float(np.median(np.abs(heights(points, plane)) / sigma))
        widths = [max(1.0, shown / 2**k) for k in range(6)] + widths
    else:
        plane = np.asarray(guess, dtype=np.float64)
    inlier = np.zeros(len(points), dtype=np.bool_)
    for width in widths:
        inlier = np.abs(heights(points, plane)) < _TRIM * width * sigma
        if np.count_nonzero(inlier) < _MIN_POINTS:
            return None
        plane = least_squares(points[inlier], weight[inlier])
    return plane, inlier


def least_squares(points: Array, weight: Array) -> Array:
    """Return the plane (4,) nearest to points (n, 3) with weights (n,), its normal towards the camera."""
    centre = weight @ points / weight.sum()
    centred = points - centre
    normal = np.linalg.eigh((centred * weight[:, None]).T @ centred)[1][:, 0]
    offset = -float(normal @ centre)
    return np.append(normal, offset) * (1.0 if offset > 0.0 else -1.0)


def _sandwich(uv: Array, residual: Array, weight: Array) -> Array:
    """Return the covariance (3, 3) of slopes and height at the origin that errors correlated over blocks explain.

    Args:
        uv: (n, 2) coordinates of the points in the plane.
        residual: (n,) their heights above it.
        weight: (n,) of the points.
    """
    design = np.column_stack([uv, np.ones(len(uv))])
    bread = np.linalg.inv((design * weight[:, None]).T @ design)
    score = design * (weight * residual)[:, None]
    covariance = bread @ (score.T @ score) @ bread
    low, side = uv.min(axis=0), float(np.ptp(uv, axis=0).max())
    for across in _BLOCKS_ACROSS:
        cell = np.minimum((uv - low) * (across / side), across - 1).astype(np.int64)
        block = cell[:, 0] * across + cell[:, 1]
        blocks = int(np.count_nonzero(np.bincount(block)))
        if blocks < _LEAST_BLOCKS:
            continue
        sums = np.stack([np.bincount(block, score[:, k]) for k in range(3)])
        other = bread @ (sums @ sums.T) @ bread * (blocks / (blocks - 3))
        covariance = other if np.trace(other[:2, :2]) > np.trace(covariance[:2, :2]) else covariance
    return covariance


def _warp(uv: Array, residual: Array, weight: Array) -> Array:
    """Return the covariance (3, 3) of slopes and height at the origin that a warp of the whole surface explains.

    Errors that vary as slowly as the plane itself are absorbed by it. The next slowest, quadratic ones show, and slow
    errors are no smaller than faster ones: what they have in each of their three modes is taken for the plane's three.
    """
    u, v = (uv / uv.std(axis=0)).T
    modes = np.column_stack([np.ones(len(u)), u, v, u * u, u * v, v * v]) * np.sqrt(weight / weight.sum())[:, None]
    basis = np.linalg.qr(modes)[0][:, 3:]
    power = float(np.mean((basis.T @ (residual * np.sqrt(weight / weight.sum()))) ** 2))
    return power * np.diag(np.append(1.0 / uv.var(axis=0), 1.0))
