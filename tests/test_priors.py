"""What every prior must keep: samples follow the density, support is respected, the camera's frame does not matter."""

import numpy as np
import pytest
from scipy import stats

from modeler import se3
from modeler.priors import GeneralPrior, TablePrior
from modeler.types import Camera, Frame, InputError, Plane, RayImage

PRIORS = [GeneralPrior(max_rotation_deg=30, max_offset_m=0.03), TablePrior(max_rotation_deg=40, max_shift_m=0.03)]
IDS = ["general", "table"]


def view(points_m, plane):
    """A view with nothing but surface points and a support plane."""
    frame = Frame(0, 0.0, np.ones((2, 2), dtype=np.float32), Camera(2, 2, 1.0, 1.0, 0.5, 0.5))
    return RayImage(frame, plane, 0.002, 0.002, points_m, np.zeros_like(points_m), np.zeros((len(points_m), 2), int))


@pytest.fixture
def views(rng):
    """Two views of points on a tilted table."""
    normal = np.array([0.1, -0.8, -0.6])
    normal /= np.linalg.norm(normal)
    plane = Plane(normal, 0.7, sigma_tilt_rad=0.004, sigma_offset_m=0.001)
    points_m = np.array([0.0, 0.0, 0.8]) + rng.normal(0, 0.03, (100, 3))
    return view(points_m, plane), view(points_m + np.array([0.01, 0.0, 0.005]), plane)


@pytest.mark.parametrize("prior", PRIORS, ids=IDS)
def test_samples_lie_in_the_support_and_repeat_under_a_seed(prior, views):
    motion = prior.between(*views)
    samples = motion.sample(2000, np.random.default_rng(1))
    assert np.isfinite(motion.log_density(samples)).all()
    np.testing.assert_array_equal(samples, motion.sample(2000, np.random.default_rng(1)))
    np.testing.assert_allclose(np.linalg.det(samples[:, :3, :3]), 1.0)


@pytest.mark.parametrize("prior", PRIORS, ids=IDS)
def test_samples_follow_the_density(prior, views, rng):
    """A Metropolis step that keeps the density must keep the samples as they are distributed."""
    motion = prior.between(*views)
    samples = motion.sample(20_000, rng)
    centre = se3.translation(views[0].centroid_m)
    step = rng.normal(size=(len(samples), 6)) * np.repeat([0.03, 0.006], 3)
    moved = samples @ centre @ se3.exp(step) @ se3.inverse(centre)
    accept = np.log(rng.random(len(samples))) < motion.log_density(moved) - motion.log_density(samples)
    assert 0.005 < accept.mean() < 0.995
    kept = np.where(accept[:, None, None], moved, samples)
    fresh = motion.sample(20_000, rng)

    def features(poses):
        offset = poses[:, :3, :3] @ views[0].centroid_m + poses[:, :3, 3] - views[1].centroid_m
        height = offset @ views[0].plane.normal
        tilt = np.arccos(np.clip((poses[:, :3, :3] @ views[0].plane.normal) @ views[0].plane.normal, -1, 1))
        return {
            "angle": se3.rotation_angle(poses),
            "offset": np.linalg.norm(offset, axis=1),
            "height": height,
            "tilt": tilt,
            "x": offset[:, 0],
        }

    for name, values in features(kept).items():
        probability = np.array(stats.ks_2samp(values, features(fresh)[name]))[1]
        assert probability > 1e-3, name


@pytest.mark.parametrize("prior", PRIORS, ids=IDS)
def test_the_density_integrates_to_one(prior, views, rng):
    """Its mean over a box of tangents about one sample's neighbourhood equals the share of samples that fall there."""
    motion = prior.between(*views)
    samples = motion.sample(400_000, rng)
    centre = se3.translation(views[0].centroid_m)
    # A box wide enough to hold many samples and narrow enough for the tangent's volume to be that of the group.
    middle = samples[np.argmin(se3.rotation_angle(samples))]
    half = np.repeat([np.radians(4.0), 0.012], 3)
    xi = se3.log(se3.inverse(centre) @ se3.inverse(middle) @ samples @ centre)
    share = np.mean((np.abs(xi) < half).all(axis=1))
    box = rng.uniform(-half, half, (400_000, 6))
    density = np.exp(motion.log_density(middle @ centre @ se3.exp(box) @ se3.inverse(centre)))
    assert share * len(samples) > 100
    assert np.mean(density) * np.prod(2 * half) == pytest.approx(share, rel=0.15)


@pytest.mark.parametrize("prior", PRIORS, ids=IDS)
def test_the_choice_of_camera_frame_does_not_matter(prior, views, rng):
    turn = se3.exp(np.array([0.3, -0.5, 0.2, 0.1, -0.2, 0.3]))
    plane = views[0].plane
    normal = turn[:3, :3] @ plane.normal
    moved_plane = Plane(normal, plane.offset_m - normal @ turn[:3, 3], plane.sigma_tilt_rad, plane.sigma_offset_m)
    moved = [view(se3.transform(turn, v.points_m), moved_plane) for v in views]
    samples = prior.between(*views).sample(500, rng)
    np.testing.assert_allclose(
        prior.between(*moved).log_density(turn @ samples @ se3.inverse(turn)),
        prior.between(*views).log_density(samples),
        atol=1e-6,
    )


def test_the_table_prior_holds_an_object_on_its_table(views, rng):
    samples = TablePrior(sigma_tilt_deg=0.01, sigma_height_m=1e-5, max_shift_m=0.03).between(*views).sample(1000, rng)
    plane = views[0].plane
    before = plane.height_m(views[0].points_m)
    for sample in samples[::100]:
        after = plane.height_m(se3.transform(sample, views[0].points_m))
        np.testing.assert_allclose(after, before, atol=0.003)  # what the plane's own tilt of 0.004 rad leaves


def test_without_a_table_the_table_prior_says_so(views):
    bare = [view(v.points_m, None) for v in views]
    with pytest.raises(InputError, match=r"no support plane.*--prior general"):
        TablePrior().between(*bare)
