"""The kernels of fusion, against readable twins and laws: thinning, integration, the zero level, cells seen empty."""

import numpy as np
import pytest
import tabletop
from scipy.ndimage import gaussian_filter
from tabletop import edge_uses

from modeler import se3
from modeler.fusion import meshing
from modeler.fusion.meshing import DistanceField, VoxelGrid
from modeler.kernels import marching_cubes, occupancy, point_clouds, tsdf
from modeler.kernels import votes as sides


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
    """Twin of `votes.dominant_vote`."""
    score = {k: votes[k][1] * (1.01 - abs(votes[k][0]) / tau_m) for k in remaining}
    best = max(remaining, key=lambda k: score[k])
    if votes[best][0] >= 0:
        return best
    rivals = [k for k in remaining if votes[k][0] > 0 and votes[k][2] @ votes[best][2] < sides.SAME_SIDE]
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
    return n >= 0 and normals[n] @ normal > sides.SAME_SIDE and abs(normals[n] @ (crossing - points[n])) < -along


def naive_integrate(voxels, tau_m, empty_weight, voxel_m, views):
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
            side = [k for k in remaining if votes[k][2] @ votes[best][2] > sides.SAME_SIDE]
            weight = sum(votes[k][1] for k in side)
            distance = sum(votes[k][1] * votes[k][0] for k in side) / weight
            scale_m = max(2.385 / 2**0.5 * (tau_m - 3 * voxel_m) / 2, 0.1 * voxel_m)
            for _ in range(sides.ROBUST_ROUNDS):
                shares = {k: votes[k][1] / (1 + ((votes[k][0] - distance) / scale_m) ** 2) for k in side}
                distance = sum(shares[k] * votes[k][0] for k in side) / sum(shares.values())
            opposite = [k for k in remaining if votes[k][2] @ votes[best][2] < -sides.SAME_SIDE]
            if opposite:
                behind = sum(votes[k][1] * votes[k][0] for k in opposite) / sum(votes[k][1] for k in opposite)
                if -2 * sides.THINNEST * voxel_m < distance + behind < tau_m - 2 * voxel_m:
                    distance = abs(distance - behind) / 2 - sides.THINNEST * voxel_m
            excess = max(0.0, emptiness - sides.OUTWEIGHED * weight)
            totals[number] = weight + excess
            values[number] = (excess * tau_m + weight * distance) / totals[number]
            against = [k for k in remaining if k not in side and naive_wall(voxel, votes[best], votes[k], views)]
            if len(against) < sides.MAJORITY * len(side):
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
    expected_values, expected_totals = naive_integrate(voxels, tau_m, 0.3, voxel_m, views)
    assert 0.0 < (expected_totals > 0.0).mean() <= 1.0
    np.testing.assert_allclose(totals.ravel(), expected_totals, rtol=1e-5)
    np.testing.assert_allclose(values.ravel(), expected_values, rtol=1e-4, atol=1e-8)
    monkeypatch.setattr(sides, "MAJORITY", 1000)  # of the twin alone
    if one_mind:  # some votes were rejected
        assert np.any(naive_integrate(voxels, tau_m, 0.3, voxel_m, views)[1] != expected_totals)


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
    values = np.tile(np.arange(16.0, dtype=np.float32) - 7.5, (16, 16, 1))
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
    cells, means = marching_cubes.fill(values, weights, 15)
    assert np.array_equal(cells, [[6, 6, 6]])
    assert means == pytest.approx([0.5])


@pytest.mark.parametrize("seed", range(3))
def test_no_edge_of_a_zero_level_has_more_than_two_triangles(seed):
    rng = np.random.default_rng(seed)
    values = gaussian_filter(rng.normal(size=(24, 24, 24)), 0.6).astype(np.float32)
    weights = np.zeros(values.shape, dtype=np.float32)
    weights[1:-1, 1:-1, 1:-1] = 1.0
    field = DistanceField(VoxelGrid(np.zeros(3), 1.0, np.array([6, 6, 6])), values, weights)
    _, torn = marching_cubes.extract(values, weights, np.argwhere(weights > 0.0))
    assert edge_uses(torn).max() > 1
    _, triangles = meshing.extracted_mesh(field)
    assert edge_uses(triangles).max() == 1


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
