"""Depth errors near silhouettes: estimated from matches, and eliminated from their equations."""

from dataclasses import replace
from typing import Final

import numpy as np
import pytest
from scipy import ndimage, optimize

from modeler.evaluation import nees, rotation_error_deg, true_motion
from modeler.kernels import planes
from modeler.kernels.point_to_plane import FACING_WEIGHT, OTHER_RIM, WEIGHT
from modeler.priors import GeneralPrior
from modeler.registration import VisibilityLikelihood, VisibilityRegistrar
from modeler.registration.visibility.directed import OWN_RIM, nonnegative_solution, significant_variances
from modeler.registration.visibility.likelihood import PairLikelihood
from modeler.registration.visibility.refinement import Equations
from modeler.se3 import rows
from modeler.sequences import bundled, open_sequence
from modeler.types import Array, RayImage
from modeler.views.rays import Sensor, rim_weights

BLUR_M: Final = 0.001


class Unaware(PairLikelihood):
    """Without errors near silhouettes."""

    def with_rim_m(self, rim_m: float) -> PairLikelihood:
        return self


class UnawareLikelihood(VisibilityLikelihood):
    """The likelihood of such pairs."""

    def between(self, source: RayImage, target: RayImage, rng: np.random.Generator) -> PairLikelihood:
        pair = super().between(source, target, rng)
        return Unaware(pair.forward, pair.backward, pair.size_m)


def boxes(target: int, nearer_m: float) -> tuple[RayImage, RayImage, Array]:
    """Return two views of the bundled box, too near by up to `nearer_m` at the rim, and the true motion."""
    sequence = open_sequence(bundled("box"))
    truth, noise, views = sequence.truth(), sequence.sensor(), []
    assert truth is not None
    assert noise is not None
    for index in (target, target + 1):
        frame = sequence.frame(index)
        assert frame.mask is not None
        depth_m = frame.depth_m - nearer_m * np.where(frame.mask, rim_weights(frame.mask), 0.0)
        views.append(Sensor(noise).ray_image(replace(frame, depth_m=depth_m.astype(np.float32), colour=None)))
    return views[1], views[0], true_motion(truth, target=target, source=target + 1)


def test_weights_fall_with_the_distance_from_the_silhouette() -> None:
    outline = np.zeros((80, 90), dtype=bool)
    outline[10:70, 15:90] = True  # as far as the edge of the image, which is no silhouette
    within_px = ndimage.distance_transform_edt(np.pad(outline, ((0, 0), (0, 99)), mode="edge"))
    exact = np.exp(-((np.asarray(within_px, dtype=np.float64) / 10.0) ** 2))
    found = rim_weights(outline)[outline]
    assert found == pytest.approx(exact[:, :90][outline], abs=0.06)
    assert found.max() > 0.98
    assert rim_weights(np.ones((20, 20), dtype=bool)).max() < 1e-3


def test_cells_and_points_hold_the_weights() -> None:
    source, _, _ = boxes(2, 0.0)
    pair = VisibilityLikelihood().between(source, source, np.random.default_rng(0))
    mask = source.frame.mask
    assert mask is not None
    on_surface = source.layers["cells"][..., planes.KIND] == planes.SURFACE
    weights = rim_weights(mask)
    assert source.layers["cells"][on_surface, planes.RIM] == pytest.approx(weights[on_surface], abs=1e-6)
    columns, lines = pair.forward.points[:, 7:9].round().astype(int).T
    assert pair.forward.points[:, OWN_RIM] == pytest.approx(weights[lines, columns], abs=1e-6)


def test_errors_near_silhouettes_are_estimated() -> None:
    found_m = []
    for nearer_m in (0.0, 0.002, 0.004):
        source, target, truth = boxes(3, nearer_m)
        pair = VisibilityLikelihood().between(source, target, np.random.default_rng(0))
        found_m.append(pair.noises_m(truth, BLUR_M)[1])
    assert np.all(np.diff(found_m) > 1e-4)
    assert found_m[2] > 2.0 * found_m[0]


def test_views_that_agree_have_none() -> None:
    source, _, _ = boxes(2, 0.004)
    pair = VisibilityLikelihood().between(source, source, np.random.default_rng(0))
    assert pair.noises_m(np.eye(4), BLUR_M)[1] < 1e-4


def test_noises_are_the_nonnegative_least_squares(rng: np.random.Generator) -> None:
    zeros = 0
    for _ in range(200):
        design, right = rng.uniform(size=(8, 2)), rng.normal(0.1, 1.0, 8)
        want = optimize.nnls(design, right)[0]
        (aa, ab), (_, bb) = (design.T @ design).tolist()
        assert nonnegative_solution(aa, ab, bb, *(design.T @ right).tolist()) == pytest.approx(want, abs=1e-9)
        zeros += int(np.count_nonzero(want == 0.0))
    assert 50 < zeros < 350
    assert nonnegative_solution(5.0, 0.0, 0.0, 1.0, 0.0) == (0.2, 0.0)  # nothing near silhouettes


def test_chance_does_not_pass_for_errors_near_silhouettes(rng: np.random.Generator) -> None:
    """Groups of ten squares are alike, as neighbouring points are."""
    found = {0.0: list[float](), 4.0: list[float]()}
    for rim_m2, variances in found.items():
        for _ in range(400):
            rims = np.repeat(rng.uniform(0.0, 1.0, 80), 10)
            variance = 1.0 + rim_m2 * rims
            excess = variance * np.repeat(rng.chisquare(1, 80), 10)
            table = np.column_stack([np.ones(800), rims, excess])
            variances.append(significant_variances(table.T @ table, 80.0)[1])
    assert np.mean(np.array(found[0.0]) > 0.0) < 0.06
    assert np.mean(np.array(found[4.0]) > 0.0) > 0.5
    constant = np.column_stack([np.ones(50), np.zeros(50), np.full(50, 0.3)])
    assert significant_variances(constant.T @ constant, 20.0) == pytest.approx((0.3, 0.0))


def test_variances_grow_by_those_of_both_rims() -> None:
    """A match at distance r has the weight f / (τ² + σ² (ϑ² + ϑ'²))."""
    source, target, truth = boxes(2, 0.0)
    pair = VisibilityLikelihood().between(source, target, np.random.default_rng(0))
    from_matches = [one.forward.matches(rows(truth), 0.01) for one in (pair, pair.with_rim_m(0.003))]
    matched = from_matches[0][:, WEIGHT] > 0.0
    plain, wide = (found[matched] for found in from_matches)
    own = pair.forward.points[matched, OWN_RIM]
    more_m2 = wide[:, FACING_WEIGHT] / wide[:, WEIGHT] - plain[:, FACING_WEIGHT] / plain[:, WEIGHT]
    assert more_m2 == pytest.approx(9e-6 * (own**2 + plain[:, OTHER_RIM] ** 2), rel=2e-3, abs=1e-9)
    assert np.ptp(own) > 0.5


def test_elimination_is_the_schur_complement(rng: np.random.Generator) -> None:
    """Least squares for ξ and β ~ N(0, 1) together give the same ξ."""
    by_motion, by_nuisance = rng.normal(size=(40, 6)), rng.normal(size=40)
    residuals, weights = rng.normal(size=40), rng.uniform(0.5, 2.0, 40)
    zeros = np.zeros((40, 6))
    equations = Equations(zeros[:, :3], by_motion, by_motion, residuals, weights, zeros, np.zeros((2, 6, 6)))
    design = np.column_stack([by_motion, by_nuisance])
    joint = (design.T * weights) @ design + np.diag([0.0] * 6 + [1.0])
    want = np.linalg.solve(joint, -design.T @ (weights * residuals))[:6]
    left = equations.without(by_nuisance)
    gradient = -by_motion.T @ (weights * residuals) - left.explained.gradient
    matrix = (by_motion.T * weights) @ by_motion - left.explained.matrix
    assert np.linalg.solve(matrix, gradient) == pytest.approx(want)
    assert left.by_own.T @ (weights * residuals) == pytest.approx(-gradient)


def test_poses_are_nearer_and_not_overconfident_where_rims_are_too_near() -> None:
    squares, errors_deg = [], []
    for likelihood in (VisibilityLikelihood(), UnawareLikelihood()):
        registrar = VisibilityRegistrar(likelihood=likelihood)
        for frame in (2, 3):
            source, target, truth = boxes(frame, 0.004)
            density = GeneralPrior().between(source, target)
            posterior = registrar.register(source, target, density, rng=np.random.default_rng(0))
            squares.append(nees(posterior.pose, truth))
            errors_deg.append(rotation_error_deg(posterior.pose.mean, truth))
    assert sum(squares[:2]) < 0.5 * sum(squares[2:])
    assert sum(errors_deg[:2]) < 0.75 * sum(errors_deg[2:])
