"""Fusion: laws of the kernels, and what a fused model owes to the views."""

from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import open3d as o3d
import pytest
import tabletop
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from modeler import se3
from modeler.fusion import Fuser, IncrementalTsdf, conditional_covariances, meshing
from modeler.fusion.depth_views import depth_views, disagreement, posed_views
from modeler.fusion.distance_field import DistanceField, VoxelGrid
from modeler.fusion.support import exposure_gains
from modeler.kernels import marching_cubes, occupancy, point_clouds, tsdf
from modeler.rays import Sensor
from modeler.types import (
    Edge,
    Frame,
    InputError,
    ObjectModel,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    Solution,
    Stated,
)
from sequences.bop import BopSequence

BALL = tabletop.Sphere(0.06)
BRICK = tabletop.Box((0.07, 0.05, 0.04))
PLATE = tabletop.Box((0.06, 0.0025, 0.05))
POSES = tabletop.turntable(14)
VOXEL_M = 0.0025
FUSER = Fuser(voxel_m=VOXEL_M)


def fused(body, *, rng=None, fuser=FUSER, object_from_model=None):
    return fuser.fuse(tabletop.views(body, POSES, rng), tabletop.trajectory(POSES, object_from_model))


@pytest.fixture(scope="module")
def ball():
    return fused(BALL)


@pytest.fixture(scope="module")
def brick():
    return fused(BRICK)


def on_surface(model: ObjectModel, count: int = 20000):
    """Return points drawn evenly on a mesh."""
    rng = np.random.default_rng(1)
    area = meshing.areas_of(model.vertices_m, model.triangles)
    chosen = model.triangles[rng.choice(len(area), size=count, p=area / area.sum())]
    share = rng.dirichlet(np.ones(3), size=count)
    return np.einsum("nk,nkc->nc", share, model.vertices_m[chosen])


def edge_uses(triangles):
    """Return how often each edge of a mesh occurs in each direction, as two counts (e, 2)."""
    directed = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges, number = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)
    forward = directed[:, 0] < directed[:, 1]
    return np.stack([np.bincount(number[forward == side], minlength=len(edges)) for side in (True, False)], axis=1)


def same(one: ObjectModel, other: ObjectModel) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in vars(one))


# The kernels.


def test_thinning_puts_points_of_one_voxel_together(rng):
    points, weights = rng.uniform(0.0, 0.1, (500, 3)), rng.uniform(0.1, 1.0, 500)
    cells, count = point_clouds.voxel_numbers(points, np.zeros(3), 0.02, np.array([5, 5, 4]))
    voxels = np.floor(points / 0.02).astype(int)
    outside = voxels[:, 2] >= 4
    assert np.array_equal(cells == -1, outside)
    kept, numbers = voxels[~outside], cells[~outside]
    assert count == len(np.unique(kept, axis=0)) == numbers.max() + 1
    assert len(np.unique(np.column_stack([kept, numbers]), axis=0)) == count
    sums, totals = point_clouds.voxel_sums(cells, count, weights, points)
    for cell in range(count):
        mine = cells == cell
        np.testing.assert_allclose(sums[cell], weights[mine] @ points[mine])
        np.testing.assert_allclose(totals[cell], weights[mine].sum())


def test_crowd_counts_the_points_in_the_cells_around(rng):
    points = rng.uniform(0.0, 0.1, (200, 3))
    cells = np.floor(points / 0.01).astype(int)
    expected = [(np.abs(cells - cell).max(axis=1) <= 1).sum() for cell in cells]
    assert np.array_equal(point_clouds.neighbour_counts(points, np.zeros(3), 0.01, np.array([10, 10, 10])), expected)


def test_blocks_near_are_those_that_a_cube_around_a_point_touches(rng):
    points, shape, reach_m = rng.uniform(0.0, 1.0, (20, 3)), np.array([9, 10, 11]), 0.03
    found = tsdf.blocks_near(points, np.zeros(3), 0.1, reach_m, shape)
    blocks = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1).reshape(-1, 3)
    gap = np.maximum(blocks * 0.1 - points[:, None], points[:, None] - (blocks + 1) * 0.1).max(axis=2)
    assert np.array_equal(found, blocks[(gap <= reach_m).any(axis=0)])


def test_surfels_of_a_plane_lie_in_it():
    camera = tabletop.CAMERA
    w, h = camera.rays()
    normal = np.array([0.4, -0.3, -0.8]) / np.linalg.norm([0.4, -0.3, -0.8])
    depth_m = (normal @ [0.0, 0.0, 0.8]) / (w * normal[0] + h * normal[1] + normal[2])
    mask = np.ones(depth_m.shape, dtype=bool)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    points, normals = point_clouds.fitted_planes(depth_m.astype(np.float32), np.argwhere(mask), mask, lens, 1e-5, 5.0)
    np.testing.assert_allclose((points - [0.0, 0.0, 0.8]) @ normal, 0.0, atol=1e-6)
    assert np.degrees(np.arccos((normals @ normal).clip(-1, 1))).max() < 1.5  # it leans to the camera a little


def test_a_pixel_that_hangs_in_the_air_has_no_surfel():
    depth_m = np.full((9, 9), 0.8, dtype=np.float32)
    depth_m[4, 4] = 0.75
    _, normals = point_clouds.fitted_planes(
        depth_m, np.array([[4, 4], [2, 2]]), depth_m > 0, np.array([200.0, 200.0, 4.0, 4.0]), 1e-3, 5.0
    )
    assert np.array_equal(np.any(normals != 0.0, axis=1), [False, True])


def naive_side(votes, remaining, tau_m):
    """Twin of `tsdf.dominant_vote`."""
    score = {k: votes[k][1] * (1.01 - abs(votes[k][0]) / tau_m) for k in remaining}
    best = max(remaining, key=lambda k: score[k])
    if votes[best][0] >= 0:
        return best
    rivals = [k for k in remaining if votes[k][0] > 0 and votes[k][2] @ votes[best][2] < tsdf.SAME_SIDE]
    rivals = [k for k in rivals if score[k] > 0.3 * score[best]]
    return max(rivals, key=lambda k: score[k], default=best)


def naive_wall(voxel, vote, other, views):
    """Return whether a vote is for surface that hides a voxel from the view of another vote."""
    index, _, poses, intrinsics, points, normals, _ = views
    along, _, normal, point, f = other
    camera = -poses[vote[4], :, :3].T @ poses[vote[4], :, 3]
    if along >= 0 or normal @ (camera - point) <= 0:
        return False
    way = camera - voxel
    crossing = voxel + way * (normal @ (point - voxel)) / (normal @ way)
    x, y, z = poses[f, :, :3] @ crossing + poses[f, :, 3]
    column, row = round(intrinsics[f, 0] * x / z + intrinsics[f, 2]), round(intrinsics[f, 1] * y / z + intrinsics[f, 3])
    if not (0 <= row < index.shape[1] and 0 <= column < index.shape[2]):
        return False
    n = index[f, row, column]
    return n >= 0 and normals[n] @ normal > tsdf.SAME_SIDE and abs(normals[n] @ (crossing - points[n])) < -along


def naive_integrate(voxels, tau_m, empty_weight, views):
    """Twin of `tsdf.integrate` for single voxels (n, 3)."""
    index, free_m, poses, intrinsics, points, normals, weights = views
    values, totals = np.zeros(len(voxels)), np.zeros(len(voxels))
    for number, voxel in enumerate(voxels):
        votes, emptiness = [], 0.0
        for f in range(len(index)):
            x, y, z = poses[f, :, :3] @ voxel + poses[f, :, 3]
            column = round(intrinsics[f, 0] * x / z + intrinsics[f, 2])
            row = round(intrinsics[f, 1] * y / z + intrinsics[f, 3])
            if not (0 <= row < index.shape[1] and 0 <= column < index.shape[2]):
                continue
            n = index[f, row, column]
            along = normals[n] @ (voxel - points[n]) if n >= 0 else 2 * tau_m
            if abs(along) <= tau_m:
                votes.append((along, weights[n] * min(1.0, 1.5 * (1 + along / tau_m) + 1e-3), normals[n], points[n], f))
            elif along > 0 and z < free_m[f, row, column] - tau_m:
                emptiness += empty_weight
        remaining = list(range(len(votes)))
        values[number], totals[number] = (tau_m, emptiness) if emptiness else (0.0, 0.0)
        while remaining:
            best = naive_side(votes, remaining, tau_m)
            side = [k for k in remaining if votes[k][2] @ votes[best][2] > tsdf.SAME_SIDE]
            values[number], totals[number] = tau_m * emptiness, emptiness + sum(votes[k][1] for k in side)
            values[number] = (values[number] + sum(votes[k][1] * votes[k][0] for k in side)) / totals[number]
            against = [k for k in remaining if k not in side and naive_wall(voxel, votes[best], votes[k], views)]
            if len(against) < tsdf.MAJORITY * len(side):
                break
            remaining = [k for k in remaining if k not in side]
            values[number], totals[number] = tau_m, emptiness
    return values, totals


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("one_mind", "turned_rad"), [(0.0, 1.0), (0.9, 0.4)])
def test_integration_is_its_twin(seed, one_mind, turned_rad, monkeypatch):
    rng = np.random.default_rng(seed)
    frames, height, width, count = 12, 12, 14, 156
    own = count // frames  # points of a view
    poses = np.stack(
        [
            (se3.translation(np.array([0, 0, 0.5])) @ se3.exp(rng.normal(0, turned_rad, 6) * [1, 1, 1, 0, 0, 0]))[:3]
            for _ in range(frames)
        ]
    )
    normals = rng.normal(size=(count, 3))
    normals[rng.random(count) < one_mind] = [0.1, 0.1, -1.0]
    views = (
        np.stack(
            [
                np.where(rng.random((height, width)) < 0.1, -1, rng.integers(own * k, own * (k + 1), (height, width)))
                for k in range(frames)
            ]
        ).astype(np.int32),
        rng.uniform(0.4, 0.7, (frames, height, width)).astype(np.float32),
        poses,
        np.tile([150.0, 160.0, 6.5, 5.5], (frames, 1)),
        rng.uniform(-0.02, 0.02, (count, 3)),
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        rng.uniform(0.01, 1.0, count),
    )
    blocks = rng.permutation(np.stack(np.meshgrid(*[np.arange(2)] * 3), axis=-1).reshape(-1, 3))
    origin, voxel_m, tau_m = np.full(3, -0.02), 0.04 / (2 * tsdf.SIDE), 0.015
    values, totals = tsdf.integrate(blocks, origin, voxel_m, tau_m, 0.3, np.arange(count) // own, *views)
    inner = np.stack(np.meshgrid(*[np.arange(tsdf.SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    voxels = origin + ((blocks[:, None] * tsdf.SIDE + inner).reshape(-1, 3) + 0.5) * voxel_m
    expected_values, expected_totals = naive_integrate(voxels, tau_m, 0.3, views)
    assert 0.0 < (expected_totals > 0.0).mean() <= 1.0
    np.testing.assert_allclose(totals.ravel(), expected_totals, rtol=1e-5)
    np.testing.assert_allclose(values.ravel(), expected_values, rtol=1e-4, atol=1e-8)
    monkeypatch.setattr(tsdf, "MAJORITY", 1000)  # of the twin alone
    if one_mind:  # some votes were rejected
        assert np.any(naive_integrate(voxels, tau_m, 0.3, views)[1] != expected_totals)


# The zero level.


def level_of(values):
    weights = np.zeros(values.shape, dtype=np.float32)
    weights[1:-1, 1:-1, 1:-1] = 1.0
    return marching_cubes.extract(values.astype(np.float32), weights, np.argwhere(weights > 0))


def test_every_crossed_edge_of_a_cell_belongs_to_one_piece_of_at_least_three():
    for case, pieces in enumerate(marching_cubes.PIECES):
        for edge, piece in enumerate(pieces):
            axis, a, b = edge // 4, edge >> 1 & 1, edge & 1
            start = int(np.insert([a, b], axis, 0) @ [4, 2, 1])
            crossed = (case >> start & 1) != (case >> (start + [4, 2, 1][axis]) & 1)
            assert (piece >= 0) == crossed
        assert all((pieces == piece).sum() >= 3 for piece in range(pieces.max() + 1))


def test_the_zero_level_of_a_ball_is_a_sphere_seen_from_outside():
    grid = np.stack(np.meshgrid(*[np.arange(40.0)] * 3, indexing="ij"), axis=-1)
    vertices, triangles = level_of(np.linalg.norm(grid - 19.3, axis=-1) - 12.4)
    assert np.abs(np.linalg.norm(vertices - 19.3, axis=1) - 12.4).max() < 0.05
    assert np.array_equal(edge_uses(triangles), np.ones((len(triangles) * 3 // 2, 2)))  # closed, one orientation
    corners = vertices[triangles]
    volume = np.linalg.det(corners).sum() / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 12.4**3, rel=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_the_zero_level_of_any_field_is_closed_inside_the_grid(seed):
    rng = np.random.default_rng(seed)
    values = gaussian_filter(rng.normal(size=(24, 24, 24)), 1.0)
    values[[1, 2, -2, -3]] = values[:, [1, 2, -2, -3]] = values[:, :, [1, 2, -2, -3]] = 1.0
    _, triangles = level_of(values)
    uses = edge_uses(triangles)
    assert len(triangles) > 1000
    assert np.array_equal(uses[:, 0], uses[:, 1])


def test_the_zero_level_stays_open_where_nothing_is_known():
    values = np.broadcast_to(np.arange(16.0) - 7.5, (16, 16, 16)).astype(np.float32)
    weights = np.zeros(values.shape, dtype=np.float32)
    weights[2:9, 3:13, 1:15] = 1.0
    vertices, triangles = marching_cubes.extract(values, weights, np.argwhere(weights > 0))
    assert np.allclose(vertices[:, 2], 7.5)
    used = vertices[np.unique(triangles)]
    assert np.array_equal(used.min(axis=0), [2.5, 3.5, 7.5])
    assert np.array_equal(used.max(axis=0), [7.5, 11.5, 7.5])


def test_gaps_are_filled_but_borders_do_not_grow():
    values = np.zeros((14, 14, 14), dtype=np.float32) + 0.5
    weights = np.zeros_like(values)
    weights[2:12, 2:12, 2:12] = 1.0
    weights[6, 6, 6] = 0.0
    cells, means = marching_cubes.fill(values, weights, np.argwhere(weights > 0), 15)
    assert np.array_equal(cells, [[6, 6, 6]])
    assert means == pytest.approx([0.5])


# The model.


def test_the_mesh_is_the_surface_that_was_seen(ball, brick):
    for body, model in ((BALL, ball), (BRICK, brick)):
        off = np.abs(body.distance(on_surface(model)))
        assert np.quantile(off, 0.95) < 0.25 * VOXEL_M
        assert off.max() < 1.5 * VOXEL_M
        seen = tabletop.visible(body, POSES)
        assert (KDTree(on_surface(model, 60000)).query(seen)[0] < VOXEL_M).mean() > 0.97


def test_the_mesh_is_a_clean_one(ball, brick):
    for model in (ball, brick):
        uses = edge_uses(model.triangles)
        assert uses.max() == 1  # one orientation, no edge of three triangles
        assert np.array_equal(np.unique(model.triangles), np.arange(len(model.vertices_m)))
        assert np.isfinite(model.vertices_m).all()
        np.testing.assert_allclose(np.linalg.norm(model.vertex_normals, axis=1), 1.0)


def test_normals_point_outwards(ball):
    outwards = ball.vertices_m / np.linalg.norm(ball.vertices_m, axis=1, keepdims=True)
    assert np.quantile(np.sum(ball.vertex_normals * outwards, axis=1), 0.02) > 0.9
    outwards = ball.points_m / np.linalg.norm(ball.points_m, axis=1, keepdims=True)
    assert np.sum(ball.normals * outwards, axis=1).min() > 0.9


def test_there_is_no_table_and_the_unseen_bottom_is_open(brick):
    x, y, z = brick.vertices_m.T
    assert z.min() > -BRICK.depth_m - 1.5 * VOXEL_M
    under = (np.abs(x) < 0.06) & (np.abs(y) < 0.04) & (z < -0.02)
    assert not under.any()
    assert np.abs(BRICK.distance(brick.points_m)).max() < VOXEL_M


def test_fusing_averages_the_noise_of_the_views(rng):
    model = fused(BRICK, rng=rng)
    mesh, cloud = (BRICK.distance(points) for points in (on_surface(model), model.points_m))
    assert np.sqrt(np.mean(mesh**2)) < 0.5e-3  # half of a pixel's noise
    assert np.sqrt(np.mean(cloud**2)) < 1e-3


CORNERS_M = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])


def disagreement_m(views, trajectory):
    pairs = posed_views(views, trajectory)
    found = disagreement(depth_views(pairs, CORNERS_M, margin_px=2, min_cosine=0.15, edge_weight=0.1), 0.02)
    return float("nan") if found is None else found[0]


def test_views_asked_in_batches_disagree_by_the_same(rng, monkeypatch):
    trajectory, noisy = tabletop.trajectory(POSES), tabletop.views(BRICK, POSES, rng)
    at_once = disagreement_m(noisy, trajectory)
    monkeypatch.setattr("modeler.fusion.depth_views.BATCH", 100 * len(POSES))
    assert disagreement_m(noisy, trajectory) == at_once


def test_views_disagree_by_their_noise_and_the_error_of_their_poses(rng):
    trajectory = tabletop.trajectory(POSES)
    exact, noisy = tabletop.views(BRICK, POSES), tabletop.views(BRICK, POSES, rng)
    assert disagreement_m(exact, trajectory) < 1e-4
    # Two pixels with 1 mm along the ray each: less by the cosine along the normal.
    assert 0.4e-3 < disagreement_m(noisy, trajectory) < np.sqrt(2.0) * 1e-3
    off = {k: se3.translation(rng.normal(0.0, 3e-3, 3)) @ pose for k, pose in trajectory.items()}
    assert 2e-3 < disagreement_m(exact, off) < 6e-3
    assert np.isnan(disagreement_m({0: exact[0]}, trajectory))  # nobody to disagree with


def test_surface_survives_poses_that_are_off_by_more_than_the_noise(rng):
    off = {k: se3.translation(rng.normal(0.0, 3e-3, 3)) @ pose for k, pose in tabletop.trajectory(POSES).items()}
    model = FUSER.fuse(tabletop.views(BALL, POSES), off)
    seen = tabletop.visible(BALL, POSES)
    assert (KDTree(on_surface(model, 60000)).query(seen)[0] < 6e-3).mean() > 0.95


def test_a_plate_thinner_than_the_band_keeps_both_sides():
    model = fused(PLATE)
    points = on_surface(model)
    middle = (np.abs(points[:, 0]) < 0.05) & (np.abs(points[:, 2]) < 0.04)
    for side in (-1.0, 1.0):
        face = points[middle & (points[:, 1] * side > 0.0), 1] * side
        assert len(face) > 5000
        assert face.mean() == pytest.approx(PLATE.half_m[1], abs=0.1 * VOXEL_M)


def haunted(ghost_depth_m: float = 0.77) -> dict[int, RayImage]:
    """Return views of the ball; in the first one a patch that is not there hangs beside it, as part of the object."""
    views = tabletop.views(BALL, POSES)
    frame = views[0].frame
    assert frame.mask is not None
    depth_m, mask = frame.depth_m.copy(), frame.mask.copy()
    depth_m[60:72, 121:133], mask[60:72, 121:133] = ghost_depth_m, True
    ghostly = replace(frame, depth_m=depth_m, mask=mask)
    pixels, normals = np.argwhere(mask), np.tile([0.0, 0.0, -1.0], (mask.sum(), 1))
    normals[frame.mask[tuple(pixels.T)]] = views[0].normals
    return views | {0: tabletop.seen(ghostly, normals, views[0].sigma_r_m)}


def test_what_nobody_saw_is_trimmed_where_it_curls_at_a_border_and_closes_gaps_however_it_lies():
    """A sheet that rolls up along two sides, one seen and one not, with a bump in the middle that nobody saw."""
    x, y = np.meshgrid(np.arange(-30.0, 31.0), np.arange(41.0), indexing="ij")
    over = np.maximum(np.abs(x) - 20.0, 0.0) / 6.0  # rad of a roll of radius 6 beyond x = ±20
    bump = np.maximum(4.0 - 2.0 * np.hypot(x, y - 20.0), 0.0)
    vertices = np.stack(
        [np.clip(x, -20.0, 20.0) + np.sign(x) * 6.0 * np.sin(over), y, bump - 6.0 * (1.0 - np.cos(over))], axis=-1
    ).reshape(-1, 3)
    corner = np.arange(len(vertices)).reshape(x.shape)
    a, b, c, d = (corner[i : 60 + i, j : 40 + j].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    normals = meshing.normals_of(vertices, triangles)
    x, bump = x.ravel(), bump.ravel()
    seen = (x < 20.0) & (bump == 0.0)
    loose = meshing.folded(vertices, normals, seen, ~seen)
    assert loose[(bump > 0.5) & (bump < 4.0)].all()
    assert not loose[seen].any()
    left = meshing.without_loose_border(np.ones(len(x), dtype=bool), loose, triangles, 20)
    assert left.all()  # no border of what is marked: the whole mesh is
    left = meshing.without_loose_border(x < 30.0, loose, triangles, 20)
    assert left[x < 22.0].all()
    assert not left[x > 25.0].any()
    assert np.array_equal(
        meshing.without_loose_border(x < 30.0, loose, triangles, 3)[x < 30.0], (left | (x < 27.0))[x < 30.0]
    )


def test_a_few_wrong_pixels_at_a_flat_angle_dig_no_pit():
    # One view sees the brick's top at a flat angle, and some of it as a patch that faces it and dives into the brick.
    poses = [*POSES, tabletop.turntable(1, tilt_deg=10.0)[0]]
    views, trajectory = tabletop.views(BRICK, poses), tabletop.trajectory(poses)
    last = views[14]
    model_m = se3.transform(trajectory[14], last.points_m)
    off = (model_m[:, 2] > BRICK.half_m[2] - 1e-6) & (np.abs(model_m[:, :2]) < 0.02).all(axis=1)
    assert np.count_nonzero(off) > 10
    rays = last.points_m / last.points_m[:, 2:]
    points_m = np.where(off[:, None], last.points_m[off, 2].max() * rays, last.points_m)
    depth_m = last.frame.depth_m.copy()
    depth_m[tuple(last.pixels.T)] = points_m[:, 2]
    normals = np.where(off[:, None], [0.0, 0.0, -1.0], last.normals)
    views[14] = replace(last, frame=replace(last.frame, depth_m=depth_m), points_m=points_m, normals=normals)
    model = FUSER.fuse(views, trajectory)
    top = (model.vertices_m[:, 2] > 0.0) & (np.abs(model.vertices_m[:, :2]) < 0.03).all(axis=1)
    assert np.abs(BRICK.distance(model.vertices_m[top])).max() < 0.2 * VOXEL_M


def test_what_other_views_see_through_is_carved(ball):
    trajectory = tabletop.trajectory(POSES)
    blind = replace(FUSER, empty_weight=0.0).fuse(haunted(), trajectory)
    assert BALL.distance(blind.vertices_m).max() > 0.02
    carved = FUSER.fuse(haunted(), trajectory)
    assert BALL.distance(carved.vertices_m).max() < 1.5 * VOXEL_M
    assert BALL.distance(carved.points_m).max() < 1.5 * VOXEL_M


def test_colours_are_those_of_the_surface(brick):
    assert brick.vertex_colours is not None
    assert brick.colours is not None
    for points, colours in ((brick.vertices_m, brick.vertex_colours), (brick.points_m, brick.colours)):
        top = (np.abs(points[:, 0]) < 0.05) & (np.abs(points[:, 1]) < 0.03) & (points[:, 2] > 0.03)
        assert top.sum() > 100
        assert np.abs(colours[top].astype(int) - [128, 128, 228]).max() <= 2


def test_without_colour_the_model_has_none(ball):
    views = {
        k: replace(view, frame=replace(view.frame, colour=None)) for k, view in tabletop.views(BALL, POSES).items()
    }
    model = FUSER.fuse(views, tabletop.trajectory(POSES))
    assert model.colours is None
    assert model.vertex_colours is None
    assert np.array_equal(model.vertices_m, ball.vertices_m)


def test_the_model_moves_with_the_object_frame(ball):
    object_from_model = se3.exp(np.array([0.4, -0.7, 0.3, 0.1, -0.2, 0.5]))
    moved = fused(BALL, object_from_model=object_from_model)
    back = se3.transform(se3.inverse(object_from_model), on_surface(moved))
    assert np.quantile(np.abs(BALL.distance(back)), 0.95) < 0.25 * VOXEL_M
    assert np.quantile(KDTree(on_surface(ball, 60000)).query(back)[0], 0.99) < VOXEL_M


def test_neither_order_nor_threads_change_a_bit(ball):
    views, trajectory = tabletop.views(BALL, POSES), tabletop.trajectory(POSES)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        again = FUSER.fuse(dict(reversed(views.items())), dict(reversed(trajectory.items())))
    finally:
        numba.set_num_threads(threads)
    assert same(ball, again)


def test_views_without_a_pose_are_left_out():
    views, trajectory = tabletop.views(BALL, POSES[:4]), tabletop.trajectory(POSES[:3])
    assert same(FUSER.fuse(views, trajectory), FUSER.fuse({k: views[k] for k in range(3)}, trajectory))


def test_a_view_that_looks_elsewhere_changes_nothing_and_one_of_nothing_neither():
    views, trajectory = tabletop.views(BALL, POSES[:3]), tabletop.trajectory(POSES[:3])
    frame = replace(views[0].frame, mask=np.zeros_like(views[0].frame.mask))
    blank = tabletop.seen(frame, np.zeros((0, 3)), views[0].sigma_r_m)
    away = trajectory[0] @ se3.exp(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))
    model = FUSER.fuse(views | {7: blank}, trajectory | {7: away})
    assert same(model, FUSER.fuse(views, trajectory))


def test_a_handful_of_pixels_is_no_reason_to_fail():
    view = tabletop.views(BALL, POSES)[0]
    assert view.frame.mask is not None
    mask = np.zeros_like(view.frame.mask)
    mask[tuple(view.pixels[100:103].T)] = True
    few = tabletop.seen(replace(view.frame, mask=mask), view.normals[100:103], view.sigma_r_m)
    model = FUSER.fuse({0: few}, {0: np.eye(4)})
    assert model.triangles.shape == (len(model.triangles), 3)
    assert np.isfinite(model.vertices_m).all()
    assert np.isfinite(IncrementalTsdf(FUSER).updated({0: few}, {0: np.eye(4)}).model().points_m).all()


def test_input_that_cannot_be_fused_is_refused():
    views, trajectory = tabletop.views(BALL, POSES[:2]), tabletop.trajectory(POSES[:2])
    for method in (FUSER.fuse, IncrementalTsdf(FUSER).updated):
        with pytest.raises(InputError, match="nothing to fuse"):
            method(views, {})
        with pytest.raises(InputError, match="nothing to fuse"):
            method({}, trajectory)


@pytest.mark.parametrize("voxel_m", [0.0, -1.0, 1e-300, 1e-9, 1e-6, np.inf, np.nan])
def test_an_absurd_voxel_size_is_refused_before_anything_is_allocated(voxel_m):
    views, trajectory = tabletop.views(BALL, POSES[:2]), tabletop.trajectory(POSES[:2])
    fuser = Fuser(voxel_m=voxel_m)
    for method in (fuser.fuse, IncrementalTsdf(fuser).updated):
        with pytest.raises(InputError, match=r"voxel size .* is out of range: .* give at least [\d.e-]+ m"):
            method(views, trajectory)


@pytest.mark.parametrize("voxel_m", [5e-5, 1.0])
def test_extreme_voxel_sizes_stay_within_the_memory_bound(voxel_m):
    views, trajectory = tabletop.views(BALL, POSES[:2]), tabletop.trajectory(POSES[:2])
    fuser = Fuser(voxel_m=voxel_m, max_voxels=64**3, preview_limit=64**3)
    assert np.prod(fuser.volume(views, trajectory).grid.shape) < 1.5 * 64**3
    fuser.fuse(views, trajectory)
    preview = IncrementalTsdf(fuser).updated(views, trajectory)
    assert preview.sums[..., 0].size <= 64**3
    preview.model()


def test_the_voxels_follow_the_pixels_and_stay_within_their_number(ball):
    views, trajectory = tabletop.views(BALL, POSES), tabletop.trajectory(POSES)

    def spacing(model):
        return np.median(np.linalg.norm(np.diff(model.vertices_m[model.triangles], axis=1), axis=2))

    pixel_m = tabletop.DISTANCE_M / tabletop.CAMERA.fx
    assert spacing(Fuser().fuse(views, trajectory)) / spacing(ball) == pytest.approx(pixel_m / VOXEL_M, rel=0.1)
    assert len(replace(FUSER, max_voxels=20**3).fuse(views, trajectory).vertices_m) < 0.3 * len(ball.vertices_m)


# What is known of each vertex, and of colours.


def test_a_vertex_knows_who_saw_it_and_how_far_off_it_may_be(rng):
    model = fused(BRICK, rng=rng)
    assert model.vertex_views is not None
    assert model.vertex_sigmas_m is not None
    assert np.array_equal(model.vertex_views == 0, ~np.isfinite(model.vertex_sigmas_m))
    flat = np.sort(np.abs(model.vertices_m) - BRICK.half_m, axis=1)[:, 1] < -5e-3  # away from the edges
    seen = flat & (model.vertex_views > 0)
    off = BRICK.distance(model.vertices_m[seen]) / model.vertex_sigmas_m[seen]
    assert 0.4 < np.sqrt(np.mean(off**2)) < 1.3  # smoothing takes some of the noise away
    side = seen & (np.abs(model.vertices_m[:, 2]) < 0.02)
    top = seen & (model.vertices_m[:, 2] > 0.035)
    assert np.median(model.vertex_views[top]) == len(POSES)
    assert 2 <= np.median(model.vertex_views[side]) <= len(POSES) / 2 + 1
    assert np.median(model.vertex_sigmas_m[top]) < np.median(model.vertex_sigmas_m[side])


def test_a_pose_that_is_unsure_counts_less():
    off = {k: pose for k, pose in tabletop.trajectory(POSES).items()}
    off[3] = se3.translation(np.array([0.0, 0.0, 4e-3])) @ off[3]
    views = tabletop.views(BRICK, POSES)
    covariances = {k: np.eye(6) * ((5e-3 if k == 3 else 1e-5) ** 2) for k in off}
    blind, warned = FUSER.fuse(views, off), FUSER.fuse(views, off, covariances)

    def error(model):
        top = (model.vertices_m[:, 2] > 0.035) & (np.abs(model.vertices_m[:, :2]) < [0.06, 0.04]).all(axis=1)
        return np.abs(model.vertices_m[top, 2] - BRICK.half_m[2]).mean()

    assert error(blind) > 1e-4
    assert error(warned) < 0.3 * error(blind)
    alike = FUSER.fuse(views, off, {k: np.zeros((6, 6)) for k in off})
    assert same(alike, blind)


def test_conditional_covariances_do_not_know_of_drift(rng):
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-6

    def edge(target, source, *, accepted=True):
        pose = PoseGaussian(se3.exp(rng.normal(size=6)), covariance)
        return Edge(Posterior(source, target, pose, Outcome.CONVERGED, overlap=0.9), "odometry", accepted, Stated(""))

    edges = [edge(2, 5), edge(5, 6), edge(6, 9, accepted=False), edge(2, 6)]
    solution = Solution(trajectory={k: np.eye(4) for k in (2, 5, 6)}, outliers=(edges[3],))
    own = conditional_covariances(solution, edges)
    assert set(own) == {2, 5, 6}
    np.testing.assert_allclose(own[6], covariance)
    np.testing.assert_allclose(own[2], edges[0].posterior.pose.inverse().covariance)
    both = np.linalg.inv(covariance) + np.linalg.inv(edges[1].posterior.pose.inverse().covariance)
    np.testing.assert_allclose(own[5], np.linalg.inv(both))
    assert conditional_covariances(Solution(trajectory={0: np.eye(4)}), []) == {}


def dimmed(view: RayImage, factor: float) -> RayImage:
    assert view.frame.colour is not None
    return replace(view, frame=replace(view.frame, colour=(view.frame.colour * factor).astype(np.uint8)))


def test_differences_of_exposure_are_evened_out(brick):
    views = {k: dimmed(view, 0.6 if k % 3 == 0 else 0.9) for k, view in tabletop.views(BRICK, POSES).items()}
    model = FUSER.fuse(views, tabletop.trajectory(POSES))
    assert model.vertex_colours is not None
    assert brick.vertex_colours is not None
    ratio = np.log(model.vertex_colours / brick.vertex_colours).mean(axis=1)
    assert np.std(ratio) < 0.03  # against 0.2 between the frames
    assert np.exp(ratio.mean()) == pytest.approx(0.79, abs=0.05)


def test_sharp_views_have_more_say_in_colours_than_blurred_ones(rng):
    def textured(view: RayImage, spread: int) -> RayImage:
        levels = 120 + rng.integers(-spread, spread + 1, view.frame.depth_m.shape)
        return replace(view, frame=replace(view.frame, colour=np.repeat(levels[..., None], 3, axis=2).astype(np.uint8)))

    views = {k: textured(view, 60 if k % 3 else 20) for k, view in tabletop.views(BRICK, POSES).items()}
    seen = depth_views(
        posed_views(views, tabletop.trajectory(POSES)), CORNERS_M, margin_px=2, min_cosine=0.15, edge_weight=0.1
    )
    say = exposure_gains(seen, seen.points_m, seen.normals, tau_m=0.005, near_m=0.003)[:, 3]
    sharp = np.arange(len(POSES)) % 3 > 0
    np.testing.assert_allclose(say[~sharp] / say[sharp].mean(), 20.0 / 60.0, rtol=0.15)


def test_a_view_without_colour_leaves_the_colours_to_others(brick):
    views = tabletop.views(BRICK, POSES)
    views[4] = replace(views[4], frame=replace(views[4].frame, colour=None))
    trajectory = tabletop.trajectory(POSES)
    for model in (FUSER.fuse(views, trajectory), IncrementalTsdf(FUSER).updated(views, trajectory).model()):
        assert model.colours is not None
        top = (np.abs(model.points_m[:, :2]) < [0.05, 0.03]).all(axis=1) & (model.points_m[:, 2] > 0.03)
        assert np.abs(model.colours[top].astype(int) - [128, 128, 228]).max() <= 2


def test_what_stands_right_before_the_background_is_carved():
    # A flap of one view's mask that lies on the table: no view looks through it, but others see the table there.
    views, trajectory = tabletop.views(BRICK, POSES), tabletop.trajectory(POSES)
    frame = views[0].frame
    assert frame.mask is not None
    rows = np.flatnonzero(frame.mask.any(axis=1))
    mask = frame.mask.copy()
    mask[rows[-1] - 4 : rows[-1] + 8, 90:100] = True
    points = tabletop.seen(replace(frame, mask=mask), np.zeros((mask.sum(), 3)), views[0].sigma_r_m)
    normals = np.tile(trajectory[0][2, :3], (mask.sum(), 1))
    normals[frame.mask[tuple(np.argwhere(mask).T)]] = views[0].normals
    views[0] = replace(points, normals=normals)
    model = FUSER.fuse(views, trajectory)
    assert BRICK.distance(views[0].points_m @ trajectory[0][:3, :3].T + trajectory[0][:3, 3]).max() > 0.04
    # Of 40 mm there is left what others see within a margin of two pixels beside the brick, 15 mm on a table seen flat.
    assert BRICK.distance(model.vertices_m).max() < 0.018
    assert BRICK.distance(model.points_m).max() < 0.018


# Closing what nobody saw.


def test_views_find_cells_empty_at_a_surface_or_hidden():
    free_m = np.full((2, 40, 40), 0.8, dtype=np.float32)
    free_m[1] = 0.0
    poses = np.tile(np.eye(4)[:3], (2, 1, 1))
    intrinsics = np.tile([20.0, 20.0, 19.5, 19.5], (2, 1))
    planes = np.array([[np.nan] * 4, [0.0, -1.0, 0.0, 0.1]])  # y points down: the table is 0.1 m below
    shape = np.array([10, 10, 10])
    counts = occupancy.observation_counts(
        np.array([-0.25, -0.25, 0.5]), 0.05, shape, 0.05, free_m, poses, intrinsics, planes
    )
    centres = np.array([-0.25, -0.25, 0.5]) + 0.05 * (np.argwhere(np.ones(shape)) + 0.5)
    below = centres[:, 1] > 0.15
    assert np.array_equal(counts[0].ravel(), (centres[:, 2] < 0.75).astype(int) + below)
    assert np.array_equal(counts[1].ravel(), np.abs(centres[:, 2] - 0.8) < 0.05)
    assert np.array_equal(counts[2].ravel(), centres[:, 2] > 0.85)


def test_the_smallest_surface_across_an_open_tube_is_flat():
    size = 30
    start, fixed = np.ones((size, size, size), dtype=np.float32), np.zeros((size, size, size), dtype=bool)
    x, y, z = np.meshgrid(*[np.arange(size)] * 3, indexing="ij")
    for axis in (x, y, z):
        fixed |= (axis == 0) | (axis == size - 1)
    radius = np.hypot(x - 14.5, y - 14.5)
    wall = (z >= 8) & (z < 24) & (np.abs(radius - 8.0) <= 2.0)
    lid = (z >= 22) & (z < 26) & (radius < 10.0)
    fixed |= wall | lid
    start[(wall & (radius < 8.0)) | (lid & (z < 24) & (radius < 8.0))] = -1.0
    start[~fixed & (radius < 8.0)] = -1.0  # spills out of the open end, as far as it goes
    decided = occupancy.minimal_surface(start, fixed, 600)
    assert np.array_equal(decided[fixed], start[fixed])
    core = radius < 5.0
    assert (decided[core & (z >= 10) & (z < 22)] < -0.5).all()
    assert (decided[core & (z < 6)] > 0.5).all()


def test_a_watertight_model_is_closed_and_marks_what_it_made_up():
    for body in (BALL, BRICK, PLATE):
        views, trajectory = tabletop.views(body, POSES), tabletop.trajectory(POSES)
        model = FUSER.volume(views, trajectory).model(watertight=True)
        mesh = trimesh.Trimesh(model.vertices_m, model.triangles, process=False)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert np.array_equal(edge_uses(model.triangles), np.ones((len(mesh.edges_unique), 2)))
        assert mesh.body_count == 1
        assert model.vertex_views is not None
        assert model.vertex_sigmas_m is not None
        made_up = model.vertex_views == 0
        assert np.isinf(model.vertex_sigmas_m[made_up]).all()
        assert np.quantile(np.abs(body.distance(model.vertices_m[~made_up])), 0.95) < 0.5 * VOXEL_M
        assert np.abs(body.distance(model.vertices_m)).max() < 0.025
    # Of a brick, the bottom was made up, and lies where it is.
    brick = FUSER.volume(tabletop.views(BRICK, POSES), tabletop.trajectory(POSES)).model(watertight=True)
    assert brick.vertex_views is not None
    under = brick.vertices_m[:, 2] < -BRICK.half_m[2] + 1e-3
    core = (np.abs(brick.vertices_m[:, :2]) < 0.04).all(axis=1) & (brick.vertices_m[:, 2] < 0.0)
    assert (brick.vertex_views[core] == 0).all()
    assert np.abs(brick.vertices_m[core, 2] + BRICK.half_m[2]).max() < 3.0 * VOXEL_M
    assert under.any()
    volume = trimesh.Trimesh(brick.vertices_m, brick.triangles, process=False).volume
    assert volume == pytest.approx(8.0 * np.prod(BRICK.half_m), rel=0.06)


@pytest.mark.parametrize("off", [0, 3])
def test_one_view_whose_pose_is_off_does_not_hollow_a_watertight_model(off):
    body, poses = tabletop.Box((0.05, 0.04, 0.07)), tabletop.turntable(14, tilt_deg=0.0)  # neither end is seen
    trajectory = tabletop.trajectory(poses)
    trajectory[off] = trajectory[off] @ se3.translation(np.array([0.0, 0.0, 0.03]))
    views = {k: tabletop.view(body, pose, k, table=False) for k, pose in enumerate(poses)}
    model = FUSER.volume(views, trajectory).model(watertight=True)
    volume = trimesh.Trimesh(model.vertices_m, model.triangles, process=False).volume
    assert volume == pytest.approx(8.0 * np.prod(body.half_m), rel=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_no_edge_of_a_zero_level_has_more_than_two_triangles(seed):
    rng = np.random.default_rng(seed)
    values = gaussian_filter(rng.normal(size=(24, 24, 24)), 0.6).astype(np.float32)
    weights = np.zeros(values.shape, dtype=np.float32)
    weights[1:-1, 1:-1, 1:-1] = 1.0
    field = DistanceField(VoxelGrid(np.zeros(3), 1.0, np.array([6, 6, 6])), values, weights, np.argwhere(weights > 0.0))
    _, torn = marching_cubes.extract(values, weights, field.known)
    assert edge_uses(torn).max() > 1
    _, triangles = meshing.extracted_mesh(field)
    assert edge_uses(triangles).max() == 1


# Rendered sequences with the noise and the flaws of a depth camera.


def tensor(values, kind):
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, dtype=kind))


@pytest.mark.parametrize("name", ["flashlight", "tube"])
def test_bundled_objects_are_fused_within_3_mm(name):
    sequence = BopSequence(Path(__file__).parents[1] / "sequences" / "bundled" / name)
    truth, noise = sequence.truth(), sequence.sensor()
    assert truth is not None
    assert noise is not None
    sensor = Sensor(*noise)
    frames = {frame.index: frame for frame in sequence}
    model = Fuser().fuse(
        {k: sensor.ray_image(frame) for k, frame in frames.items()}, {k: se3.inverse(pose) for k, pose in truth.items()}
    )
    mesh = trimesh.load_mesh(sequence.model_path, process=False)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(mesh.vertices, np.float32), tensor(mesh.faces, np.uint32))
    points = on_surface(model, 50000)
    precision = (scene.compute_distance(tensor(points, np.float32)).numpy() < 3e-3).mean()
    seen = np.concatenate([true_points(frame, truth[k], scene) for k, frame in frames.items()])
    recall = (KDTree(points).query(seen)[0] < 3e-3).mean()
    assert precision > 0.99
    assert recall > 0.99


def true_points(frame: Frame, camera_from_model, scene):
    """Return the points (n, 3) of the true surface at the object's measured pixels, in the model frame."""
    assert frame.mask is not None
    seen = frame.mask & np.isfinite(frame.depth_m)
    w, h = (side[seen] for side in frame.camera.rays())
    model_from_camera = se3.inverse(camera_from_model)
    along = np.stack([w, h, np.ones_like(w)], axis=1) @ model_from_camera[:3, :3].T
    rays = np.concatenate([np.broadcast_to(model_from_camera[:3, 3], along.shape), along], axis=1)
    distance = scene.cast_rays(tensor(rays, np.float32))["t_hit"].numpy()
    hit = np.isfinite(distance)
    return rays[hit, :3] + distance[hit, None] * rays[hit, 3:]
