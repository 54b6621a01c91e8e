"""Statistics of solved loops over many seeds: covariances are true before and after closing, lies are found out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from rings import edge, measured, nees, rotation_error, spun, turntable
from scipy import stats

from modeler.graph import PoseGraph, Smoother, solve
from modeler.types import Edge, PoseGaussian, Solution

SEEDS = 120


def _assert_chi2(values: np.ndarray) -> None:
    """NEES of six dimensions: its mean within four standard errors of 6, its distribution chi²."""
    assert np.mean(values) == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / len(values)))
    assert stats.kstest(values, stats.chi2(6).cdf).pvalue > 1e-3


def _nees(solution: Solution, truth: dict[int, np.ndarray], frame: int) -> float:
    return nees(PoseGaussian(solution.trajectory[frame], solution.covariances[frame]), truth[frame])


@pytest.mark.parametrize("count", [5, 14, pytest.param(24, marks=pytest.mark.slow)])
def test_poses_of_a_loop_are_calibrated_before_and_after_it_closes(count: int) -> None:
    before, after, every = np.zeros(SEEDS), np.zeros(SEEDS), np.zeros(SEEDS)
    spread_before, spread_after = np.zeros(SEEDS), np.zeros(SEEDS)
    truth = turntable(count)
    for seed in range(SEEDS):
        rng = np.random.default_rng([count, seed])
        odometry = [edge(k - 1, k, measured(truth, k - 1, k, rng)) for k in range(1, count)]
        growing = Smoother(graph=PoseGraph(first=0)).plus(odometry)
        last = count - 1
        before[seed] = _nees(growing.solution, truth, last)
        spread_before[seed] = np.linalg.slogdet(growing.solution.covariances[last])[1]
        growing = growing.plus([edge(0, last, measured(truth, 0, last, rng), "closure")])
        after[seed] = _nees(growing.solution, truth, last)
        every[seed] = _nees(growing.solution, truth, 1 + seed % last)
        spread_after[seed] = np.linalg.slogdet(growing.solution.covariances[last])[1]
    for values in (before, after, every):
        _assert_chi2(values)
    assert np.all(spread_after < spread_before)


def _two_turns(seed: int, spoil: Callable[[Edge, np.random.Generator], Edge]) -> tuple[PoseGraph, list[Edge], dict]:
    """Two turns of 18 stops, each stop of the second closed on the first, a fifth of the closures spoilt."""
    rng = np.random.default_rng(seed)
    truth = turntable(36, 18)
    edges = [edge(k - 1, k, measured(truth, k - 1, k, rng)) for k in range(1, 36)]
    pairs = [(k - 18, k) for k in range(18, 36)] + [(k - 17, k) for k in range(18, 36)]
    closures = [edge(t, s, measured(truth, t, s, rng), "closure") for t, s in pairs]
    chosen = rng.choice(len(closures), size=len(closures) // 5, replace=False)
    false = [spoil(closures[number], rng) for number in chosen]
    kept = [closure for number, closure in enumerate(closures) if number not in chosen]
    return PoseGraph((*edges, *kept)), false, truth


def _anywhere(of: Edge, rng: np.random.Generator) -> Edge:
    axis = rng.normal(size=3)
    return spun(of, rng.uniform(0.5, np.pi) * axis / np.linalg.norm(axis))


def _all_alike(of: Edge, rng: np.random.Generator) -> Edge:
    """Wrong by the same quarter turn every time, as a square box is: the lies agree with each other."""
    return spun(of, [0.0, 0.5 * np.pi, 0.0])


@pytest.mark.parametrize("spoil", [_anywhere, _all_alike])
def test_a_fifth_of_the_closures_may_lie(spoil: Callable[[Edge, np.random.Generator], Edge]) -> None:
    for seed in range(4):
        graph, false, truth = _two_turns(seed, spoil)
        without = rotation_error(solve(graph, {}).trajectory, truth)
        spoilt = solve(graph.plus(false), {})
        assert rotation_error(spoilt.trajectory, truth) <= 1.2 * without
        assert set(false) <= set(spoilt.outliers)
        assert len(spoilt.outliers) <= len(false) + 1


def test_lies_among_closures_are_found_out_as_they_come() -> None:
    graph, false, truth = _two_turns(11, _anywhere)
    edges = sorted([*graph.edges, *false], key=lambda e: e.source)
    growing, error = Smoother(graph=PoseGraph(first=0)), {}
    for source in range(1, 36):
        growing = growing.plus([e for e in edges if e.source == source])
        so_far = {k: truth[k] for k in range(source + 1)}
        error[source] = rotation_error(growing.solution.trajectory, so_far)
    assert set(false) <= set(growing.solution.outliers)
    assert max(error.values()) < 0.1
    assert error[35] <= 1.2 * rotation_error(solve(graph, {}).trajectory, truth)
