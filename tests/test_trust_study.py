"""The study of the verdict: its design, its faults, and how it judges and counts."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modeler import se3
from modeler.types import Camera, Frame, Solution, Step
from studies.calibration.specimens import load_specimen
from studies.trust.__main__ import run
from studies.trust.faults import FAULTS, late_mask, loose_mask, object_still, thin_mask, wrong_intrinsics, wrong_scale
from studies.trust.plan import HALVES, SOUND, Plan, shapes, sound, viewed
from studies.trust.stage import Recorded, Stage
from studies.trust.study import Outcome, pose_errors
from studies.trust.tables import text

RIGHT = Outcome(
    half="tuning",
    number=0,
    fault=SOUND,
    shape="box",
    prior="table",
    masks=True,
    frames=8,
    placed=8,
    status=0,
    codes=(),
    evidence={"false_surface": (0.0, 0.03)},
    error_deg=1.0,
    error_m=0.001,
    f_score=0.99,
    seconds=1.0,
)


@pytest.fixture
def stage() -> Stage:
    rng = np.random.default_rng(1)
    return sound(viewed(load_specimen("wedge"), rng, 1), rng)


def small_frames() -> list[Frame]:
    camera = Camera(40, 40, 50.0, 50.0, 19.5, 19.5)
    frames = []
    for index in range(3):
        mask = np.zeros((40, 40), bool)
        mask[12:30, 10 + index : 28] = True
        frames.append(Frame(index, float(index), np.full((40, 40), 0.8, np.float32), camera, mask))
    return frames


def test_halves_share_neither_shapes_nor_draws() -> None:
    classes = ("asymmetric", "near-symmetric", "n-fold", "revolution")
    tuning, held_out = (set(shapes(half, *classes)) for half in HALVES)
    assert not tuning & held_out
    assert min(len(tuning), len(held_out)) > 60
    seeds = {Plan(half, number).seed for half in HALVES for number in range(150)}
    assert len(seeds) == 300


def test_every_other_run_is_sound_and_every_fault_occurs() -> None:
    plans = [Plan("tuning", number) for number in range(150)]
    assert sum(plan.fault == SOUND for plan in plans) == 75
    counts = [sum(plan.fault == fault.name for plan in plans) for fault in FAULTS]
    assert len(FAULTS) == 20
    assert min(counts) >= 3


@pytest.mark.parametrize("number", [0, 7, 13])
def test_a_plan_draws_the_same_stage_again(number: int) -> None:
    first, second = (Plan("tuning", number).stage() for _ in range(2))
    assert first.recipe == second.recipe
    assert first.options == second.options
    assert Plan("held-out", number).stage().recipe != first.recipe


def test_faults_of_masks_and_camera_do_what_they_say(stage: Stage) -> None:
    rng, frames = np.random.default_rng(3), small_frames()
    own = frames[0].mask
    assert own is not None
    wider = loose_mask(stage, stage.recipe, rng).mask_of(0, own, ())
    assert (wider & own).sum() == own.sum() < wider.sum()
    narrower = thin_mask(stage, stage.recipe, rng).mask_of(0, own, ())
    assert 0 < (narrower & own).sum() == narrower.sum() < own.sum()
    late = late_mask(stage, stage.recipe, rng).spoil(frames)
    assert [late[k].mask is frames[max(k - 1, 0)].mask for k in range(3)] == [True] * 3
    for _ in range(10):
        camera = wrong_intrinsics(stage, stage.recipe, rng).spoil(frames)[1].camera
        assert 0.02 <= abs(camera.fx / 50.0 - 1.0) <= 0.1
        assert camera.fx == camera.fy
        depth_m = wrong_scale(stage, stage.recipe, rng).spoil(frames)[1].depth_m
        assert 0.02 - 1e-6 <= abs(depth_m[0, 0] / 0.8 - 1.0) <= 0.1 + 1e-6


def test_an_object_that_stands_still_keeps_the_order_of_its_poses(stage: Stage) -> None:
    for seed in range(20):
        places = object_still(stage, stage.recipe, np.random.default_rng(seed)).places
        order = [stage.places.index(place) for place in places]
        assert len(order) == len(stage.places)
        assert order[0] == 0
        assert set(np.diff(order)) == {0, 1} or set(order) == {0}


def test_depth_stated_wrongly_moves_what_lands_by_the_size_of_the_object_alone() -> None:
    """The camera is 10 % nearer than stated: poses scaled alike place the surface wrongly by a tenth of its size."""
    rng = np.random.default_rng(2)
    observed = sound(viewed(load_specimen("wedge"), rng, 2), rng)
    observed = replace(observed.moving(observed.places[:3]), masks=True)
    recorded = Recorded(replace(observed, spoil=lambda frames: [replace(f, depth_m=1.1 * f.depth_m) for f in frames]))
    truth = recorded.truth()
    first_from = {k: truth[0] @ se3.inverse(pose) for k, pose in truth.items()}
    for pose in first_from.values():
        pose[:3, 3] *= 1.1
    frame = recorded.frame(2)
    step = Step(frame, None, None, (), (), None, Solution(first_from))  # pyright: ignore[reportArgumentType]
    error_deg, error_m = pose_errors(recorded, step)
    assert error_deg < 1e-4
    assert error_m < 0.005
    exact = pose_errors(
        Recorded(observed), replace(step, solution=Solution({k: truth[0] @ se3.inverse(truth[k]) for k in truth}))
    )
    assert exact == pytest.approx((0.0, 0.0), abs=1e-5)


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        ({}, False),
        ({"error_deg": 3.1}, True),
        ({"error_m": 0.0051}, True),
        ({"f_score": 0.89}, True),
        ({"error_deg": None, "error_m": None}, True),
        ({"f_score": None}, True),
    ],
)
def test_a_model_is_wrong_by_pose_place_or_surface(change: dict[str, float | None], wrong: bool) -> None:
    assert replace(RIGHT, **change).wrong is wrong  # pyright: ignore[reportArgumentType]


def test_the_table_counts_by_fault_and_status() -> None:
    wrong = replace(RIGHT, fault="masks late", error_deg=20.0)
    outcomes = [RIGHT, replace(RIGHT, status=3), wrong, replace(wrong, status=3), replace(wrong, status=2)]
    lines = {line[:26].strip(): line[26:].split() for line in text(outcomes).splitlines()[1:]}
    assert lines["no fault"] == ["2", "0", "0", "1", "1"]
    assert lines["masks late"] == ["3", "1", "2", "0", "0"]
    assert lines["all"] == ["5", "1", "2", "1", "1"]


def test_a_study_goes_on_where_it_was(tmp_path: Path) -> None:
    path = tmp_path / "tuning.jsonl"
    path.write_text("".join(json.dumps(replace(RIGHT, number=number).values()) + "\n" for number in range(3)))
    assert [one.number for one in run("tuning", 3, 1, path)] == [0, 1, 2]
    assert len(path.read_text().splitlines()) == 3


@pytest.mark.slow
def test_a_run_is_judged_and_the_same_again(tmp_path: Path) -> None:
    first, second = (run("tuning", 2, 1, tmp_path / f"{name}.jsonl") for name in ("first", "second"))
    assert [replace(one, seconds=0.0) for one in first] == [replace(one, seconds=0.0) for one in second]
    assert [one.fault for one in first] == [SOUND, FAULTS[0].name]
    assert not first[0].wrong
    assert first[0].evidence


@pytest.mark.slow
def test_runs_side_by_side_from_the_command_line(tmp_path: Path) -> None:
    """Workers are processes of their own: what they are sent must be found there."""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent)}
    command = [sys.executable, "-m", "studies", "trust", "--runs", "2", "--jobs", "2", "--out", str(tmp_path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert len((tmp_path / "tuning.jsonl").read_text().splitlines()) == 2
