"""Exported meshes as solid bodies: mass, inertia, convex parts, a flat bottom."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from modeler.export.mesh import simplified
from modeler.types import Array, InputError, ObjectModel

HULL_TRIANGLES = 500
"""Most triangles of a convex part; a ball then loses 3 % of its volume."""
# For CoACD: of a bear of 0.13 m, 1500 triangles became 15 parts with 5 % more volume in 9 s on two busy cores; with its
# own settings and 8000 triangles, 70 parts in five minutes.
PART_TRIANGLES = 1_500
"""Triangles of the mesh from which convex parts are found."""
_CONCAVITY = 0.08
_SEARCH: Mapping[str, Any] = {"resolution": 800, "mcts_nodes": 10, "mcts_iterations": 30}
_LEAST_AREA_M2 = 1e-12  # of a triangle: (1 µm)², below the resolution of a 32-bit file at a distance of 10 m


@dataclass(frozen=True, eq=False)
class Body:
    """Physical properties of a rigid body of uniform density."""

    mass_kg: float
    """Mass."""
    centre_m: Array
    """(3,) centre of mass in the frame of the mesh."""
    inertia_kg_m2: Array
    """(3, 3) moments of inertia about the centre of mass, along the axes of the mesh."""
    volume_m3: float
    """Enclosed volume."""


def body_of(model: ObjectModel, *, density_kg_m3: float, mass_kg: float | None = None) -> Body:
    """Return mass, centre and inertia of the solid that a closed mesh encloses, by integrals over its volume.

    Args:
        model: with a closed mesh.
        density_kg_m3: mass per volume.
        mass_kg: mass, where it is known: the density then follows from it.

    Raises:
        InputError: if the mesh encloses no volume.
    """
    import trimesh

    mesh = trimesh.Trimesh(model.vertices_m, model.triangles, process=False)
    if not mesh.is_watertight or not mesh.is_winding_consistent or mesh.volume <= 0.0:
        raise InputError("the closed mesh encloses no volume; more views are needed for a solid")
    mesh.density = density_kg_m3 if mass_kg is None else mass_kg / mesh.volume
    found = mesh.mass_properties
    return Body(
        float(found.mass), np.asarray(found.center_mass, float), np.asarray(found.inertia, float), float(mesh.volume)
    )


def is_possible_inertia(inertia: Array) -> bool:
    """Return whether a body can have such moments (3, 3): positive, none larger than the sum of the others."""
    moments = np.linalg.eigvalsh(inertia)
    return bool(moments[0] > 0.0 and moments[2] <= (moments[0] + moments[1]) * (1.0 + 1e-9))


@dataclass(frozen=True, eq=False)
class ConvexParts:
    """Convex meshes that together stand for a body in collisions."""

    meshes: tuple[tuple[Array, npt.NDArray[np.int64]], ...]
    """Vertices (v, 3) in m and triangles (t, 3) of each."""
    method: str
    """How they were found, in words."""


def convex_parts(model: ObjectModel, seed: int = 0) -> ConvexParts:
    """Return convex parts of a closed mesh: by CoACD where it is installed, else one convex hull.

    CoACD: Wei et al. 2022, "Approximate convex decomposition for 3D meshes with collision-aware concavity and tree
    search".
    """
    if importlib.util.find_spec("coacd") is None:
        hull = _hull(model.vertices_m)
        how = "pip install -c constraints.txt -e '.[physics]'"
        return ConvexParts((hull,), f"one convex hull, as CoACD is not installed ({how})")
    import coacd  # pyright: ignore[reportMissingImports]

    coacd.set_log_level("error")
    coarse = simplified(model, PART_TRIANGLES)
    found = coacd.run_coacd(
        coacd.Mesh(coarse.vertices_m, coarse.triangles.astype(np.int32)), threshold=_CONCAVITY, seed=seed, **_SEARCH
    )
    parts = tuple(_hull(np.asarray(vertices, dtype=np.float64)) for vertices, _ in found)
    return ConvexParts(parts, f"{len(parts)} convex part{'s' if len(parts) != 1 else ''} by CoACD")


def _hull(points_m: Array) -> tuple[Array, npt.NDArray[np.int64]]:
    """Return the convex hull of points (n, 3), simplified to `HULL_TRIANGLES`: vertices and triangles."""
    import open3d as o3d
    import trimesh

    hull = trimesh.convex.convex_hull(points_m)
    if len(hull.faces) > HULL_TRIANGLES:
        fine = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(hull.vertices), o3d.utility.Vector3iVector(hull.faces.astype(np.int32))
        )
        coarse = fine.simplify_quadric_decimation(HULL_TRIANGLES)
        hull = trimesh.convex.convex_hull(np.asarray(coarse.vertices))
    return np.asarray(hull.vertices, dtype=np.float64), np.asarray(hull.faces, dtype=np.int64)


def without_degenerate(model: ObjectModel) -> ObjectModel:
    """Return the model without triangles that have no area."""
    kept = triangle_areas(model.vertices_m, model.triangles) > _LEAST_AREA_M2
    return model if kept.all() else replace(model, triangles=model.triangles[kept])


def triangle_areas(vertices: Array, triangles: npt.NDArray[np.int64]) -> Array:
    """Return the areas (t,) of triangles (t, 3)."""
    corners = vertices[triangles]
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def with_flat_bottom(model: ObjectModel, laid_m: float | None) -> ObjectModel:
    """Return a closed mesh, z up, that stands flat on the plane z = 0; its topology stays.

    Args:
        model: closed, with its base about z = 0.
        laid_m: vertices less than this above a support at z = 0, or below it, are moved onto it; a voxel, within which
            closed bottoms follow the support. None: no support was seen, and the object is cut 2 % of its height above
            its lowest vertex.
    """
    height_m = model.vertices_m[:, 2]
    if laid_m is None:
        level_m = onto_m = float(height_m.min() + 0.02 * np.ptp(height_m))
    else:
        level_m, onto_m = laid_m, 0.0
    vertices_m = model.vertices_m.copy()
    vertices_m[height_m < level_m, 2] = onto_m
    vertices_m[:, 2] -= onto_m
    return replace(model, vertices_m=vertices_m)


def bottom_area_m2(vertices_m: Array, triangles: npt.NDArray[np.int64]) -> float:
    """Return the area of the triangles that lie in the plane z = 0 and face down."""
    flat = triangles[np.all(np.abs(vertices_m[triangles][:, :, 2]) < 1e-7, axis=1)]
    a, b, c = np.moveaxis(vertices_m[flat], 1, 0)
    return max(0.0, float(-0.5 * np.cross(b - a, c - a)[:, 2].sum()))
