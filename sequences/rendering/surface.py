"""The outer surface of overlapping parts."""

import numpy as np

from modeler.types import Array, BoolArray
from sequences.rendering.mesh import IntArray, Mesh
from sequences.rendering.raycast import inside

_COARSE_M, _FINE_M = 0.01, 0.001
_SKIN_M = 1e-5


def outer_surface(mesh: Mesh) -> Mesh:
    """Return the mesh without what lies inside other parts; where parts meet, the cut is right to a millimetre.

    Triangles that two parts cut are halved until they are small; the pieces inside another part are left out.
    """
    parts = int(mesh.part.max(initial=0)) + 1
    if parts == 1:
        return mesh
    others = [mesh.only(mesh.part == number) for number in range(parts)]
    corners, albedo, part = mesh.corners(), mesh.albedo, mesh.part
    done: list[Mesh] = []
    while len(corners):
        hidden = _hidden(corners, part, others)
        longest_m = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
        near_m = np.where(part[:, None] == np.arange(parts), np.inf, _box_gap(corners, others)).min(axis=1)
        whole = (hidden.all(axis=1) | ~hidden.any(axis=1)) & (longest_m <= _COARSE_M) | (near_m > 0.0)
        settled = whole | (longest_m <= _FINE_M)
        kept = settled & ~hidden[:, 0]
        pieces = np.arange(3 * int(kept.sum())).reshape(-1, 3)
        done.append(Mesh(corners[kept].reshape(-1, 3), pieces, albedo[kept], part[kept]))
        corners = _halved(corners[~settled])
        albedo, part = np.repeat(albedo[~settled], 2, axis=0), np.repeat(part[~settled], 2)
    return _welded(Mesh.joined(done), parts)


def _hidden(corners: Array, part: IntArray, others: list[Mesh]) -> BoolArray:
    """Return which of centre and corners (t, 4) of triangles lie, just off their face, inside another part."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    centre = corners.mean(axis=1, keepdims=True)
    # Corners are drawn in a little, so that a corner that touches another part does not count as cut by it.
    points = np.concatenate([centre, centre + 0.98 * (corners - centre)], axis=1) + _SKIN_M * normals[:, None]
    hidden = np.zeros(points.shape[:2], bool)
    for number, other in enumerate(others):
        asked = part != number
        if asked.any():
            hidden[asked] |= inside(other, points[asked].reshape(-1, 3)).reshape(-1, 4)
    return hidden


def _box_gap(corners: Array, others: list[Mesh]) -> Array:
    """Return how far (t, parts) triangles are from the bounding box of each part; 0 where they touch it."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    gaps = [np.maximum(low - o.vertices_m.max(axis=0), o.vertices_m.min(axis=0) - high) for o in others]
    return np.maximum(np.stack(gaps, axis=1).max(axis=2), 0.0)


def _halved(corners: Array) -> Array:
    """Return both halves (2t, 3, 3) of triangles, cut across their longest edge."""
    lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    order = (np.argmax(lengths, axis=1)[:, None] + np.arange(3)) % 3  # the longest edge runs from first to second
    a, b, c = np.moveaxis(np.take_along_axis(corners, order[..., None], axis=1), 1, 0)
    middle = 0.5 * (a + b)
    return np.stack([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)], axis=1).reshape(-1, 3, 3)


def _welded(mesh: Mesh, parts: int) -> Mesh:
    """Return the mesh with equal vertices made one."""
    _, first, number = np.unique(np.round(mesh.vertices_m, 9), axis=0, return_index=True, return_inverse=True)
    return Mesh(mesh.vertices_m[first], number.reshape(-1)[mesh.triangles], mesh.albedo, mesh.part % parts)
