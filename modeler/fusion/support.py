"""What the views observe at points of a surface: support, standard deviation and colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import laplace, minimum_filter

from modeler.fusion.depth_views import GREY, DepthViews, ViewBlocks
from modeler.kernels import tsdf
from modeler.types import Array, BoolArray

# Strength of the prior on the noise of a single point: the noise of all points counts as much as this many views.
PRIOR_VIEWS = 3.0  # chosen by hand
BATCH = 1 << 18  # points per kernel call, which bounds memory

DARK, BRIGHT = 12.0, 243.0  # levels (of 255) beyond which a pixel may be clipped: 5 % at either end
EXPOSURE_LOOKUPS = 100_000  # points times views at which exposures are compared, which bounds time
ROUNDS = 8  # of iteratively reweighted least squares
GAIN_SIGMA = 0.05  # prior sd of log gains; chosen by hand
COLOUR_SIGMA = 0.1  # scale of the Cauchy weights on log colours, against highlights; chosen by hand
LARGEST_GAIN = 2.5  # largest factor between exposures; chosen by hand


@dataclass(frozen=True, eq=False)
class ViewSupport:
    """What the views observe at oriented points, each (n,) or (n, 3)."""

    weight: Array
    """Sum of the weights of the views that see surface there."""
    empty_views: Array
    """Number of views that see the point in empty space."""
    views: npt.NDArray[np.int64]
    """Number of views that see surface there."""
    sigmas_m: Array
    """Standard deviation of the fused surface along the normal; inf where no view sees surface."""
    colours: npt.NDArray[np.uint8]
    """RGB, grey where no view has a colour."""
    coloured: npt.NDArray[np.bool_]
    """Whether a view has."""


def view_support(
    views: ViewBlocks,
    points_m: Array,
    normals: Array,
    *,
    tau_m: float,
    near_m: float,
    sigma_m: float,
    gains: Array,
    focus: float,
) -> ViewSupport:
    """Return what the views observe at oriented points (docs/method.md, F7 to F9).

    Args:
        views: the views, by block.
        points_m: (n, 3) in the object frame.
        normals: (n, 3) unit.
        tau_m: half width of the truncation band.
        near_m: largest distance along the normal to the same surface.
        sigma_m: standard deviation of one view of weight 1.
        gains: (f, 4) gains of red, green and blue, and the weight of each view's colours.
        focus: exponent of the view weights for colours; the larger, the more the most frontal view dominates.
    """
    sums, colours = np.zeros((len(points_m), 5)), np.zeros((len(points_m), 4))
    start = 0
    for some in views:
        mine = gains[start : start + len(some.index)]
        some_sums, some_colours = _observed(
            some, points_m, normals, tau_m=tau_m, near_m=near_m, gains=mine, focus=focus
        )
        start += len(some.index)
        sums += some_sums
        colours[:, 3] += some_colours[:, 3]
        shares = np.divide(some_colours[:, 3], colours[:, 3], out=np.zeros(len(points_m)), where=colours[:, 3] > 0.0)
        colours[:, :3] += shares[:, None] * (some_colours[:, :3] - colours[:, :3])
    weight, empty_views, count, first, second = sums.T
    found = count > 0.0
    safe = np.where(found, weight, 1.0)
    misfit = np.maximum(second - first**2 / safe, 0.0) / sigma_m**2  # χ² of the views about their mean
    scale = (PRIOR_VIEWS + misfit) / (PRIOR_VIEWS + np.maximum(count - 1.0, 0.0))  # (F8)
    coloured = colours[:, 3] > 0.0
    return ViewSupport(
        weight=weight,
        empty_views=empty_views,
        views=count.astype(np.int64),
        sigmas_m=np.where(found, sigma_m * np.sqrt(scale / safe), np.inf),  # (F8)
        colours=np.rint(np.where(coloured[:, None], colours[:, :3], GREY)).astype(np.uint8),
        coloured=coloured,
    )


def _observed(
    views: DepthViews, points_m: Array, normals: Array, *, tau_m: float, near_m: float, gains: Array, focus: float
) -> tuple[Array, Array]:
    """Return what `tsdf.observe` returns for the views of a block."""
    batches = [
        tsdf.observe(
            points_m[start : start + BATCH],
            normals[start : start + BATCH],
            near_m,
            tau_m,
            *views.lookup,
            views.colour_weights,
            views.colour,
            gains,
            focus,
        )
        for start in range(0, max(len(points_m), 1), BATCH)
    ]
    sums, colours = (np.concatenate(part) for part in zip(*batches, strict=True))
    return sums, colours


def exposure_gains(views: ViewBlocks, *, tau_m: float, near_m: float) -> Array:
    """Return (f, 4): gains of red, green and blue that equalise exposure, and colour weights, 0 without colour.

    Each point has one colour and each view a gain; both are fitted to the logarithms of the observed colours of
    common points (docs/method.md, F10). Sharper views have more weight.

    Args:
        views: the views, by block.
        tau_m: half width of the truncation band.
        near_m: largest distance along the normal to the same surface.
    """
    coloured = np.concatenate([some.coloured for some in views.blocks])
    result = np.concatenate([np.ones((len(coloured), 3)), _sharpness(views, coloured)[:, None]], axis=1)
    with_colour = np.flatnonzero(coloured)
    if len(with_colour) < 2:
        return result
    points = sum(len(some.points_m) for some in views.blocks)
    step = max(1, points * len(with_colour) // EXPOSURE_LOOKUPS)
    points_m = np.concatenate([some.points_m[::step] for some in views])
    normals = np.concatenate([some.normals[::step] for some in views])
    levels, weights = np.zeros((len(with_colour), len(points_m), 3)), np.zeros((len(with_colour), len(points_m)))
    unit_gain, row = np.ones((1, 4)), 0
    for some in views:
        for view in np.flatnonzero(some.coloured):
            one = some.only(int(view))
            images = one.colour_weights, one.colour, unit_gain, 1.0
            _, colours = tsdf.observe(points_m, normals, near_m, tau_m, *one.lookup, *images)
            levels[row], weights[row] = colours[:, :3], colours[:, 3]
            row += 1
    weights[np.any((levels < DARK) | (levels > BRIGHT), axis=2)] = 0.0
    weights[:, np.count_nonzero(weights, axis=0) < 2] = 0.0
    if not weights.any():
        return result
    logs = np.log(np.maximum(levels, 1.0))
    for channel in range(3):
        result[with_colour, channel] = np.exp(_log_gains(logs[:, :, channel], weights))
    return result


def _log_gains(logs: Array, observed: Array) -> Array:
    """Return log gains (f,), zero on average, that make logs (f, n) with weights `observed` (f, n) agree, robustly."""
    gain, weights = np.zeros(len(logs)), observed
    for _ in range(ROUNDS):
        totals = np.maximum(weights.sum(axis=0), 1e-12)
        shares = weights / totals
        means = np.sum(shares * logs, axis=0)
        # Normal equations of (F10), the points' colours already eliminated.
        totals, off = weights.sum(axis=1), np.sum(weights * (means - logs), axis=1)
        ridge = 1e-3 * (totals.sum() - np.sum(weights * shares)) / len(logs) + (COLOUR_SIGMA / GAIN_SIGMA) ** 2
        gain = _solved(totals + ridge, weights, shares, off)
        gain = np.clip(gain - gain.mean(), -np.log(LARGEST_GAIN), np.log(LARGEST_GAIN))
        off = logs + gain[:, None] - np.sum(shares * (logs + gain[:, None]), axis=0)
        weights = observed / (1.0 + (off / COLOUR_SIGMA) ** 2)
    return gain


def _solved(diagonal: Array, left: Array, right: Array, values: Array) -> Array:
    """Return x (f,) with (diag(d) - l rᵀ) x = y, for l and r (f, n).

    Of the system in f and that in n unknowns (Woodbury) the smaller one is solved.
    """
    if len(left) <= left.shape[1]:
        return np.linalg.solve(np.diag(diagonal) - left @ right.T, values).astype(np.float64)
    across = np.eye(left.shape[1]) - right.T @ (left / diagonal[:, None])
    return (values + left @ np.linalg.solve(across, right.T @ (values / diagonal))) / diagonal


def _sharpness(views: ViewBlocks, coloured: BoolArray) -> Array:
    """Return colour weights (f,): fine detail on the object relative to the other views; 0 without colour."""
    sharpness = np.concatenate([[_detail(some, view) for view in range(len(some.index))] for some in views])
    known = sharpness > 0.0
    if known.any():
        sharpness[known] = np.clip(sharpness[known] / np.median(sharpness[known]), 0.3, 3.0)
    sharpness[coloured & ~known] = 1.0
    return sharpness


def _detail(views: DepthViews, view: int) -> float:
    """Return fine detail on the object in a view, relative to its brightness; 0 where there is none, or no colour."""
    if not views.coloured[view]:
        return 0.0
    brightness = views.colour[view].astype(np.float64).mean(axis=2)
    inside = np.asarray(minimum_filter(views.index[view] >= 0, size=3), dtype=bool)
    if not inside.any():
        return 0.0
    return float(np.median(np.abs(laplace(brightness)[inside]))) / max(float(brightness[inside].mean()), 1.0)
