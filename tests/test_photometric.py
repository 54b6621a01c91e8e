"""Colour as evidence: print turns with the object and tells its spin; light stays, and says nothing."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import ndimage
from tabletop import recoloured

import modeler
from modeler import se3
from modeler.evaluation import nees, rotation_error_deg
from modeler.kernels import bands, gauss_newton, point_to_plane, scores
from modeler.pipeline import Modeler
from modeler.priors import TablePrior
from modeler.registration import VisibilityLikelihood, VisibilityRegistrar
from modeler.registration.visibility import photometric as colours
from modeler.se3 import rows
from modeler.sequences import bundled, open_sequence
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Place, Places, load_recipe
from modeler.types import Array, Camera, Frame, InputError, Outcome, Posterior, RayImage
from modeler.views import Sensor

TURN_DEG = 24.0
Views = tuple[RayImage, RayImage]


def turned(name: str) -> tuple[Views, Array]:
    """Return two views of a built-in recipe, turned about the vertical, and the true motion from first to second."""
    recipe = load_recipe(name)
    places = Places((Place(), Place(rotation_deg=(0.0, 0.0, TURN_DEG))))
    sequence = RenderedSequence(replace(recipe, trajectory=places))
    noise, truth = sequence.sensor(), sequence.truth()
    loop: Any = Modeler(sensor=Sensor(noise))
    frames = [sequence.frame(index) for index in (0, 1)]
    first, second = (loop.prepare(frame, loop.segmenter.scene(frames)).view for frame in frames)
    return (first, second), np.asarray(truth[1] @ se3.inverse(truth[0]))


@pytest.fixture(scope="module")
def printed() -> tuple[Views, Array]:
    return turned("ball")


def picture(rng: np.random.Generator) -> Frame:
    """Return a frame whose colours are smooth noise."""
    height, width = 60, 80
    camera = Camera(width, height, 100.0, 100.0, 39.5, 29.5)
    coarse = rng.uniform(60.0, 200.0, (height // 5, width // 5, 3))
    colour = np.kron(coarse, np.ones((5, 5, 1))).astype(np.uint8)
    return Frame(0, 0.0, np.full((height, width), 0.5, dtype=np.float32), camera, colour=colour)


def features(frame: Frame, normals: Array | None = None) -> np.ndarray:
    """Return the features of a frame that is all surface, by default of one that faces the camera."""
    pixels = np.argwhere(np.ones(frame.depth_m.shape, dtype=bool))
    facing = np.broadcast_to([0.0, 0.0, -1.0], (len(pixels), 3)) if normals is None else normals
    return colours.features(frame, pixels, facing)


def test_exposure_does_not_change_features(rng):
    frame = picture(rng)
    brighter = replace(frame, colour=(1.2 * (frame.colour.astype(float) + 4.0) - 4.0).round().astype(np.uint8))
    found, changed = features(frame), features(brighter)
    for band in range(colours.BANDS):
        deviation = found[band, colours.VALUE].std()
        assert np.abs(changed[band, colours.VALUE] - found[band, colours.VALUE]).max() < 0.1 * deviation


def test_a_plain_image_has_no_features(rng):
    frame = replace(picture(rng), colour=np.full((60, 80, 3), 90, dtype=np.uint8))
    np.testing.assert_allclose(features(frame), 0.0, atol=1e-5)


def test_the_edge_between_faces_that_are_lit_unlike_is_no_feature(rng):
    frame = picture(rng)
    left = np.arange(80) < 40
    bright = np.where(left, 180, 90).astype(np.uint8)
    lit = replace(frame, colour=np.broadcast_to(bright[None, :, None], (60, 80, 3)))
    faces = np.where(left[:, None], [-0.6, 0.0, -0.8], [0.6, 0.0, -0.8])
    assert np.abs(features(lit)).max() > 0.1
    np.testing.assert_allclose(features(lit, np.tile(faces, (60, 1))), 0.0, atol=1e-3)


def test_bands_are_differences_of_gaussian_means(rng):
    frame = picture(rng)
    image = features(frame).reshape(colours.BANDS, 3, 60, 80)
    logs = np.log(frame.colour + 4.0).mean(axis=2)
    inside = (slice(20, -20), slice(20, -20))
    for band in range(3):
        width_px = colours.FINEST_PX * 2**band
        exact = ndimage.gaussian_filter(logs, width_px) - ndimage.gaussian_filter(logs, 2.0 * width_px)
        by_row, by_column = np.gradient(exact, axis=0), np.gradient(exact, axis=1)
        for layer, want in ((0, exact), (colours.BY_ROW, by_row), (colours.BY_COLUMN, by_column)):
            assert np.corrcoef(image[band, layer][inside].ravel(), want[inside].ravel())[0][1] > 0.95


def test_few_spots_are_limited_and_prints_are_not(rng):
    surface = rng.uniform(-1.0, 1.0, size=(3, 4000)).astype(np.float32)
    spots, print_ = surface.copy(), surface.copy()
    spots[:, :80] *= 50.0
    print_[:, :1600] *= 3.0
    want = print_ / print_[0].std()
    for band in (spots, print_):
        bands.winsorise(band)
        np.testing.assert_allclose(band[0].std(), 1.0, atol=0.02)
    limited = np.abs(spots[0]) > 2.9999
    assert 70 < np.count_nonzero(limited[:80])
    assert not np.any(limited[80:])
    assert not np.any(spots[1:, limited])
    np.testing.assert_allclose(print_, want, atol=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_curvatures_are_those_of_the_likelihood(printed, seed: int):
    """Averaged over their axes: poses by one standard deviation from the true one are half a nat worse.

    Along a single axis it is 0.1 to 1.4 of that, depending on the points. They are of squared distances and differences
    of features, without what the fixed pattern takes off them.
    """
    views = [replace(view, pattern_share=0.0) for view in printed[0]]
    pair = VisibilityLikelihood().between(views[0], views[1], np.random.default_rng(seed))
    fine_m = 0.015 * pair.size_m
    best = printed[1]
    noise_m, _ = pair.noises_m(best, fine_m)
    found = pair.curvatures(best[None], noise_m, stride=1)[0]
    scales, axes = np.linalg.eigh(found)
    away, ratios = np.linspace(-2.0, 2.0, 41), []
    for scale, axis in zip(scales, axes.T, strict=True):
        poses = se3.moved(
            best[None].repeat(len(away), axis=0),
            np.outer(away, np.asarray(axis / np.sqrt(scale), dtype=np.float64)),
            pair.centre_m,
        )
        values = pair.tempered(poses, noise_m, typical_misfit=pair.typical_misfit(best, noise_m))
        ratios.append(-2.0 * np.polyfit(away, values, 2)[0])
    assert 0.5 < np.mean(ratios) < 1.5


def test_moments_are_sums_over_matching_points(printed):
    views, truth = printed
    pair = VisibilityLikelihood(colour=True).between(views[0], views[1], np.random.default_rng(0))
    both = pair.colour.colours(1, 1)
    sides = (*pair.surfaces(1), pair.forward.parameters(0.002), pair.backward.parameters(0.002))
    found = scores.scores(rows(truth[None]), *sides, both)[0, scores.PRODUCT :]
    want = np.zeros(4)
    carried = ((truth, both[0], pair.forward), (se3.inverse(truth), both[1], pair.backward))
    for pose, seen, directed in carried:
        matches = directed.matches(rows(pose), 0.002)
        good = matches[:, point_to_plane.WEIGHT] > 0.0
        camera = directed.image.frame.camera
        x, y, z = matches[:, point_to_plane.POSITION].T
        pixel = np.round(camera.fy * y / z + camera.cy) * camera.width + np.round(camera.fx * x / z + camera.cx)
        cells = seen.cells[seen.numbers[pixel.astype(int)]]
        other = np.sum(cells[:, :3] * matches[:, point_to_plane.POSITION], axis=1) + cells[:, 3]
        weight, own = matches[:, point_to_plane.FACING_WEIGHT] * good, seen.values
        want += [np.sum(weight * part) for part in (own * other, own * own, other * other, 1.0)]
    np.testing.assert_allclose(found, want, rtol=0.02)


def test_equations_of_features_are_those_of_planes_with_their_gradient(printed):
    views, truth = printed
    pair = VisibilityLikelihood(colour=True).between(views[0], views[1], np.random.default_rng(0))
    pose, weight = se3.moved(truth[None], np.full((1, 6), 0.004), pair.centre_m)[0], 3.0
    both = pair.colour.colours(1, 1)
    gradients_of, matrices_of = gauss_newton.normal_equations(
        rows(pose[None]), pair.surfaces(1), both, np.float32(weight), pair.centre_m, 0.002
    )
    want = np.zeros(6), np.zeros((6, 6))
    for directed, carried, sign in ((pair.forward, pose, 1.0), (pair.backward, se3.inverse(pose), -1.0)):
        matches = directed.matches(rows(carried), 0.002)
        points = np.flatnonzero(matches[:, point_to_plane.WEIGHT] > 0.0)
        found = pair.colour.matches(carried, matches[points], points, 1, weight, forward=sign > 0.0)
        to_source = se3.inverse(pose) if sign > 0.0 else np.eye(4)
        arms = se3.transform(to_source, found[:, point_to_plane.POSITION]) - pair.centre_m
        gradients = found[:, point_to_plane.OTHER] @ to_source[:3, :3].T
        derivatives = sign * np.hstack([np.cross(arms, gradients), gradients])
        weighted = derivatives.T * found[:, point_to_plane.WEIGHT]
        want = want[0] - weighted @ found[:, point_to_plane.RESIDUAL], want[1] + weighted @ derivatives
    assert abs(want[0]).max() > 0.0
    np.testing.assert_allclose(gradients_of[0, 1], want[0], rtol=0.02, atol=0.02 * abs(want[0]).max())
    np.testing.assert_allclose(matrices_of[0, 1], want[1], rtol=0.02, atol=0.02 * abs(want[1]).max())


def test_noise_of_normals_does_not_seem_to_tell_how_a_ball_turns(printed):
    views, truth = printed
    pair = VisibilityLikelihood(colour=False).between(views[0], views[1], np.random.default_rng(0))
    extent, blur_m = np.repeat([1.0, pair.size_m], 3), 0.06 * pair.size_m
    by_both = np.linalg.eigvalsh(pair.sensitivity(truth, blur_m) * np.outer(extent, extent))
    by_mean = np.linalg.eigvalsh(pair.curvatures(truth[None], blur_m, stride=1)[0] * np.outer(extent, extent))
    np.testing.assert_allclose(by_both[3:], by_mean[3:], rtol=0.02)
    assert np.all(np.abs(by_both[:3]) < 0.5 * by_mean[:3])


def registered(views: Views, *, colour: bool, seed: int = 0) -> Posterior:
    registrar = VisibilityRegistrar(VisibilityLikelihood(colour=colour))
    density = TablePrior().between(*views)
    return registrar.register(*views, density, rng=np.random.default_rng(seed))


def test_a_label_tells_the_spin_that_depth_leaves_open(printed):
    views, truth = printed
    depth, both = registered(views, colour=False), registered(views, colour=True)
    assert depth.outcome is Outcome.AMBIGUOUS
    assert both.outcome is Outcome.CONVERGED
    sigma_deg = np.rad2deg(np.sqrt(np.trace(both.pose.covariance[:3, :3])))
    assert sigma_deg < 5.0
    assert rotation_error_deg(both.pose.mean, truth) < 3.0 * sigma_deg


@pytest.mark.parametrize("seed", range(4))
def test_the_peak_that_a_label_makes_on_the_ridge_of_a_spin_is_drawn(printed, seed):
    assert registered(printed[0], colour=True, seed=seed).usable


def test_what_stays_in_its_place_is_found_though_centroids_err(printed):
    (view, _), _ = printed
    aside = recoloured(view, np.roll(np.asarray(view.frame.colour), (1, -1), axis=(0, 1)))
    pair = VisibilityLikelihood().between(view, aside, np.random.default_rng(0))
    assert all(pair.colour.static_correlation(band) > 0.8 for band in range(3))


def test_noise_of_colours_counts_more_than_print_unless_it_is_light_that_stays(printed):
    (view, other), _ = printed
    aside = recoloured(view, np.roll(np.asarray(view.frame.colour), (1, -1), axis=(0, 1)))
    for target, noise in ((other, 400.0), (aside, 140.0)):
        colour = VisibilityLikelihood().between(view, target, np.random.default_rng(0)).colour
        static = 1.0 - colour.static_correlation(0) ** 2
        found = static / colour.independent(0, np.array([0.0, 1.0])) - 1.0 / colour.patches(0)
        np.testing.assert_allclose(1.0 / found, [noise, 140.0], rtol=0.1)


def test_the_curvature_of_colours_is_the_slope_of_their_gain(printed):
    views, _ = printed
    colour = VisibilityLikelihood().between(views[0], views[1], np.random.default_rng(0)).colour
    for correlation in (0.2, 0.8):
        squares = correlation**2 + np.array([-1e-4, 1e-4])
        gains = colour.independent(0, np.sqrt(squares)) * squares
        slope = float(np.diff(gains)[0]) / 2e-4
        np.testing.assert_allclose(colour.curvature(correlation, 0), correlation * slope, rtol=1e-3)


def test_a_shift_of_colours_is_eliminated(rng):
    root, shifts = rng.normal(size=(6, 6)), rng.normal(size=(6, 2))
    information = root @ root.T
    marginal = colours.without_shift(information, shifts) @ information
    np.testing.assert_allclose(np.linalg.inv(marginal), np.linalg.inv(information) + shifts @ shifts.T, rtol=1e-8)


def test_a_shift_of_colours_widens_the_spin_and_does_not_mislead(printed):
    views, truth = printed
    shift_px = 0.7
    loose = [replace(view, sigma_colour_px=shift_px) for view in views]
    colour = loose[1].frame.colour
    moved = np.stack(
        [ndimage.shift(colour[..., k], (0.0, shift_px), order=1, mode="nearest") for k in range(3)], axis=-1
    )
    loose[1] = recoloured(loose[1], moved)
    aligned, shifted = registered(views, colour=True), registered((loose[0], loose[1]), colour=True)
    assert nees(shifted.pose, truth) / 6.0 < 3.0
    assert np.trace(shifted.pose.covariance[:3, :3]) > np.trace(aligned.pose.covariance[:3, :3])


def test_light_says_nothing_of_the_spin_of_a_plain_tin():
    views, truth = turned("tin-plain")
    posterior = registered(views, colour=True)
    assert posterior.outcome is Outcome.AMBIGUOUS
    assert nees(posterior.pose, truth) / 6.0 < 6.0


def test_without_colour_pairs_are_what_depth_says(printed):
    views, _ = printed
    first, second = (recoloured(view, None) for view in views)
    without, switched_off = registered((first, second), colour=True), registered(views, colour=False)
    np.testing.assert_array_equal(without.pose.mean, switched_off.pose.mean)
    np.testing.assert_array_equal(without.pose.covariance, switched_off.pose.covariance)


def test_two_arrays_are_registered_with_their_colours():
    sequence = open_sequence(bundled("box"))
    frames = [sequence.frame(index) for index in (0, 1)]
    depths, masks, colours = (tuple(getattr(frame, name) for frame in frames) for name in ("depth_m", "mask", "colour"))
    given = {"intrinsics": frames[0].camera, "masks": masks}
    with pytest.raises(InputError, match="colours"):
        modeler.register(*depths, **given, colours=(colours[0][:5], colours[1]))
    seen, blind = modeler.register(*depths, **given, colours=colours), modeler.register(*depths, **given)
    assert not np.array_equal(seen.pose.mean, blind.pose.mean)
