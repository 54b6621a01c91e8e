"""Clouds and meshes as binary PLY."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from modeler.types import Array, ObjectModel


def cloud_ply(model: ObjectModel) -> bytes:
    """Return the merged cloud of a model as PLY."""
    return ply_bytes(model.points_m, model.normals, model.colours)


def mesh_ply(model: ObjectModel) -> bytes:
    """Return the mesh of a model as PLY; vertices have `views` and `sigma_m` beside the usual, where they are known."""
    return ply_bytes(
        model.vertices_m,
        model.vertex_normals,
        model.vertex_colours,
        model.triangles,
        views=model.vertex_views,
        sigmas_m=model.vertex_sigmas_m,
    )


def ply_bytes(
    points_m: Array,
    normals: Array,
    colours: npt.NDArray[np.uint8] | None = None,
    triangles: npt.NDArray[np.int64] | None = None,
    *,
    views: npt.NDArray[np.int64] | None = None,
    sigmas_m: Array | None = None,
) -> bytes:
    """Return a little-endian PLY file.

    Args:
        points_m: (n, 3); stored as 32-bit floats, 0.06 µm at a distance of 1 m.
        normals: (n, 3) unit vectors.
        colours: (n, 3) RGB.
        triangles: (t, 3) vertex numbers; None: a cloud, without a face element.
        views: (n,) number of views that saw each point, stored as `views`; 0 = made up.
        sigmas_m: (n,) standard deviation along the normal, stored as `sigma_m`; inf, stored as -1, where there is none.
    """
    names = ["x", "y", "z", "nx", "ny", "nz"]
    fields = [(name, "<f4") for name in names]
    header = [f"property float {name}" for name in names]
    values = list(np.concatenate([points_m, normals], axis=1).T)
    if colours is not None:
        names = ["red", "green", "blue"]
        fields += [(name, "u1") for name in names]
        header += [f"property uchar {name}" for name in names]
        values += list(colours.T)
    if views is not None:
        fields.append(("views", "<u2"))
        header.append("property ushort views")
        values.append(np.minimum(views, np.iinfo(np.uint16).max))
    if sigmas_m is not None:
        fields.append(("sigma_m", "<f4"))
        header.append("property float sigma_m")
        values.append(np.where(np.isfinite(sigmas_m), sigmas_m, -1.0))  # readers of PLY stumble over inf
    vertices = np.empty(len(points_m), dtype=fields)
    for (name, _), column in zip(fields, values, strict=True):
        vertices[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *header]
    body = vertices.tobytes()
    if triangles is not None:
        faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
        faces["count"], faces["corners"] = 3, triangles
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        body += faces.tobytes()
    return "\n".join([*header, "end_header", ""]).encode() + body
