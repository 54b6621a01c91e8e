"""The depth cameras of the study by camera, against what they are said to be, and the study itself."""

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from modeler.types import Frame
from modeler.views.range_noise import range_noise
from studies.calibration.by_camera import (
    CameraStudy,
    Trial,
    conformal_factors,
    conformal_text,
    equal_volume,
    main,
    read,
    standard_error,
    summary,
    table,
    text,
)
from studies.calibration.depth_cameras import CAMERAS, TimeOfFlight, World
from studies.calibration.specimens import Specimen
from studies.loops import cameras

CUBE = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (0.6, 0.7)])
FACES = np.array([[0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3], [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5],
                  [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]])  # fmt: skip
WALL = np.array([[-3.0, -3.0, 0.8], [3.0, -3.0, 0.8], [3.0, 3.0, 0.8], [-3.0, 3.0, 0.8]])
WORLD = World((CUBE, FACES), (WALL, np.array([[0, 1, 2], [0, 2, 3]])))


@pytest.mark.parametrize("name", CAMERAS)
def test_noise_is_of_the_size_and_the_correlation_that_the_camera_has(name: str) -> None:
    camera = CAMERAS[name]
    seen = camera.look(WORLD)
    depth_m = camera.measure(WORLD, np.random.default_rng(0), 0).astype(np.float32)
    assert np.isfinite(depth_m).all()
    face = seen.on_object & (depth_m > 0.0)
    assert abs(np.median(depth_m[face] - seen.depth_m[face])) < 0.004  # time of flight: by light from the wall
    around = ~seen.on_object & (np.abs(depth_m - 0.8) < 0.02)
    expected_mm = {"laser stripe": 0.1, "time of flight": 1.07, "independent pixels": 1.79}.get(name)
    if expected_mm is not None:
        assert 1e3 * np.std(depth_m[around] - 0.8) == pytest.approx(expected_mm, rel=0.25)
    again = camera.measure(WORLD, np.random.default_rng(1), 0).astype(np.float32)
    frames = [Frame(0, 0.0, shown, camera.camera, seen.on_object) for shown in (depth_m, again)]
    noise = range_noise([(frame, seen.on_object) for frame in frames])
    assert (noise.area_px > 20.0) == (name in ("Kinect 1", "D415, holes filled", "D435"))
    fixed = {"Kinect 1": 0.5, "D415, holes filled": 0.75, "D435": 0.75}.get(name, 0.0)
    assert noise.pattern_share == pytest.approx(fixed, abs=0.15)


def test_holes_are_filled_by_the_camera_that_fills_them_only() -> None:
    for name in ("D415, holes filled", "D435"):
        depth_m = CAMERAS[name].measure(WORLD, np.random.default_rng(0), 0)
        assert (depth_m == 0.0).any() == (name == "D435")


def test_light_by_way_of_other_surfaces_makes_time_of_flight_read_too_far() -> None:
    floor = np.array([[-1.0, 0.05, 0.3], [1.0, 0.05, 0.3], [1.0, 0.05, 2.0], [-1.0, 0.05, 2.0]])
    beside = World((CUBE, FACES), (floor, np.array([[0, 1, 2], [0, 2, 3]])))
    empty = World((CUBE, FACES), (floor, np.zeros((0, 3), dtype=np.int64)))
    camera = TimeOfFlight()
    face = camera.look(beside).on_object
    near, isolated = (camera.measure(world, np.random.default_rng(1), 0)[face] for world in (beside, empty))
    assert np.median(near) - np.median(isolated) > 0.0005


def _trial(squares: float, **changes: object) -> Trial:
    said = {"method": "visibility", "usable": True, "nees": squares, "log_volume": -40.0, "outcome": "converged"}
    return Trial("laser stripe", "true", "n-fold", "box", 0.8, 25.0, "table", **{**said, **changes})


def test_volumes_are_compared_at_the_same_coverage() -> None:
    rng = np.random.default_rng(0)
    squares = rng.chisquare(6, 4000)
    true, sure = ([_trial(float(factor * one)) for one in squares] for factor in (1.0, 100.0))
    assert equal_volume(true) == pytest.approx(-40.0, abs=0.2)
    assert equal_volume(sure) - equal_volume(true) == pytest.approx(3.0 * np.log(100.0), abs=1e-6)
    assert "1.0" in summary(true)
    assert "-" in summary([])


def test_the_standard_error_of_a_mean_allows_for_correlation_within_shapes() -> None:
    rng = np.random.default_rng(0)
    of_shapes, independent = rng.normal(size=(2, 400))
    shapes = [str(number) for number in range(400)]
    assert standard_error(independent, shapes) == pytest.approx(1.0 / np.sqrt(400.0), rel=0.1)
    repeated = standard_error(np.repeat(of_shapes, 3), [shape for shape in shapes for _ in range(3)])
    assert repeated == pytest.approx(standard_error(of_shapes, shapes))
    assert np.isnan(standard_error(independent, ["box"] * 400))


def test_conformal_factors_make_regions_hold_the_truth_that_were_too_small(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    tuning, held_out = (
        [_trial(4.0 * one) for one in rng.chisquare(6, 4000)]
        + [_trial(one, outcome="ambiguous") for one in rng.chisquare(6, 4000)]
        + [_trial(1.0, outcome="degenerate") for _ in range(10)]
        + [_trial(1e6, usable=False), _trial(1e6, method="icp")]
        for _ in range(2)
    )
    path = tmp_path / "tuning.csv"
    path.write_text(table(tuning))
    factors = conformal_factors(read(path))
    assert factors == {
        "converged": pytest.approx(4.0, rel=0.1),
        "ambiguous": pytest.approx(1.0, rel=0.1),
        "degenerate": np.inf,
    }
    as_is, with_factors = (float(word) for word in conformal_text(held_out, factors).splitlines()[-1].split()[-2:])
    assert with_factors == pytest.approx(95.0, abs=1.0)
    assert as_is < 80.0


def test_the_study_by_camera_runs_and_repeats_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    box = Specimen("box", "n-fold", "tuning")
    study = CameraStudy((box,), ("independent pixels",), frames=2)
    trials = list(study.trials(0))
    assert {(one.stated, one.prior, one.method) for one in trials} == {
        (stated, prior, method)
        for stated in ("true", "nominal")
        for prior in ("general", "table")
        for method in ("visibility", "icp")
    }
    again = islice(study.trials(0), 2)
    assert [one.nees for one in trials[:2]] == pytest.approx([one.nees for one in again], nan_ok=True)
    assert "independent pixels" in text(trials)
    with pytest.raises(SystemExit):
        main(["--frames", "1", "--out", str(tmp_path)])
    assert "no pair is left" in capsys.readouterr().err


@pytest.mark.slow
def test_whole_runs_of_a_camera_are_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = cameras.run("independent pixels", "figurine", seed=0, frames=3, step_deg=24.0)
    assert (found.placed, found.wrong) == (3, False)
    assert found.error_deg < 1.0
    assert found.f_score > 0.95
    assert 0.0 < abs(found.given - 1.0) < 0.1
    table = cameras.summary([replace(found, status=3), replace(found, wrong=True, status=0)])
    assert table.splitlines()[1].split()[2:8] == ["2", "6", "0", "1", "1", "0"]
    out = tmp_path / "runs" / "found.json"
    monkeypatch.setattr(cameras, "run", lambda *of: found)
    assert cameras.main(["--shapes", "figurine", "--cameras", "independent pixels", "--out", str(out)]) == 0
    assert "independent pixels" in capsys.readouterr().out
    assert len(json.loads(out.read_text())) == 1
