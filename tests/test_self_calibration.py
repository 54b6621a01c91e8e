"""The focal length that loops tell."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tabletop
from slow_cases import quick_first

from modeler import se3
from modeler.cli import main
from modeler.graph.focal import FocalCalibrator
from modeler.pipeline import Modeler
from modeler.priors import GeneralPrior
from modeler.sequences import FocalFactor, RefocusedSequence, bundled, open_sequence, read_focal_factor
from modeler.types import AbstractPrior, Edge, FocalLength, Outcome, Posterior, RayImage, SensorNoise, Stated
from modeler.views import Sensor

STEPS = 12
SENSOR = Sensor(SensorNoise(sigma_r_m=1e-3, sigma_focal=0.02))
MODELER = Modeler(sensor=SENSOR)


@cache
def seen(stated: float) -> tuple[dict[int, RayImage], tuple[Edge, ...]]:
    """Views of a box that turns once, and the edges of its loop, under a focal length that is stated wrongly."""
    rng = np.random.default_rng(0)
    views = {}
    for index, pose in enumerate(tabletop.turntable(STEPS)):
        frame = tabletop.view(tabletop.Box((0.08, 0.05, 0.04)), pose, index, rng=rng).frame
        camera = replace(frame.camera, fx=stated * frame.camera.fx, fy=stated * frame.camera.fy)
        views[index] = SENSOR.ray_image(replace(frame, camera=camera))
    edges = []
    for source in range(1, STEPS + 1):
        target, source = source - 1, source % STEPS
        posterior = MODELER.register(views[source], views[target]).without_samples()
        edges.append(Edge(posterior, "odometry" if source else "closure", posterior.usable, Stated("made for a test")))
    return views, tuple(edges)


def estimate(stated: float, *, closed: bool = True) -> FocalLength:
    views, edges = seen(stated)
    chain = edges if closed else edges[:-1]
    return FocalCalibrator().estimate(views, chain, SENSOR, MODELER.register, MODELER.prior)


@pytest.mark.parametrize("stated", quick_first([0.93, 1.0, 1.06]))
def test_a_closed_turn_tells_the_focal_length(stated: float) -> None:
    found = estimate(stated)
    assert found.determined_by == "loop"
    assert found.loops == 1
    assert abs(found.factor * stated - 1.0) < 0.01
    assert abs(np.log(found.factor * stated)) < 3.0 * found.sigma
    assert found.sigmas_after < 1.5


def test_limits_on_one_step_do_not_cut_off_what_a_run_found_beyond_them() -> None:
    views, edges = seen(0.93)
    found = FocalCalibrator().estimate(views, edges, SENSOR, MODELER.register, GeneralPrior(max_rotation_deg=25.0))
    assert (found.determined_by, found.loops) == ("loop", 1)
    assert abs(0.93 * found.factor - 1.0) < 0.01


def test_a_step_that_cannot_be_registered_again_stays_part_of_its_loop() -> None:
    views, edges = seen(0.93)

    def refusing(source: RayImage, target: RayImage, prior: AbstractPrior | None = None) -> Posterior:
        posterior = MODELER.register(source, target, prior)
        return replace(posterior, outcome=Outcome.NO_OVERLAP) if source.index == 4 else posterior

    found = FocalCalibrator().estimate(views, edges, SENSOR, refusing, MODELER.prior)
    assert found.determined_by == "loop"
    assert abs(0.93 * found.factor - 1.0) < 0.01


def test_what_surface_does_not_determine_is_not_predicted_to_move_far() -> None:
    """Of steps of a box of which two faces are seen: where it slides along them, the images hold its silhouette."""
    views, edges = seen(0.93)
    for edge in edges:
        pose, from_centre = edge.posterior.pose, se3.translation(views[edge.source].centroid_m)
        about_centre = se3.adjoint(se3.inverse(from_centre)) @ pose.by_focal
        assert np.linalg.norm(about_centre[3:]) < 0.15  # m by unit: the box is 0.2 m long, and moves by 0.03 to 0.04


def test_an_open_chain_tells_nothing() -> None:
    found = estimate(0.93, closed=False)
    assert (found.factor, found.sigma, found.determined_by) == (1.0, FocalCalibrator().prior_sigma, "prior")


def test_a_run_without_a_loop_is_calibrated_with_what_was_given(scene: Path, tmp_path: Path) -> None:
    run, file = tmp_path / "run", tmp_path / "camera.json"
    assert main(["build", str(scene), "--out", str(run), "--prior", "table", "--method", "icp", "--frames", "0:2"]) == 0
    assert main(["calibrate-camera", str(run), "--out", str(file)]) == 3
    assert read_focal_factor(file).factor == 1.0
    assert json.loads(file.read_bytes())["sigmas_after"] is None


def test_the_file_of_a_focal_length_is_read_as_it_was_written(tmp_path: Path) -> None:
    focal = FocalFactor(1.0 / 3.0 + 0.5, 597.522, 1.0 / 3.0 + 0.6, 0.1 / 3.0, 0.01 / 3.0, "loop")
    (tmp_path / "camera.json").write_text(focal.text({"loops": 1}))
    assert read_focal_factor(tmp_path / "camera.json") == focal
    (tmp_path / "older.json").write_text('{"focal_factor": 1.1, "stated_fx_px": 597.522}')
    assert read_focal_factor(tmp_path / "older.json") == FocalFactor(1.1, 597.522)


@pytest.mark.parametrize(
    ("known", "depth_scale", "sigma"),
    [(None, 0.95, -0.5 * np.log(0.9025)), ("focal-length", 0.9025, 0.0), ("depth", 1.0, 0.0)],
)
def test_what_is_known_of_the_camera_decides_the_scale_of_its_depth(
    known: str | None, depth_scale: float, sigma: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scene: Path
) -> None:
    """A loop tells the product of two factors, of the focal length and of the depth's relief."""
    given = FocalLength(float(np.log(0.9025)), 0.01, 0.05, 1, 5.0, 1.0, {})
    monkeypatch.setattr(FocalCalibrator, "estimate", lambda *_: given)
    run, file = tmp_path / "run", tmp_path / "camera.json"
    assert main(["build", str(scene), "--out", str(run), "--prior", "table", "--method", "icp", "--frames", "0:2"]) == 0
    options = [] if known is None else ["--known", known]
    assert main(["calibrate-camera", str(run), "--out", str(file), *options]) == 0
    found = read_focal_factor(file)
    assert (found.factor, found.depth_scale, found.depth_scale_sigma) == pytest.approx((0.9025, depth_scale, sigma))


def test_depth_stretched_with_the_focal_length_leaves_what_pixels_show_across_the_ray() -> None:
    """So that a camera of known focal length keeps its widths, and relief alone is stretched."""
    whole = open_sequence(bundled("box"))
    before = whole.frame(3)
    after = RefocusedSequence(whole, FocalFactor(1.1, before.camera.fx, depth_scale=1.1)).frame(3)
    w, h = before.camera.rays()
    stretched_w, stretched_h = after.camera.rays()
    np.testing.assert_allclose(stretched_w * after.depth_m, w * before.depth_m, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(stretched_h * after.depth_m, h * before.depth_m, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(after.depth_m, 1.1 * before.depth_m, rtol=1e-6)


def test_a_sequence_is_seen_with_the_focal_length_that_was_measured() -> None:
    whole = open_sequence(bundled("box"))
    before = whole.frame(3).camera
    after = RefocusedSequence(whole, FocalFactor(1.1, before.fx)).select(frames=slice(3, 5))
    assert [frame.camera for frame in after] == 2 * [replace(before, fx=1.1 * before.fx, fy=1.1 * before.fy)]


def test_the_focal_length_of_another_camera_is_refused(tmp_path: Path, refusal: Callable[..., str]) -> None:
    (tmp_path / "camera.json").write_text(FocalFactor(1.1, 400.0).text({}))
    said = refusal("build", bundled("box"), "--camera", tmp_path / "camera.json", "--out", tmp_path / "run")
    assert "400" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_run_with_a_wrong_focal_length_tells_the_right_one(tmp_path: Path, refusal: Callable[..., str]) -> None:
    wrong, right, run = tmp_path / "wrong.json", tmp_path / "right.json", tmp_path / "run"
    stated_px = open_sequence(bundled("box")).frame(0).camera.fx
    wrong.write_text(FocalFactor(0.94, stated_px).text({}))
    main(["build", str(bundled("box")), "--prior", "table", "--camera", str(wrong), "--out", str(run)])
    assert main(["calibrate-camera", str(run), "--out", str(right)]) == 0
    found = json.loads(right.read_text())
    assert found["focal_factor"] == pytest.approx(1.0, abs=max(0.01, 3.0 * found["focal_factor_sigma"]))
    assert "--overwrite" in refusal("calibrate-camera", run, "--out", right)  # is there
