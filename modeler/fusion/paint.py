"""Points drawn from a surface, and whether like colours are found at like places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from modeler.system.pictures import linear_light
from modeler.types import Array, areas_m2


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points drawn evenly from a surface, as shares of the corners of triangles."""

    triangles: npt.NDArray[np.int64]
    """(n,) numbers of the triangles that they lie in."""
    corners: npt.NDArray[np.int64]
    """(n, 3) vertex numbers of these."""
    shares: Array
    """(n, 3) of the corners."""

    @classmethod
    def draw(
        cls, vertices_m: Array, triangles: npt.NDArray[np.int64], count: int, rng: np.random.Generator
    ) -> SurfacePoints:
        """Draw points from triangles (t, 3) of vertices (v, 3), by their area."""
        areas = areas_m2(vertices_m, triangles)
        picked = rng.choice(len(triangles), count, p=areas / areas.sum())
        u, v = rng.random((2, count))
        # The far half of the parallelogram folds back onto the triangle.
        u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
        return cls(picked, triangles[picked], np.stack([1.0 - u - v, u, v], axis=1))

    def of(self, values: Array) -> Array:
        """Return what the points have of values (v, k) of vertices: (n, k)."""
        return np.einsum("nc,nck->nk", self.shares, values[self.corners])


@dataclass(frozen=True, eq=False)
class Paint:
    """The colours of a surface by place."""

    tree: KDTree
    """Of points of the surface: place and colour in CIELAB, each over its tolerance."""
    tolerance_m: float
    """Distance of places that count as the same."""
    tolerance: float
    """Distance of colours in CIELAB that count as the same."""

    @classmethod
    def of(cls, points_m: Array, colours: Array, tolerance_m: float, tolerance: float) -> Paint:
        """Return the colours (n, 3) in CIELAB of a surface at points (n, 3)."""
        return cls(KDTree(np.hstack([points_m / tolerance_m, colours / tolerance])), tolerance_m, tolerance)

    def differs(self, points_m: Array, colours: Array) -> npt.NDArray[np.bool_]:
        """Return which points (n, 3) with colours (n, 3) in CIELAB find none of the surface within both tolerances."""
        away, _ = self.tree.query(np.hstack([points_m / self.tolerance_m, colours / self.tolerance]))
        return np.asarray(away) > np.sqrt(2.0)


_XYZ_FROM_RGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_LAB_FROM_ROOTS = np.array([[0.0, 116.0, 0.0], [500.0, -500.0, 0.0], [0.0, 200.0, -200.0]])


def cielab(srgb: Array) -> Array:
    """Return colours (n, 3) in CIELAB of sRGB colours (n, 3) from 0 to 255, under its white (CIE 15)."""
    xyz = linear_light(np.asarray(srgb, dtype=np.float64) / 255.0) @ _XYZ_FROM_RGB.T / _XYZ_FROM_RGB.sum(axis=1)
    roots = np.where(xyz > (6.0 / 29.0) ** 3, np.cbrt(xyz), xyz / (3.0 * (6.0 / 29.0) ** 2) + 4.0 / 29.0)
    return roots @ _LAB_FROM_ROOTS.T - np.array([16.0, 0.0, 0.0])
