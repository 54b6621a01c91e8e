"""Closed surfaces swept from outlines: turned on a lathe, extruded from a polygon, bent along an arc."""

import numpy as np

from modeler.types import Array, BoolArray
from sequences.rendering.mesh import IntArray, Mesh


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
    """Return triangles (p - 2, 3) of a simple polygon (p, 2), counter-clockwise.

    Raises:
        ValueError: where the polygon crosses itself or runs clockwise.
    """
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
