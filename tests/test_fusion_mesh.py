"""What is done to a fused mesh: closing it on its table, smoothing, and wrapping images around it."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import tabletop
import trimesh
from run_builders import model_of
from tabletop import BALL, BRICK, PLATE, POSES, edge_uses

from modeler import se3
from modeler.export.mesh import PIECE, textured
from modeler.fusion import Fuser, FusionVolume, meshing, watertight
from modeler.types import Array, Plane

VOXEL_M = 0.0025
FUSER = Fuser(voxel_m=VOXEL_M)


def plane(camera_from_model: Array, height_m: float = -BRICK.half_m[2]) -> Plane:
    """Return a level plane of the model frame as a camera sees it."""
    normal = camera_from_model[:3, 2]
    return Plane(normal, float(-normal @ (camera_from_model[:3, 3] + height_m * normal)), 0.005, 0.001)


def volume_of(planes: list[Plane], object_from_model: Array | None = None) -> FusionVolume:
    views = tabletop.views(BRICK, POSES)
    views = {k: replace(view, plane=planes[k]) for k, view in views.items()}
    return FUSER.volume(views, tabletop.trajectory(POSES, object_from_model))


def support_planes_of(volume: FusionVolume) -> Array:
    return watertight.support_planes(volume.views, volume.grid.corners_m, volume.tau_m)


def test_a_watertight_model_stands_on_its_table(rng: np.random.Generator) -> None:
    object_from_model = se3.exp(rng.normal(size=6) * [1, 1, 1, 0.1, 0.1, 0.1])
    model = volume_of([plane(pose) for pose in POSES], object_from_model).model(watertight=True)
    mesh = trimesh.Trimesh(model.vertices_m, model.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(8.0 * np.prod(BRICK.half_m), rel=0.01)
    vertices_m = se3.transform(se3.inverse(object_from_model), model.vertices_m)
    under = (np.abs(vertices_m[:, :2]) < 0.04).all(axis=1) & (vertices_m[:, 2] < 0.0)
    assert (model.vertex_views[under] == 0).all()
    np.testing.assert_allclose(vertices_m[under, 2], -BRICK.half_m[2], atol=0.5 * VOXEL_M)
    assert vertices_m[:, 2].min() > -BRICK.half_m[2] - 0.25 * VOXEL_M  # smoothing rounds edges


def test_planes_that_are_alike_are_one_table_and_one_view_makes_none() -> None:
    rng = np.random.default_rng(0)
    planes = [plane(pose, -BRICK.half_m[2] + rng.normal(0.0, 3e-4)) for pose in POSES]
    (table,) = support_planes_of(volume_of(planes))
    np.testing.assert_allclose(table, [0.0, 0.0, 1.0, BRICK.half_m[2]], atol=3e-4)
    wrong = replace(planes[5], offset_m=planes[5].offset_m - 0.03)
    (same,) = support_planes_of(volume_of([*planes[:5], wrong, *planes[6:]]))
    np.testing.assert_allclose(same, table, atol=3e-4)


def test_an_object_that_lay_two_ways_stood_on_two_tables() -> None:
    on_end = [
        Plane(pose[:3, 0], float(-pose[:3, 0] @ (pose[:3, 3] - 0.07 * pose[:3, 0])), 0.005, 1e-3) for pose in POSES
    ]
    found = support_planes_of(volume_of([plane(pose) if k < 9 else on_end[k] for k, pose in enumerate(POSES)]))
    np.testing.assert_allclose(found, [[0.0, 0.0, 1.0, 0.04], [1.0, 0.0, 0.0, 0.07]], atol=1e-9)


def test_what_reaches_below_a_plane_does_not_stand_on_it() -> None:
    volume = volume_of([plane(pose, -0.02) for pose in POSES])
    assert len(support_planes_of(volume)) == 0
    low_m = volume.model(watertight=True).vertices_m[:, 2].min()
    assert low_m < -0.035


@pytest.mark.parametrize("body", [BALL, BRICK, PLATE], ids=("ball", "brick", "plate"))
def test_a_watertight_model_is_closed_and_marks_what_it_made_up(body):
    views, trajectory = tabletop.views(body, POSES), tabletop.trajectory(POSES)
    model = FUSER.volume(views, trajectory).model(watertight=True)
    mesh = trimesh.Trimesh(model.vertices_m, model.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert np.array_equal(edge_uses(model.triangles), np.ones((len(mesh.edges_unique), 2)))
    assert mesh.body_count == 1
    made_up = model.vertex_views == 0
    assert np.isinf(model.vertex_sigmas_m[made_up]).all()
    assert np.quantile(np.abs(body.distance(model.vertices_m[~made_up])), 0.95) < 0.5 * VOXEL_M
    assert np.abs(body.distance(model.vertices_m)).max() < 0.025
    if body is BRICK:  # its bottom was made up, and lies where it is
        core = (np.abs(model.vertices_m[:, :2]) < 0.04).all(axis=1) & (model.vertices_m[:, 2] < 0.0)
        assert made_up[core].all()
        assert np.abs(model.vertices_m[core, 2] + BRICK.half_m[2]).max() < 3.0 * VOXEL_M
        assert mesh.volume == pytest.approx(8.0 * np.prod(BRICK.half_m), rel=0.06)


@pytest.mark.parametrize("off", [0, 3])
def test_one_view_whose_pose_is_off_does_not_hollow_a_watertight_model(off):
    body, poses = tabletop.Box((0.05, 0.04, 0.07)), tabletop.turntable(14, tilt_deg=0.0)  # neither end is seen
    trajectory = tabletop.trajectory(poses)
    trajectory[off] = trajectory[off] @ se3.translation(np.array([0.0, 0.0, 0.03]))
    views = {k: tabletop.view(body, pose, k, table=False) for k, pose in enumerate(poses)}
    model = FUSER.volume(views, trajectory).model(watertight=True)
    volume = trimesh.Trimesh(model.vertices_m, model.triangles, process=False).volume
    assert volume == pytest.approx(8.0 * np.prod(body.half_m), rel=0.05)


# Smoothing of meshes: where views know the surface badly, and along the seam with what is made up.

RADIUS_M, NOISE_M = 0.05, 0.0004
ICOSPHERE = trimesh.creation.icosphere(5, RADIUS_M)
TRIANGLES = np.asarray(ICOSPHERE.faces, dtype=np.int64)
MEANS = meshing.neighbour_means(TRIANGLES, len(ICOSPHERE.vertices))
EDGE_M = float(np.mean(ICOSPHERE.edges_unique_length))


def rough(rng: np.random.Generator) -> Array:
    """Return the ball's vertices, off along their normals."""
    return np.asarray(ICOSPHERE.vertices * (1.0 + rng.normal(0.0, NOISE_M / RADIUS_M, (len(ICOSPHERE.vertices), 1))))


def off_m(vertices_m: Array) -> Array:
    return np.linalg.norm(vertices_m, axis=1) - RADIUS_M


def test_only_vertices_asked_for_are_smoothed_and_nothing_shrinks(rng: np.random.Generator) -> None:
    vertices_m = rough(rng)
    before_m = vertices_m.copy()
    only = vertices_m[:, 2] > 0.0
    smooth_m = meshing.taubin_smoothed(vertices_m, MEANS, meshing.WEAK_PASSES, only)
    np.testing.assert_array_equal(smooth_m[~only], before_m[~only])
    np.testing.assert_array_equal(vertices_m, before_m)
    assert off_m(smooth_m[only]).std() < 0.5 * off_m(before_m[only]).std()
    assert abs(off_m(smooth_m[only]).mean()) < 1e-3 * RADIUS_M
    everywhere_m = meshing.taubin_smoothed(vertices_m, MEANS, 3)
    np.testing.assert_allclose(
        meshing.taubin_smoothed(vertices_m, MEANS, 3, np.ones_like(only)), everywhere_m, atol=1e-12
    )


CUBE = trimesh.creation.box((0.1, 0.1, 0.1)).subdivide().subdivide().subdivide().subdivide().subdivide()


def bumps(places_m: Array, rng: np.random.Generator) -> Array:
    """Return heights (n,) of waves several triangles long, of root mean square 0.2 mm."""
    heights = np.zeros(len(places_m))
    for _ in range(40):
        wave = rng.normal(0.0, 2.0 * np.pi / 0.02, 3)
        heights += np.cos(places_m @ wave + rng.uniform(0.0, 2.0 * np.pi))
    return 2e-4 * heights / heights.std()


def bumpy_cube(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the cube's vertices off by bumps along the normals, and the distance of each from the cube's edges."""
    vertices_m = CUBE.vertices + bumps(np.asarray(CUBE.vertices), rng)[:, None] * CUBE.vertex_normals
    return np.asarray(vertices_m), 0.05 - np.sort(np.abs(CUBE.vertices), axis=1)[:, 1]


def cube_distance_m(vertices_m: Array) -> Array:
    return np.abs(np.abs(vertices_m).max(axis=1) - 0.05)


def test_flat_gets_flat_edges_stay_and_no_vertex_moves_beyond_its_limit(rng: np.random.Generator) -> None:
    vertices_m, edge_m = bumpy_cube(rng)
    limits_m = np.full(len(vertices_m), 4e-4)
    smooth_m = meshing.without_relief(vertices_m, CUBE.faces, limits_m)
    assert np.linalg.norm(smooth_m - vertices_m, axis=1).max() <= 4e-4 * (1.0 + 1e-12)
    face, edge = edge_m > 0.01, edge_m < 1e-9
    assert np.mean(cube_distance_m(smooth_m[face]) ** 2) < 0.25 * np.mean(cube_distance_m(vertices_m[face]) ** 2)
    rounded_m = meshing.laplacian_smoothed(
        vertices_m, meshing.neighbour_means(CUBE.faces, len(vertices_m)), np.ones(len(vertices_m), dtype=bool), 5
    )
    assert cube_distance_m(smooth_m[edge]).mean() < 1.2 * cube_distance_m(vertices_m[edge]).mean()
    assert cube_distance_m(rounded_m[edge]).mean() > 2.0 * cube_distance_m(vertices_m[edge]).mean()
    normals, true = (meshing.normals_of(of, CUBE.faces)[face] for of in (smooth_m, np.asarray(CUBE.vertices)))
    assert np.median(np.arccos(np.clip(np.sum(normals * true, axis=1), -1.0, 1.0))) < np.radians(2.0)


def test_rounded_surface_gets_smooth_not_faceted(rng: np.random.Generator) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    vertices_m = ball.vertices * (1.0 + bumps(np.asarray(ball.vertices), rng) / 0.05)[:, None]
    smooth_m = meshing.without_relief(vertices_m, ball.faces, np.full(len(vertices_m), 4e-4))

    def errors_deg(of_m: Array) -> Array:
        cosines = np.sum(meshing.normals_of(of_m, ball.faces) * ball.vertices / 0.05, axis=1)
        return np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))

    assert np.median(errors_deg(smooth_m)) < 0.4 * np.median(errors_deg(vertices_m))
    assert np.quantile(errors_deg(smooth_m), 0.95) < 0.5 * np.quantile(errors_deg(vertices_m), 0.95)
    assert np.std(np.linalg.norm(smooth_m, axis=1)) < 2e-4
    turns = trimesh.Trimesh(smooth_m, ball.faces, process=False).face_adjacency_angles
    assert np.quantile(turns, 0.99) < 4.0 * np.median(turns)


def test_smoothing_moves_with_the_mesh_and_leaves_what_is_sure_or_smooth(rng: np.random.Generator) -> None:
    vertices_m, edge_m = bumpy_cube(rng)
    limits_m = np.where(edge_m > 0.02, 2e-4, 0.0)
    smooth_m = meshing.without_relief(vertices_m, CUBE.faces, limits_m)
    np.testing.assert_array_equal(smooth_m[limits_m == 0.0], vertices_m[limits_m == 0.0])
    moved = se3.exp(np.array([0.4, -0.7, 0.3, 0.1, -0.2, 0.5]))
    np.testing.assert_allclose(
        meshing.without_relief(se3.transform(moved, vertices_m), CUBE.faces, limits_m),
        se3.transform(moved, smooth_m),
        atol=1e-9,
    )
    exact_m = np.asarray(CUBE.vertices)
    np.testing.assert_allclose(meshing.without_relief(exact_m, CUBE.faces, limits_m), exact_m, atol=1e-12)
    nothing = np.zeros((0, 3), dtype=np.int64)
    np.testing.assert_array_equal(meshing.without_relief(exact_m, nothing, limits_m), exact_m)


def test_pieces_stay_where_enough_of_them_is_confirmed() -> None:
    """Two spheres, of which the upper half of one is confirmed."""
    vertices_m = np.concatenate([ICOSPHERE.vertices, ICOSPHERE.vertices + np.eye(3)[0]])
    triangles = np.concatenate([TRIANGLES, TRIANGLES + len(ICOSPHERE.vertices)])
    confirmed = (np.arange(len(vertices_m)) >= len(ICOSPHERE.vertices)) & (vertices_m[:, 2] > 0.0)
    half_m2 = 2.0 * np.pi * RADIUS_M**2
    second = np.arange(len(triangles)) >= len(TRIANGLES)
    for share, kept in ((0.8, second), (1.0, np.zeros_like(second))):
        found = meshing.confirmed_pieces(vertices_m, triangles, confirmed, share * half_m2)
        np.testing.assert_array_equal(found, kept)
    assert not len(meshing.confirmed_pieces(vertices_m, triangles[:0], confirmed, half_m2))


def test_grown_marks_reach_as_many_rings_as_asked() -> None:
    one = np.zeros(len(ICOSPHERE.vertices), dtype=bool)
    one[0] = True
    np.testing.assert_array_equal(meshing.dilated(one, TRIANGLES, 0), one)
    ring = meshing.dilated(one, TRIANGLES, 1)
    assert set(np.flatnonzero(ring)) == {0, *ICOSPHERE.vertex_neighbors[0]}
    np.testing.assert_array_equal(meshing.dilated(one, TRIANGLES, 2), meshing.dilated(ring, TRIANGLES, 1))


@pytest.mark.parametrize("weak_above_m", [np.inf, 0.03])
def test_crumbs_along_the_seam_and_where_views_know_little_are_smoothed(
    rng: np.random.Generator, weak_above_m: float
) -> None:
    """The upper half was seen, with crumbs along the equator."""
    vertices_m = rough(rng)
    crumbs = (np.abs(vertices_m[:, 2]) < 2.0 * EDGE_M) & (rng.random(len(vertices_m)) < 0.3)
    vertices_m[crumbs] *= 1.0 + 0.5 * EDGE_M / RADIUS_M
    seen_m = vertices_m[vertices_m[:, 2] > 0.0]
    weak = seen_m[:, 2] > weak_above_m
    found_m, triangles, shown = watertight.cleaned(
        vertices_m, TRIANGLES, seen_m, weak, np.zeros(len(seen_m)), voxel_m=0.5 * EDGE_M, passes=0
    )
    np.testing.assert_array_equal(np.sort(triangles), np.sort(TRIANGLES))
    np.testing.assert_array_equal(shown, vertices_m[:, 2] > 0.0)
    equator = np.abs(vertices_m[:, 2]) < EDGE_M
    assert off_m(found_m[equator]).std() < 0.5 * off_m(vertices_m[equator]).std()
    top, between = vertices_m[:, 2] > 0.035, (vertices_m[:, 2] > 0.015) & (vertices_m[:, 2] < 0.025)
    np.testing.assert_array_equal(found_m[between], vertices_m[between])
    if np.isinf(weak_above_m):
        np.testing.assert_array_equal(found_m[top], vertices_m[top])
    else:
        assert off_m(found_m[top]).std() < 0.5 * off_m(vertices_m[top]).std()


# Images wrapped around meshes: in pieces, so that large ones take no longer than many small ones.


def test_a_mesh_of_many_triangles_is_unwrapped_in_pieces_without_overlap() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    model = model_of(ball)
    assert len(model.triangles) > 3 * PIECE

    def paint(points_m: Array, *_: npt.NDArray[np.generic]) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
        rgb = np.rint(127.5 + 2400.0 * points_m).clip(0.0, 255.0).astype(np.uint8)
        return rgb, points_m[:, 0] > 0.0

    wrapped, texture = textured(model, paint, 512)
    corners, before = wrapped.vertices_m[wrapped.triangles], model.vertices_m[model.triangles]
    assert sorted(map(tuple, corners.mean(axis=1).round(9))) == sorted(map(tuple, before.mean(axis=1).round(9)))
    # Were two charts on top of each other, the image would show the colours of one of them only.
    middle = texture.uv[wrapped.triangles].mean(axis=1)
    height, width = texture.image.shape[:2]
    rows, columns = ((1.0 - middle[:, 1]) * height).astype(int), (middle[:, 0] * width).astype(int)
    shown = texture.image[rows, columns].astype(int)
    assert np.abs(shown - paint(corners.mean(axis=1))[0]).max() <= 6
    sides = corners.mean(axis=1)[:, 0]
    away = np.abs(sides) > 3.0 * texture.texel_m
    np.testing.assert_array_equal(texture.seen[rows, columns][away], sides[away] > 0.0)
