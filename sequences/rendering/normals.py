"""Normals of the surfaces that meshes stand for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.sparse import coo_array

from modeler.types import Array
from sequences.rendering.meshes import IntArray, Mesh

_CREASE = np.cos(np.radians(30.0))
"""Triangles that meet at more than 30 degrees meet at an edge; others are facets of a round surface."""


@final
@dataclass(frozen=True, eq=False)
class SmoothNormals:
    """The normals of the round surfaces that a mesh's facets stand for.

    With those of the facets, shading would show facets, which turn with the body as a print does.
    """

    mesh: Mesh

    @cached_property
    def flat(self) -> Array:
        """(t, 3) unit normals of the triangles."""
        first, second = (self.mesh.corners()[:, k] - self.mesh.corners()[:, 0] for k in (1, 2))
        across = np.cross(first, second)
        return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)

    @cached_property
    def corners(self) -> Array:
        """(t, 3, 3) unit normals at the triangles' corners: the mean around a vertex, up to edges."""
        corners = self.mesh.corners()
        count, flat = len(corners), self.flat
        _, vertex = np.unique(np.round(corners.reshape(-1, 3), 9), axis=0, return_inverse=True)
        arms = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
        first, second = (arm / np.maximum(np.linalg.norm(arm, axis=2, keepdims=True), 1e-300) for arm in arms)
        angle = np.arccos(np.clip(np.sum(first * second, axis=2), -1.0, 1.0)).reshape(-1)
        at = coo_array((np.ones(3 * count), (np.arange(3 * count), vertex.reshape(-1)))).tocsr()
        pairs = (at @ at.T).tocoo()
        mine, other = pairs.coords[0], pairs.coords[1]
        alike = np.sum(flat[mine // 3] * flat[other // 3], axis=1) > _CREASE
        mine, other = mine[alike], other[alike]
        weights = angle[other]
        total = np.stack(
            [np.bincount(mine, weights * flat[other // 3, axis], minlength=3 * count) for axis in range(3)], axis=1
        )
        lengths = np.linalg.norm(total, axis=1, keepdims=True)
        means = np.where(lengths > 0.0, total / np.maximum(lengths, 1e-300), np.repeat(flat, 3, axis=0))
        return means.reshape(count, 3, 3)

    def at(self, triangle: IntArray, weights: Array) -> Array:
        """Return unit normals (n, 3), in the frame of the mesh, at barycentric coordinates (n, 3) in triangles (n,)."""
        normals = np.einsum("nc,nck->nk", weights, self.corners[triangle])
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)
