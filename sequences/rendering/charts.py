"""How images are laid on surfaces: flat charts, and which place of which chart a point of the body has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from modeler.sequences.rendering.meshes import IntArray, Mesh
from modeler.types import Array, InputError

STEEP = np.sqrt(0.5)
"""Surface tilted from upright by more than 45 degrees counts as facing up or down."""


@final
@dataclass(frozen=True)
class Chart:
    """A flat image's size on the body: u runs to the right and v down, as seen from outside, each 0 to 1."""

    width_m: float
    """Length of the row that is the longest."""
    height_m: float
    """Length of a column."""
    closed: bool = False
    """Whether rows meet their own beginning."""
    polar: bool = False
    """Whether rows are circles of latitude, the first and the last of them points."""

    def row_lengths_m(self, v: Array) -> Array:
        """Return the lengths of rows at `v` (n,)."""
        return self.width_m * (np.sin(np.pi * v) if self.polar else np.ones_like(v))


@final
@dataclass(frozen=True, eq=False)
class Surfels:
    """Points of a mesh's surface."""

    points_m: Array
    """(n, 3) in the frame of the mesh."""
    normals: Array
    """(n, 3) outward normals of the triangles."""
    triangle: IntArray
    """(n,) number of the triangle."""
    weights: Array
    """(n, 3) barycentric coordinates."""


@final
@dataclass(frozen=True, eq=False)
class Places:
    """Where points lie in charts."""

    chart: IntArray
    """(n,) number of the chart; -1 for points that are in none."""
    u: Array
    """(n,)."""
    v: Array
    """(n,)."""


@final
@dataclass(frozen=True)
class Cylindrical:
    """One image around the z axis, over side-facing surface."""

    bottom_m: float | None = None
    """Height in the model frame at which it begins in m; null for that of the lowest point."""
    top_m: float | None = None
    """Height at which it ends in m; null for that of the highest point."""

    def __post_init__(self) -> None:
        """Check the order."""
        if self.bottom_m is not None and self.top_m is not None and self.bottom_m >= self.top_m:
            raise ValueError("top_m must be more than bottom_m")

    @property
    def count(self) -> int:
        """Number of charts."""
        return 1

    def _heights_m(self, mesh: Mesh) -> tuple[float, float]:
        low, high = mesh.vertices_m[:, 2].min(), mesh.vertices_m[:, 2].max()
        return float(low) if self.bottom_m is None else self.bottom_m, float(high) if self.top_m is None else self.top_m

    def charts(self, mesh: Mesh) -> tuple[Chart, ...]:
        """Return the charts of a mesh."""
        low_m, high_m = self._heights_m(mesh)
        radius_m = float(np.hypot(mesh.vertices_m[:, 0], mesh.vertices_m[:, 1]).max())
        return (Chart(2.0 * np.pi * radius_m, high_m - low_m, closed=True),)

    def places(self, mesh: Mesh, surfels: Surfels) -> Places:
        """Return where points of a mesh lie."""
        low_m, high_m = self._heights_m(mesh)
        x, y, z = surfels.points_m.T
        v = (high_m - z) / (high_m - low_m)
        covered = (v >= 0.0) & (v <= 1.0) & (np.abs(surfels.normals[:, 2]) <= STEEP)
        return Places(np.where(covered, 0, -1), _turn(x, y), v)


@final
@dataclass(frozen=True)
class Spherical:
    """One image around the middle of the body: columns are meridians, rows circles of latitude."""

    @property
    def count(self) -> int:
        """Number of charts."""
        return 1

    def charts(self, mesh: Mesh) -> tuple[Chart, ...]:
        """Return the charts of a mesh."""
        radius_m = float(np.linalg.norm(mesh.vertices_m - _middle(mesh), axis=1).max())
        return (Chart(2.0 * np.pi * radius_m, np.pi * radius_m, closed=True, polar=True),)

    def places(self, mesh: Mesh, surfels: Surfels) -> Places:
        """Return where points of a mesh lie."""
        x, y, z = (surfels.points_m - _middle(mesh)).T
        return Places(np.zeros(len(x), np.int64), _turn(x, y), np.arctan2(np.hypot(x, y), z) / np.pi)


_RIGHT = np.array([[0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, 0, 0], [1, 0, 0], [1, 0, 0]], np.float64)
_DOWN = np.array([[0, 0, -1]] * 4 + [[0, -1, 0], [0, 1, 0]], np.float64)
_OUT = np.array([[1, 0, 0], [0, -1, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]], np.float64)


@final
@dataclass(frozen=True)
class Faces:
    """An image on each face of the body's bounding box: facing +x, -y, -x, +y and, if wanted, up and down."""

    lids: bool = False
    """Whether surface facing up and down has images too."""

    @property
    def count(self) -> int:
        """Number of charts."""
        return 6 if self.lids else 4

    def charts(self, mesh: Mesh) -> tuple[Chart, ...]:
        """Return the charts of a mesh."""
        size_m = np.ptp(mesh.vertices_m, axis=0)
        sides = zip(np.abs(_RIGHT) @ size_m, np.abs(_DOWN) @ size_m, strict=True)
        return tuple(Chart(float(width_m), float(height_m)) for width_m, height_m in sides)[: self.count]

    def places(self, mesh: Mesh, surfels: Surfels) -> Places:
        """Return where points of a mesh lie."""
        face = np.argmax(surfels.normals @ _OUT.T, axis=1)
        from_middle = (surfels.points_m - _middle(mesh)) / np.ptp(mesh.vertices_m, axis=0)
        u, v = (0.5 + np.sum(from_middle * along[face], axis=1) for along in (_RIGHT, _DOWN))
        return Places(np.where(face < self.count, face, -1), u, v)


@final
@dataclass(frozen=True)
class Unwrapped:
    """One image mapped by the texture coordinates of the mesh file."""

    @property
    def count(self) -> int:
        """Number of charts."""
        return 1

    def charts(self, mesh: Mesh) -> tuple[Chart, ...]:
        """Return the charts of a mesh.

        Raises:
            InputError: if the mesh has no texture coordinates.
        """
        if mesh.uv is None:
            raise InputError("the object has no texture coordinates; give a mesh file that has, or another wrap.")
        there = np.isfinite(mesh.uv).all(axis=(1, 2))
        in_image = _doubled_areas(np.pad(mesh.uv[there], ((0, 0), (0, 0), (0, 1)))).sum()
        on_body_m2 = _doubled_areas(mesh.corners()[there]).sum()
        side_m = float(np.sqrt(on_body_m2 / max(in_image, 1e-12)))
        return (Chart(side_m, side_m),)

    def places(self, mesh: Mesh, surfels: Surfels) -> Places:
        """Return where points of a mesh lie."""
        assert mesh.uv is not None
        u, up = np.einsum("nc,nck->kn", surfels.weights, mesh.uv[surfels.triangle])
        found = np.isfinite(u)
        inside = [np.where(found, value, 0.0) % 1.0 for value in (u, 1.0 - up)]
        return Places(np.where(found, 0, -1), *inside)


AnyWrap = Cylindrical | Spherical | Faces | Unwrapped


def _doubled_areas(corners: Array) -> Array:
    """Return twice the areas (t,) of triangles (t, 3, 3)."""
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def _turn(x: Array, y: Array) -> Array:
    """Return azimuths as a share of a full turn, 0 to 1."""
    return np.arctan2(y, x) / (2.0 * np.pi) % 1.0


def _middle(mesh: Mesh) -> Array:
    """Return the middle (3,) of the bounding box."""
    return 0.5 * (mesh.vertices_m.min(axis=0) + mesh.vertices_m.max(axis=0))
