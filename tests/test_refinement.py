"""Sharpening by matching surface: its equations against a plain twin, and what it may and may not make sure."""

from dataclasses import replace

import numpy as np
import pytest
from bundled_views import views
from naive_kernels import point_to_plane_equations
from scipy import ndimage

from modeler import se3
from modeler.evaluation import rotation_error_deg
from modeler.kernels import point_to_plane
from modeler.registration.posterior import weighted_gaussian
from modeler.registration.visibility import VisibilityLikelihood
from modeler.registration.visibility.directed import FixedPattern
from modeler.registration.visibility.likelihood import MatchNoise
from modeler.registration.visibility.refinement import Refiner, shrunk, visible_share
from modeler.registration.visibility.sampling import WeightedSamples
from modeler.se3 import rows


def bundled_pair(name):
    """The first two frames of a bundled sequence compared, and the true motion from 1 to 0."""
    source, target, truth = views(name, 1, 0)
    pair = VisibilityLikelihood().between(source, target, np.random.default_rng(0))
    return pair, truth, source.centroid_m


def scattered(truth, centre_m, sigmas, rng, count=400):
    """Motions around the truth: (6,) standard deviations of ξ about the centre."""
    return se3.moved(truth, rng.normal(size=(count, 6)) * sigmas, centre_m)


def sigmas_about(poses, centre_m):
    """Root mean square rotation (rad) and translation (m) about their mean at the centre."""
    pose = weighted_gaussian(poses, np.full(len(poses), 1.0 / len(poses)), centre_m)
    to_centre = se3.adjoint(se3.translation(-centre_m))
    variances = np.diag(to_centre @ pose.covariance @ to_centre.T)
    return pose.mean, np.sqrt(variances[:3].sum()), np.sqrt(variances[3:].sum())


def test_normal_equations_are_those_of_the_matching_points_and_the_fixed_pattern(rng):
    pair, truth, centre_m = bundled_pair("box")
    wide = FixedPattern(0.6, 1500.0)  # so that it reaches most matches
    pair = replace(pair, forward=replace(pair.forward, pattern=wide), backward=replace(pair.backward, pattern=wide))
    poses = scattered(truth, centre_m, np.repeat([0.01, 0.001], 3), rng, count=5)
    gradients, matrices = pair.normal_equations(poses, MatchNoise(0.001), stride=1)
    for pose, gradient, matrix in zip(poses, gradients, matrices, strict=True):
        want = np.zeros(6), np.zeros((6, 6))
        for directed, carried, sign in ((pair.forward, pose, 1.0), (pair.backward, se3.inverse(pose), -1.0)):
            # In the target, ξ moves points about the transformed centre, rotated; in the source by -ξ.
            turned = np.kron(np.eye(2), pose[:3, :3] if sign > 0.0 else -np.eye(3))
            about = se3.transform(pose, centre_m[None])[0] if sign > 0.0 else centre_m
            matches = directed.matches(rows(carried), 0.001)
            equations = point_to_plane_equations(matches, about)
            matched = matches[matches[:, point_to_plane.WEIGHT] > 0.0]
            slopes, _ = directed.pattern.derivatives(matched, directed.image.frame.camera)
            arms = matched[:, point_to_plane.POSITION] - about
            of_pattern = -np.hstack([np.cross(arms, slopes), slopes]).sum(axis=0)
            assert np.abs(of_pattern).max() > 0.0
            want = want[0] + turned.T @ (equations[0] + of_pattern), want[1] + turned.T @ equations[1] @ turned
        np.testing.assert_allclose(gradient, want[0], rtol=1e-4, atol=1e-5 * abs(want[0]).max())
        np.testing.assert_allclose(matrix, want[1], rtol=1e-4, atol=1e-5 * abs(want[1]).max())


def test_matches_are_near_and_face_alike(rng):
    pair, truth, centre_m = bundled_pair("flashlight")
    pose = scattered(truth, centre_m, np.repeat([0.02, 0.002], 3), rng, count=1)[0]
    found = pair.forward.matches(rows(pose), 0.001)
    carried = se3.transform(pose, pair.forward.points[:, :3])
    np.testing.assert_allclose(found[:, point_to_plane.POSITION], carried, atol=1e-6)
    good = found[found[:, point_to_plane.WEIGHT] > 0]
    assert 0.3 * len(found) < len(good) < len(found)
    assert (
        np.sum(good[:, point_to_plane.OWN] * good[:, point_to_plane.OTHER], axis=1)
        >= point_to_plane.MIN_AGREEMENT - 1e-6
    ).all()
    assert (
        good[:, point_to_plane.RESIDUAL] ** 2 * good[:, point_to_plane.WEIGHT] <= point_to_plane.MAX_SIGMAS**2
    ).all()


def alike(poses):
    """Samples of equal weight."""
    return WeightedSamples(poses, np.full(len(poses), 1.0 / len(poses)), np.zeros(len(poses)), 0.0, 0.0)


def test_directions_that_the_surface_determines_are_refined(rng):
    pair, truth, centre_m = bundled_pair("box")
    poses = scattered(truth, centre_m, np.repeat([0.01, 0.001], 3), rng)
    mean, turn_rad, shift_m = sigmas_about(Refiner().refine(pair, pair, alike(poses), rng, fine_m=0.001), centre_m)
    _, turn_before_rad, shift_before_m = sigmas_about(poses, centre_m)
    assert turn_rad < 0.5 * turn_before_rad
    assert shift_m < shift_before_m
    assert rotation_error_deg(mean, truth) < np.degrees(3.0 * turn_rad)


def test_the_roll_of_a_tube_is_not(rng):
    """A body of revolution: turning it about its axis moves no surface, and noise must not pass for knowledge."""
    pair, truth, centre_m = bundled_pair("tube")
    view = pair.backward.image
    arms = view.points_m - centre_m
    axis = np.linalg.svd(arms, full_matrices=False)[2][0]
    # About its own axis, which is behind the surface seen: the shift that lets surface slide along itself.
    shift, *_ = np.linalg.lstsq(view.normals, -np.sum(view.normals * np.cross(axis, arms), axis=1))
    roll = np.concatenate([axis, shift])
    poses = scattered(truth, centre_m, np.repeat([0.003, 0.0003], 3), rng)
    poses = se3.moved(poses, rng.normal(size=(len(poses), 1)) * 0.2 * roll, centre_m)
    refined = Refiner().refine(pair, pair, alike(poses), rng, fine_m=0.001)
    xi = se3.difference(truth, refined, centre_m)
    assert np.std(xi[:, :3] @ axis) > 0.12


def test_too_few_matches_leave_the_samples_alone(rng):
    pair, truth, centre_m = bundled_pair("box")
    poses = scattered(truth, centre_m, np.repeat([0.01, 0.001], 3), rng)
    refined = Refiner(min_matches=10_000.0).refine(pair, pair, alike(poses), rng, fine_m=0.001)
    np.testing.assert_allclose(refined, poses, atol=1e-9)


@pytest.mark.parametrize("width", [3, 5, 10, 20])
def test_the_scatter_of_patches_leaves_out_what_neighbours_share(width, rng):
    """Squares of noise smoothed by a square of 5 × 5: their scatter relative to the variance of the sum."""
    ball, side = 5, 20 * width
    noise = rng.normal(size=(60, side, side))
    smooth = ndimage.uniform_filter(noise, ball, mode="wrap", axes=(1, 2))
    sums = smooth.reshape(60, 20, width, 20, width).sum(axis=(2, 4))
    assert np.mean(sums**2) / width**2 == pytest.approx(
        visible_share((width / ball) ** 2), rel=0.1
    )  # pixels, not areas


@pytest.mark.parametrize("departs", [False, True])
def test_shrinking_to_the_expected_shape_improves_the_variability_of_few_scores(departs, rng):
    """Errors that are alike everywhere, and such as are far larger in one direction than they should be."""
    root = rng.normal(size=(6, 6))
    shape = root @ root.T
    truth = shape + (30.0 * np.outer(root[:, 0], root[:, 0]) if departs else 0.0)
    draws = rng.normal(size=(400, 32, 6)) @ np.linalg.cholesky(truth).T

    def error(found):
        return np.linalg.norm(np.linalg.solve(root, np.linalg.solve(root, found / 32 - truth).T))  # in units of shape

    shrinking = np.mean([error(shrunk(scores, 5.0 * shape)) for scores in draws])
    scattering = np.mean([error(scores.T @ scores * 32 / 31) for scores in draws])
    assert shrinking < (1.0 if departs else 0.4) * scattering


@pytest.mark.parametrize("scores", [np.zeros((32, 6)), 1e-12 * np.eye(32)[:, :6]])
def test_variability_is_positive_definite_where_residuals_vanish(scores, rng):
    root = rng.normal(size=(6, 3))  # three directions are determined, as by a plane
    variability = shrunk(scores, root @ root.T)
    assert np.linalg.eigvalsh(variability)[0] > 0.0
    assert np.linalg.eigvalsh(variability)[-1] < 0.01 * np.linalg.norm(root @ root.T)


def test_variability_is_the_scatter_of_many_scores_and_follows_a_change_of_coordinates(rng):
    root, turned = rng.normal(size=(2, 6, 6))
    scores = rng.normal(size=(100_000, 6)) @ root.T
    np.testing.assert_allclose(shrunk(scores, np.eye(6)), scores.T @ scores, rtol=0.01, atol=0.01 * len(scores))
    few = scores[:20]
    here, there = shrunk(few, root @ root.T), shrunk(few @ turned.T, turned @ root @ root.T @ turned.T)
    np.testing.assert_allclose(there, turned @ here @ turned.T, rtol=1e-6, atol=1e-6 * np.trace(there))
