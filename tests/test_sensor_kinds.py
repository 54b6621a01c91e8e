"""What is known of a camera from its kind and from where its intrinsics come."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import tabletop
from scipy.stats import chi2

from modeler import se3
from modeler.evaluation import true_motion
from modeler.priors import TablePrior
from modeler.registration import VisibilityRegistrar
from modeler.registration.posterior import displacement, of_multipath
from modeler.sequences import Overrides, open_sequence
from modeler.sequences.rendering import RenderedSequence
from modeler.types import CALIBRATED_FOCAL, MULTIPATH, NOMINAL_FOCAL, InputError, SensorNoise
from modeler.verdict.evidence import default_tolerance_m
from studies.calibration.by_camera import shown, viewed
from studies.calibration.depth_cameras import CAMERAS
from studies.calibration.specimens import load_specimen
from studies.calibration.study import Condition, staged
from studies.formats.image_folders import raw_depth, save
from studies.formats.kinect import write_mkv

BRICK = replace(tabletop.view(tabletop.BRICK, tabletop.POSES[1], 0), sigma_multipath=0.1)
CAMERA = tabletop.CAMERA
UNKNOWN = SensorNoise(sigma_r_m=None)
INTRINSICS = {"fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of depth images, without intrinsics."""
    frame = tabletop.view(tabletop.BRICK, tabletop.POSES[0], 0).frame
    for name in ("0", "1"):
        save(tmp_path / "depth" / f"{name}.png", raw_depth(frame, 1.0))
    return tmp_path


def test_smooth_errors_scale_with_the_object() -> None:
    twice = replace(BRICK, points_m=2.0 * BRICK.points_m)
    units = np.repeat([1.0, 2.0], 3)
    np.testing.assert_allclose(of_multipath(twice), of_multipath(BRICK) * np.outer(units, units), rtol=1e-9)
    assert not of_multipath(replace(BRICK, sigma_multipath=0.0)).any()


def test_errors_of_surface_displace_a_pose_as_least_squares_does() -> None:
    rng = np.random.default_rng(0)
    arms_m, normals = BRICK.points_m - BRICK.centroid_m, BRICK.normals
    rows = np.concatenate([np.cross(arms_m, normals), normals], axis=1)
    errors_m = rng.normal(0.0, 1.0, (4000, len(rows)))
    xi = np.linalg.lstsq(rows, errors_m.T, rcond=None)[0]
    spread = len(rows) * np.cov(xi)
    np.testing.assert_allclose(displacement(arms_m, normals, BRICK.size_m), spread, atol=0.1 * np.abs(spread).max())


def test_what_surface_leaves_open_gets_no_error_from_it() -> None:
    ball = tabletop.view(tabletop.BALL, tabletop.POSES[0], 0)
    centre_m = se3.transform(tabletop.POSES[0], np.zeros((1, 3)))[0]
    covariance = displacement(ball.points_m - centre_m, ball.normals, ball.size_m)
    assert np.abs(covariance[:3, :3]).max() * ball.size_m**2 < 1e-6 * np.trace(covariance[3:, 3:])


def test_a_model_is_known_at_best_to_the_smooth_errors_of_its_camera() -> None:
    exact = replace(BRICK, sigma_multipath=0.0)
    assert default_tolerance_m([exact]) == pytest.approx(0.075 * BRICK.size_m)
    assert default_tolerance_m([BRICK]) == pytest.approx(0.25 * BRICK.size_m, rel=0.01)


def test_regions_hold_the_truth_before_a_camera_by_time_of_flight() -> None:
    camera, squares = CAMERAS["time of flight"], []
    sequence = RenderedSequence(staged(load_specimen("cactus"), Condition(distance_m=0.8), frames=4, seed=0))
    views = viewed(shown(sequence, camera, np.random.default_rng(0), seed=0), camera)
    for target, source in pairwise(views):
        truth, density = true_motion(sequence.truth(), target.index, source.index), TablePrior().between(source, target)
        pose = VisibilityRegistrar().register(source, target, density, rng=np.random.default_rng(0)).pose
        xi = se3.log(se3.inverse(pose.mean) @ truth)
        exact = pose.covariance - of_multipath(source)
        squares.append([xi @ np.linalg.solve(covariance, xi) for covariance in (exact, pose.covariance)])
    without, stated = np.median(squares, axis=0)
    assert without > chi2(6).ppf(0.99)
    assert stated < chi2(6).ppf(0.95)


@pytest.mark.parametrize(
    ("sensor", "noise"),
    [
        ({"kind": "tof"}, UNKNOWN._replace(sigma_focal=NOMINAL_FOCAL, sigma_multipath=MULTIPATH["tof"])),
        ({"kind": "stereo"}, UNKNOWN._replace(sigma_focal=NOMINAL_FOCAL)),
        ({"kind": "tof", "sigma_multipath": 0.02}, UNKNOWN._replace(sigma_focal=NOMINAL_FOCAL, sigma_multipath=0.02)),
        ({"kind": "laser", "sigma_focal": 0}, UNKNOWN),
    ],
)
def test_the_kind_of_a_camera_says_how_it_errs(folder: Path, sensor: dict[str, object], noise: SensorNoise) -> None:
    (folder / "camera.json").write_text(json.dumps(INTRINSICS))
    (folder / "sequence.json").write_text(json.dumps({"sensor": sensor}))
    assert open_sequence(folder).sensor() == noise


def test_a_kind_that_is_not_known_is_refused(folder: Path) -> None:
    (folder / "camera.json").write_text(json.dumps(INTRINSICS))
    (folder / "sequence.json").write_text('{"sensor": {"kind": "sonar"}}')
    with pytest.raises(InputError, match="structured, stereo, laser, tof"):
        open_sequence(folder)


def test_a_focal_length_is_known_as_well_as_where_it_comes_from(folder: Path) -> None:
    (folder / "camera.json").write_text(json.dumps(INTRINSICS))
    assert open_sequence(folder).sensor() is None  # typed: nominal
    (folder / "camera.json").write_text(json.dumps({**INTRINSICS, "dist_coeffs": [0.0, 0.0, 0.0, 0.0, 0.0]}))
    assert open_sequence(folder).sensor() == UNKNOWN._replace(sigma_focal=CALIBRATED_FOCAL)
    typed = Overrides(intrinsics=(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy))
    assert open_sequence(folder, typed).sensor() is None


def test_a_recording_of_the_azure_kinect_is_calibrated_and_by_time_of_flight(tmp_path: Path) -> None:
    pytest.importorskip("av")
    write_mkv(tmp_path / "scan.mkv")
    noise = UNKNOWN._replace(sigma_focal=CALIBRATED_FOCAL, sigma_multipath=MULTIPATH["tof"])
    assert open_sequence(tmp_path / "scan.mkv").sensor() == noise
    typed = open_sequence(tmp_path / "scan.mkv", Overrides(intrinsics=(500.0, 500.0, 320.0, 288.0))).sensor()
    assert typed == noise._replace(sigma_focal=NOMINAL_FOCAL)
