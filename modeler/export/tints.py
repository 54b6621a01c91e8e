"""What is known of the vertices of a mesh as colours."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from modeler.types import InputError, ObjectModel

Tint = Literal["views", "sigma"]
MADE_UP_RGB = (230, 90, 200)
MOST_VIEWS, MOST_SIGMA_M = 12, 1e-3  # at the end of the scale


def tinted(model: ObjectModel, tint: Tint) -> ObjectModel:
    """Return the model with vertices coloured by how well they are known; what is made up is pink.

    Args:
        model: with `vertex_views` and `vertex_sigmas_m`.
        tint: "views": how many views saw a vertex, dark = 1, yellow = 12 and more. "sigma": its standard deviation,
            dark = 0, yellow = 1 mm and more.

    Raises:
        InputError: where the model does not tell.
    """
    from matplotlib import colormaps

    views, sigmas_m = model.vertex_views, model.vertex_sigmas_m
    if views is None or sigmas_m is None:
        raise InputError("the model does not tell who saw its vertices; build it again with this version")
    scale = views / MOST_VIEWS if tint == "views" else np.where(np.isfinite(sigmas_m), sigmas_m, 0.0) / MOST_SIGMA_M
    rgb = np.rint(255.0 * colormaps["cividis"](np.clip(scale, 0.0, 1.0))[:, :3])
    rgb[views == 0] = MADE_UP_RGB
    return replace(model, vertex_colours=rgb.astype(np.uint8))
