"""What is made of an experiment: summaries, loops, files and figures."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from oracles import POSES, Oracle, Recording, experiment, trial
from PIL import Image

from modeler import se3
from modeler.experiment import Pairing, Trial, evaluate, summaries
from modeler.types import (
    AbstractPoseDensity,
    AbstractRegistrar,
    InputError,
    Posterior,
    RayImage,
)
from viz.figures import rotation_errors


def test_summaries_count_failures_and_leave_them_out_of_quantiles() -> None:
    failed = Trial("box", "icp", 1, 3, 2, "too few points", usable=False, rotation_deg=25.0)
    errors = [1.0, 2.0, 3.0, 4.0, 50.0]
    (row,) = summaries([*(trial(e) for e in errors), trial(5.0, nees=900.0, usable=False), failed], success_deg=16.2)
    assert (row.pairs, row.usable, row.successes) == (7, 5, 5)
    assert row.rotation_error_deg == (2.25, 3.5, 4.75, 27.5, 50.0)
    assert row.translation_error_mm == (2.0,) * 5
    assert math.isnan(row.loop_deg)
    assert row.nees == pytest.approx((5 * 5.0 + 900.0) / 6)
    assert row.inside_95 == pytest.approx(5 / 6)


def test_summaries_of_failures_alone_have_no_quantiles() -> None:
    failed = Trial("box", "icp", 1, 1, 0, "too few points", usable=False, rotation_deg=25.0)
    (row,) = summaries([failed], success_deg=16.2)
    assert row.successes == 0
    assert all(math.isnan(value) for value in (*row.rotation_error_deg, row.nees, row.inside_95, row.seconds))


@pytest.mark.parametrize("known", [True, False])
def test_a_closed_turn_is_judged_by_what_all_its_steps_leave(known: bool) -> None:
    @dataclass(frozen=True)
    class Turning(AbstractRegistrar):
        """Turns by a little too much about one axis at every step."""

        def register(
            self, source: RayImage, target: RayImage, density: AbstractPoseDensity, *, rng: np.random.Generator
        ) -> Posterior:
            truth = POSES[target.index] @ se3.inverse(POSES[source.index])
            posterior = Oracle().register(source, target, density, rng=rng)
            in_model = POSES[source.index] @ se3.exp(np.array([0, 0, 0.05, 0, 0, 0])) @ se3.inverse(POSES[source.index])
            return replace(posterior, pose=replace(posterior.pose, mean=truth @ in_model))

    plan = experiment(methods={"turning": Turning()}, pairing=Pairing(closed=True))
    trials = list(plan.trials(Recording(known=known)))
    assert len(trials) == plan.size(Recording(known=known)) == len(POSES)
    (row,) = summaries(trials, 16.2, loops=plan.pairing.loops)
    assert row.loop_deg == pytest.approx(np.degrees(0.05 * len(POSES)))
    assert row.turned_deg == pytest.approx(2 * 15.0 * (len(POSES) - 1), abs=np.degrees(0.05 * len(POSES)))
    assert row.successes == (len(POSES) if known else None)
    assert math.isfinite(row.rotation_error_deg.median) == known
    (row,) = summaries(plan.trials(Recording(known=known, lost=1)), 16.2, loops=True)
    assert math.isnan(row.loop_deg)


@pytest.mark.parametrize("pairing", [Pairing(), Pairing(closed=True, both_ways=True), Pairing((1, 2), closed=True)])
def test_only_steps_once_round_are_a_loop(pairing: Pairing) -> None:
    assert not pairing.loops
    with pytest.raises(InputError, match="--closed"):
        experiment(pairing=pairing).size(Recording(known=False))


def run(out: Path, *recordings: Recording) -> list[Trial]:
    told: list[Trial] = []
    evaluate(recordings or [Recording()], experiment(), out, draw=rotation_errors, told=told.append)
    return told


def test_writes_json_csv_and_a_figure(tmp_path: Path) -> None:
    told = run(tmp_path / "new" / "folder", Recording(), Recording(name="with a lost frame", lost=1))
    folder = tmp_path / "new" / "folder"
    assert sorted(p.name for p in folder.iterdir()) == ["results.csv", "results.json", "rotation_errors.png"]
    results = json.loads((folder / "results.json").read_text())
    assert results["schema"] == 1
    assert results["pairing"] == {"offsets": [1, 2], "both_ways": False, "closed": False}
    assert len(results["trials"]) == len(told) == 20
    assert len(results["summaries"]) == 8
    assert results["summaries"][0]["rotation_error_deg"]["median"] < 3.0
    assert np.shape(results["trials"][0]["target_from_source"]) == (16,)
    table = list(csv.DictReader(io.StringIO((folder / "results.csv").read_text())))
    assert len(table) == 20
    for row, record, one in zip(table, results["trials"], told, strict=True):
        assert row["method"] == record["method"] == one.method
        if math.isfinite(one.rotation_error_deg):
            assert float(row["rotation_error_deg"]) == record["rotation_error_deg"] == one.rotation_error_deg
        else:
            assert row["rotation_error_deg"] == ""
            assert record["rotation_error_deg"] is None
    with Image.open(folder / "rotation_errors.png") as picture:
        assert min(picture.size) > 300


def test_same_seed_writes_the_same_files(tmp_path: Path) -> None:
    for name in ("first", "again"):
        run(tmp_path / name)
    for file in ("results.json", "results.csv", "rotation_errors.png"):
        assert (tmp_path / "first" / file).read_bytes() == (tmp_path / "again" / file).read_bytes()


def test_refuses_sequences_without_truth_before_it_begins(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"dark: has no ground truth.*scene_gt\.json"):
        run(tmp_path / "out", Recording(), Recording(name="dark", known=False))
    assert not (tmp_path / "out").exists()


def test_refuses_two_sequences_of_one_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="two sequences are called 'box'"):
        run(tmp_path / "out", Recording(), Recording())


def test_refuses_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--out"):
        run(tmp_path / "file" / "out")


@pytest.mark.parametrize("trials", [[], [trial(0.0)], [trial(math.nan)], [trial(1e-9), trial(180.0, usable=False)]])
def test_figures_survive_what_a_log_axis_does_not_hold(trials: list[Trial]) -> None:
    with Image.open(io.BytesIO(rotation_errors(trials))) as picture:
        assert picture.format == "PNG"
