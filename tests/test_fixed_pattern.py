"""Fixed-pattern noise: what both views have in common, and what it must not be taken for."""

from dataclasses import replace

import numpy as np
import pytest
import tabletop
from scipy.ndimage import gaussian_filter
from scipy.stats import chi2

from modeler import se3
from modeler.evaluation import about_point, nees
from modeler.kernels import point_to_plane
from modeler.priors import GeneralPrior
from modeler.registration import VisibilityRegistrar
from modeler.registration.visibility.directed import FixedPattern
from modeler.types import Posterior, RayImage, SensorNoise
from modeler.views import Sensor

PATTERN = FixedPattern(share=0.6, area_px=40.0)
WIDTH_PX, SIGMA_M = 3.0, 0.0025


def matches_at(positions: np.ndarray, own_px: np.ndarray) -> np.ndarray:
    """Return matches (n, 15) at positions in the camera of `tabletop`, of points seen elsewhere in their own view."""
    camera = tabletop.CAMERA
    found = np.zeros((len(positions), point_to_plane.COLUMNS))
    found[:, point_to_plane.POSITION] = positions
    where = positions[:, :2] / positions[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    found[:, point_to_plane.SHIFT] = where - own_px
    found[:, point_to_plane.FACING_WEIGHT] = 0.8
    return found


def test_derivatives_are_those_of_what_the_pattern_counts(rng: np.random.Generator) -> None:
    positions = rng.uniform((-0.1, -0.1, 0.7), (0.1, 0.1, 0.9), (50, 3))
    own_px = matches_at(positions, np.zeros((50, 2)))[:, point_to_plane.SHIFT] + rng.normal(0.0, 3.0, (50, 2))

    def counted(moved: np.ndarray) -> np.ndarray:
        return 0.5 * 0.8 * PATTERN.common(matches_at(moved, own_px))

    slopes, curvatures = PATTERN.derivatives(matches_at(positions, own_px), tabletop.CAMERA)
    assert 10 < np.count_nonzero(counted(positions)) < 50  # of some, and beyond its reach
    step = 1e-6 * np.eye(3)
    for k in range(3):
        ahead, behind = positions + step[k], positions - step[k]
        np.testing.assert_allclose((counted(ahead) - counted(behind)) / 2e-6, slopes[:, k], rtol=1e-5, atol=1e-5)
        change = [PATTERN.derivatives(matches_at(moved, own_px), tabletop.CAMERA)[0] for moved in (ahead, behind)]
        # Without what pixels move by the square of a motion: a part in a focal length of it.
        tolerance = 0.02 * np.abs(curvatures).max()
        np.testing.assert_allclose((change[0] - change[1]) / 2e-6, curvatures[:, :, k], atol=tolerance)


def test_its_reach_is_that_of_the_area_over_which_errors_are_alike() -> None:
    x, y = (side.ravel() for side in np.meshgrid(np.arange(-20.0, 20.0, 0.1), np.arange(-20.0, 20.0, 0.1)))
    found = np.zeros((len(x), point_to_plane.COLUMNS))
    found[:, point_to_plane.SHIFT] = np.stack([x, y], axis=1)
    assert PATTERN.common(found).sum() * 0.01 == pytest.approx(PATTERN.share * PATTERN.area_px, rel=1e-3)


def ball_views(share: float, seed: int) -> list[RayImage]:
    """Two views, 15° apart, of a ball by a camera whose error is the same in both."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(160, 200)), WIDTH_PX)
    sensor = Sensor(SensorNoise(sigma_r_m=0.001), noise_area_px=4.0 * np.pi * WIDTH_PX**2, pattern_share=share)
    found = []
    for index, pose in enumerate(tabletop.turntable(24)[:2]):
        frame = tabletop.view(tabletop.BALL, pose, index).frame
        depth_m = (frame.depth_m + SIGMA_M * noise / noise.std()).astype(np.float32)
        found.append(sensor.ray_image(replace(frame, depth_m=depth_m, colour=None)))
    return found


def registered(share: float, seed: int) -> tuple[Posterior, float]:
    """Return the posterior of the ball's motion, and the NEES of its rotation."""
    target, source = ball_views(share, seed)
    density = GeneralPrior(max_offset_m=0.04).between(source, target)
    posterior = VisibilityRegistrar().register(source, target, density, rng=np.random.default_rng(seed))
    zero, one = tabletop.turntable(24)[:2]
    truth = zero @ se3.inverse(one) @ se3.translation(source.centroid_m)
    return posterior, nees(about_point(posterior.pose, source.centroid_m), truth, slice(0, 3))


def test_balls_that_carry_the_cameras_pattern_do_not_seem_to_stand_still() -> None:
    seeds = range(6)
    without = [registered(0.0, seed) for seed in seeds]
    assert all(posterior.usable for posterior, _ in without)
    degrees_of_freedom = 3 * len(seeds)
    assert sum(wrong for _, wrong in without) > chi2.ppf(0.99, degrees_of_freedom)  # 1 in 100 of true covariances
    given = [registered(1.0, seed) for seed in seeds]
    assert sum(right for _, right in given) < chi2.ppf(0.5, degrees_of_freedom)
    for posterior, _ in given:
        assert np.degrees(np.sqrt(np.linalg.eigvalsh(posterior.pose.covariance[:3, :3])).min()) > 10.0
