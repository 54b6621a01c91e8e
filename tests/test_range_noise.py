"""Noise statistics of a depth camera, from what surrounds the object."""

from dataclasses import replace

import numpy as np
import pytest
import tabletop
from scipy.ndimage import gaussian_filter

from modeler import se3
from modeler.registration import VisibilityLikelihood
from modeler.segmentation import Segmenter
from modeler.types import Camera, Frame, SensorNoise
from modeler.views import Sensor
from modeler.views.range_noise import range_noise

CAMERA = Camera(width=480, height=360, fx=500.0, fy=500.0, cx=239.5, cy=179.5)
MASK = np.zeros((360, 480), dtype=bool)
MASK[150:230, 200:280] = True
NORMAL = np.array([0.1, -0.5, -0.8])


def plane_frame(sigma_inverse_per_m: float, width_px: float, *, bend: float = 0.0, index: int = 0) -> Frame:
    """A slanted plane behind a box at 0.7 m, with noise of inverse depth that is smooth over a width (sd) in px."""
    rng = np.random.default_rng(index)
    w, h = CAMERA.rays()
    inverse = -(NORMAL[0] * w + NORMAL[1] * h + NORMAL[2]) / 0.9 + bend * (w**2 + h**2)
    noise = rng.normal(size=inverse.shape)
    if width_px:
        noise = gaussian_filter(noise, width_px, mode="wrap")
        noise /= noise.std()
    depth_m = 1.0 / (inverse + sigma_inverse_per_m * noise)
    return Frame(index, float(index), np.where(MASK, 0.7, depth_m).astype(np.float32), CAMERA, MASK)


@pytest.mark.parametrize("sigma_inverse_per_m", [3e-4, 3e-3])
@pytest.mark.parametrize("width_px", [0.0, 1.0, 3.0])
def test_the_correlated_area_is_found_whatever_the_strength(sigma_inverse_per_m: float, width_px: float) -> None:
    noise = range_noise([(plane_frame(sigma_inverse_per_m, width_px, index=k), MASK) for k in range(4)])
    # Of a Gaussian mean of width s the autocorrelation is one of width √2 s. Wide errors pass for the plane's in part.
    expected_px = max(4.0 * np.pi * width_px**2, 1.0)
    assert noise.area_px == pytest.approx(expected_px, abs=0.5, rel=0.1 if width_px < 3.0 else 0.35)
    # Averaged over 6 × 6 px: the variance of independent errors falls to a 36th, that of wide ones hardly.
    lags = np.abs(np.subtract.outer(np.arange(6), np.arange(6)))
    correlation = np.exp(-((lags / (2.0 * width_px)) ** 2)) if width_px else np.eye(6)
    assert noise.sigma_inverse_per_m == pytest.approx(sigma_inverse_per_m * correlation.mean(), rel=0.1)
    assert noise.pixel_sigma_inverse_per_m == pytest.approx(sigma_inverse_per_m, rel=0.05 if width_px < 3.0 else 0.1)


def test_errors_that_averaging_removes_do_not_hide_smooth_ones() -> None:
    smooth = [plane_frame(1e-3, 2.0, index=k) for k in range(4)]
    rough = []
    for frame in smooth:
        errors = np.random.default_rng([frame.index, 1]).normal(0.0, 1e-3, frame.depth_m.shape)  # as strong
        rough.append(replace(frame, depth_m=(1.0 / (1.0 / frame.depth_m + errors)).astype(np.float32)))
    single, both = (range_noise([(frame, MASK) for frame in frames]) for frames in (smooth, rough))
    assert both.area_px == pytest.approx(single.area_px, rel=0.15)


def test_edges_and_the_object_do_not_count() -> None:
    frame = plane_frame(1e-3, 0.0)
    depth_m = frame.depth_m.copy()
    depth_m[:, 300:] += 0.4  # a step
    noise = range_noise([(Frame(0, 0.0, depth_m, CAMERA, MASK), MASK)])
    assert noise.area_px == pytest.approx(1.0, abs=0.1)
    assert noise.pattern_share is None  # one frame cannot tell


@pytest.mark.parametrize("nothing", [np.nan, 0.0])
def test_without_surroundings_nothing_is_said(nothing: float) -> None:
    frame = plane_frame(1e-3, 0.0)
    single = np.where(MASK, frame.depth_m, np.float32(nothing)).astype(np.float32)
    assert range_noise([(Frame(0, 0.0, single, CAMERA, MASK), MASK)]) is None
    assert range_noise([]) is None


@pytest.mark.parametrize("width_px", [0.0, 2.0])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_the_share_that_stays_from_frame_to_frame_is_found(share: float, width_px: float) -> None:
    fixed = plane_frame(1e-3, width_px, index=99)
    frames = []
    for k in range(4):
        inverse = np.sqrt(1.0 - share) / plane_frame(1e-3, width_px, index=k).depth_m + np.sqrt(share) / fixed.depth_m
        frames.append(Frame(k, float(k), (1.0 / inverse).astype(np.float32), CAMERA, MASK))
    noise = range_noise([(frame, MASK) for frame in frames])
    assert noise.pattern_share == pytest.approx(share, abs=0.05)


def test_a_scene_tells_the_sensor() -> None:
    scene = Segmenter().scene([plane_frame(2e-3, 2.0, index=k) for k in range(3)])
    noise = scene.range_noise
    assert noise.pattern_share is not None
    assert Sensor(SensorNoise(0.001, 0.0007)).measured(noise) == Sensor(
        SensorNoise(0.001, 0.0007),
        noise_area_px=noise.area_px,
        sigma_inverse_per_m=noise.sigma_inverse_per_m,
        pixel_sigma_inverse_per_m=noise.pixel_sigma_inverse_per_m,
        pattern_share=noise.pattern_share,
    )
    assert Sensor().measured(noise._replace(pattern_share=None)).pattern_share == Sensor().pattern_share
    assert Sensor().measured(Segmenter().scene([]).range_noise) == Sensor()


def test_balls_are_smaller_where_planes_show_less_noise_than_stated() -> None:
    frame = plane_frame(1e-3, 0.0)
    stated = Sensor(SensorNoise(sigma_r_m=0.004), min_neighbours=5.0)

    def ball_px(sensor: Sensor) -> float:
        return sensor.ray_image(frame).error_area_px - sensor.noise_area_px

    quarter, more = (replace(stated, pixel_sigma_inverse_per_m=share * 0.004 / 0.7**2) for share in (0.25, 2.0))
    assert ball_px(quarter) == pytest.approx(0.25 * ball_px(stated))  # ρ² is proportional to the noise: eq. 1.1
    assert ball_px(more) == ball_px(stated)  # the planes may be uneven


def test_the_more_pixels_err_alike_the_fewer_patches_a_view_has() -> None:
    frame = plane_frame(1e-3, 0.0)
    views = [
        Sensor(SensorNoise(0.001, 0.0007), noise_area_px=area_px).ray_image(frame) for area_px in (1.0, 10.0, 100.0)
    ]
    counts = [view.patches for view in views]
    assert counts[0] > counts[1] > counts[2]
    # Two correlated areas each beside the ball: method, eq. 1.4.
    sharing = [view.sharing for view in views]
    assert (sharing[2] - sharing[1]) / (sharing[1] - sharing[0]) == pytest.approx(10.0, rel=1e-6)


def test_views_of_a_noisy_camera_overlap_where_they_fit() -> None:
    sigma_m, width_px = 0.003, 3.0
    poses = tabletop.turntable(24)[:2]
    shared = {}
    for given in (0.0, sigma_m / 0.76**2):
        sensor = Sensor(SensorNoise(0.001, 0.001), noise_area_px=4.0 * np.pi * width_px**2, sigma_inverse_per_m=given)
        views = []
        for index, pose in enumerate(poses):
            frame = tabletop.view(tabletop.BRICK, pose, index).frame
            noise = gaussian_filter(np.random.default_rng(index).normal(size=frame.depth_m.shape), width_px)
            depth_m = (frame.depth_m + sigma_m * noise / noise.std()).astype(np.float32)
            views.append(sensor.ray_image(replace(frame, depth_m=depth_m, colour=None)))
        assert views[0].range_noise_m == pytest.approx(sigma_m if given else 0.0, rel=0.05)
        pair = VisibilityLikelihood().between(views[1], views[0], np.random.default_rng(0))
        truth = poses[0] @ se3.inverse(poses[1])
        shared[given] = pair.overlap(truth), pair.overlap(se3.translation(np.array([0.0, 0.0, 0.03])) @ truth)
    (unstated, _), (stated_right, stated_wrong) = shared.values()
    assert unstated < 0.5 < stated_right
    assert stated_wrong < 0.5
