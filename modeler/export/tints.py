"""What is known of the vertices of a mesh as colours."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Literal

import numpy as np

from modeler.types import Array, InputError, ObjectModel

Tint = Literal["views", "sigma"]
MADE_UP_RGB: Final = (230, 90, 200)
"""Of surface that nobody saw, wherever it is shown."""
MOST_VIEWS: Final = 12
"""Views at the end of the scale."""
MOST_SIGMA_M: Final = 2e-3
"""Standard deviation at the end of the scale."""


def tinted(model: ObjectModel, tint: Tint) -> ObjectModel:
    """Return the model with vertices coloured by how well they are known; what is made up is pink.

    Args:
        model: with `vertex_views` and `vertex_sigmas_m`.
        tint: "views": how many views saw a vertex, dark = 1, yellow = 12 and more. "sigma": its standard deviation,
            dark = 0, yellow = 2 mm and more.

    Raises:
        InputError: where the model does not tell.
    """
    views, sigmas_m = model.vertex_views, model.vertex_sigmas_m
    if views is None or sigmas_m is None:
        raise InputError("the model does not tell who saw its vertices; build it again with this version")
    rgb = sigma_rgb(sigmas_m) if tint == "sigma" else _scale_rgb(views / MOST_VIEWS)
    rgb[views == 0] = MADE_UP_RGB
    return replace(model, vertex_colours=np.rint(rgb).astype(np.uint8))


def sigma_rgb(sigmas_m: Array) -> Array:
    """Return colours (v, 3) of standard deviations (v,), from dark (0) to yellow (`MOST_SIGMA_M` and more).

    What has none, surface that is made up, is pink.
    """
    rgb = _scale_rgb(np.where(np.isfinite(sigmas_m), sigmas_m, 0.0) / MOST_SIGMA_M)
    rgb[~np.isfinite(sigmas_m)] = MADE_UP_RGB
    return rgb


def _scale_rgb(shares: Array) -> Array:
    """Return colours (v, 3), 0 to 255, of places (v,) on the scale, 0 to 1."""
    from matplotlib import colormaps

    return 255.0 * colormaps["cividis"](np.clip(shares, 0.0, 1.0))[:, :3]
