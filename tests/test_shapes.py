"""Shapes: closed surfaces of the right size, their unions, and what the built-in recipes are made of."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from calibration.specimens import load_specimen, recipe_names
from slow import sampled

from sequences.rendering.meshes import Mesh, outer_surface, ply_bytes
from sequences.rendering.shapes import (
    AnyShape,
    Box,
    Capsule,
    Compound,
    Cone,
    Cylinder,
    Extrusion,
    Lathe,
    MeshFile,
    Part,
    Sphere,
    Torus,
    ear_clipped,
)

PI = np.pi
L_OUTLINE = ((0.0, 0.0), (0.14, 0.0), (0.14, 0.025), (0.025, 0.025), (0.025, 0.09), (0.0, 0.09))
CUP = ((0.0, 0.0), (0.04, 0.0), (0.04, 0.1), (0.03, 0.1), (0.03, 0.01), (0.0, 0.01))
SOLIDS: dict[str, tuple[AnyShape, float]] = {
    "box": (Box((0.1, 0.2, 0.3)), 0.1 * 0.2 * 0.3),
    "cylinder": (Cylinder(0.03, 0.2), PI * 0.03**2 * 0.2),
    "cone": (Cone(0.03, 0.1), PI * 0.03**2 * 0.1 / 3),
    "frustum": (Cone(0.03, 0.1, 0.01), PI * 0.1 * (0.03**2 + 0.03 * 0.01 + 0.01**2) / 3),
    "funnel": (Cone(0.0, 0.1, 0.03), PI * 0.03**2 * 0.1 / 3),
    "sphere": (Sphere(0.05), 4 / 3 * PI * 0.05**3),
    "capsule": (Capsule(0.02, 0.1), PI * 0.02**2 * 0.1 + 4 / 3 * PI * 0.02**3),
    "torus": (Torus(0.05, 0.01), 2 * PI**2 * 0.05 * 0.01**2),
    "handle": (Torus(0.05, 0.01, 210), 2 * PI**2 * 0.05 * 0.01**2 * 210 / 360),
    "cup": (Lathe(CUP), PI * (0.04**2 * 0.1 - 0.03**2 * 0.09)),
    "bracket": (Extrusion(L_OUTLINE, 0.06), (0.14 * 0.025 + 0.025 * 0.065) * 0.06),
    "stretched": (Compound((Part(Sphere(0.05), stretch=(1, 2, 0.5)),)), 4 / 3 * PI * 0.05**3),
}


def volume_m3(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.corners(), 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def assert_closed(mesh: Mesh) -> None:
    edges = mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    there, back = (np.sort(edges @ weights) for weights in ([len(mesh.vertices_m), 1], [1, len(mesh.vertices_m)]))
    assert np.all(np.diff(there) > 0)  # no edge is run through twice in one direction ...
    assert np.array_equal(there, back)  # ... and each is in the other: closed, and oriented alike


def area_m2(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.corners(), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_and_of_the_right_volume(name: str) -> None:
    shape, expected_m3 = SOLIDS[name]
    mesh = shape.mesh()
    assert_closed(mesh)
    assert volume_m3(mesh) == pytest.approx(expected_m3, rel=0.02)  # facets lie inside; positive: outwards
    assert volume_m3(mesh) <= expected_m3 * (1 + 1e-9)


def test_facets_of_round_shapes_are_fine() -> None:
    for radius_m in (0.005, 0.03, 0.1):
        middles = Cylinder(radius_m, 0.1).mesh().corners()
        edges = 0.5 * (middles + np.roll(middles, -1, axis=1)).reshape(-1, 3)
        rims = edges[np.abs(np.abs(edges[:, 2]) - 0.05) < 1e-9]
        outside = np.hypot(rims[:, 0], rims[:, 1])
        outside = outside[outside > 0.75 * radius_m]  # the rest are spokes of the discs
        assert outside.min() > radius_m - 16e-6


def test_the_outer_surface_of_a_union_has_its_area() -> None:
    cross = Compound((Part(Box((0.1, 0.04, 0.04))), Part(Box((0.03, 0.1, 0.03)), rgb=(9, 8, 7))))
    expected_m2 = (4 * 0.1 * 0.04 + 2 * 0.04**2) + 2 * 4 * 0.03 * 0.03  # what two caps add, two holes take
    surface = outer_surface(cross.mesh())
    assert area_m2(surface) == pytest.approx(expected_m2, rel=0.01)
    assert area_m2(cross.mesh()) > expected_m2 * 1.1
    inner = np.abs(surface.corners().mean(axis=1)) < np.array([0.05, 0.02, 0.02]) - 1.1e-3
    assert not inner.all(axis=1).any()
    assert {tuple(rgb) for rgb in surface.albedo.tolist()} == {(190, 190, 190), (9, 8, 7)}


def test_the_outer_surface_finds_a_small_part_in_a_large_face() -> None:
    button = Compound((Part(Box((0.2, 0.2, 0.2))), Part(Sphere(0.004), offset_m=(0.03, 0.02, 0.1))))
    expected_m2 = 6 * 0.2**2 - PI * 0.004**2 + 2 * PI * 0.004**2
    assert area_m2(outer_surface(button.mesh())) == pytest.approx(expected_m2, abs=8e-6)


def test_ply_files_are_read_back(tmp_path: Path) -> None:
    mesh = SOLIDS["bracket"][0].mesh()
    path = tmp_path / "m.ply"
    path.write_bytes(ply_bytes(mesh))
    loaded = trimesh.load_mesh(path)
    assert loaded.is_watertight
    assert loaded.volume == pytest.approx(volume_m3(mesh), rel=1e-5)
    again = MeshFile(path, scale=2.0).mesh()
    assert volume_m3(again) == pytest.approx(8 * volume_m3(mesh), rel=1e-5)


def lathes(shape: AnyShape) -> list[Lathe]:
    if isinstance(shape, Compound):
        return [lathe for part in shape.parts for lathe in lathes(part.shape)]
    return [shape] if isinstance(shape, Lathe) else []


@pytest.mark.parametrize("name", sampled(recipe_names(), every=12))
def test_recipes_are_well_formed_and_of_a_size_to_handle(name: str) -> None:
    shape = load_specimen(name).object
    mesh = shape.mesh()
    assert 0.05 < np.ptp(mesh.vertices_m, axis=0).max() < 0.3
    for number in np.unique(mesh.part):
        part = mesh.only(mesh.part == number)
        assert_closed(part)
        assert volume_m3(part) > 0.0
    for lathe in lathes(shape):
        bottom, *_, top = lathe.profile_m
        ends = [(0.0, height) for radius, height in (top, bottom) if radius > 0.0]
        ear_clipped(np.array([*lathe.profile_m, *ends]))  # complains of a profile that crosses itself
