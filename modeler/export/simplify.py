"""Meshes with fewer triangles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from modeler.types import InputError, ObjectModel

_TRIES = (1.0, 0.98, 0.95, 0.9, 0.8)  # of the number asked for, until no edge of three triangles is left


def simplified(model: ObjectModel, triangles: int) -> ObjectModel:
    """Return the model with at most so many triangles, closed where it was closed.

    Edges are collapsed in the order of the least quadric error (Garland and Heckbert 1997, "Surface simplification
    using quadric error metrics"). Colours, views and deviations are those of the nearest old vertex.

    Raises:
        InputError: where the number is too small for a solid.
    """
    import open3d as o3d

    if triangles < 4:
        raise InputError(f"--triangles {triangles} is too few for a solid; give at least 4")
    if len(model.triangles) <= triangles:
        return model
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(model.vertices_m), o3d.utility.Vector3iVector(model.triangles.astype(np.int32))
    )
    closed = not len(mesh.get_non_manifold_edges(allow_boundary_edges=False))
    fewer = mesh
    for share in _TRIES:
        fewer = mesh.simplify_quadric_decimation(int(share * triangles))
        fewer.remove_degenerate_triangles()
        fewer.remove_unreferenced_vertices()
        if not len(fewer.get_non_manifold_edges(allow_boundary_edges=not closed)):
            break
    fewer.compute_vertex_normals()
    vertices_m = np.asarray(fewer.vertices)
    if not len(fewer.triangles):
        raise InputError(f"--triangles {triangles} leaves nothing of the mesh; ask for more")
    _, nearest = KDTree(model.vertices_m).query(vertices_m)
    return replace(
        model,
        vertices_m=vertices_m,
        triangles=np.asarray(fewer.triangles, dtype=np.int64),
        vertex_normals=np.asarray(fewer.vertex_normals),
        vertex_colours=None if model.vertex_colours is None else model.vertex_colours[nearest],
        vertex_views=None if model.vertex_views is None else model.vertex_views[nearest],
        vertex_sigmas_m=None if model.vertex_sigmas_m is None else model.vertex_sigmas_m[nearest],
    )
