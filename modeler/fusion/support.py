"""What the views say of points of a surface: who saw them, how sure they are, and in which colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modeler.fusion.crop import GREY
from modeler.fusion.views import DepthViews
from modeler.kernels import fusion
from modeler.types import Array

# The noise at a point is that of all points as if so many views had shown it, until its own tell more.
PRIOR_VIEWS = 3.0
BATCH = 1 << 18  # points looked up at a time


@dataclass(frozen=True, eq=False)
class ViewSupport:
    """What the views say of oriented points, each (n,) or (n, 3)."""

    support: Array
    """Sum of the weights of the views that see surface there."""
    emptiness: Array
    """Number of views that see the place empty."""
    views: npt.NDArray[np.int64]
    """Number of views that see surface there."""
    sigmas_m: Array
    """Standard deviation along the normal of the surface fused from those views; inf where there is none."""
    colours: npt.NDArray[np.uint8]
    """RGB, grey where no view has a colour to give."""
    coloured: npt.NDArray[np.bool_]
    """Whether a view has."""


def view_support(
    views: DepthViews,
    points_m: Array,
    normals: Array,
    *,
    tau_m: float,
    near_m: float,
    sigma_m: float,
    gains: Array,
    focus: float,
) -> ViewSupport:
    """Ask the views about points.

    Args:
        views: the views.
        points_m: (n, 3) in the object frame.
        normals: (n, 3) unit.
        tau_m: half width of the band around the surface.
        near_m: surface further away along the normal is another one.
        sigma_m: standard deviation of what one view of weight 1 says.
        gains: (f, 4) factors on the views' red, green and blue, and their say in colours.
        focus: power of the weights with which views speak of colour: the higher, the more the most frontal one alone.
    """
    parts = [
        fusion.survey(
            np.ascontiguousarray(points_m[start : start + BATCH]),
            np.ascontiguousarray(normals[start : start + BATCH]),
            near_m,
            tau_m,
            *views.lookup,
            views.colour,
            gains,
            focus,
        )
        for start in range(0, max(len(points_m), 1), BATCH)
    ]
    sums, colours = (np.concatenate(part) for part in zip(*parts, strict=True))
    support, emptiness, count, first, second = sums.T
    found = count > 0.0
    safe = np.where(found, support, 1.0)
    # How well the views agree here, against how well they agree everywhere: a χ² with one degree for the mean.
    misfit = np.maximum(second - first**2 / safe, 0.0) / sigma_m**2
    scale = (PRIOR_VIEWS + misfit) / (PRIOR_VIEWS + np.maximum(count - 1.0, 0.0))
    known = colours[:, 3] > 0.0
    return ViewSupport(
        support=support,
        emptiness=emptiness,
        views=count.astype(np.int64),
        sigmas_m=np.where(found, sigma_m * np.sqrt(scale / safe), np.inf),
        colours=np.rint(np.where(known[:, None], colours[:, :3], GREY)).astype(np.uint8),
        coloured=known,
    )
