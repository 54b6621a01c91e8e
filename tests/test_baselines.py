"""The baselines' algebra: where they start, what they match, and in which tangent they state their information."""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import open3d as o3d
import pytest
import small_gicp
import tabletop
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.baselines import (
    ColouredIcpRegistrar,
    FpfhIcpRegistrar,
    FpfhRegistrar,
    GicpRegistrar,
    IcpRegistrar,
    KissIcpRegistrar,
)
from modeler.baselines.clouds import (
    Cloud,
    Fit,
    Matches,
    cube_edges_m,
    matched,
    plane_residuals,
    posterior,
    start,
    whitened_jacobian,
)
from modeler.baselines.icp import intensity_gradients
from modeler.experiment import sparse_view
from modeler.priors import GeneralPrior
from modeler.types import AbstractPoseDensity, Array, Outcome, RayImage

BODY = tabletop.Box((0.05, 0.08, 0.035))
POSES = tabletop.turntable(24)[2:4]
Pair = tuple[RayImage, RayImage]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


@pytest.fixture(scope="module")
def pair() -> Pair:
    """Two views of a box that turns by 15° between them, with depth noise."""
    first, second = (
        tabletop.view(BODY, pose, index, rng=np.random.default_rng(index), table=False)
        for index, pose in enumerate(POSES)
    )
    return first, second


@dataclass(frozen=True)
class Normal(AbstractPoseDensity):
    """A Gaussian about a motion, isotropic in rotation about a point and in shift."""

    pose: Array
    centre_m: Array
    sigma_rad: float
    sigma_m: float
    evidence: bool = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        xi = rng.normal(size=(count, 6)) * np.repeat([self.sigma_rad, self.sigma_m], 3)
        return self.pose @ se3.translation(self.centre_m) @ se3.exp(xi) @ se3.translation(-self.centre_m)

    def log_density(self, target_from_source: Array) -> Array:
        raise NotImplementedError


@dataclass(frozen=True)
class AnyTurn(AbstractPoseDensity):
    """Any rotation at all about the centroids."""

    source_m: Array
    target_m: Array
    evidence: bool = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        turn = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
        turn[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
        return se3.translation(self.target_m) @ turn @ se3.translation(-self.source_m)

    def log_density(self, target_from_source: Array) -> Array:
        raise NotImplementedError


def of_open3d(cloud: Cloud) -> o3d.geometry.PointCloud:
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points_m))
    points.normals = o3d.utility.Vector3dVector(cloud.normals)
    if cloud.intensity is not None:
        points.colors = o3d.utility.Vector3dVector(np.repeat(cloud.intensity[:, None], 3, axis=1))
    return points


def degrees_between(first: Array, second: Array) -> float:
    return float(np.degrees(se3.rotation_angle(se3.inverse(first) @ second)))


def second_derivative(cost: Callable[[Array], float], step: float = 1e-4) -> Array:
    """Return the Hessian (6, 6) of a cost of ξ at zero by central differences."""
    unit = step * np.eye(6)
    return np.array(
        [[(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / (4.0 * step**2) for b in unit] for a in unit]
    )


def test_starts_with_the_centroids_together_where_the_prior_is_general(pair: Pair, rng: np.random.Generator) -> None:
    source, target = pair
    initial = start(source, target, GeneralPrior(50.0, 0.04).between(source, target), rng)
    aligned = se3.translation(target.centroid_m - source.centroid_m)
    assert degrees_between(initial.target_from_source, aligned) < 3.0
    carried = se3.transform(initial.target_from_source, source.centroid_m[None])[0]
    assert np.linalg.norm(carried - target.centroid_m) < 0.004


def test_starts_at_the_centre_of_a_narrow_prior(pair: Pair, rng: np.random.Generator) -> None:
    source, target = pair
    truth = POSES[1] @ se3.inverse(POSES[0])
    initial = start(source, target, Normal(truth, source.centroid_m, 0.02, 0.003), rng)
    assert degrees_between(initial.target_from_source, truth) < 0.2
    assert initial.sigma_rad == pytest.approx(0.02, rel=0.05)
    assert initial.sigma_m == pytest.approx(0.003, rel=0.05)


def test_starts_without_turning_where_the_prior_has_no_centre(pair: Pair, rng: np.random.Generator) -> None:
    source, target = pair
    initial = start(source, target, AnyTurn(source.centroid_m, target.centroid_m), rng)
    np.testing.assert_allclose(initial.target_from_source, se3.translation(target.centroid_m - source.centroid_m))


def test_spread_is_stated_at_the_start_in_our_tangent(pair: Pair, rng: np.random.Generator) -> None:
    source, target = pair
    density = Normal(POSES[1] @ se3.inverse(POSES[0]), source.centroid_m, 0.1, 0.02)
    initial = start(source, target, density, rng)
    xi = se3.log(se3.inverse(initial.target_from_source) @ density.sample(20_000, rng))
    about_centre = xi @ se3.adjoint(se3.translation(-initial.centre_m)).T
    # Sampled Gaussians of this spread have squared Mahalanobis length 6 on average.
    assert np.mean(np.sum((about_centre / initial.sigmas) ** 2, axis=1)) == pytest.approx(6.0, rel=0.05)


def test_thinning_keeps_one_mean_point_a_cube(rng: np.random.Generator) -> None:
    points = rng.uniform(-0.1, 0.1, (4000, 3))
    points -= points.mean(axis=0)
    cloud = Cloud(points, np.tile([0.0, 0.0, -1.0], (4000, 1)))
    thin = cloud.thinned(0.05)
    cubes = {}
    for point in points:
        cubes.setdefault(tuple(np.floor(point / 0.05)), []).append(point)
    expected = np.array(sorted(np.mean(members, axis=0).tolist() for members in cubes.values()))
    np.testing.assert_allclose(np.array(sorted(thin.points_m.tolist())), expected, atol=1e-12)
    np.testing.assert_allclose(thin.normals, np.tile([0.0, 0.0, -1.0], (len(expected), 1)))
    offset = np.array([0.3, 0.2, 1.0])
    np.testing.assert_allclose(Cloud(points + offset, cloud.normals).thinned(0.05).points_m, thin.points_m + offset)


def test_matches_are_the_nearest_within_reach(rng: np.random.Generator) -> None:
    source, target = rng.uniform(size=(50, 3)), rng.uniform(size=(70, 3))
    pose = se3.exp(rng.normal(size=6))
    cloud = Cloud(target, target)
    found = matched(source, cloud, KDTree(target), pose, 0.2)
    distances = np.linalg.norm(se3.transform(pose, source)[:, None] - target, axis=2)
    near = distances.min(axis=1) < 0.2
    np.testing.assert_array_equal(found.points_m, source[near])
    np.testing.assert_array_equal(found.partners.points_m, target[distances.argmin(axis=1)[near]])
    assert found.fitness == near.mean()


def test_plane_residuals_differentiate_by_the_right_perturbation(rng: np.random.Generator) -> None:
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    matches = Matches(rng.normal(size=(30, 3)), Cloud(rng.normal(size=(30, 3)), normals), 1.0)
    pose = se3.exp(rng.normal(size=6))
    _, jacobian = plane_residuals(matches, pose)
    for axis in range(6):
        step = 1e-6 * np.eye(6)[axis]
        ahead, behind = (plane_residuals(matches, pose @ se3.exp(side))[0] for side in (step, -step))
        np.testing.assert_allclose(jacobian[:, axis], (ahead - behind) / 2e-6, atol=1e-7)


def test_information_is_true_where_residuals_are_independent_and_partners_true(rng: np.random.Generator) -> None:
    """The formula is sound; real residuals are what it is not sound for."""
    squares = []
    for _ in range(300):
        normals = rng.normal(size=(60, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        points = rng.normal(0.0, 0.1, (60, 3)) + np.array([0.0, 0.0, 0.8])
        noise = rng.normal(0.0, 0.001, (60, 1))
        matches = Matches(points, Cloud(points + noise * normals, normals), 1.0)
        residuals, jacobian = plane_residuals(matches, np.eye(4))
        error = np.linalg.lstsq(jacobian, -residuals)[0]
        after = residuals + jacobian @ error
        squares.append(np.sum((whitened_jacobian(after, np.ones(60), jacobian) @ error) ** 2))
    # 6 · (54 / 52) for a variance estimated from 54 degrees of freedom; standard error 0.21.
    assert np.mean(squares) == pytest.approx(6.23, abs=0.65)


def test_icp_stops_where_open3d_would(pair: Pair, rng: np.random.Generator) -> None:
    method = IcpRegistrar()
    source, target = (Cloud.of(view) for view in pair)
    initial = start(pair[0], pair[1], GeneralPrior(40.0, 0.03).between(*pair), rng)
    fit = method.refine(source, target, initial.target_from_source)
    voxel_m = cube_edges_m(source, target, method.voxels)[-1]
    reach_m = method.reach * voxel_m
    library = o3d.pipelines.registration
    theirs = library.registration_icp(
        of_open3d(source.thinned(voxel_m)),
        of_open3d(target.thinned(voxel_m)),
        reach_m,
        fit.target_from_source,
        library.TransformationEstimationPointToPlane(library.TukeyLoss(reach_m)),
        library.ICPConvergenceCriteria(1e-9, 1e-9, 30),
    )
    assert degrees_between(theirs.transformation, fit.target_from_source) < 0.01
    assert theirs.fitness == pytest.approx(fit.fitness, abs=0.005)


def printed_ball(turn_deg: float, seed: int) -> RayImage:
    """Return a ball with a smooth print, turned about its vertical axis: all that depth shows is where it is."""
    turn = se3.exp(np.array([0.0, 0.0, np.radians(turn_deg), 0.0, 0.0, 0.0]))
    seen = tabletop.view(tabletop.BALL, POSES[0] @ turn, seed, rng=np.random.default_rng(seed), table=False)
    on_ball = se3.transform(se3.inverse(POSES[0] @ turn), seen.points_m)
    grey = 128.0 + 90.0 * np.sin(90.0 * on_ball[:, 0]) * np.cos(70.0 * on_ball[:, 1] + 40.0 * on_ball[:, 2])
    colour = seen.frame.colour.copy()
    colour[seen.pixels[:, 0], seen.pixels[:, 1]] = np.rint(grey)[:, None]
    return tabletop.recoloured(seen, colour)


def test_coloured_icp_sees_a_printed_ball_turn(rng: np.random.Generator) -> None:
    source, target = printed_ball(0.0, 0), printed_ball(8.0, 1)
    truth = POSES[0] @ se3.exp(np.array([0.0, 0.0, np.radians(8.0), 0.0, 0.0, 0.0])) @ se3.inverse(POSES[0])
    density = Normal(np.eye(4), source.centroid_m, 0.1, 0.005)
    found, blind = (m.register(source, target, density, rng=rng) for m in (ColouredIcpRegistrar(), IcpRegistrar()))
    assert degrees_between(found.pose.mean, truth) < 0.5
    assert degrees_between(blind.pose.mean, truth) > 4.0


def test_coloured_icp_stops_where_open3d_would() -> None:
    method = ColouredIcpRegistrar()
    source, target = (Cloud.coloured(printed_ball(turn_deg, seed)) for turn_deg, seed in ((0.0, 0), (3.0, 1)))
    voxel_m = 0.004
    thin = source.thinned(voxel_m), target.thinned(voxel_m)
    reach_m = method.reach * voxel_m
    library = o3d.pipelines.registration
    theirs = library.registration_colored_icp(
        *map(of_open3d, thin),
        reach_m,
        np.eye(4),
        library.TransformationEstimationForColoredICP(),
        library.ICPConvergenceCriteria(1e-9, 1e-9, 60),
    )
    ours = method.level(*thin, np.eye(4), voxel_m)
    assert degrees_between(np.eye(4), ours.target_from_source) > 2.0
    assert degrees_between(theirs.transformation, ours.target_from_source) < 0.02
    assert theirs.fitness == pytest.approx(ours.fitness, abs=0.005)


def test_intensity_gradients_are_those_of_the_print(rng: np.random.Generator) -> None:
    across = rng.uniform(-0.05, 0.05, (3000, 2))
    normal = np.array([0.6, 0.0, -0.8])
    along = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0]])
    cloud = Cloud(across @ along, np.tile(normal, (3000, 1)), 0.5 + across @ [3.0, -2.0])
    gradients = intensity_gradients(cloud, KDTree(cloud.points_m), 0.01)
    np.testing.assert_allclose(gradients, np.tile(np.array([3.0, -2.0]) @ along, (3000, 1)), atol=1e-6)


def test_a_lonely_point_has_no_intensity_gradient() -> None:
    cloud = Cloud(np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0]]), np.tile([0.0, 0.0, -1.0], (2, 1)), np.array([0.1, 0.9]))
    np.testing.assert_array_equal(intensity_gradients(cloud, KDTree(cloud.points_m), 0.1), 0.0)


def test_gicp_states_its_hessian_in_our_tangent(pair: Pair, rng: np.random.Generator) -> None:
    method = GicpRegistrar(voxels=(1 / 20,))
    source, target = pair
    found = method.register(source, target, GeneralPrior(40.0, 0.03).between(source, target), rng=rng)
    points, shapes = [], []
    voxel_m = max(Cloud.of(view).size_m for view in pair) / 20
    for view in pair:
        cloud, _ = small_gicp.preprocess_points(view.points_m - view.centroid_m, voxel_m, 10)
        points.append(cloud.points()[:, :3] + view.centroid_m)
        shapes.append(np.array([cloud.cov(k)[:3, :3] for k in range(cloud.size())]))
    pose = found.pose.mean
    distances, partners = KDTree(points[1]).query(se3.transform(pose, points[0]))
    near = distances < method.reach * voxel_m
    turned = pose[:3, :3] @ shapes[0][near] @ pose[:3, :3].T
    weights = np.linalg.inv(shapes[1][np.asarray(partners)[near]] + turned)

    def cost(xi: Array) -> float:
        gaps = points[1][np.asarray(partners)[near]] - se3.transform(pose @ se3.exp(xi), points[0][near])
        return 0.5 * float(np.einsum("ni,nij,nj->", gaps, weights, gaps))

    variance = 2.0 * cost(np.zeros(6)) / (np.sum(near) - 6)
    hessian = second_derivative(cost)
    information = np.linalg.inv(found.pose.covariance)  # of the surfaces: the prior's is some 10⁵ times less
    np.testing.assert_allclose(information * variance, hessian, rtol=1e-3, atol=1e-4 * np.max(hessian))


def test_features_need_no_start(pair: Pair, rng: np.random.Generator) -> None:
    """A prior that points the wrong way does not mislead a method that does not use it."""
    source, target = pair
    truth = POSES[1] @ se3.inverse(POSES[0])
    wrong = Normal(truth @ se3.exp(np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0])), source.centroid_m, 0.05, 0.005)
    for method, tolerance_deg in ((FpfhRegistrar(), 8.0), (FpfhIcpRegistrar(), 1.0)):
        found = method.register(source, target, wrong, rng=rng)
        assert degrees_between(found.pose.mean, truth) < tolerance_deg
    assert degrees_between(IcpRegistrar().register(source, target, wrong, rng=rng).pose.mean, truth) > 20.0


def test_surfaces_and_prior_add_up(pair: Pair, rng: np.random.Generator) -> None:
    initial = start(*pair, Normal(np.eye(4), pair[0].centroid_m, 0.3, 0.01), rng)
    jacobian = rng.normal(size=(40, 6))
    found = posterior(*pair, initial, Fit(np.eye(4), jacobian, 1.0), 0.1).pose.covariance
    about_centre = se3.adjoint(se3.translation(-initial.centre_m))
    prior = about_centre.T @ np.diag(initial.sigmas**-2.0) @ about_centre
    np.testing.assert_allclose(found, np.linalg.inv(jacobian.T @ jacobian + prior), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("rounding", range(8))
def test_directions_that_nobody_saw_keep_the_spread_of_the_prior(
    pair: Pair, rng: np.random.Generator, rounding: int
) -> None:
    """A sphere says nothing of rotation about its centre, however points and normals are rounded."""
    source, target = pair
    centre = source.centroid_m
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ball = centre + 0.05 * normals
    last_digit = np.random.default_rng(rounding).integers(-2, 3, (2, 500, 3)) * (rounding > 0) * np.finfo(float).eps
    ball, normals = ball * (1.0 + last_digit[0]), normals * (1.0 + last_digit[1])
    residuals, jacobian = plane_residuals(Matches(ball, Cloud(ball, normals), 1.0), np.eye(4))
    fit = Fit(np.eye(4), whitened_jacobian(residuals, np.ones(500), jacobian), 1.0)
    initial = start(source, target, Normal(np.eye(4), centre, 0.3, 0.01), rng)
    at_centre = se3.adjoint(se3.translation(-centre))
    covariance = at_centre @ posterior(source, target, initial, fit, 0.1).pose.covariance @ at_centre.T
    np.testing.assert_allclose(covariance[:3, :3], initial.sigma_rad**2 * np.eye(3), atol=1e-6 * initial.sigma_rad**2)
    assert np.all(np.sqrt(np.diag(covariance)[3:]) < 1e-5)


def test_a_fit_of_few_matches_is_no_overlap(pair: Pair, rng: np.random.Generator) -> None:
    initial = start(pair[0], pair[1], Normal(np.eye(4), pair[0].centroid_m, 0.1, 0.01), rng)
    fit = IcpRegistrar().refine(Cloud.of(pair[0]), Cloud.of(pair[1]), se3.translation(np.array([0.0, 0.0, 0.5])))
    assert posterior(pair[0], pair[1], initial, fit, min_fitness=0.1).outcome is Outcome.NO_OVERLAP


def test_thinning_is_not_finer_than_the_points(rng: np.random.Generator) -> None:
    down, across = 0.01 * np.indices((30, 30), dtype=np.float64).reshape(2, -1)
    grid = Cloud(np.stack([across, down, np.ones(900)], axis=1), np.tile([0.0, 0.0, -1.0], (900, 1)))
    assert grid.spacing_m == pytest.approx(0.01)
    assert grid.size_m == pytest.approx(2.0 * np.sqrt(2.0 * (900 - 1) / 12.0) * 0.01)
    halves = Cloud(0.5 * grid.points_m, grid.normals)
    assert cube_edges_m(grid, halves, (1 / 2, 1 / 50, 1 / 100)) == pytest.approx([grid.size_m / 2, 0.01])


def test_sparse_clouds_are_registered_by_the_levels_that_they_allow(pair: Pair, rng: np.random.Generator) -> None:
    truth = POSES[1] @ se3.inverse(POSES[0])
    few = [sparse_view(view, 80, rng) for view in pair]
    for method in (IcpRegistrar(), GicpRegistrar()):
        found = method.register(few[0], few[1], Normal(truth, few[0].centroid_m, 0.05, 0.005), rng=rng)
        assert found.usable
        assert degrees_between(found.pose.mean, truth) < 6.0
    fewest = [sparse_view(view, 11, rng) for view in pair]
    found = IcpRegistrar().register(fewest[0], fewest[1], Normal(truth, few[0].centroid_m, 0.05, 0.005), rng=rng)
    assert found.outcome is Outcome.TOO_FEW_POINTS


@pytest.mark.skipif(importlib.util.find_spec("kiss_matcher") is None, reason="KISS-Matcher is not installed")
def test_kiss_finds_any_motion_of_a_body_with_features(rng: np.random.Generator) -> None:
    """A bumpy ball of 4 cm, smaller than the cubes that KISS-Matcher is made for, turned by 140°; twice the same."""
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    waves, phases = rng.normal(size=(8, 3)) * 2.5, rng.uniform(0.0, 6.0, size=8)
    points = 0.02 * directions * (1.0 + 0.06 * np.sin(directions @ waves.T + phases).sum(axis=1, keepdims=True))
    source = Cloud(points[:12_000], directions[:12_000])
    motion = se3.translation(np.array([0.1, -0.2, 0.9])) @ se3.exp(np.array([1.0, -2.0, 1.0, 0.0, 0.0, 0.0]))
    target = Cloud(se3.transform(motion, points[6_000:]), directions[6_000:] @ motion[:3, :3].T)
    found = KissIcpRegistrar().search(source, target, np.eye(4))
    assert np.degrees(se3.rotation_angle(se3.inverse(found) @ motion)) < 3.0
    assert np.linalg.norm(found[:3, 3] - motion[:3, 3]) < 0.002
    np.testing.assert_array_equal(KissIcpRegistrar().search(source, target, np.eye(4)), found)
