"""Laws of rigid motions and of their uncertainty, and that the conventions are those of GTSAM's Pose3."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modeler import se3

LAWS = settings(derandomize=True, max_examples=100)

# Angles at which a formula may lose its digits: zero, the switch to the series, half a turn.
ANGLES_RAD = st.one_of(
    st.sampled_from([0.0, 1e-300, 1e-12, 9.99e-5, 1e-4, 1.01e-4, 1e-3, np.pi - 1e-3, np.pi - 1e-7]),
    st.floats(0.0, np.pi - 1e-7),
)
SEEDS = st.integers(0, 2**32 - 1)


def _unit(rng: np.random.Generator) -> se3.Array:
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


@st.composite
def tangents(draw: st.DrawFn) -> se3.Array:
    """A tangent vector (6,) with a rotation below half a turn and a shift of up to 10 m."""
    rng = np.random.default_rng(draw(SEEDS))
    return np.concatenate([draw(ANGLES_RAD) * _unit(rng), draw(st.floats(0.0, 10.0)) * _unit(rng)])


def poses() -> st.SearchStrategy[se3.Array]:
    return tangents().map(se3.exp)


def _covariance(rng: np.random.Generator, sigma_rad: float, sigma_m: float) -> se3.Array:
    scale = np.diag([sigma_rad] * 3 + [sigma_m] * 3)
    factor = rng.normal(size=(6, 6)) / np.sqrt(6.0) + 0.3 * np.eye(6)
    return scale @ factor @ factor.T @ scale


@LAWS
@given(poses())
def test_poses_are_rigid_motions(pose: se3.Array) -> None:
    np.testing.assert_array_equal(se3.rigid(pose[:3, :3], pose[:3, 3]), pose)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_array_equal(pose[3], [0.0, 0.0, 0.0, 1.0])


@LAWS
@given(poses())
def test_rigid_motions_are_distinguished_from_other_matrices(pose: se3.Array) -> None:
    def stated(matrix: se3.Array) -> bool:
        return se3.is_rigid(matrix, tolerance=1e-6, farthest_m=11.0)

    assert stated(pose)
    for place in np.ndindex(4, 4):
        for wrong in (np.nan, np.inf, pose[place] + 30.0):
            spoilt = pose.copy()
            spoilt[place] = wrong
            assert not stated(spoilt)
    assert not stated(pose @ np.diag([1.0, 1.0, -1.0, 1.0]))  # a mirror
    assert not stated(pose @ np.diag([1.001, 1.001, 1.001, 1.0]))
    assert not stated(np.zeros((4, 4)))


@LAWS
@given(poses(), poses(), poses())
def test_group_axioms(a: se3.Array, b: se3.Array, c: se3.Array) -> None:
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-13)
    np.testing.assert_array_equal(a @ se3.exp(np.zeros(6)), a)
    np.testing.assert_allclose(a @ se3.inverse(a), np.eye(4), atol=1e-13)
    np.testing.assert_allclose(se3.inverse(a) @ a, np.eye(4), atol=1e-13)
    np.testing.assert_allclose(se3.inverse(a @ b), se3.inverse(b) @ se3.inverse(a), atol=1e-12)


@LAWS
@given(tangents())
def test_log_inverts_exp(xi: se3.Array) -> None:
    # Where R is near a half turn log is as ill-conditioned as reading an angle off its cosine: never, with quaternions.
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=3e-14 * (1.0 + float(np.linalg.norm(xi))))


@LAWS
@given(SEEDS, st.floats(0.0, 10.0))
def test_exp_inverts_log_at_half_a_turn(seed: int, shift_m: float) -> None:
    rng = np.random.default_rng(seed)
    pose = se3.exp(np.concatenate([np.pi * _unit(rng), shift_m * _unit(rng)]))
    xi = se3.log(pose)  # its axis may point either way
    assert np.linalg.norm(xi[:3]) == pytest.approx(np.pi, abs=1e-12)
    np.testing.assert_allclose(se3.exp(xi), pose, atol=1e-13 * (1.0 + shift_m))


@LAWS
@given(tangents())
def test_exp_of_multiples_is_a_one_parameter_group(xi: se3.Array) -> None:
    np.testing.assert_allclose(se3.exp(0.3 * xi) @ se3.exp(0.7 * xi), se3.exp(xi), atol=1e-13)
    np.testing.assert_allclose(se3.exp(-xi), se3.inverse(se3.exp(xi)), atol=1e-13)


@LAWS
@given(poses(), tangents())
def test_adjoint_moves_a_tangent_across_a_pose(pose: se3.Array, xi: se3.Array) -> None:
    np.testing.assert_allclose(pose @ se3.exp(xi), se3.exp(se3.adjoint(pose) @ xi) @ pose, atol=1e-11)


@LAWS
@given(poses(), poses())
def test_adjoint_is_a_homomorphism(a: se3.Array, b: se3.Array) -> None:
    np.testing.assert_allclose(se3.adjoint(a @ b), se3.adjoint(a) @ se3.adjoint(b), atol=1e-12)
    np.testing.assert_allclose(se3.adjoint(se3.inverse(a)) @ se3.adjoint(a), np.eye(6), atol=1e-12)


@LAWS
@given(tangents())
def test_convention_is_that_of_gtsam_pose3(xi: se3.Array) -> None:
    theirs = gtsam.Pose3.Expmap(xi)
    pose = se3.exp(xi)
    np.testing.assert_allclose(pose, theirs.matrix(), atol=1e-13)
    np.testing.assert_allclose(se3.adjoint(pose), theirs.AdjointMap(), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(pose), theirs.inverse().matrix(), atol=1e-13)
    if np.linalg.norm(xi[:3]) < np.pi - 1e-2:  # nearer to half a turn GTSAM's own logarithm loses digits
        np.testing.assert_allclose(se3.log(pose), gtsam.Pose3.Logmap(theirs), atol=1e-9)


def test_functions_broadcast_over_leading_axes() -> None:
    xi = np.random.default_rng(0).normal(size=(2, 3, 6))
    stacked = se3.exp(xi)
    assert stacked.shape == (2, 3, 4, 4)
    for i in range(2):
        for j in range(3):
            np.testing.assert_array_equal(stacked[i, j], se3.exp(xi[i, j]))
            np.testing.assert_allclose(se3.log(stacked)[i, j], se3.log(stacked[i, j]), atol=1e-15)
            np.testing.assert_array_equal(se3.inverse(stacked)[i, j], se3.inverse(stacked[i, j]))
            np.testing.assert_array_equal(se3.adjoint(stacked)[i, j], se3.adjoint(stacked[i, j]))
    np.testing.assert_allclose(se3.rotation_angle(stacked), np.linalg.norm(se3.log(stacked)[..., :3], axis=-1))


@LAWS
@given(poses(), SEEDS)
def test_transform_carries_points_as_the_matrix_does(pose: se3.Array, seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(5, 3))
    homogeneous = np.concatenate([points, np.ones((5, 1))], axis=1)
    np.testing.assert_allclose(se3.transform(pose, points), (homogeneous @ pose.T)[:, :3], atol=1e-13)
    np.testing.assert_array_equal(
        se3.transform(se3.translation(np.array([1.0, 2.0, 3.0])), points), points + np.array([1.0, 2.0, 3.0])
    )


def _sample_covariance(pose: se3.Array, samples: se3.Array) -> se3.Array:
    """Return the second moment of samples (n, 4, 4) about `pose`."""
    xi = se3.log(se3.inverse(pose) @ samples)
    return xi.T @ xi / len(xi)


def _assert_same_covariance(actual: se3.Array, expected: se3.Array, count: int) -> None:
    """Compare in the units in which `expected` is the identity: entries of a sample covariance scatter by √(2/n)."""
    factor = np.linalg.inv(np.linalg.cholesky(expected))
    np.testing.assert_allclose(factor @ actual @ factor.T, np.eye(6), atol=5.0 * np.sqrt(2.0 / count))


@pytest.mark.parametrize("seed", range(5))
def test_covariance_of_the_inverse_against_monte_carlo(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 100_000
    pose = se3.exp(rng.normal(size=6))
    covariance = _covariance(rng, 0.01, 0.003)
    noise = rng.multivariate_normal(np.zeros(6), covariance, size=count)
    samples = se3.inverse(pose @ se3.exp(noise))
    _assert_same_covariance(
        _sample_covariance(se3.inverse(pose), samples), se3.inverse_covariance(pose, covariance), count
    )


@pytest.mark.parametrize("seed", range(5))
def test_covariance_of_a_composition_against_monte_carlo(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 100_000
    first, second = se3.exp(rng.normal(size=(2, 6)))
    covariance_first, covariance_second = _covariance(rng, 0.01, 0.003), _covariance(rng, 0.005, 0.004)
    noise_first = rng.multivariate_normal(np.zeros(6), covariance_first, size=count)
    noise_second = rng.multivariate_normal(np.zeros(6), covariance_second, size=count)
    samples = first @ se3.exp(noise_first) @ second @ se3.exp(noise_second)
    expected = se3.composed_covariance(covariance_first, second, covariance_second)
    _assert_same_covariance(_sample_covariance(first @ second, samples), expected, count)


def test_covariances_of_many_motions_are_those_of_each() -> None:
    rng = np.random.default_rng(0)
    many = se3.exp(rng.normal(size=(2, 3, 6)))
    one, other = (np.array([[_covariance(rng, 0.01, 0.003) for _ in range(3)] for _ in range(2)]) for _ in range(2))
    inverse, composed = se3.inverse_covariance(many, one), se3.composed_covariance(one, many, other)
    for place in np.ndindex(2, 3):
        np.testing.assert_allclose(inverse[place], se3.inverse_covariance(many[place], one[place]), rtol=1e-12)
        expected = se3.composed_covariance(one[place], many[place], other[place])
        np.testing.assert_allclose(composed[place], expected, rtol=1e-12)


@LAWS
@given(poses(), tangents(), SEEDS)
def test_covariance_about_a_point_is_that_of_the_step_about_it(pose: se3.Array, eta: se3.Array, seed: int) -> None:
    point_m = np.random.default_rng(seed).normal(size=3)
    xi = se3.log(se3.inverse(pose) @ se3.moved(pose, eta, point_m))
    # Every covariance is a sum of such products, and the function is linear in it.
    scale = 1.0 + float(xi @ xi) + float(eta @ eta)
    about = se3.covariance_about(np.outer(xi, xi), point_m)
    np.testing.assert_allclose(about, np.outer(eta, eta), atol=1e-11 * scale)


@LAWS
@given(SEEDS)
def test_covariance_about_a_point_is_symmetric_and_leads_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    point_m, covariances = rng.normal(size=3), np.stack([_covariance(rng, 0.01, 0.003) for _ in range(3)])
    about = se3.covariance_about(covariances, point_m)
    np.testing.assert_array_equal(about, np.swapaxes(about, 1, 2))
    np.testing.assert_array_equal(about[1], se3.covariance_about(covariances[1], point_m))
    np.testing.assert_allclose(se3.covariance_about(about, -point_m), covariances, atol=1e-17, rtol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_mean_solves_its_equation_and_recovers_the_gaussian(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 50_000
    pose = se3.exp(rng.normal(size=6))
    covariance = _covariance(rng, 0.2, 0.05)
    samples = pose @ se3.exp(rng.multivariate_normal(np.zeros(6), covariance, size=count))
    weights = rng.uniform(0.5, 1.5, size=count)
    centre, spread = se3.mean(samples, weights)
    residual = weights @ se3.log(se3.inverse(centre) @ samples) / weights.sum()
    assert np.linalg.norm(residual) < 1e-11
    offset = se3.log(se3.inverse(pose) @ centre)
    effective = weights.sum() ** 2 / np.sum(weights**2)
    assert offset @ np.linalg.solve(covariance, offset) < 30.0 / effective  # chi² with 6 dof, p = 4e-5
    _assert_same_covariance(spread, covariance, int(effective))
    np.testing.assert_array_equal(spread, spread.T)


def test_means_that_are_predicted_from_means_stay_rigid(rng: np.random.Generator) -> None:
    before, last = np.eye(4), se3.exp(np.array([0.1, 0.2, -0.05, 0.01, 0.0, 0.02]))
    for _ in range(100):
        predicted = last @ se3.inverse(before) @ last
        samples = predicted @ se3.exp(rng.normal(0.0, 1e-3, (50, 6)))
        before, last = last, se3.mean(samples, np.ones(50))[0]
    np.testing.assert_allclose(last[:3, :3] @ last[:3, :3].T, np.eye(3), atol=1e-12)


def test_mean_does_not_depend_on_the_frame_nor_on_the_start() -> None:
    rng = np.random.default_rng(3)
    samples = se3.exp(rng.normal(size=(20, 6)) * 0.3)
    weights = rng.uniform(size=20)
    left, right = se3.exp(rng.normal(size=(2, 6)))
    centre, covariance = se3.mean(samples, weights)
    moved, moved_covariance = se3.mean(left @ samples @ right, weights)
    np.testing.assert_allclose(moved, left @ centre @ right, atol=1e-10)
    adjoint = se3.adjoint(se3.inverse(right))
    np.testing.assert_allclose(moved_covariance, adjoint @ covariance @ adjoint.T, atol=1e-10)
    np.testing.assert_allclose(se3.mean(samples, 7.0 * weights, start=samples[3])[0], centre, atol=1e-10)
