"""Experiments: which pairs are tried, with what, and what errors come of it."""

import csv
import io
import json
import math
import weakref
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tabletop
from oracle_experiments import BODY, POSES, Oracle, Recording, experiment, trial
from PIL import Image

from modeler import se3
from modeler.experiment import Pairing, Trial, evaluate, sparse_view, summaries
from modeler.experiment.experiment import viewed
from modeler.pipeline import Modeler
from modeler.priors import GeneralPrior
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    AbstractRegistrar,
    Edge,
    InputError,
    Posterior,
    RayImage,
    SensorNoise,
    Solution,
    ViewPair,
)
from modeler.views import Sensor
from modeler.viz.figures import rotation_errors


class Refusing(AbstractPrior):
    """Lacks what it needs."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        raise InputError("no robot was seen")


@pytest.mark.parametrize(
    ("pairing", "pairs"),
    [
        (Pairing(), [(3, 1, 1), (7, 3, 1)]),
        (Pairing(offsets=(2,)), [(7, 1, 2)]),
        (Pairing(offsets=(1, 2)), [(3, 1, 1), (7, 3, 1), (7, 1, 2)]),
        (Pairing(both_ways=True), [(3, 1, 1), (1, 3, 1), (7, 3, 1), (3, 7, 1)]),
        (Pairing(closed=True), [(3, 1, 1), (7, 3, 1), (1, 7, 1)]),
        (Pairing(offsets=(3, 5)), []),
    ],
)
def test_pairs_frames_at_an_offset_of_the_sequence(pairing: Pairing, pairs: list[tuple[int, int, int]]) -> None:
    assert list(pairing.pairs((1, 3, 7))) == pairs


@dataclass(frozen=True)
class ContradictedWithin(AbstractRegistrar):
    """Knows the truth where any motion is possible; within limits, the images contradict its answer."""

    def posterior_of(self, pair: ViewPair) -> Posterior:
        turned = se3.moved(np.eye(4)[None], np.array([[3.0, 0.0, 0.0, 0.0, 0.0, 0.0]]), pair.source.centroid_m)
        wide = np.isfinite(pair.density.log_density(turned)).all()
        found = Oracle(off_rad=0.0 if wide else 0.6).posterior_of(pair)
        return found if wide else replace(found, contradicted=True)


@pytest.mark.parametrize(("assumed", "error_deg"), [(True, 0.0), (False, 34.4)])
def test_limits_that_are_assumed_are_left_as_a_registration_leaves_them(*, assumed: bool, error_deg: float) -> None:
    prior, methods = GeneralPrior(limits_assumed=assumed), {"method": ContradictedWithin()}
    trials = experiment(methods=methods, prior=prior).trials(Recording())
    assert [trial.rotation_error_deg for trial in trials] == pytest.approx([error_deg] * 5, abs=2.0)


@pytest.mark.parametrize("assumed", [True, False])
@pytest.mark.parametrize("method", [Oracle(), ContradictedWithin()])
def test_a_trial_is_what_register_gives_of_the_pair(method: AbstractRegistrar, assumed: bool) -> None:
    prior, recording, sensor = GeneralPrior(limits_assumed=assumed), Recording(), Sensor(SensorNoise(0.002, 0.001))
    single: Any = Modeler(prior=prior, registrar=method, sensor=sensor, seed=3)
    scene = single.segmenter.scene([recording.frame(index) for index in recording.indices])
    for found in experiment(methods={"one": method}, prior=prior, seed=3).trials(recording):
        source, target = (single.prepare(recording.frame(index), scene).view for index in (found.source, found.target))
        posterior = single.register(source, target)
        stated = posterior.outcome.label, posterior.usable, posterior.seconds
        assert (found.outcome, found.usable, found.seconds) == stated
        np.testing.assert_array_equal(found.target_from_source, posterior.pose.mean.ravel())
        assert found.seconds == (0.5 if assumed and isinstance(method, ContradictedWithin) else 0.25)


def test_tries_every_pair_by_every_method_and_counts_them() -> None:
    trials = list(experiment().trials(Recording()))
    assert len(trials) == experiment().size(Recording()) == 10
    assert [(t.method, t.offset, t.source, t.target) for t in trials[:3]] == [
        ("good", 1, 1, 0),
        ("bad", 1, 1, 0),
        ("good", 1, 2, 1),
    ]


@dataclass(frozen=True)
class Learning(GeneralPrior):
    """Keeps count of the pairs that it could learn from."""

    seen: list[int] = field(default_factory=list)

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> GeneralPrior:
        assert not solution.trajectory  # pairs of a table have no sequence
        self.seen.append(len(edges))
        return self


@pytest.mark.parametrize("learn", [False, True])
def test_a_prior_learns_from_the_pairs_before_where_it_may(learn: bool) -> None:
    prior = Learning()
    assert len(list(experiment(prior=prior, learn=learn, methods={"good": Oracle()}).trials(Recording()))) == 5
    assert prior.seen == ([0, 1, 2, 3, 4] if learn else [])


@pytest.mark.parametrize("pairing", [Pairing(), Pairing(offsets=(2, 1), both_ways=True), Pairing(closed=True)])
def test_keeps_no_more_views_than_the_offset_asks_for(pairing: Pairing) -> None:
    """Views weigh ten megabytes each, so that a sequence must not be held as a whole."""

    @dataclass(eq=False)
    class View:
        index: int

    alive: weakref.WeakSet[View] = weakref.WeakSet()

    def view(index: int) -> View:
        alive.add(made := View(index))
        return made

    pairs = list(pairing.pairs(range(40)))
    most = 0
    for (pair, source, target), wanted in zip(viewed(pairs, view), pairs, strict=True):
        assert (pair, source.index, target.index) == (wanted, wanted.source, wanted.target)
        del source, target
        most = max(most, len(alive))
    assert most <= max(pairing.offsets) * (1 + pairing.closed) + 1


def test_measures_errors_in_the_units_that_it_says() -> None:
    for answer in experiment().trials(Recording()):
        assert answer.rotation_deg == pytest.approx(15.0 * answer.offset)
        assert answer.sigma_deg == pytest.approx(np.degrees(0.01 * np.sqrt(3)))
        assert (answer.overlap, answer.seconds, answer.outcome, answer.usable) == (0.5, 0.25, "converged", True)
        if answer.method == "bad":
            assert answer.rotation_error_deg == pytest.approx(np.degrees(0.6), abs=5.0)
            assert answer.nees > 1000.0
        else:
            assert answer.rotation_error_deg < 3.0
            assert answer.nees < 30.0


def test_same_seed_gives_the_same_trials() -> None:
    first, again = (list(experiment(points=80).trials(Recording())) for _ in range(2))
    assert first == again
    assert first != list(experiment(points=80, seed=1).trials(Recording()))


def test_tells_of_views_without_an_object_and_goes_on() -> None:
    trials = list(experiment(pairing=Pairing()).trials(Recording(lost=1)))
    lost = [t for t in trials if 1 in (t.source, t.target)]
    assert len(lost) == 4
    assert {t.outcome for t in lost} == {"too few points"}
    assert not any(t.usable or math.isfinite(t.rotation_error_deg) for t in lost)
    assert all(t.usable for t in trials if t not in lost)


def test_tells_where_the_prior_does_not_apply() -> None:
    trials = list(experiment(prior=Refusing()).trials(Recording()))
    assert {(t.outcome, t.usable) for t in trials} == {("no robot was seen", False)}


def test_sparse_views_keep_so_many_points_and_what_belongs_to_them() -> None:
    view = Sensor().ray_image(tabletop.view(BODY, POSES[0], 0).frame)
    thin = sparse_view(view, 50, np.random.default_rng(0))
    assert [len(a) for a in (thin.points_m, thin.normals, thin.pixels, thin.layers["variance_m2"])] == [50] * 4
    at = [int(np.flatnonzero(np.all(view.pixels == pixel, axis=1))[0]) for pixel in thin.pixels]
    np.testing.assert_array_equal(thin.points_m, view.points_m[at])
    np.testing.assert_array_equal(thin.normals, view.normals[at])
    np.testing.assert_array_equal(thin.layers["variance_m2"], view.layers["variance_m2"][at])
    assert thin.layers["cells"] is view.layers["cells"]
    np.testing.assert_array_equal(sparse_view(view, 10**6, np.random.default_rng(0)).points_m, view.points_m)


def test_sparse_experiments_give_methods_few_points() -> None:
    class Counting(AbstractRegistrar):
        def __init__(self) -> None:
            self.seen: list[int] = []

        def posterior_of(self, pair: ViewPair) -> Posterior:
            self.seen.extend([len(pair.source.points_m), len(pair.target.points_m)])
            return Oracle().posterior_of(pair)

    dense, thin = Counting(), Counting()
    list(experiment(methods={"dense": dense}).trials(Recording()))
    list(experiment(methods={"thin": thin}, points=80).trials(Recording()))
    assert set(thin.seen) == {80}
    assert min(dense.seen) > 80


# What is made of an experiment: summaries, loops, files and figures.


def test_summaries_count_failures_and_leave_them_out_of_quantiles() -> None:
    failed = Trial("box", "icp", 1, 3, 2, "too few points", usable=False, rotation_deg=25.0)
    errors = [1.0, 2.0, 3.0, 4.0, 50.0]
    (row,) = summaries([*(trial(e) for e in errors), trial(5.0, nees=900.0, usable=False), failed], success_deg=16.2)
    assert (row.pairs, row.usable, row.successes) == (7, 5, 5)
    assert astuple(row.rotation_error_deg) == (2.25, 3.5, 4.75, 27.5, 50.0)
    assert astuple(row.translation_error_mm) == (2.0,) * 5
    assert math.isnan(row.loop_deg)
    assert row.nees == pytest.approx((5 * 5.0 + 900.0) / 6)
    assert row.inside_95 == pytest.approx(5 / 6)


def test_summaries_of_failures_alone_have_no_quantiles() -> None:
    failed = Trial("box", "icp", 1, 1, 0, "too few points", usable=False, rotation_deg=25.0)
    (row,) = summaries([failed], success_deg=16.2)
    assert row.successes == 0
    assert all(math.isnan(value) for value in (*astuple(row.rotation_error_deg), row.nees, row.inside_95, row.seconds))


@pytest.mark.parametrize("known", [True, False])
def test_a_closed_turn_is_judged_by_what_all_its_steps_leave(known: bool) -> None:
    @dataclass(frozen=True)
    class Turning(AbstractRegistrar):
        """Turns by a little too much about one axis at every step."""

        def posterior_of(self, pair: ViewPair) -> Posterior:
            truth = POSES[pair.target.index] @ se3.inverse(POSES[pair.source.index])
            posterior = Oracle().posterior_of(pair)
            pose = POSES[pair.source.index]
            in_model = pose @ se3.exp(np.array([0, 0, 0.05, 0, 0, 0])) @ se3.inverse(pose)
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
    with pytest.raises(InputError, match="`closed`"):
        experiment(pairing=pairing).size(Recording(known=False))


def run(out: Path, *recordings: Recording) -> list[Trial]:
    given: list[Trial] = []
    evaluate(recordings or [Recording()], experiment(), out, draw=rotation_errors, report=given.append)
    return given


def test_writes_json_csv_and_a_figure(tmp_path: Path) -> None:
    given = run(tmp_path / "new" / "folder", Recording(), Recording(name="with a lost frame", lost=1))
    folder = tmp_path / "new" / "folder"
    assert sorted(p.name for p in folder.iterdir()) == ["results.csv", "results.json", "rotation_errors.png"]
    results = json.loads((folder / "results.json").read_text())
    assert results["schema"] == 1
    assert results["pairing"] == {"offsets": [1, 2], "both_ways": False, "closed": False}
    assert len(results["trials"]) == len(given) == 20
    assert len(results["summaries"]) == 8
    assert results["summaries"][0]["rotation_error_deg"]["median"] < 3.0
    assert np.shape(results["trials"][0]["target_from_source"]) == (16,)
    table = list(csv.DictReader(io.StringIO((folder / "results.csv").read_text())))
    assert len(table) == 20
    for row, record, one in zip(table, results["trials"], given, strict=True):
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


@pytest.mark.parametrize(
    ("out", "recordings", "says"),
    [
        ("out", (Recording(), Recording(name="dark", known=False)), r"dark: .*scene_gt\.json"),
        ("out", (Recording(), Recording()), "two sequences are called 'box'"),
        ("file/out", (), "`out`"),
    ],
)
def test_refuses_what_it_cannot_judge_or_write_before_it_begins(
    tmp_path: Path, out: str, recordings: tuple[Recording, ...], says: str
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=says):
        run(tmp_path / out, *recordings)
    assert not (tmp_path / out).exists()


@pytest.mark.parametrize("trials", [[], [trial(0.0)], [trial(math.nan)], [trial(1e-9), trial(180.0, usable=False)]])
def test_figures_survive_what_a_log_axis_does_not_hold(trials: list[Trial]) -> None:
    with Image.open(io.BytesIO(rotation_errors(trials))) as picture:
        assert picture.format == "PNG"
