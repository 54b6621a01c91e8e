"""Depth images with pixels missing at random: what is known between measurements, and how well."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from segmentation_worlds import segmented
from slow_cases import quick_first

from modeler.evaluation import nees, rotation_error_deg, true_motion
from modeler.fusion import Fuser
from modeler.kernels import planes
from modeler.pipeline import Modeler
from modeler.priors import TablePrior
from modeler.registration import VisibilityRegistrar
from modeler.segmentation import Scene
from modeler.sequences.rendering import RenderedSequence
from modeler.types import Camera, Frame, Outcome, SensorNoise, Step
from modeler.views import Sensor
from modeler.views.rays import closed, gap_px, measured_share, nearest_depth, part_of
from studies.calibration.specimens import load_specimen
from studies.calibration.study import Condition, staged

SHAPE = (120, 160)
CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)


def thinned(frame, share, rng):
    """Return a frame of whose pixels a share is kept, at random."""
    kept = rng.random(frame.depth_m.shape) < share
    return replace(frame, depth_m=np.where(kept, frame.depth_m, np.nan).astype(np.float32))


@pytest.mark.parametrize("share", [0.02, 0.1, 0.5, 0.9])
def test_the_share_of_measured_pixels_is_that_of_random_loss_within_any_outline(share, rng):
    outline = np.zeros(SHAPE, dtype=bool)
    outline[20:100, 30:130] = True
    whole, inside = rng.random(SHAPE) < share, outline & (rng.random(SHAPE) < share)
    assert measured_share(whole) == pytest.approx(share, rel=0.1)
    assert measured_share(inside, outline) == pytest.approx(share, rel=0.15)


@pytest.mark.parametrize("step", [2, 3, 5, 7])
def test_the_share_of_a_grid_is_that_of_its_cells(step):
    measured = np.zeros(SHAPE, dtype=bool)
    measured[::step, ::step] = True
    assert measured_share(measured) == pytest.approx(1.0 / step**2, rel=0.5)  # windows end between its lines


def test_a_dense_image_with_holes_has_no_gaps_and_its_holes_stay():
    depth_m = np.full(SHAPE, 0.8, dtype=np.float32)
    depth_m[40:60, 50:90] = np.nan
    assert gap_px(measured_share(np.isfinite(depth_m))) < 1.0
    view = Sensor().ray_image(Frame(0, 0.0, depth_m, CAMERA, mask=np.ones(SHAPE, dtype=bool)))
    assert (view.layers["cells"][40:60, 50:90, planes.KIND] == planes.MISSING).all()


@pytest.mark.parametrize("share", [0.03, 0.1, 0.5])
def test_gaps_that_random_loss_leaves_are_closed_and_larger_ones_stay(share, rng):
    measured = rng.random((300, 300)) < share
    measured[100:200, 100:200] = False
    between = closed(measured, gap_px(share))
    assert not between[120:180, 120:180].any()
    assert np.concatenate([between[20:80, 20:280], between[220:280, 20:280]]).mean() > 0.98


def test_pixels_between_measurements_have_the_depth_of_the_nearest(rng):
    measured = rng.random((30, 40)) < 0.1
    depth_m = rng.uniform(0.5, 1.0, (30, 40)).astype(np.float32)
    filled = nearest_depth(depth_m, measured, np.ones_like(measured), 4.0)
    places = np.argwhere(measured)
    for pixel in np.argwhere(rng.random((30, 40)) < 0.1):
        away_px = np.hypot(*(places - pixel).T)
        nearest = places[np.isclose(away_px, away_px.min())]
        if away_px.min() <= 4.0:
            assert filled[tuple(pixel)] in depth_m[tuple(nearest.T)]
        else:
            assert np.isnan(filled[tuple(pixel)])


def test_planes_between_sparse_measurements_err_as_they_state(rng):
    sigma_m, ratios, covered = 0.002, [], []
    w, h = CAMERA.rays()
    exact = 1.0 / (1.2 - 0.3 * w + 0.4 * h)
    for _ in range(8):
        depth_m = (exact + exact**2 * sigma_m * rng.normal(size=SHAPE)).astype(np.float32)
        frame = thinned(Frame(0, 0.0, depth_m, CAMERA, mask=np.ones(SHAPE, dtype=bool)), 0.1, rng)
        view = Sensor(SensorNoise(0.001, sigma_m)).ray_image(frame)
        normal = np.array([-0.3, 0.4, 1.2])
        off_m = (view.points_m @ normal - 1.0) / np.linalg.norm(normal)
        ratios.append(np.mean(off_m**2 / view.layers["variance_m2"]))
        covered.append(len(view.points_m) / depth_m.size)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.3)
    assert min(covered) > 0.7  # planes between measurements, not only at a tenth of the pixels


@pytest.fixture(scope="module")
def drill():
    """Return a rendered drill 1.3 m away, of three frames."""
    return RenderedSequence(staged(load_specimen("drill"), Condition(distance_m=1.3), frames=3, seed=4))


@pytest.mark.parametrize("masked", quick_first([False, True]))
def test_sparse_frames_show_the_object_and_its_support_as_dense_ones_do(drill, masked, rng):
    dense = [drill.frame(index) if masked else replace(drill.frame(index), mask=None) for index in drill.indices]
    sparse = [thinned(frame, 0.1, rng) for frame in dense]
    for want, got in zip(segmented(dense), segmented(sparse), strict=True):
        assert got.outcome is want.outcome
        assert got.plane.normal @ want.plane.normal > np.cos(np.radians(0.3))
        assert abs(got.plane.offset_m - want.plane.offset_m) < 0.002
        assert np.count_nonzero(got.mask & want.mask) > 0.8 * np.count_nonzero(got.mask | want.mask)


@pytest.mark.parametrize(("share", "worst_deg"), quick_first([(0.03, 30.0), (0.1, 10.0)]))
def test_sparse_views_are_registered_as_well_as_they_state(drill, share, worst_deg):
    indices, sensor, squares = drill.indices[:2], Sensor(drill.sensor()), []
    truth = true_motion(drill.truth(), *indices)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        frames = [thinned(drill.frame(index), share, rng) for index in indices]
        target, source = (
            sensor.ray_image(frame, found.plane) for frame, found in zip(frames, segmented(frames), strict=True)
        )
        found = VisibilityRegistrar().register(source, target, TablePrior().between(source, target), rng=rng)
        assert found.usable
        assert rotation_error_deg(found.pose.mean, truth) < worst_deg
        squares.append(nees(found.pose, truth))
    assert np.mean(squares) < 2.0 * 6.0  # 6 on average; the mean of three exceeds 12 with a probability of 0.7 %


def test_a_small_object_is_registered_by_a_hundred_pixels(drill):
    indices, (sigma_wh, sigma_r_m, *_) = drill.indices[:2], drill.sensor()
    found, sixth = segmented([drill.frame(index) for index in indices]), slice(None, None, 6)
    target, source = (
        Sensor(SensorNoise(sigma_wh, sigma_r_m)).ray_image(
            part_of(drill.frame(index), sixth, sixth), segmentation.plane
        )
        for index, segmentation in zip(indices, found, strict=True)
    )
    density = TablePrior().between(source, target)
    posterior = VisibilityRegistrar().register(source, target, density, rng=np.random.default_rng(0))
    assert np.count_nonzero(source.frame.mask & np.isfinite(source.frame.depth_m)) < 130
    assert posterior.outcome is not Outcome.TOO_FEW_POINTS
    assert nees(posterior.pose, true_motion(drill.truth(), *indices)) < chi2.ppf(0.999, 6)


def test_sparse_frames_make_a_model(drill, rng):
    frames = [thinned(drill.frame(index), 0.1, rng) for index in drill.indices]
    builder = Modeler(sensor=Sensor(drill.sensor()), prior=TablePrior(), fuser=Fuser(voxel_m=0.008))
    *_, last = (event for event in builder.run(frames, Scene()) if isinstance(event, Step))
    assert set(last.solution.trajectory) == set(drill.indices)
    sizes_m = np.ptp(last.model.vertices_m, axis=0)
    assert np.sort(sizes_m)[-1] == pytest.approx(0.2, abs=0.04)  # of the drill's sides that were seen
