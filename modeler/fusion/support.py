"""What the views observe at points of a surface: support, standard deviation, and colours made alike."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import laplace, minimum_filter

from modeler.fusion.depth_views import BATCH, GREY, DepthViews, ViewBlocks
from modeler.fusion.meshing import FAINT
from modeler.kernels import tsdf
from modeler.kernels.photometric import HARMONICS, harmonics_of
from modeler.types import Array, BoolArray

CLIPPED = 12.0  # levels from 0 and from 255 within which a pixel may be clipped: 5 % at either end
LOOKUPS = 100_000
"""Points times views at which colours are compared, which bounds time; halved or doubled, gains are the same to
0.1 %."""
ROUNDS = 8  # of iteratively reweighted least squares; with 4 or 16, gains are the same to 0.1 %
COLOUR_SIGMA = 0.1  # scale of the Cauchy weights on log colours, against highlights, and prior sd of log gains


@dataclass(frozen=True, eq=False)
class Exposure:
    """Factors on the colours of views that make them alike where they see the same point."""

    gains: Array
    """(f, 4) of red, green and blue, and the weight of each view's colours; 0 = it has none."""
    shading: Array
    """(8, 3) coefficients of the logarithm of a factor common to all views, as `harmonics` orders them."""

    @classmethod
    def blind(cls, count: int) -> Exposure:
        """Return that of a number of views whose colours are of no interest."""
        return cls(np.zeros((count, 4)), np.zeros((HARMONICS, 3)))

    def of(self, start: int, stop: int) -> Exposure:
        """Return that of some of the views."""
        return replace(self, gains=self.gains[start:stop])


def exposure_of(views: ViewBlocks, *, tau_m: float, near_m: float) -> Exposure:
    """Return what equalises exposure and shading.

    Each point has one colour, each view a gain, and all views the same lamps, which brighten the surface that faces
    them; the three are fitted to the logarithms of the observed colours of common points
    (method, eq. 12.11). Sharper views have more weight.

    Args:
        views: the views, by block.
        tau_m: half width of the truncation band.
        near_m: largest distance along the normal to the same surface.
    """
    coloured = np.concatenate([some.coloured for some in views.blocks])
    gains = np.concatenate([np.ones((len(coloured), 3)), _sharpness(views, coloured)[:, None]], axis=1)
    shading = np.zeros((HARMONICS, 3))
    with_colour = np.flatnonzero(coloured)
    if len(with_colour) < 2:
        return Exposure(gains, shading)
    points = sum(len(some.points_m) for some in views.blocks)
    step = max(1, points * len(with_colour) // LOOKUPS)
    points_m = np.concatenate([some.points_m[::step] for some in views])
    normals = np.concatenate([some.normals[::step] for some in views])
    levels, basis = (np.zeros((len(with_colour), len(points_m), k)) for k in (3, HARMONICS))
    weights = np.zeros(levels.shape[:2])
    row = 0
    for some in views:
        for view in np.flatnonzero(some.coloured):
            one = some.only(int(view))
            images = one.background_m, one.colour_weights, one.colour, np.ones((1, 4)), shading, 1.0
            _, colours = tsdf.observe(points_m, normals, near_m, tau_m, *one.lookup, *images)
            levels[row], weights[row] = colours[:, :3], colours[:, 3]
            basis[row] = harmonics_of(normals, one.poses[0])
            row += 1
    weights[np.any(np.abs(levels - 127.5) > 127.5 - CLIPPED, axis=2)] = 0.0
    weights[:, np.count_nonzero(weights, axis=0) < 2] = 0.0
    common = weights.any(axis=1)
    if not common.any():
        return Exposure(gains, shading)
    logs, log_gains = np.log(np.maximum(levels, 1.0)), np.zeros((len(with_colour), 3))
    mean = np.tensordot(weights, basis, 2) / weights.sum()
    log_gains[common], shading = _fitted(logs[common], weights[common], basis[common] - mean)
    # A factor common to all colours is not observable: it is 1 on average.
    gains[with_colour, :3] = np.exp(log_gains - mean @ shading)
    return Exposure(gains, shading)


def _fitted(logs: Array, observed: Array, basis: Array) -> tuple[Array, Array]:
    """Return log gains (f, 3), zero on average, and coefficients (h, 3) of shading, that make colours agree, robustly.

    Args:
        logs: (f, n, 3) logarithms of the colours of n points in f views.
        observed: (f, n) their weights.
        basis: (f, n, h), zero on average.
    """
    gains, shading = np.zeros((len(logs), 3)), np.zeros((basis.shape[2], 3))
    weights = observed
    # Differences between points that are the same in all views, as along the axis of a turntable, are not shading: of
    # all solutions that explain the colours equally well, the one with the least shading is chosen (λ of eq. 12.11).
    least = FAINT * np.tensordot(observed[..., None] * basis, basis, ((0, 1), (0, 1))) + FAINT * np.eye(basis.shape[2])
    for _ in range(ROUNDS):
        shares = weights / np.maximum(weights.sum(axis=0), 1e-12)
        off, relief = _centred(logs, shares), _centred(basis, shares)
        # Normal equations of eq. 12.11, the points' colours already eliminated, then the gains.
        weighted = weights[..., None] * relief
        across, inner = weighted.sum(axis=1), np.tensordot(weighted, relief, ((0, 1), (0, 1)))
        totals = weights.sum(axis=1)
        ridge = 1e-3 * (totals.sum() - np.sum(weights * shares)) / len(logs) + 1.0
        solved = _solved(
            totals + ridge, weights, shares, np.concatenate([-np.sum(weights[..., None] * off, axis=1), across], axis=1)
        )
        left = inner + least - across.T @ solved[:, 3:]
        shading = np.linalg.solve(left, -np.tensordot(weighted, off, ((0, 1), (0, 1))) - across.T @ solved[:, :3])
        gains = solved[:, :3] - solved[:, 3:] @ shading
        gains = gains - gains.mean(axis=0)
        off = _centred(logs + gains[:, None] + basis @ shading, shares)
        weights = observed / (1.0 + np.mean(off**2, axis=2) / COLOUR_SIGMA**2)
    return gains, shading


def _centred(values: Array, shares: Array) -> Array:
    """Return values (f, n, k) less their means over the views, given shares (f, n) of each."""
    return values - np.einsum("fn,fnk->nk", shares, values)


def _solved(diagonal: Array, left: Array, right: Array, values: Array) -> Array:
    """Return x (f, k) with (diag(d) - l rᵀ) x = y, for l and r (f, n).

    Of the system in f and that in n unknowns (Woodbury) the smaller one is solved.
    """
    if len(left) <= left.shape[1]:
        return np.linalg.solve(np.diag(diagonal) - left @ right.T, values).astype(np.float64)
    across = np.eye(left.shape[1]) - right.T @ (left / diagonal[:, None])
    scaled = values / diagonal[:, None]
    return scaled + left @ np.linalg.solve(across, right.T @ scaled) / diagonal[:, None]


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


# Strength of the prior on the noise of a single point: the noise of all points counts as much as this many views.
PRIOR_VIEWS = 3.0  # halved or doubled, models are the same to 0.1 %


@dataclass(frozen=True, eq=False)
class ViewSupport:
    """What the views observe at oriented points, each (n,) or (n, 3)."""

    weight: Array
    """Sum of the weights of the views that see surface there."""
    empty_views: Array
    """Number of views that see the point in empty space."""
    views: npt.NDArray[np.int64]
    """Number of views that see surface there."""
    background: Array
    """Sum of the cosines, between normal and ray, of the views that measure background where they should see it."""
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
    exposure: Exposure,
    focus: float,
) -> ViewSupport:
    """Return what the views observe at oriented points (method, eq. 12.7, 12.8 and 12.10).

    Args:
        views: the views, by block.
        points_m: (n, 3) in the object frame.
        normals: (n, 3) unit.
        tau_m: half width of the truncation band.
        near_m: largest distance along the normal to the same surface.
        sigma_m: standard deviation of one view of weight 1.
        exposure: what makes the views' colours alike.
        focus: exponent of the view weights for colours; the larger, the more the most frontal view dominates.
    """
    sums, colours = np.zeros((len(points_m), 6)), np.zeros((len(points_m), 4))
    start = 0
    for some in views:
        mine = exposure.of(start, start + len(some.index))
        some_sums, some_colours = _observed(
            some, points_m, normals, tau_m=tau_m, near_m=near_m, exposure=mine, focus=focus
        )
        start += len(some.index)
        sums += some_sums
        colours[:, 3] += some_colours[:, 3]
        shares = np.divide(some_colours[:, 3], colours[:, 3], out=np.zeros(len(points_m)), where=colours[:, 3] > 0.0)
        colours[:, :3] += shares[:, None] * (some_colours[:, :3] - colours[:, :3])
    weight, empty_views, count, first, second, background = sums.T
    found = count > 0.0
    safe = np.where(found, weight, 1.0)
    misfit = np.maximum(second - first**2 / safe, 0.0) / sigma_m**2  # χ² of the views about their mean
    scale = (PRIOR_VIEWS + misfit) / (PRIOR_VIEWS + np.maximum(count - 1.0, 0.0))  # eq. 12.8
    coloured = colours[:, 3] > 0.0
    return ViewSupport(
        weight=weight,
        empty_views=empty_views,
        views=count.astype(np.int64),
        background=background,
        sigmas_m=np.where(found, sigma_m * np.sqrt(scale / safe), np.inf),  # eq. 12.8
        colours=np.rint(np.where(coloured[:, None], colours[:, :3], GREY)).astype(np.uint8),
        coloured=coloured,
    )


def _observed(
    views: DepthViews,
    points_m: Array,
    normals: Array,
    *,
    tau_m: float,
    near_m: float,
    exposure: Exposure,
    focus: float,
) -> tuple[Array, Array]:
    """Return what `tsdf.observe` returns for the views of a block."""
    batches = [
        tsdf.observe(
            points_m[start : start + BATCH],
            normals[start : start + BATCH],
            near_m,
            tau_m,
            *views.lookup,
            views.background_m,
            views.colour_weights,
            views.colour,
            exposure.gains,
            exposure.shading,
            focus,
        )
        for start in range(0, max(len(points_m), 1), BATCH)
    ]
    sums, colours = (np.concatenate(part) for part in zip(*batches, strict=True))
    return sums, colours
