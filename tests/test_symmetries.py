"""Symmetries of a surface, found by registering it with itself."""

from functools import cache
from typing import Any

import numpy as np
import open3d as o3d
import pytest
import trimesh
from slow_cases import quick_first
from trimesh.transformations import random_rotation_matrix

from modeler import se3
from modeler.export.datasets import symmetry_entries
from modeler.fusion import Symmetries, SymmetryFinder
from modeler.fusion.paint import cielab
from modeler.types import Array, ObjectModel

SIGMA_M = 3e-4


def noisy(mesh: Any, seed: int = 0) -> tuple[Array, Any, Any]:
    """Vertices (v, 3), with noise, and triangles (t, 3) of a shape that is turned away from its axes; what was up."""
    rng = np.random.default_rng(seed)
    vertices, triangles = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge=0.01)[:2]
    pose = random_rotation_matrix(rng.random(3))
    pose[:3, 3] = [0.1, -0.2, 0.7]
    return se3.transform(pose, vertices) + SIGMA_M * rng.normal(size=vertices.shape), triangles, pose[:3, 2]


def distances(vertices: Array, triangles: Any, points: Array) -> Array:
    """Distances (n,) of points (n, 3) from a surface."""
    scene, tensor = o3d.t.geometry.RaycastingScene(), o3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(triangles.astype(np.uint32)))
    return scene.compute_distance(tensor(points.astype(np.float32))).numpy()


def found(mesh: Any, *, closed: bool = True) -> Symmetries:
    vertices, triangles, up = noisy(mesh)
    return SymmetryFinder().find(vertices, triangles, up=up, sigma_m=SIGMA_M, closed=closed)


def prism(corners: int) -> Any:
    """A prism that is higher than wide."""
    return trimesh.creation.cylinder(0.04, 0.12, sections=corners)


def bracket() -> Any:
    angle = trimesh.creation.box((0.1, 0.05, 0.02))
    leg = trimesh.creation.box((0.02, 0.05, 0.07))
    leg.apply_translation([0.04, 0.0, 0.045])
    bump = trimesh.creation.box((0.02, 0.02, 0.02))
    bump.apply_translation([-0.03, 0.01, 0.02])
    return trimesh.util.concatenate([angle, leg, bump])


SHAPES = {
    "box": (trimesh.creation.box((0.06, 0.1, 0.14)), 3, 0),
    "cylinder": (trimesh.creation.cylinder(0.04, 0.12, sections=96), 1, 1),
    "bracket": (bracket(), 0, 0),
    "square": (trimesh.creation.box((0.08, 0.08, 0.14)), 7, 0),
    "cube": (trimesh.creation.box((0.1, 0.1, 0.1)), 23, 0),
    "3": (prism(3), 5, 0),
    "5": (prism(5), 9, 0),
    "cone": (trimesh.creation.cone(0.05, 0.12, sections=96), 0, 1),
    "ball": (trimesh.creation.icosphere(subdivisions=4, radius=0.06), 0, 3),
}
"""Shapes, and how many discrete and continuous symmetries they have."""


@cache
def of_shape(name: str) -> Symmetries:
    return found(SHAPES[name][0])


def test_turns_that_leave_a_model_as_it_is_are_those_about_its_axis() -> None:
    for name, count in (("cylinder", 1), ("bracket", 0)):
        vertices, triangles, up = noisy(SHAPES[name][0])
        normals = np.zeros_like(vertices)
        model = ObjectModel(vertices, normals, None, vertices, triangles, normals, None)
        turns = SymmetryFinder().free_turns(model)
        assert turns.shape == (count, 6)
        for turn in turns:
            assert abs(turn[:3] @ up) > np.cos(np.radians(0.5))
            assert (
                np.quantile(distances(vertices, triangles, se3.transform(se3.exp(0.7 * turn), vertices)), 0.9) < 0.001
            )


@pytest.mark.parametrize("name", quick_first(SHAPES, 3))
def test_symmetries_are_those_of_the_shape(name: str) -> None:
    result = of_shape(name)
    assert (len(result.discrete), len(result.continuous)) == SHAPES[name][1:]
    for pose in result.discrete:
        assert se3.is_rigid(pose, tolerance=1e-9, farthest_m=10.0)
        assert se3.rotation_angle(pose) > np.radians(10.0)


def test_each_symmetry_and_the_products_of_them_map_the_surface_onto_itself() -> None:
    vertices, triangles, _ = noisy(SHAPES["square"][0])
    result = of_shape("square")
    for one in result.discrete:
        away_m = distances(vertices, triangles, se3.transform(one, vertices))
        assert np.mean(away_m > result.tolerance_m) < 0.01
        for other in result.discrete:
            product = one @ other
            angles = [se3.rotation_angle(se3.inverse(product) @ motion) for motion in (np.eye(4), *result.discrete)]
            assert min(angles) < np.radians(2.0)


def test_nothing_is_said_of_turns_that_bring_up_what_was_not_seen() -> None:
    """Of a box that stands on a table, only the half turn about the vertical is evident."""
    box = trimesh.creation.box((0.06, 0.1, 0.05))
    vertices, triangles, up = noisy(box)
    heights = (vertices[triangles] @ up).mean(axis=1)
    seen = triangles[heights > heights.min() + 1e-3]
    result = SymmetryFinder().find(vertices, seen, up=up, sigma_m=SIGMA_M)
    assert len(result.discrete) == 1
    axis = np.linalg.eigh(result.discrete[0][:3, :3] + result.discrete[0][:3, :3].T)[1][:, -1]
    assert abs(axis @ up) > np.cos(np.radians(2.0))
    assert 0.85 < result.compared <= 1.0


def test_a_small_part_on_a_body_of_revolution_counts() -> None:
    can = trimesh.creation.cylinder(0.04, 0.12, sections=96)
    handle = trimesh.creation.box((0.02, 0.01, 0.02))
    handle.apply_translation([0.05, 0.0, 0.02])
    result = found(trimesh.util.concatenate([can, handle]))
    assert (result.discrete, result.continuous) == ((), ())
    assert "none" in result.words


def test_a_can_that_lies_is_seen_in_part_and_only_its_half_turn_is_claimed() -> None:
    """Turns about its own axis bring up what the table hid; half turns about axes beside the vertical are one."""
    can = trimesh.creation.cylinder(0.04, 0.12, sections=96)
    can.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2.0, [1.0, 0.0, 0.0]))
    vertices, triangles, up = noisy(can)
    heights = (vertices[triangles] @ up).mean(axis=1)
    seen = triangles[heights > heights.min() + 0.008]
    result = SymmetryFinder().find(vertices, seen, up=up, sigma_m=SIGMA_M)
    (half_turn,), (own,) = result.discrete, result.seen_in_part
    assert result.continuous == ()
    assert abs(own.direction @ up) < 0.05
    assert se3.rotation_angle(half_turn) == pytest.approx(np.pi)
    np.testing.assert_allclose(half_turn[:3, :3] @ own.direction, -own.direction, atol=0.05)
    assert "not seen all around" in result.words


def checked(points: Array) -> Any:
    """Colours (n, 3) of a print that no rotation maps onto itself: darker to one side, in stripes of three widths."""
    stripes = np.sin(90.0 * points[:, 0]) + np.sin(151.0 * points[:, 1]) + np.sin(211.0 * points[:, 2])
    grey = 120.0 + 60.0 * np.clip(stripes + 8.0 * points[:, 1], -1.0, 1.0)
    return np.stack([grey, 0.8 * grey, np.full_like(grey, 60.0)], axis=1).astype(np.uint8)


@pytest.mark.slow
def test_colour_breaks_the_symmetries_of_a_shape_that_it_tells_apart() -> None:
    vertices, triangles, up = noisy(SHAPES["box"][0])
    place = vertices - vertices.mean(axis=0)
    shades = np.random.default_rng(0).normal(0.0, 4.0, (len(vertices), 1))
    plain = np.clip(np.array([[150.0, 120.0, 60.0]]) + shades, 0, 255).astype(np.uint8)
    for colours, kept in ((plain, True), (checked(place), False)):
        result = SymmetryFinder().find(vertices, triangles, up=up, sigma_m=SIGMA_M, colours=colours, closed=True)
        assert (len(result.discrete), len(result.continuous)) == (3, 0)
        left = result.with_colour
        assert (len(left.discrete), len(left.continuous)) == ((3, 0) if kept else (0, 0))
        assert ("with colour: none" in result.words) != kept


def test_of_an_axis_that_colour_breaks_the_turns_that_it_leaves_are_found() -> None:
    """A can with a label on each of its four sides."""
    can = trimesh.creation.cylinder(0.04, 0.12, sections=96)
    rng = np.random.default_rng(0)
    vertices, triangles = trimesh.remesh.subdivide_to_size(can.vertices, can.faces, max_edge=0.005)[:2]
    side = np.cos(4.0 * np.arctan2(vertices[:, 1], vertices[:, 0])) > 0.2
    label = side & (np.abs(vertices[:, 2]) < 0.05)
    colours = np.where(label[:, None], [200, 40, 40], [220, 220, 210]).astype(np.uint8)
    vertices = vertices + SIGMA_M * rng.normal(size=vertices.shape)
    up = np.array([0.0, 0.0, 1.0])
    result = SymmetryFinder().find(vertices, triangles, up=up, sigma_m=SIGMA_M, colours=colours, closed=True)
    assert len(result.continuous) == 1
    assert result.with_colour.continuous == ()
    about_up = [pose for pose in result.with_colour.discrete if abs(pose[2, 2] - 1.0) < 0.01]
    assert len(about_up) == 3


def test_cielab_has_white_black_and_primaries_where_they_are() -> None:
    srgb = np.array([[255.0, 255.0, 255.0], [0.0, 0.0, 0.0], [255.0, 0.0, 0.0], [0.0, 0.0, 255.0]])
    expected = [[100.0, 0.0, 0.0], [0.0, 0.0, 0.0], [53.24, 80.09, 67.20], [32.30, 79.19, -107.86]]
    np.testing.assert_allclose(cielab(srgb), expected, atol=0.1)


def test_bop_entries_hold_the_symmetries_in_the_frame_and_unit_of_the_model() -> None:
    vertices, triangles, up = noisy(SHAPES["cylinder"][0])
    result = of_shape("cylinder")
    object_from_mesh = se3.exp(np.array([0.3, 0.1, -0.4, 0.1, -0.2, 0.7]))
    entries = symmetry_entries(result.discrete, [(a.direction, a.point_m) for a in result.continuous], object_from_mesh)
    vertices_mm = 1000.0 * se3.transform(se3.inverse(object_from_mesh), vertices)
    (axis,) = entries["symmetries_continuous"]
    direction, offset = np.array(axis["axis"]), np.array(axis["offset"])
    turn = np.asarray(trimesh.transformations.rotation_matrix(0.7, direction, offset))
    (flip,) = (np.reshape(numbers, (4, 4)) for numbers in entries["symmetries_discrete"])
    for pose in (turn, flip):
        away_mm = distances(vertices_mm, triangles, se3.transform(pose, vertices_mm))
        assert np.mean(away_mm > 1000.0 * result.tolerance_m) < 0.01
    assert abs(direction @ object_from_mesh[:3, :3].T @ up) > np.cos(np.radians(1.0))
    assert symmetry_entries((), (), np.eye(4)) == {}
