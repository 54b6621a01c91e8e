"""A growing graph: each incremental solution is the batch solution, with no more work than needed."""

import gc
import itertools
import weakref
from collections.abc import Sequence

import numpy as np
import pytest
from ring_graphs import edge, measured, spin, spun, turntable

from modeler import se3
from modeler.graph import PoseGraph, Smoother, optimise, solve
from modeler.types import Edge, Mode, PoseGaussian, Solution

COUNT, PER_TURN = 40, 12
TAIL = 40  # frames of one edge each, so many that all are eliminated anew


def _arrivals(rng: np.random.Generator, *, false: float = 0.0, modes: bool = False) -> list[list[Edge]]:
    """The edges that each frame of a turntable brings: to the last view, the one before it, and a turn ago."""
    truth = turntable(COUNT, PER_TURN)
    arrivals = []
    for k in range(1, COUNT):
        pose = measured(truth, k - 1, k, rng)
        spun = PoseGaussian(pose.mean @ spin([0.0, np.pi / 2, 0.0]), pose.covariance)
        both = (Mode(0.6, spun), Mode(0.4, pose)) if modes and k % 5 == 3 else ()
        edges = [edge(k - 1, k, both[0].pose if both else pose, modes=both)]
        edges += [edge(t, k, measured(truth, t, k, rng), "closure") for t in (k - 2, k - PER_TURN) if t >= 0]
        wrong = [e for e in edges[1:] if rng.random() < false]
        arrivals.append([_spoilt(e, rng) if e in wrong else e for e in edges])
    return arrivals


def _spoilt(of: Edge, rng: np.random.Generator) -> Edge:
    axis = rng.normal(size=3)
    return spun(of, axis / np.linalg.norm(axis) * rng.uniform(0.8, 2.5))


def _assert_same(one: Solution, other: Solution) -> None:
    """Poses are the same to half a hundredth of their standard deviations, covariances to two hundredths."""
    assert set(one.trajectory) == set(other.trajectory)
    for frame, pose in one.trajectory.items():
        np.testing.assert_allclose(one.odometry[frame], other.odometry[frame], atol=1e-12)
        whiten = np.linalg.inv(np.linalg.cholesky(other.covariances[frame]))
        if frame != next(iter(one.trajectory)):
            assert np.linalg.norm(whiten @ se3.log(se3.inverse(other.trajectory[frame]) @ pose)) < 5e-3
        np.testing.assert_allclose(whiten @ one.covariances[frame] @ whiten.T, np.eye(6), atol=2e-2)
    assert set(one.outliers) == set(other.outliers)
    assert set(one.mode_weights) == set(other.mode_weights)
    for pair, weights in one.mode_weights.items():
        np.testing.assert_allclose(weights, other.mode_weights[pair], atol=1e-3)


@pytest.mark.parametrize(
    ("false", "modes"), [(0.0, False), (0.2, False), (0.0, True), pytest.param(0.2, True, marks=pytest.mark.slow)]
)
def test_after_any_frame_the_solution_is_that_of_the_batch(false: float, modes: bool) -> None:
    growing = Smoother()
    for number, edges in enumerate(_arrivals(np.random.default_rng(3), false=false, modes=modes)):
        growing = growing.plus(edges)
        if number % (12 if modes else 6 if false else 3) == 1:  # a batch takes its time
            _assert_same(growing.solution, solve(growing.graph, {}))


def test_how_it_grew_does_not_matter() -> None:
    arrivals = _arrivals(np.random.default_rng(4), false=0.1)
    edges = list(itertools.chain.from_iterable(arrivals))
    singly, wholly = Smoother(), Smoother().plus(edges)
    for one in edges:
        singly = singly.plus([one])
    _assert_same(singly.solution, wholly.solution)


def test_smoother_is_a_value() -> None:
    arrivals = _arrivals(np.random.default_rng(5))
    trunk = Smoother()
    for edges in arrivals[:20]:
        trunk = trunk.plus(edges)
    before = dict(trunk.solution.trajectory)
    one = trunk.plus(arrivals[20])
    trunk.plus([arrivals[20][0], _spoilt(arrivals[20][2], np.random.default_rng(0))])
    again = trunk.plus(arrivals[20])
    for frame, pose in before.items():
        np.testing.assert_array_equal(trunk.solution.trajectory[frame], pose)
    for frame, pose in one.solution.trajectory.items():
        np.testing.assert_array_equal(again.solution.trajectory[frame], pose)


def test_the_batch_optimiser_runs_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []

    def counted(tree: Sequence[object], *args: object, **options: object) -> object:
        calls.append(len(tree))
        return batch(tree, *args, **options)  # pyright: ignore[reportArgumentType]

    batch = optimise.optimise
    monkeypatch.setattr(optimise, "optimise", counted)
    growing = Smoother()
    arrivals = _arrivals(np.random.default_rng(7))
    for edges in arrivals[:-1]:
        growing = growing.plus(edges)
    assert len(calls) == 1  # the first loop
    growing = growing.plus([*arrivals[-1], _spoilt(arrivals[-1][2], np.random.default_rng(0))])
    assert len(calls) == 1  # those that agree judge it
    assert len(growing.solution.outliers) == 1


def test_other_root_or_other_edges_are_solved_afresh() -> None:
    arrivals = _arrivals(np.random.default_rng(8))
    edges = list(itertools.chain.from_iterable(arrivals))
    growing = Smoother().plus(edges)
    for graph in (PoseGraph(tuple(edges), first=5), PoseGraph(tuple(edges[:40])), PoseGraph(tuple(edges[::-1]), 0)):
        _assert_same(growing.to(graph).solution, solve(graph, {}))
    assert dict(growing.to(PoseGraph()).solution.trajectory) == {}


def _tail(count: int, rng: np.random.Generator) -> list[list[Edge]]:
    """The edges of frames beyond those of `_arrivals`: each hangs on one that came before, some of them forked."""
    truth = turntable(COUNT + count, PER_TURN)
    hooks = [(k - 3 if k % 4 == 0 else k - 1, k) for k in range(COUNT, COUNT + count)]
    return [[edge(t, k, measured(truth, t, k, rng))] for t, k in hooks]


def test_frames_of_one_edge_have_the_covariances_of_the_batch() -> None:
    growing = Smoother()
    for edges in [*_arrivals(np.random.default_rng(9)), *_tail(TAIL, np.random.default_rng(10))]:
        growing = growing.plus(edges)
    batch, rng = solve(growing.graph, {}), np.random.default_rng(11)
    assert set(growing.solution.covariances) == set(batch.covariances) == set(range(COUNT + TAIL))
    pairs = [*itertools.pairwise(range(COUNT - 2, COUNT + TAIL)), *rng.permuted([range(COUNT + TAIL)] * 2, axis=1).T]
    for target, source in pairs:
        if target != source:
            found, wanted = (s.relative_covariance(target, source) for s in (growing.solution, batch))
            np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4 * np.abs(wanted).max())
    for frame, wanted in batch.covariances.items():
        found = growing.solution.covariances[frame]
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4 * np.abs(wanted).max())


def test_two_continuations_of_one_solution_are_independent() -> None:
    trunk = Smoother()
    for edges in _arrivals(np.random.default_rng(15)):
        trunk = trunk.plus(edges)
    one, other = (_tail(1, np.random.default_rng(seed))[0] for seed in (16, 17))
    vague = PoseGaussian(other[0].posterior.pose.mean, 100.0 * other[0].posterior.pose.covariance)
    other = [edge(other[0].target, COUNT, vague)]
    here, there = trunk.plus(one).solution, trunk.plus(other).solution
    assert np.trace(there.covariances[COUNT]) > 3.0 * np.trace(here.covariances[COUNT])
    np.testing.assert_allclose(here.covariances[COUNT - 1], there.covariances[COUNT - 1], rtol=1e-9)


def test_a_solution_keeps_none_of_those_before_it() -> None:
    growing, kept = Smoother(), []
    for edges in _arrivals(np.random.default_rng(19)):
        growing = growing.plus(edges)
        assert growing.solution.relative_covariance(0, edges[0].source).shape == (6, 6)
        kept.append(weakref.ref(growing.solution.relative_covariance))
    assert kept[-1]() is growing.solution.relative_covariance
    gc.collect()
    assert [covariance() for covariance in kept[:-1]] == [None] * (len(kept) - 1)


@pytest.fixture
def condensing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Graphs of 24 frames and more are condensed, every 12 frames."""
    monkeypatch.setattr(optimise, "CONDENSED_FROM", 2 * PER_TURN)
    monkeypatch.setattr(optimise, "_RENEWED_AT", (PER_TURN, COUNT))


def _turns(count: int, rng: np.random.Generator, *, false: float = 0.0) -> list[list[Edge]]:
    """The edges that each frame of many turns brings: to the last view, and of every third to views of the first turn.

    The first false loop comes after five right ones.
    """
    truth = turntable(count, PER_TURN)
    arrivals = []
    for k in range(1, count):
        edges = [edge(k - 1, k, measured(truth, k - 1, k, rng))]
        if k >= PER_TURN and k % 3 == 0:
            near = k % PER_TURN, (k + 3) % PER_TURN
            edges += [edge(t, k, measured(truth, t, k, rng), "closure") for t in near]
            wrong = len(arrivals) > 2 * PER_TURN and rng.random() < false
            edges[-1] = _spoilt(edges[-1], rng) if wrong else edges[-1]
        arrivals.append(edges)
    return arrivals


def _assert_near(one: Solution, other: Solution, frames: Sequence[int]) -> None:
    """Poses of frames are the same to half a tenth of their standard deviations, covariances to two hundredths."""
    for frame in frames:
        whiten = np.linalg.inv(np.linalg.cholesky(other.covariances[frame]))
        assert np.linalg.norm(whiten @ se3.log(se3.inverse(other.trajectory[frame]) @ one.trajectory[frame])) < 0.05
        np.testing.assert_allclose(whiten @ one.covariances[frame] @ whiten.T, np.eye(6), atol=2e-2)
    assert set(one.outliers) == set(other.outliers)


@pytest.mark.usefixtures("condensing")
@pytest.mark.parametrize("false", [0.0, 0.3])
def test_a_condensed_graph_places_new_frames_as_the_batch_does(false: float) -> None:
    growing, sizes = Smoother(), []
    for number, edges in enumerate(_turns(7 * PER_TURN, np.random.default_rng(21), false=false), 1):
        growing = growing.plus(edges)
        solver = growing.state.solver
        sizes.append(0 if solver is None else solver.values.size())
        if number > 2 * PER_TURN and number % 11 == 0:
            batch = solve(growing.graph, {})
            _assert_near(growing.solution, batch, [3, 6, 9, number])
            for frame in (4, number - 15):  # eliminated
                found, wanted = (s.relative_covariance(number, frame) for s in (growing.solution, batch))
                np.testing.assert_allclose(found, wanted, rtol=2e-2, atol=2e-2 * np.abs(wanted).max())
    assert max(sizes[: 2 * PER_TURN]) >= 2 * PER_TURN - 3
    assert max(sizes[3 * PER_TURN :]) < 2 * PER_TURN + 6  # it does not grow


@pytest.mark.usefixtures("condensing")
def test_solved_again_a_condensed_graph_has_the_solution_of_the_batch() -> None:
    growing = Smoother()
    for edges in _turns(5 * PER_TURN - 4, np.random.default_rng(22)):
        growing = growing.plus(edges)
    assert growing.state.solver.condensed is not None
    _assert_same(growing.to(growing.graph).solution, solve(growing.graph, {}))


@pytest.mark.usefixtures("condensing")
def test_an_edge_to_an_eliminated_frame_counts_as_any_other() -> None:
    arrivals, truth = _turns(5 * PER_TURN - 4, np.random.default_rng(23)), turntable(5 * PER_TURN, PER_TURN)
    growing = Smoother()
    for edges in arrivals:
        growing = growing.plus(edges)
    old, new = 2 * PER_TURN + 1, 5 * PER_TURN - 4
    rng = np.random.default_rng(24)
    edges = [
        edge(new - 1, new, measured(truth, new - 1, new, rng)),
        edge(old, new, measured(truth, old, new, rng), "span"),
    ]
    growing = growing.plus(edges)
    _assert_near(growing.solution, solve(growing.graph, {}), [3, old, new])
