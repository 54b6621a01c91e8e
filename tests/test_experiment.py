"""Experiments: which pairs are tried, with what, and what errors come of it."""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest
import tabletop
from oracles import BODY, POSES, Oracle, Recording, experiment

from modeler.experiment import Pairing, sparse_view
from modeler.experiment.experiment import viewed
from modeler.priors import GeneralPrior
from modeler.rays import Sensor
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    AbstractRegistrar,
    Edge,
    InputError,
    Posterior,
    RayImage,
    Solution,
)


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


def test_pairs_of_the_dragon_protocol_are_thirty_a_step() -> None:
    pairs = list(Pairing(offsets=(1, 2, 3, 4), both_ways=True, closed=True).pairs(range(15)))
    assert len(set(pairs)) == 4 * 30


def test_tries_every_pair_by_every_method_and_knows_how_many() -> None:
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
    for trial in experiment().trials(Recording()):
        assert trial.rotation_deg == pytest.approx(15.0 * trial.offset)
        assert trial.sigma_deg == pytest.approx(np.degrees(0.01 * np.sqrt(3)))
        assert (trial.overlap, trial.seconds, trial.outcome, trial.usable) == (0.5, 0.25, "converged", True)
        if trial.method == "bad":
            assert trial.rotation_error_deg == pytest.approx(np.degrees(0.6), abs=5.0)
            assert trial.nees > 1000.0
        else:
            assert trial.rotation_error_deg < 3.0
            assert trial.nees < 30.0


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

        def register(
            self, source: RayImage, target: RayImage, density: AbstractPoseDensity, *, rng: np.random.Generator
        ) -> Posterior:
            self.seen.extend([len(source.points_m), len(target.points_m)])
            return Oracle().register(source, target, density, rng=rng)

    dense, thin = Counting(), Counting()
    list(experiment(methods={"dense": dense}).trials(Recording()))
    list(experiment(methods={"thin": thin}, points=80).trials(Recording()))
    assert set(thin.seen) == {80}
    assert min(dense.seen) > 80
