"""Every kernel of the registration against its readable twin, on random inputs."""

from pathlib import Path

import naive_kernels
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from modeler import kernels, se3
from modeler.kernels import (
    cache,
    gauss_newton,
    mixture,
    paper,
    photometric,
    planes,
    point_likelihood,
    point_to_plane,
    scores,
)
from modeler.kernels.point_likelihood import Projection
from modeler.registration.visibility.sampling import GaussianMixture
from modeler.runs import compiling
from modeler.se3 import matrices, rows

INTRINSICS = np.array([40.0, 42.0, 9.3, 7.1])
SHAPE = (16, 20)
ISOTROPIC = np.diag([0.02, 0.02, 0.02]) ** 2
ANISOTROPIC = np.array([[4e-4, 1e-4, 2e-5], [1e-4, 9e-4, -5e-5], [2e-5, -5e-5, 1e-4]])


def random_pose(rng, angle_rad=0.6):
    return se3.exp(np.concatenate([rng.normal(0, angle_rad, 3), rng.normal(0, 0.03, 3)])) @ se3.translation(
        np.array([0.0, 0.0, rng.normal(0, 0.02)])
    )


def random_points(rng, count):
    z = rng.uniform(0.7, 0.9, count)
    return np.stack([rng.uniform(-0.15, 0.15, count), rng.uniform(-0.12, 0.12, count), z], axis=1)


def random_ranges(rng):
    ranges_m = rng.uniform(0.7, 0.9, SHAPE)
    ranges_m[rng.random(SHAPE) < 0.2] = 0.0  # missing
    ranges_m[rng.random(SHAPE) < 0.2] = 2.0  # background
    return ranges_m


@pytest.mark.parametrize("noise", [ISOTROPIC, ANISOTROPIC], ids=["isotropic", "anisotropic"])
@pytest.mark.parametrize("seed", range(10))
def test_paper_is_the_paper(noise, seed):
    rng = np.random.default_rng(seed)
    ranges_m, pose = random_ranges(rng), random_pose(rng)
    for points, motion in ((random_points(rng, 5), pose), (random_points(rng, 5), se3.inverse(pose))):
        want = sum(np.log(naive_kernels.paper_density(point, motion, ranges_m, INTRINSICS, noise)) for point in points)
        got = paper.log_likelihoods(rows(motion[None]), points, ranges_m, INTRINSICS, noise, np.array([np.inf, 0.0]))
        # The twin takes Q by differences, good to about 1e-10.
        np.testing.assert_allclose(got[0], want, rtol=1e-9, atol=1e-8)


def test_ray_jacobians_are_derivatives_and_inverses(rng):
    for point in random_points(rng, 20):
        np.testing.assert_allclose(paper.ray_jacobian(point), naive_kernels.ray_jacobian(point), rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(paper.ray_jacobian(point) @ paper.ray_jacobian_inverse(point), np.eye(3), atol=1e-12)


def test_passing_over_far_pixels_changes_little(rng):
    ranges_m, pose, points = random_ranges(rng), random_pose(rng, 0.1), random_points(rng, 5)
    ranges_m[:] = 0.0  # nothing forbidden: the nearest pixels decide
    full, near = (
        paper.log_likelihoods(rows(pose[None]), points, ranges_m, INTRINSICS, ISOTROPIC, np.array([reach, 0.0]))[0]
        for reach in (np.inf, 6.0)
    )
    np.testing.assert_allclose(near, full, atol=1e-5)


def test_a_point_in_front_of_every_pixel_rejects_the_sample(rng):
    ranges_m = np.full(SHAPE, 2.0)
    points = np.array([[0.0, 0.0, 0.8]])
    for reject_below, rejected in ((1e-6, True), (0.0, True)):
        options = np.array([np.inf, reject_below])
        value = paper.log_likelihoods(rows(np.eye(4)[None]), points, ranges_m, INTRINSICS, ISOTROPIC, options)[0]
        assert np.isneginf(value) == rejected


def random_cells(rng):
    cells = np.zeros((*SHAPE, planes.CELL_SIZE), dtype=np.float32)
    depth = rng.uniform(0.7, 0.9, SHAPE)
    normals = rng.normal(0, 0.5, (*SHAPE, 3)) - [0, 0, 1.5]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    w = np.broadcast_to((np.arange(SHAPE[1]) - INTRINSICS[2]) / INTRINSICS[0], SHAPE)
    h = np.broadcast_to(((np.arange(SHAPE[0]) - INTRINSICS[3]) / INTRINSICS[1])[:, None], SHAPE)
    cells[..., : planes.NORMAL_Z + 1] = normals
    cells[..., planes.DISTANCE] = -depth * np.sum(normals * np.stack([w, h, np.ones(SHAPE)], axis=-1), axis=-1)
    cells[..., planes.VARIANCE] = rng.uniform(0.0005, 0.01, SHAPE) ** 2
    cells[..., planes.DEPTH] = depth
    cells[..., planes.KIND] = rng.choice(4, SHAPE, p=[0.1, 0.6, 0.1, 0.2])
    cells[..., planes.SILHOUETTE] = rng.uniform(0, 6, SHAPE)
    return cells


CAMERA = np.array([*INTRINSICS, SHAPE[1], SHAPE[0]], dtype=np.float32)
FACING = np.array([0.1, 0.35, 0.3, 0.7], dtype=np.float32)
PATTERN = np.array([0.7, 1 / 50], dtype=np.float32)
RIM_M2 = np.float32(1e-5)
HIDDEN = 0.3


def parameters(blur_m=0.004, support=(0.0, 0.0, 0.0, 0.0, 0.0)):
    numbers = [np.float32(value) for value in (blur_m, 1.5, 0.006, 10.0, 1.5, 2.0, -1.2, 0.4)]
    return point_likelihood.LikelihoodParameters(
        *numbers, support=np.array(support, dtype=np.float32), table=point_likelihood.match_table(HIDDEN)
    )


def random_projection(rng, count=40):
    """Points with normals, and cells independent of them."""
    normals = rng.normal(size=(count, 3)) - [0, 0, 1.5]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    pixels = rng.uniform((0, 0), (SHAPE[1], SHAPE[0]), (count, 2))
    points = np.hstack([random_points(rng, count), normals, rng.uniform(1e-7, 1e-4, (count, 1)), pixels])
    cells = random_cells(rng).reshape(-1, planes.CELL_SIZE)
    return Projection(np.ascontiguousarray(points.T, dtype=np.float32), cells, CAMERA, FACING, PATTERN, RIM_M2)


def far_from_borders(projection, poses):
    """The poses under which no point comes so near to a pixel's border that rounding decides on which side it falls."""
    good = []
    for pose in poses:
        x, y, z = pose[:3, :3] @ projection.points[:3] + pose[:3, 3:]
        where = np.stack([INTRINSICS[0] * x / z + INTRINSICS[2], INTRINSICS[1] * y / z + INTRINSICS[3]]) + 0.5
        good.append(np.abs(where - np.round(where)).min() > 1e-3)
    return np.array(good)


@pytest.mark.parametrize("seed", range(10))
def test_visibility_is_within_its_bound_of_its_twin(seed):
    rng = np.random.default_rng(seed)
    projections = random_projection(rng, 40), random_projection(rng, 30)
    poses = np.stack([random_pose(rng, 0.3) for _ in range(60)])
    poses = poses[far_from_borders(projections[0], poses) & far_from_borders(projections[1], se3.inverse(poses))]
    assert len(poses) > 20
    standing = parameters(support=(0.0, -0.8, -0.6, 0.5, 200.0))
    got = scores.scores(rows(poses), *projections, standing, parameters(0.006))
    want = [
        np.add(
            naive_kernels.visibility(pose, projections[0], standing),
            naive_kernels.visibility(se3.inverse(pose), projections[1], parameters(0.006)),
        )
        for pose in poses
    ]
    np.testing.assert_allclose(got[:, :2], want, rtol=0, atol=1e-4 * 70)


def test_descent_is_the_step_of_the_regularised_normal_equations(rng):
    projections, centre_m = (random_projection(rng), random_projection(rng)), np.array([0.0, 0.0, 0.8])
    poses = np.stack([random_pose(rng, 0.1) for _ in range(6)])
    nothing = (photometric.NO_COLOURS, photometric.NO_COLOURS), np.float32(0.0)
    root = rng.normal(size=(6, 6))
    regulariser = gauss_newton.Regulariser(rows(random_pose(rng, 0.1)), 100.0 * root @ root.T, np.arange(1.0, 7.0), 0.2)
    gradients, matrices_ = (
        part[:, 0] for part in gauss_newton.normal_equations(rows(poses), projections, *nothing, centre_m, 0.05)
    )
    got = gauss_newton.descend(rows(poses), projections, *nothing, centre_m, 0.05, regulariser, 1)
    assert np.count_nonzero(np.abs(gradients).max(axis=1)) == len(poses)  # something matches
    for pose, gradient, matrix, there in zip(poses, gradients, matrices_, matrices(got), strict=True):
        away = se3.difference(matrices(regulariser.mean[None])[0], pose, centre_m)
        held = matrix + regulariser.precision + np.diag(regulariser.damping)
        step = np.asarray(np.linalg.solve(held, gradient - regulariser.precision @ away), dtype=np.float64)
        step *= min(1.0, 0.2 / np.linalg.norm(step[:3]))
        np.testing.assert_allclose(there, se3.moved(pose, step, centre_m), atol=1e-9)


@pytest.mark.parametrize("hidden", [0.05, 0.3, 0.6])
def test_the_table_of_matches_errs_by_less_than_stated(hidden):
    match = np.linspace(point_likelihood.TABLE_LOW, point_likelihood.TABLE_HIGH, 100_001)
    nodes = np.linspace(point_likelihood.TABLE_LOW, point_likelihood.TABLE_HIGH, point_likelihood.TABLE_STEPS + 1)
    exact = np.log((1 - hidden) * np.exp(match) + hidden)
    np.testing.assert_allclose(np.interp(match, nodes, point_likelihood.match_table(hidden)), exact, rtol=0, atol=4e-6)


def test_the_class_of_a_point_follows_from_where_it_lies():
    cells = np.zeros((*SHAPE, planes.CELL_SIZE), dtype=np.float32)
    cells[..., planes.NORMAL_Z], cells[..., planes.DISTANCE] = -1.0, 0.8
    cells[..., planes.VARIANCE], cells[..., planes.DEPTH], cells[..., planes.KIND] = 1e-6, 0.8, planes.SURFACE
    cells[:, 15:, planes.KIND], cells[:, 15:, planes.DEPTH] = planes.BACKGROUND, 2.0
    cells[:, 15:, planes.SILHOUETTE] = np.arange(1, 6)
    towards, away = [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]
    cases = [
        ([0.0, 0.0, 0.8], towards, point_likelihood.MATCHED),
        ([0.0, 0.0, 0.82], towards, point_likelihood.BEHIND),
        ([0.0, 0.0, 0.78], towards, point_likelihood.IN_FRONT),
        ([0.0, 0.0, 0.85], away, point_likelihood.HIDDEN),
        ([0.0, 0.0, 0.75], away, point_likelihood.IN_FRONT),
        ([0.17, 0.0, 0.8], towards, point_likelihood.IN_EMPTY_SPACE),
        ([5.0, 0.0, 0.8], towards, point_likelihood.UNKNOWN),
        ([0.0, 0.0, -0.8], towards, point_likelihood.UNKNOWN),
        ([0.0, 0.2, 0.8], towards, point_likelihood.IN_SUPPORT),
    ]
    points = np.array([[*position, *normal, 1e-6, 0, 0] for position, normal, _ in cases], dtype=np.float32).T.copy()
    projection = Projection(points, cells.reshape(-1, planes.CELL_SIZE), CAMERA, FACING, PATTERN, np.float32(0.0))
    table = (0.0, -1.0, 0.0, 0.15, 500.0)
    classes = point_likelihood.classify(rows(np.eye(4)), projection, parameters(0.001, table))
    assert classes.tolist() == [want for *_, want in cases]


@pytest.mark.parametrize(("cosine", "want"), [(1.0, -10.0), (0.2, -1.5), (0.0, -1.5), (-0.2, -1.5), (-1.0, -10.0)])
def test_steep_surface_that_a_camera_replaces_by_the_background_is_little_evidence(cosine, want):
    cells = np.zeros((*SHAPE, planes.CELL_SIZE), dtype=np.float32)
    cells[..., planes.DEPTH], cells[..., planes.KIND], cells[..., planes.SILHOUETTE] = 2.0, planes.BACKGROUND, 20.0
    normal = [np.sqrt(1.0 - cosine**2), 0.0, -cosine]
    points = np.array([[0.0, 0.0, 0.8, *normal, 1e-6, 0.0, 0.0]], dtype=np.float32).T.copy()
    projection = Projection(points, cells.reshape(-1, planes.CELL_SIZE), CAMERA, FACING, PATTERN, np.float32(0.0))
    transformed, pixels, looked_up = point_likelihood.buffers(1)
    point_likelihood.project(rows(np.eye(4)), projection, transformed, pixels, looked_up)
    got, _ = point_likelihood.sum_over_points(points, transformed, looked_up, parameters())
    assert got == pytest.approx(want)


@pytest.mark.parametrize("noise_m", [0.01, 0.031])
def test_local_planes_are_least_squares_in_inverse_depth(rng, noise_m):
    depth_m = 0.8 + 0.05 * rng.random(SHAPE)
    depth_m[rng.random(SHAPE) < 0.1] = np.nan
    mask = np.zeros(SHAPE, dtype=bool)
    mask[2:14, 3:17] = True
    ball, edge_px = planes.Ball(0.09, 4, 1, noise_m), rng.random(SHAPE).astype(np.float32)
    cells = planes.local_planes(depth_m.astype(np.float32), mask, edge_px, INTRINSICS, ball, 1e-6)
    fitted = np.argwhere(cells[..., planes.VARIANCE] > 0)
    assert len(fitted) > 60
    np.testing.assert_array_equal(cells[..., planes.SILHOUETTE], edge_px)
    for pixel in fitted[::5]:
        want = naive_kernels.local_plane(np.where(mask, depth_m, 0).astype(np.float32), mask, INTRINSICS, pixel, ball)
        got = -cells[(*pixel, slice(0, 3))] / cells[(*pixel, planes.DISTANCE)]
        np.testing.assert_allclose(got, want, rtol=2e-3, atol=2e-4)


def test_a_noise_free_plane_is_found_whatever_its_tilt():
    w = (np.arange(64) - 31.5) / 100.0
    normal = np.array([0.5, -0.3, -0.8])
    plane = -normal / np.linalg.norm(normal) / 0.6
    depth_m = 1 / (plane[0] * w[None, :] + plane[1] * w[:, None] + plane[2])
    mask, edge_px = np.ones((64, 64), dtype=bool), np.zeros((64, 64), dtype=np.float32)
    intrinsics = np.array([100.0, 100.0, 31.5, 31.5])
    cells = planes.local_planes(
        depth_m.astype(np.float32), mask, edge_px, intrinsics, planes.Ball(0.04, 6, 2, 0.0), 1e-6
    )
    inner = cells[20:44, 20:44]
    assert (inner[..., planes.KIND] == planes.SURFACE).all()
    got = -inner[..., :3] / inner[..., planes.DISTANCE, None]
    np.testing.assert_allclose(got, np.broadcast_to(plane, (24, 24, 3)), atol=1e-3)


def test_noise_as_large_as_the_ball_does_not_flatten_slopes(rng):
    """A pixel's neighbours are those around its surface, not those that err as it does."""
    size, focal_px, distance_m, sigma_m = 96, 500.0, 1.0, 0.004
    ball = planes.Ball(0.006, 5, 1, sigma_m)  # 28 px
    w = (np.arange(size) - 47.5) / focal_px
    plane = np.array([0.8, 0.0, 1.0]) / distance_m
    inverse = plane[0] * w[None, :] + plane[2] + rng.normal(0.0, sigma_m / distance_m**2, (size, size))
    mask, edge_px = np.ones((size, size), dtype=bool), np.zeros((size, size), dtype=np.float32)
    intrinsics = np.array([focal_px, focal_px, 47.5, 47.5])
    cells = planes.local_planes((1.0 / inverse).astype(np.float32), mask, edge_px, intrinsics, ball, 1e-6)
    inner = cells[8:-8, 8:-8].reshape(-1, planes.CELL_SIZE)
    inner = inner[inner[:, planes.KIND] == planes.SURFACE].astype(np.float64)
    assert len(inner) > 0.9 * (size - 16) ** 2
    slopes = -inner[:, planes.NORMAL_X] / inner[:, planes.DISTANCE]
    assert 0.8 * plane[0] < slopes.mean() < 1.05 * plane[0]  # 0.3 with balls around measured points


def test_silhouette_distance_is_euclidean_within_the_chamfer_error(rng):
    mask = rng.random((40, 50)) < 0.004
    mask[20, 25] = True
    got, want = planes.silhouette_distance(mask, 60.0), naive_kernels.silhouette_distance(mask)
    assert (np.abs(got - want) <= 0.09 * want + 1e-5).all()
    np.testing.assert_allclose(planes.silhouette_distance(mask, 3.0), np.minimum(got, 3.0), atol=1e-4)


@pytest.mark.parametrize("sigma_rad", [0.01, 0.5, 3.0])
def test_densities_of_a_mixture_leave_out_nothing_that_counts(rng, sigma_rad):
    """However far apart the Gaussians lie, and where no pose is near any of them."""
    centre_m = np.array([0.1, 0.0, 0.8])
    means, poses = (np.stack([random_pose(rng, sigma_rad) for _ in range(count)]) for count in (12, 50))
    scatter = np.stack([0.01 * np.cov(rng.normal(size=(6, 20))) for _ in means])
    spreads = np.asarray(np.linalg.cholesky(scatter), dtype=np.float64)
    log_weights = rng.normal(0.0, 3.0, len(means))
    want = np.empty((len(means), len(poses)))
    for k, (mean, spread) in enumerate(zip(means, spreads, strict=True)):
        xi = se3.difference(mean, poses, centre_m)
        half_rad = 0.5 * np.linalg.norm(xi[:, :3], axis=1)
        want[k] = log_weights[k] + multivariate_normal.logpdf(xi, cov=spread @ spread.T)
        want[k] += 4.0 * np.log(half_rad / np.sin(half_rad))
    got = GaussianMixture(means, spreads, log_weights, centre_m).log_density(poses)
    np.testing.assert_allclose(got, np.logaddexp.reduce(want, axis=0), rtol=1e-9, atol=1e-9)


def test_distances_are_in_standard_deviations(rng):
    centre_m, poses = np.array([0.0, 0.0, 0.8]), np.stack([random_pose(rng, 0.2) for _ in range(5)])
    spreads = np.linalg.cholesky(np.stack([np.cov(rng.normal(size=(6, 20))) for _ in range(5)]))
    got = mixture.mahalanobis_distances(rows(poses), spreads, centre_m)
    for i, root in enumerate(spreads):
        xi = se3.difference(poses[i], poses, centre_m)
        np.testing.assert_allclose(got[i], np.linalg.norm(np.linalg.solve(root, xi.T), axis=0), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 7, 200])
def test_patches_come_from_recursive_bisection(rng, count):
    points = rng.normal(size=(count, 3)) * [1.0, 3.0, 0.2]
    numbers = point_to_plane.bisected(points, 3)
    sizes = np.bincount(numbers, minlength=8)
    assert len(sizes) == 8
    assert sizes.sum() == count
    assert sizes.max() - sizes.min() <= 1
    if count == 200:  # the first cut is across the longest side
        low = numbers < 4
        assert points[low, 1].max() <= points[~low, 1].min()


def test_kernels_know_that_they_are_compiled():
    point_likelihood.classify(rows(np.eye(4)[None])[0], random_projection(np.random.default_rng(0)), parameters())
    assert cache.kept("point_likelihood", "classify")


def test_the_count_of_kernels_compiled_ahead_is_that_of_all_that_a_run_uses() -> None:
    folder = Path(kernels.__file__).parent
    compiled = {path.stem for path in folder.glob("*.py") if "@njit(" in path.read_text()}
    elsewhere = {"occupancy", "paper"}  # of other commands and methods
    assert sorted((*compiling._USED, *compiling._USED_TO_FUSE)) == sorted(compiled - elsewhere)
