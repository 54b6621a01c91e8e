"""The chain before loop closure: one and the same in solutions, in `odometry.txt` and in the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rings import OBJECT_M, covariance, edge, measured, nees, ring, spin, spun, turntable
from scipy.spatial.transform import Rotation
from turning_box import steps

from modeler import se3
from modeler.export import RunFolder, RunMeta
from modeler.graph import PoseGraph, Smoother, dead_reckoning, solve
from modeler.types import Array, Edge, Mode, PoseGaussian, Solution, loop_opening
from viz.report.run_data import Result

COUNT = 8


def _graph(rng: np.random.Generator) -> PoseGraph:
    """A turn with everything beside its chain: spans, a closure, a lie, a refused edge, and an edge with two modes."""
    graph, truth = ring(COUNT, rng, [])
    edges = list(graph.edges)
    true = measured(truth, 3, 4, rng)
    modes = Mode(0.6, PoseGaussian(true.mean @ spin([0.0, 1.5, 0.0]), true.covariance)), Mode(0.4, true)
    edges[3] = edge(3, 4, PoseGaussian(true.mean @ spin([0.0, 0.9, 0.0]), covariance(rng, 0.7)), modes=modes)
    spans = [edge(k, k + 2, measured(truth, k, k + 2, rng), "span") for k in range(COUNT - 2)]
    closures = [edge(0, 7, measured(truth, 0, 7, rng), "closure"), edge(1, 6, measured(truth, 1, 6, rng), "closure")]
    lie = spun(edge(2, 7, measured(truth, 2, 7, rng), "closure"), [0.0, 1.0, 0.0])
    refused = edge(0, 5, measured(truth, 0, 5, rng), accepted=False)
    return PoseGraph((*edges, refused, *spans, *closures, lie))


def test_the_chain_has_the_poses_of_the_solutions_odometry() -> None:
    graph = _graph(np.random.default_rng(0))
    smoother = Smoother()
    for count in range(1, len(graph.edges) + 1):
        smoother = smoother.to(PoseGraph(graph.edges[:count]))
        chain = dead_reckoning(smoother.graph)
        assert set(chain) == set(smoother.solution.odometry)
        for frame, pose in chain.items():
            np.testing.assert_array_equal(pose.mean, smoother.solution.odometry[frame])
    assert len(smoother.solution.outliers) == 1
    assert dead_reckoning(PoseGraph()) == {}
    assert set(dead_reckoning(PoseGraph(first=4))) == {4}


def test_further_edges_leave_the_chain_as_it_is() -> None:
    graph = _graph(np.random.default_rng(1))
    chain, alone = dead_reckoning(graph), dead_reckoning(PoseGraph(graph.edges[: COUNT - 1]))
    for frame, pose in alone.items():
        np.testing.assert_array_equal(chain[frame].mean, pose.mean)
        np.testing.assert_array_equal(chain[frame].covariance, pose.covariance)
    solution = solve(PoseGraph(graph.edges[: COUNT - 1]), {})
    for frame in range(1, COUNT):
        np.testing.assert_allclose(
            chain[frame].covariance, solution.covariances[frame], atol=1e-6 * np.abs(chain[frame].covariance).max()
        )


def test_errors_of_the_chain_are_what_its_covariances_say() -> None:
    """NEES of its end is chi² with 6 degrees of freedom, with edges taken along and against their direction."""
    trials = 300
    values = np.zeros(trials)
    for trial in range(trials):
        graph, truth = ring(6, np.random.default_rng(trial), [])
        turned = [_turned(one) if k % 2 else one for k, one in enumerate(graph.edges)]
        values[trial] = nees(dead_reckoning(PoseGraph(tuple(turned), first=0))[5], truth[5])
    assert values.mean() == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / trials))


def test_the_report_shows_the_chain_of_odometry_txt(tmp_path: Path) -> None:
    graph = _graph(np.random.default_rng(2))
    step = replace(list(steps(COUNT))[-1], edges_so_far=graph.edges, solution=solve(graph, {}))
    RunFolder.open(tmp_path / "run").write(step, RunMeta(sequence="made up", seed=0, prior="general"))
    chain, written = Result.read(tmp_path / "run").chain, np.loadtxt(tmp_path / "run" / "odometry.txt")
    assert len(chain) == len(written) == COUNT
    for pose, line in zip(chain.values(), written, strict=True):
        np.testing.assert_allclose(pose.mean[:3, 3], line[1:4], atol=1e-8)
        assert se3.rotation_angle(pose.mean @ se3.inverse(_pose(line))) < 1e-7


def _turned(of: Edge) -> Edge:
    """The same knowledge, told as the motion from target to source."""
    return edge(of.source, of.target, of.posterior.pose.inverse(), of.kind)


def _pose(line: Array) -> Array:
    pose = se3.translation(line[1:4])
    pose[:3, :3] = Rotation.from_quat(line[4:8]).as_matrix()
    return pose


def test_the_opening_of_a_loop_is_in_units_of_what_its_edges_state() -> None:
    """Over many rings whose edges err as they state, the mean square of `sigmas` is 1."""
    rng = np.random.default_rng(5)
    squares = []
    for _ in range(300):
        graph, _ = ring(COUNT, rng, [(0, COUNT - 1)])
        opening = loop_opening(graph.edges, Solution(), {})
        assert opening is not None
        assert (opening.source, opening.target, opening.edges) == (COUNT - 1, 0, COUNT - 1)
        squares.append(opening.sigmas**2)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.15)  # sd of the mean 0.033, and first order


def test_the_opening_of_a_loop_is_what_a_closure_was_turned_by() -> None:
    rng = np.random.default_rng(6)
    truth = turntable(COUNT)
    exact = [edge(k, k + 1, PoseGaussian(_true(truth, k, k + 1), covariance(rng))) for k in range(COUNT - 1)]
    closure = edge(0, 7, PoseGaussian(_true(truth, 0, 7) @ spin([0.0, 0.1, 0.0]), covariance(rng)), "closure")
    centroid_m = {7: OBJECT_M}
    opening = loop_opening([*exact, closure], Solution(), centroid_m)
    assert opening is not None
    assert opening.rotation_rad == pytest.approx(0.1)
    assert opening.translation_m == pytest.approx(0.0, abs=1e-9)
    refused = edge(0, 7, closure.posterior.pose, "closure", accepted=False)
    assert loop_opening([*exact, refused], Solution(), centroid_m) is None
    assert loop_opening([*exact[1:], closure], Solution(), centroid_m) is None, "no chain joins its ends"


def _true(truth: Mapping[int, Array], target: int, source: int) -> Array:
    return se3.inverse(truth[target]) @ truth[source]
