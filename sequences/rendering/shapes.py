"""Shapes of objects: solids, solids swept from outlines, mesh files, and compounds. The z axis points up."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.sequences.meshes import IntArray, Mesh, read_mesh
from modeler.types import Array, BoolArray


def turned(profile_m: Array, sides: int) -> Mesh:
    """Return the solid that a profile encloses as it turns about the z axis.

    Args:
        profile_m: (p, 2) radius and height from the bottom to the top, the solid on its left; ends off the axis are
            closed by discs.
        sides: facets around.
    """
    ends = [profile_m]
    if profile_m[0, 0] > 0.0:
        ends.insert(0, np.array([[0.0, profile_m[0, 1]]]))
    if profile_m[-1, 0] > 0.0:
        ends.append(np.array([[0.0, profile_m[-1, 1]]]))
    radius, height = np.concatenate(ends).T
    angle = 2.0 * np.pi * np.arange(sides) / sides
    rings = np.stack(np.broadcast_arrays(radius * np.cos(angle)[:, None], radius * np.sin(angle)[:, None], height), -1)
    count = len(radius)
    here, there = np.arange(sides)[:, None], (np.arange(sides)[:, None] + 1) % sides
    low, high = np.arange(count - 1), np.arange(1, count)
    first = np.stack([here * count + low, there * count + low, there * count + high], axis=-1)
    second = np.stack([here * count + low, there * count + high, here * count + high], axis=-1)
    return _welded(rings.reshape(-1, 3), np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)]))


def extruded(outline_m: Array, height_m: float) -> Mesh:
    """Return the prism over a simple polygon (p, 2), counter-clockwise, from z = 0 up."""
    count = len(outline_m)
    low = np.column_stack([outline_m, np.zeros(count)])
    high = np.column_stack([outline_m, np.full(count, height_m)])
    here = np.arange(count)
    there = (here + 1) % count
    walls = [np.stack([here, there, there + count], axis=1), np.stack([here, there + count, here + count], axis=1)]
    top = ear_clipped(outline_m)
    return Mesh.single(np.concatenate([low, high]), np.concatenate([*walls, top + count, top[:, ::-1]]))


def bent(radius_m: float, tube_radius_m: float, *, arc_deg: float, steps: int, sides: int) -> Mesh:
    """Return a round bar bent about the z axis, from the x axis through `arc_deg`; a torus at 360°."""
    closed = arc_deg >= 360.0
    along = np.radians(arc_deg) * np.arange(steps if closed else steps + 1) / steps
    around = 2.0 * np.pi * np.arange(sides) / sides
    reach = radius_m + tube_radius_m * np.cos(around)
    height = np.broadcast_to(tube_radius_m * np.sin(around), (len(along), sides))
    rings = np.stack([reach * np.cos(along)[:, None], reach * np.sin(along)[:, None], height], axis=-1)
    here = np.arange(steps)[:, None]
    there = (here + 1) % len(along)
    low, high = np.arange(sides), (np.arange(sides) + 1) % sides
    quads = [
        np.stack([here * sides + low, there * sides + low, there * sides + high], axis=-1).reshape(-1, 3),
        np.stack([here * sides + low, there * sides + high, here * sides + high], axis=-1).reshape(-1, 3),
    ]
    if not closed:
        fan = np.stack([np.zeros(sides - 2, np.int64), np.arange(1, sides - 1), np.arange(2, sides)], axis=1)
        quads += [fan, fan[:, ::-1] + steps * sides]
    return Mesh.single(rings.reshape(-1, 3), np.concatenate(quads))


def ear_clipped(outline: Array) -> IntArray:
    """Return triangles (p - 2, 3) of a simple polygon (p, 2), counter-clockwise; ValueError for another."""
    left = list(range(len(outline)))
    triangles: list[list[int]] = []
    while len(left) > 3:
        for place, tip in enumerate(left):
            before, after = left[place - 1], left[(place + 1) % len(left)]
            ear = outline[[before, tip, after]]
            others = outline[[i for i in left if i not in (before, tip, after)]]
            if _doubled_area(ear) > 1e-15 and not _inside(ear, others).any():
                triangles.append([before, tip, after])
                del left[place]
                break
        else:
            raise ValueError("must be a simple polygon whose corners run counter-clockwise")
    if _doubled_area(outline[left]) <= 0.0:
        raise ValueError("must be a simple polygon whose corners run counter-clockwise")
    return np.array([*triangles, left], dtype=np.int64)


def _doubled_area(corners: Array) -> float:
    (ax, ay), (bx, by) = corners[1] - corners[0], corners[2] - corners[0]
    return float(ax * by - ay * bx)


def _inside(ear: Array, points: Array) -> BoolArray:
    """Return which points (n, 2) lie in a counter-clockwise triangle (3, 2) or on its border."""
    edges, arms = np.roll(ear, -1, axis=0) - ear, points[:, None] - ear
    return np.all(edges[:, 0] * arms[..., 1] - edges[:, 1] * arms[..., 0] >= 0.0, axis=1)


def _welded(vertices: Array, triangles: IntArray) -> Mesh:
    """Return the mesh with equal vertices made one, and without the triangles that vanish."""
    _, first, number = np.unique(np.round(vertices, 12), axis=0, return_index=True, return_inverse=True)
    triangles = number.reshape(-1)[triangles]
    distinct = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return Mesh.single(vertices[first], triangles[distinct])


_UNIT_CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_CUBE_FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


@dataclass(frozen=True)
class Box:
    """A box about the origin."""

    size_m: tuple[float, float, float]
    """Edge lengths along x, y, z in m."""

    def __post_init__(self) -> None:
        _positive(size_m=min(self.size_m))

    def mesh(self) -> Mesh:
        """Return the surface."""
        triangles = [corners for a, b, c, d in _CUBE_FACES for corners in ([a, b, c], [a, c, d])]
        return Mesh.single(_UNIT_CUBE * np.array(self.size_m), np.array(triangles))


@dataclass(frozen=True)
class Cylinder:
    """A cylinder about the z axis, centred at the origin."""

    radius_m: float
    height_m: float
    """Length along z in m."""

    def __post_init__(self) -> None:
        _positive(radius_m=self.radius_m, height_m=self.height_m)

    def mesh(self) -> Mesh:
        """Return the surface."""
        half = self.height_m / 2.0
        return turned(np.array([[self.radius_m, -half], [self.radius_m, half]]), _sides(self.radius_m))


@dataclass(frozen=True)
class Cone:
    """A cone or a frustum about the z axis, from z = 0 up."""

    radius_m: float
    """Radius at the bottom in m."""
    height_m: float
    top_radius_m: float = 0.0

    def __post_init__(self) -> None:
        _positive(height_m=self.height_m, radius_m=max(self.radius_m, self.top_radius_m))
        _positive(radius_m=min(self.radius_m, self.top_radius_m) + 1e-12)

    def mesh(self) -> Mesh:
        """Return the surface."""
        sides = _sides(max(self.radius_m, self.top_radius_m))
        return turned(np.array([[self.radius_m, 0.0], [self.top_radius_m, self.height_m]]), sides)


@dataclass(frozen=True)
class Sphere:
    """A sphere about the origin."""

    radius_m: float

    def __post_init__(self) -> None:
        _positive(radius_m=self.radius_m)

    def mesh(self) -> Mesh:
        """Return the surface."""
        sides = _sides(self.radius_m)
        return turned(self.radius_m * _arc(-90.0, 90.0, sides), sides)


@dataclass(frozen=True)
class Capsule:
    """A cylinder about the z axis with round ends, centred at the origin."""

    radius_m: float
    height_m: float
    """Length along z between the centres of the ends in m."""

    def __post_init__(self) -> None:
        _positive(radius_m=self.radius_m, height_m=self.height_m)

    def mesh(self) -> Mesh:
        """Return the surface."""
        up = np.array([0.0, self.height_m / 2.0])
        sides = _sides(self.radius_m)
        ends = [self.radius_m * _arc(-90.0, 0.0, sides) - up, self.radius_m * _arc(0.0, 90.0, sides) + up]
        return turned(np.concatenate(ends), sides)


@dataclass(frozen=True)
class Torus:
    """A round bar bent about the z axis, beginning at the x axis."""

    radius_m: float
    """Radius of the bar's centre line in m."""
    tube_radius_m: float
    """Radius of the bar in m."""
    arc_deg: float = 360.0
    """Bending angle; 360° closes the ring."""

    def __post_init__(self) -> None:
        _positive(radius_m=self.radius_m - self.tube_radius_m, tube_radius_m=self.tube_radius_m, arc_deg=self.arc_deg)

    def mesh(self) -> Mesh:
        """Return the surface."""
        sides = _sides(self.tube_radius_m)
        steps = max(4, round(_sides(self.radius_m + self.tube_radius_m) * self.arc_deg / 360.0))
        return bent(self.radius_m, self.tube_radius_m, arc_deg=self.arc_deg, steps=steps, sides=sides)


@dataclass(frozen=True)
class Lathe:
    """A solid turned about the z axis."""

    profile_m: tuple[tuple[float, float], ...]
    """Radius and height in m, from the bottom outside up to the top; it may go on down inside a hollow."""

    def __post_init__(self) -> None:
        if len(self.profile_m) < 2 or min(radius for radius, _ in self.profile_m) < 0.0:
            raise ValueError("profile_m must have at least two points, none of negative radius")
        profile = np.array(self.profile_m)
        _positive(profile_m=float(profile[:, 0].max()))

    def mesh(self) -> Mesh:
        """Return the surface."""
        profile = np.array(self.profile_m)
        return turned(profile, _sides(float(profile[:, 0].max())))


@dataclass(frozen=True)
class Extrusion:
    """A prism over a polygon, from z = 0 up."""

    outline_m: tuple[tuple[float, float], ...]
    """Corners x, y in m, counter-clockwise."""
    height_m: float

    def __post_init__(self) -> None:
        _positive(height_m=self.height_m)
        if len(self.outline_m) < 3:
            raise ValueError("outline_m must have at least three corners")
        try:
            ear_clipped(np.array(self.outline_m))
        except ValueError as error:
            raise ValueError(f"outline_m {error}") from None

    def mesh(self) -> Mesh:
        """Return the surface."""
        return extruded(np.array(self.outline_m), self.height_m)


@dataclass(frozen=True)
class MeshFile:
    """A closed surface from a file; its z axis should point up."""

    path: Path
    """PLY, OBJ, STL, GLB or OFF; relative to the recipe."""
    scale: float = 1.0
    """Metres per unit of the file: 0.001 where it is in mm."""

    def __post_init__(self) -> None:
        _positive(scale=self.scale)

    def mesh(self) -> Mesh:
        """Return the surface."""
        return read_mesh(self.path, self.scale, textured=True)


@dataclass(frozen=True)
class Part:
    """A shape at its place in a compound: stretched, then turned, then shifted."""

    shape: AnyShape
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift in m."""
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Turns about the fixed x, y and z axes, in this order."""
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors along the shape's own axes."""
    rgb: tuple[int, int, int] | None = None
    """Colour; the shape's own without it."""

    def __post_init__(self) -> None:
        _positive(stretch=min(self.stretch))
        if self.rgb is not None and not all(0 <= value <= 255 for value in self.rgb):
            raise ValueError("rgb must hold numbers from 0 to 255")

    def mesh(self) -> Mesh:
        """Return the surface at its place."""
        mesh = self.shape.mesh().scaled(self.stretch).moved(placement(self.offset_m, self.rotation_deg))
        return mesh if self.rgb is None else mesh.painted(self.rgb)


@dataclass(frozen=True)
class Compound:
    """The union of several shapes."""

    parts: tuple[Part, ...]
    """The shapes at their places."""

    def __post_init__(self) -> None:
        if not self.parts:
            raise ValueError("parts must not be empty")

    def mesh(self) -> Mesh:
        """Return the surfaces of all parts, hidden pieces included."""
        return Mesh.joined([part.mesh() for part in self.parts])


AnyShape = Box | Cylinder | Cone | Sphere | Capsule | Torus | Lathe | Extrusion | MeshFile | Compound


def placement(offset_m: tuple[float, float, float], rotation_deg: tuple[float, float, float]) -> Array:
    """Return the motion (4, 4) that turns about the fixed x, y and z axes, in this order, then shifts."""
    return se3.rigid(Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix(), np.array(offset_m))


def _sides(radius_m: float) -> int:
    """Return how many facets make a circle of a radius round enough; a multiple of four."""
    # Facets are off by 15 µm at most.
    return 4 * int(np.clip(np.ceil(np.pi / np.sqrt(2.0 * 15e-6 / radius_m) / 4.0), 4, 128))


def _arc(start_deg: float, stop_deg: float, sides: int) -> Array:
    """Return radius and height (n, 2) of a unit arc, its ends exactly on the axis or the equator."""
    angle = np.radians(np.linspace(start_deg, stop_deg, 1 + round(sides * (stop_deg - start_deg) / 360.0)))
    return np.column_stack([np.cos(angle), np.sin(angle)]).astype(np.float64).round(12)


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0.0:
            raise ValueError(f"{name} must be positive")
