"""Errors of surface that are alike over patches of it, and so do not average out over its points (method, eq. 6.6)."""

from __future__ import annotations

from typing import Final

import numpy as np

from modeler import se3
from modeler.types import Array, RayImage

_OPEN = 1e-3  # of the best determined direction's information: surface says nothing of less
_DIFFERS: Final = 0.08**2
"""Share of the variance of smooth errors of depth that moves one view against another.

The rest is alike in both, as light comes from the same surroundings. Measured on rendered time of flight (tuning half):
with it NEES/6 is 0.8, and 95 % regions hold 91 %.
"""


def displacement(arms_m: Array, normals: Array, size_m: float) -> Array:
    """Return the covariance (6, 6) of ξ of least squares of point-to-plane distances with a common sd of 1 m.

    The rows are a = (p × n, n), and the covariance is (Σ a aᵀ / N)⁻¹, without directions that surface leaves open.

    Args:
        arms_m: (n, 3) points p, relative to the origin of ξ; at least one.
        normals: (n, 3).
        size_m: of the surface: a length by which rotations are compared with shifts.
    """
    scale = np.repeat([1.0 / size_m, 1.0], 3)
    rows = np.concatenate([np.cross(arms_m, normals), normals], axis=1) * scale
    values, axes = np.linalg.eigh(rows.T @ rows / len(rows))
    spread = np.where(values > _OPEN * values[-1], 1.0 / np.maximum(values, 1e-12), 0.0)
    return np.asarray((axes * spread) @ axes.T * np.outer(scale, scale), dtype=np.float64)


def of_multipath(view: RayImage) -> Array:
    """Return the covariance (6, 6) of ξ in target_from_source · Exp(ξ) due to smooth errors of depth of both views.

    Args:
        view: the source.
    """
    if view.sigma_multipath == 0.0 or not len(view.points_m):
        return np.zeros((6, 6))
    about = _DIFFERS * view.multipath_m**2 * displacement(view.points_m - view.centroid_m, view.normals, view.size_m)
    return se3.covariance_about(about, -view.centroid_m)
