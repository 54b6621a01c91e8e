"""What smoothing makes of surfaces: as far aside as noise, no farther."""

import numpy as np
import pytest

from modeler import se3
from modeler.evaluation import about_point, true_motion
from modeler.priors import TablePrior
from modeler.registration import VisibilityRegistrar
from modeler.sequences.rendering import RenderedSequence
from modeler.types import Camera, Frame, SensorNoise
from modeler.views import Sensor
from studies.calibration.specimens import load_specimen
from studies.calibration.study import Condition, rendered_views, staged

CAMERA = Camera(width=320, height=480, fx=575.0, fy=575.0, cx=159.5, cy=239.5)
AXIS_M, RADIUS_M, HALF_M = 0.8, 0.009, 0.12


def rod():
    """Return the exact depth (h, w) of a thin upright rod; NaN beside it."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    w, h = (columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy
    a, b, c = 1.0 + w**2, -AXIS_M, AXIS_M**2 - RADIUS_M**2  # z² a + 2 z b + c = 0 if a ray meets it
    with np.errstate(invalid="ignore"):
        depth_m = (-b - np.sqrt(b**2 - a * c)) / a
    return np.where(np.abs(h * depth_m) < HALF_M, depth_m, np.nan)


def sunk_m(sigma_r_m):
    """Return how far behind its surface a rod's points lie on average under a sensor's noise."""
    depth_m = rod().astype(np.float32)
    frame = Frame(0, 0.0, depth_m, CAMERA, mask=depth_m > 0.0)
    view = Sensor(SensorNoise(0.001, sigma_r_m)).ray_image(frame)
    assert len(view.points_m) > 200
    from_axis_m = np.hypot(view.points_m[:, 0], view.points_m[:, 2] - AXIS_M)
    return float(np.mean(RADIUS_M - from_axis_m))


def test_thin_rods_sink_by_a_share_of_the_noise_whatever_the_noise():
    sigmas_m = np.array([0.0012, 0.0024, 0.0048, 0.0096])  # below, the least number of neighbours determines the ball
    shares = np.array([sunk_m(sigma_m) for sigma_m in sigmas_m]) / sigmas_m
    assert shares.max() < 0.35
    assert shares.max() < 2.0 * shares.min()


@pytest.mark.slow
def test_thin_legs_are_not_dragged_behind():
    """Turned there and back, a tripod errs to either side alike: what is common goes with the camera, not the turn."""
    sequence = RenderedSequence(staged(load_specimen("tripod"), Condition(noise=0.5), frames=3, seed=5))
    views, truth = rendered_views(sequence), sequence.truth()
    drags_mm = []
    for earlier, later in zip(sequence.indices[:-1], sequence.indices[1:], strict=True):
        for source, target, sign in ((later, earlier, 1.0), (earlier, later, -1.0)):
            there = true_motion(truth, target, source)
            density = TablePrior().between(views[source], views[target])
            rng = np.random.default_rng([source, target])
            found = VisibilityRegistrar().register(views[source], views[target], density, rng=rng)
            centre_m = views[source].centroid_m
            error = se3.log(se3.inverse(about_point(found.pose, centre_m).mean) @ there @ se3.translation(centre_m))
            drags_mm.append(1e3 * sign * error[3])
    assert abs(np.mean(drags_mm)) < 0.15
