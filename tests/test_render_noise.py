"""The depth camera: each effect does what its parameters say, and nothing when it is left out."""

from dataclasses import replace

import numpy as np
import pytest

from sequences.rendering.depth_sensor import (
    EXACT,
    DepthSensor,
    DisparityNoise,
    Exposure,
    GrazingLoss,
    LateralJitter,
    MixedPixels,
    RandomLoss,
    gaussian_field,
)
from sequences.rendering.recipe import Recipe, Viewpoint
from sequences.rendering.renderer import RenderedSequence
from sequences.rendering.shapes import AnyShape, Box, Compound, Part
from sequences.rendering.trajectory import Place, Places

FOCAL_PX, BASELINE_M = 575.0, 0.075
SHAPE = (240, 320)
VIEW = Viewpoint(160, 120, 144.0)
KINECT = DepthSensor()


def exposure(depth_m: np.ndarray | float, incidence_deg: float = 0.0) -> Exposure:
    full_m = np.broadcast_to(depth_m, SHAPE).astype(np.float64)
    return Exposure(full_m, np.full(SHAPE, np.radians(incidence_deg)), np.zeros(SHAPE, bool))


def measured(sensor: DepthSensor, seen: Exposure, seed: int = 0) -> np.ndarray:
    return sensor.measure(seen, FOCAL_PX, np.random.default_rng(seed)).astype(np.float64)


def only(**effects: object) -> DepthSensor:
    return replace(EXACT, baseline_m=BASELINE_M, **effects)  # type: ignore[arg-type]


def test_without_effects_depth_is_left_as_it_is() -> None:
    rng = np.random.default_rng(0)
    depth_m = rng.uniform(0.1, 9.0, SHAPE)
    depth_m[rng.random(SHAPE) < 0.1] = np.nan
    seen = Exposure(depth_m, rng.uniform(0, np.pi / 2, SHAPE), rng.random(SHAPE) < 0.5)
    np.testing.assert_array_equal(measured(EXACT, seen), depth_m.astype(np.float32))


@pytest.mark.parametrize("depth_m", [0.6, 0.8, 1.6])
@pytest.mark.parametrize("correlation_px", [0.0, 1.0])
def test_noise_is_as_strong_as_it_says(depth_m: float, correlation_px: float) -> None:
    noise = DisparityNoise(0.07, 0.0, correlation_px)
    error_m = measured(only(disparity=noise), exposure(depth_m)) - depth_m
    expected_m = depth_m**2 / (FOCAL_PX * BASELINE_M) * 0.07
    assert error_m.std() == pytest.approx(expected_m, rel=0.03)
    assert noise.sigma_m(depth_m, FOCAL_PX * BASELINE_M) == pytest.approx(expected_m)
    assert abs(error_m.mean()) < 0.05 * expected_m
    neighbours = np.corrcoef(error_m[:, :-1].ravel(), error_m[:, 1:].ravel())[0, 1]
    # Of a field smoothed by a Gaussian of width s, neighbours at d share exp(-d² / 4s²).
    assert neighbours == pytest.approx(0.0 if correlation_px == 0.0 else np.exp(-0.25), abs=0.03)


def test_the_default_is_a_kinect_at_arms_length() -> None:
    sigma_wh, sigma_r_m = KINECT.sigmas(0.8, FOCAL_PX, 1e-4)
    ramp_m = 0.8 + np.linspace(-0.01, 0.01, SHAPE[1])[None]  # over several steps of disparity
    quiet = only(disparity=DisparityNoise())
    error_m = measured(quiet, exposure(ramp_m)) - ramp_m
    assert 1.0e-3 < sigma_r_m < 1.5e-3
    assert error_m.std() == pytest.approx(sigma_r_m, rel=0.05)
    assert 0.3 / FOCAL_PX < sigma_wh < 1.0 / FOCAL_PX


def test_disparity_comes_in_steps() -> None:
    depth_m = measured(only(disparity=DisparityNoise(0.2, 0.125)), exposure(0.8))
    steps = FOCAL_PX * BASELINE_M / depth_m / 0.125
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)
    assert len(np.unique(np.rint(steps))) > 5


def test_noise_grows_on_slopes() -> None:
    noise = only(disparity=DisparityNoise(0.07, 0.0, 0.0, slope_gain=0.075))
    flat_m, steep_m = (np.std(measured(noise, exposure(0.8, angle))) for angle in (0.0, 75.0))
    slope = np.radians(75.0)
    assert steep_m / flat_m == pytest.approx(1 + 0.075 * (slope / (np.pi / 2 - slope)) ** 2, rel=0.02)


def test_fields_have_unit_variance() -> None:
    for correlation_px in (0.0, 0.5, 1.5, 4.0):
        field = gaussian_field((400, 600), correlation_px, np.random.default_rng(0))
        assert field.std() == pytest.approx(1.0, rel=0.06)
        assert abs(field.mean()) < 0.06


def test_jitter_is_as_wide_as_it_says_and_shared_by_neighbours() -> None:
    along_w, along_h = LateralJitter(0.4, 1.5).offsets_px((400, 600), np.random.default_rng(0))
    for offsets in (along_w, along_h):
        assert offsets.std() == pytest.approx(0.4, rel=0.03)
        assert np.corrcoef(offsets[1:].ravel(), offsets[:-1].ravel())[0, 1] > 0.8
    assert abs(np.corrcoef(along_w.ravel(), along_h.ravel())[0, 1]) < 0.05


def test_grazing_surfaces_are_lost_and_others_are_not() -> None:
    sensor = only(grazing=GrazingLoss(70.0, 88.0))
    lost = [np.isnan(measured(sensor, exposure(0.8, angle))).mean() for angle in (0.0, 69.9, 79.0, 88.0)]
    assert lost[0] == lost[1] == 0.0
    assert lost[2] == pytest.approx(0.5, abs=0.02)
    assert lost[3] == 1.0


def test_pixels_mix_at_borders_only_and_stay_between() -> None:
    depth_m = np.where(np.arange(SHAPE[1]) < 160, 0.8, 1.1)
    mixed = measured(only(mixed=MixedPixels(0.5, 0.02)), exposure(depth_m))
    moved = np.abs(mixed - depth_m) > 1e-6
    assert not moved[:, :159].any()
    assert not moved[:, 161:].any()
    assert moved[:, 159:161].mean() == pytest.approx(0.5, abs=0.07)
    assert mixed.min() >= np.float32(0.8)
    assert mixed.max() <= np.float32(1.1)
    slope_m = np.broadcast_to(0.8 + 0.0005 * np.arange(SHAPE[1]), SHAPE)
    np.testing.assert_allclose(measured(only(mixed=MixedPixels(1.0, 0.02)), exposure(slope_m)), slope_m, atol=1e-6)


def test_a_share_of_pixels_is_lost_anywhere() -> None:
    lost = np.isnan(measured(only(loss=RandomLoss(0.05, 0.0)), exposure(0.8)))
    assert lost.mean() == pytest.approx(0.05, abs=0.005)


def test_depth_out_of_range_is_not_measured() -> None:
    depth_m = np.linspace(0.1, 5.0, SHAPE[1])
    seen = np.isfinite(measured(only(min_range_m=0.4, max_range_m=3.5), exposure(depth_m)))
    np.testing.assert_array_equal(seen[0], (depth_m >= 0.4) & (depth_m <= 3.5))


@pytest.mark.parametrize("off", ["jitter", "mixed", "disparity", "grazing", "loss"])
def test_leaving_one_effect_out_leaves_the_others_as_they_were(off: str) -> None:
    everything, without = (
        measured(KINECT, exposure(0.8, 75.0)),
        measured(replace(KINECT, **{off: None}), exposure(0.8, 75.0)),
    )
    both = np.isfinite(everything) & np.isfinite(without)
    assert both.sum() > 1000
    assert np.array_equal(everything[both], without[both]) == (off != "disparity")
    if off in ("disparity", "jitter", "mixed"):
        np.testing.assert_array_equal(np.isfinite(everything), np.isfinite(without))


# --- in the renderer ---


def scene(thing: AnyShape, sensor: DepthSensor | None) -> RenderedSequence:
    """A thing 0.8 m in front of the camera, which looks along the horizontal."""
    view = replace(VIEW, elevation_deg=0.0, look_height_m=0.0)
    trajectory = Places((Place((0.0, 0.0, -0.15)),))
    return RenderedSequence(Recipe(thing, view=view, table=None, sensor=sensor, trajectory=trajectory))


def test_the_projector_throws_a_shadow_as_wide_as_the_disparities_differ() -> None:
    plate, back = Box((0.1, 0.002, 0.3)), Box((2.0, 0.002, 2.0))
    parts = Compound((Part(plate), Part(back, offset_m=(0.0, 0.3, 0.0))))
    near_m, far_m = 0.8 - 0.151, 0.8 - 0.151 + 0.3  # the compound is centred; its plates are 2 mm thick
    for baseline_m in (0.075, -0.075):
        sensor = replace(EXACT, baseline_m=baseline_m, shadow=True)
        sequence = RenderedSequence(replace(scene(parts, sensor).recipe, trajectory=Places((Place((0.0, 0.0, -1.0)),))))
        lost = np.isnan(sequence.frame(0).depth_m[60])
        expected_px = VIEW.focal_px * abs(baseline_m) * (1 / near_m - 1 / far_m)
        assert lost.sum() == pytest.approx(expected_px, abs=1.01)
        columns = np.nonzero(lost)[0]
        assert np.ptp(columns) + 1 == len(columns)  # one band
        on_left = columns.mean() < VIEW.camera().cx
        assert on_left == (baseline_m > 0)  # light from the right leaves the left in the dark
        assert not np.isnan(replace_shadow(sequence, False).frame(0).depth_m[60]).any()


def replace_shadow(sequence: RenderedSequence, shadow: bool) -> RenderedSequence:
    sensor = sequence.recipe.sensor
    assert sensor is not None
    return RenderedSequence(replace(sequence.recipe, sensor=replace(sensor, shadow=shadow)))


def test_jitter_alone_moves_borders_but_not_a_plate_that_faces_the_camera() -> None:
    plate = Box((0.2, 0.01, 0.3))
    exact = scene(plate, None).frame(0)
    moved = scene(plate, replace(EXACT, jitter=LateralJitter(0.5, 1.5))).frame(0)
    both = np.isfinite(exact.depth_m) & np.isfinite(moved.depth_m)
    np.testing.assert_allclose(moved.depth_m[both], exact.depth_m[both], atol=1e-6)
    changed = np.isfinite(exact.depth_m) != np.isfinite(moved.depth_m)
    assert changed.any()
    rows, columns = np.nonzero(changed)
    edges_px = VIEW.camera().cx + np.array([-1, 1]) * VIEW.focal_px * 0.1 / (0.8 - 0.005)
    at_side = np.abs(columns[:, None] - edges_px).min(axis=1) < 3
    lines_px = VIEW.camera().cy + np.array([-1, 1]) * VIEW.focal_px * 0.15 / (0.8 - 0.005)
    at_end = np.abs(rows[:, None] - lines_px).min(axis=1) < 3
    assert (at_side | at_end).all()
