"""What the views observe at points of a surface: support, standard deviation and colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modeler.fusion.depth_views import BATCH, GREY, DepthViews, ViewBlocks
from modeler.fusion.exposure import Exposure
from modeler.kernels import tsdf
from modeler.types import Array

# Strength of the prior on the noise of a single point: the noise of all points counts as much as this many views.
PRIOR_VIEWS = 3.0  # chosen by hand


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
    sums, colours = np.zeros((len(points_m), 5)), np.zeros((len(points_m), 4))
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
    weight, empty_views, count, first, second = sums.T
    found = count > 0.0
    safe = np.where(found, weight, 1.0)
    misfit = np.maximum(second - first**2 / safe, 0.0) / sigma_m**2  # χ² of the views about their mean
    scale = (PRIOR_VIEWS + misfit) / (PRIOR_VIEWS + np.maximum(count - 1.0, 0.0))  # eq. 12.8
    coloured = colours[:, 3] > 0.0
    return ViewSupport(
        weight=weight,
        empty_views=empty_views,
        views=count.astype(np.int64),
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
