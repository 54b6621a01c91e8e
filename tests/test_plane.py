"""The support plane: exact where it can be, honest where it cannot."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from modeler.segmentation import DepthNoise, fit_plane
from modeler.segmentation.planes import choose_support, dominant_planes, heights

NORMAL = np.array([0.0, -np.cos(0.6), -np.sin(0.6)])
OFFSET_M = 0.45


def tilt_rad(plane, normal=NORMAL):
    return float(np.arccos(np.clip(plane.normal @ normal, -1.0, 1.0)))


def ray_image(height=120, width=160, focal_px=145.0):
    """Return (h, w, 3) points at depth 1 m."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack(
        [(columns - width / 2) / focal_px, (rows - height / 2) / focal_px, np.ones((height, width))], axis=-1
    )


def plane_image(normal=NORMAL, offset_m=OFFSET_M):
    """Return the points (h, w, 3) at which the camera sees a plane; NaN where it does not or beyond 2 m."""
    rays = ray_image()
    facing = rays @ normal
    depth = np.where(facing < -1e-3, -offset_m / np.minimum(facing, -1e-3), np.nan)
    depth[~(depth < 2.0)] = np.nan
    return rays * depth[..., None]


def plate(rng, count=2000, radius_m=0.12):
    """Return points (n, 3) spread over a disc on the plane, 0.7 m from the camera."""
    along = np.linalg.svd(NORMAL[None])[2][1:]
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, count), radius_m * np.sqrt(rng.uniform(0.0, 1.0, count))
    centre = np.array([0.0, 0.0, OFFSET_M / np.sin(0.6)])
    return centre + np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]) @ along


def test_exact_points_give_the_exact_plane_towards_the_camera(rng):
    plane = fit_plane(plate(rng), sigma_m=0.001)
    np.testing.assert_allclose(plane.normal, NORMAL, atol=1e-9)
    assert plane.offset_m == pytest.approx(OFFSET_M)
    assert plane.height_m(np.zeros((1, 3)))[0] == pytest.approx(OFFSET_M)


def test_a_third_of_outliers_above_changes_nothing(rng):
    points = plate(rng) + rng.normal(0.0, 0.0005, (2000, 1)) * NORMAL
    outliers = plate(rng, 1000) + rng.uniform(0.01, 0.15, (1000, 1)) * NORMAL
    plane = fit_plane(np.concatenate([points, outliers]), sigma_m=0.001)
    assert tilt_rad(plane) < 0.001
    assert plane.offset_m == pytest.approx(OFFSET_M, abs=0.0005)


def test_the_fit_turns_with_the_points(rng):
    points = plate(rng) + rng.normal(0.0, 0.001, (2000, 1)) * NORMAL
    turn = Rotation.from_rotvec([0.0, 0.0, 0.8]).as_matrix()
    plane, turned = fit_plane(points, sigma_m=0.001), fit_plane(points @ turn.T, sigma_m=0.001)
    np.testing.assert_allclose(turned.normal, turn @ plane.normal, atol=1e-6)
    assert turned.sigma_offset_m == pytest.approx(plane.sigma_offset_m, rel=0.01)


@pytest.mark.parametrize("points", [np.zeros((10, 3)), np.linspace([0.0, 0.0, 1.0], [1.0, 0.2, 1.1], 500)])
def test_too_few_points_or_a_line_give_none(points):
    assert fit_plane(points, sigma_m=0.001) is None


@pytest.mark.parametrize("smooth_px", [1.0, 2.5, 4.0])
def test_uncertainty_holds_under_correlated_noise(smooth_px):
    """Over many draws of smooth noise the errors are as large as the plane says."""
    along = np.linalg.svd(NORMAL[None])[2][1:]
    centre = np.array([0.0, 0.0, OFFSET_M / np.sin(0.6)])
    rows, columns = np.mgrid[:40, :40]
    flat = centre + (np.column_stack([rows.ravel(), columns.ravel()]) - 19.5) * 0.006 @ along
    slopes, rises, sigmas = [], [], []
    for seed in range(60):
        field = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(40, 40)), smooth_px)
        noise = 0.008 * field * 2.0 * np.sqrt(np.pi) * smooth_px  # brings the field back to unit variance
        plane = fit_plane(flat + noise.ravel()[:, None] * NORMAL, sigma_m=0.02)
        slopes.extend(along @ plane.normal / plane.sigma_tilt_rad)
        sigmas.append(plane.sigma_tilt_rad)
        rises.append(plane.height_m(centre[None])[0] / plane.sigma_offset_m)
    assert 0.3 < np.mean(np.square(slopes)) < 1.5
    assert 0.1 < np.mean(np.square(rises)) < 1.5
    if_independent = 0.008 / np.sqrt(1600) / (0.24 / np.sqrt(12))
    assert np.median(sigmas) > 2.0 * if_independent


def test_more_noise_and_a_farther_foot_are_less_sure(rng):
    points = plate(rng)
    jitter = rng.normal(size=(2000, 1)) * NORMAL
    quiet, loud = (fit_plane(points + s * jitter, sigma_m=0.02) for s in (0.001, 0.01))
    assert quiet.sigma_tilt_rad <= loud.sigma_tilt_rad
    assert quiet.sigma_offset_m < loud.sigma_offset_m
    away = fit_plane(points + 0.01 * jitter, sigma_m=0.02, foot_m=points.mean(axis=0) + np.array([1.0, 0.0, 0.0]))
    assert away.sigma_offset_m > loud.sigma_offset_m


def test_table_and_wall_are_found_and_the_table_is_the_support(rng):
    """A body before the wall and on the table stands on the table, though the wall is nearer to most of it."""
    table, wall = plane_image(), plane_image(np.array([0.0, 0.0, -1.0]), 0.8)
    points = np.where((table[..., 2] < wall[..., 2])[..., None], table, wall)
    points += rng.normal(0.0, 0.001, points.shape)
    planes = dominant_planes(points.astype(np.float32), DepthNoise())
    assert len(planes) == 2
    np.testing.assert_allclose(planes[np.argmin(planes[:, 1]), :3], NORMAL, atol=0.01)
    np.testing.assert_allclose(planes[np.argmax(planes[:, 1]), :3], [0.0, 0.0, -1.0], atol=0.01)
    foot = np.array([0.0, (OFFSET_M + 0.75 * NORMAL[2]) / -NORMAL[1], 0.75])
    body = (foot + rng.uniform(0.0, 0.2, (500, 1)) * NORMAL + rng.uniform(-0.02, 0.02, (500, 3))).astype(np.float32)
    ground = points.reshape(-1, 3)
    ground = ground[np.linalg.norm(ground - foot, axis=1) < 0.4].astype(np.float32)
    support = choose_support(planes, body, ground, DepthNoise())
    assert support is not None
    np.testing.assert_allclose(support[:3], NORMAL, atol=0.01)
    assert np.median(heights(body, support)) == pytest.approx(0.1, abs=0.02)


def test_no_plane_in_empty_or_shapeless_images(rng):
    nothing = np.full((60, 80, 3), np.nan, dtype=np.float32)
    assert dominant_planes(nothing, DepthNoise()).shape == (0, 4)
    cloud = rng.uniform(0.5, 1.5, (60, 80, 3)).astype(np.float32)
    assert dominant_planes(cloud, DepthNoise()).shape == (0, 4)
