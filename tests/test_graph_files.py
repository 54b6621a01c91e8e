"""What a solved graph writes is read by others as it was meant: GTSAM takes graph.g2o, evo takes trajectory.txt."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
from rings import edge, ring, spin

from modeler import se3
from modeler.export import g2o_text, tum_text
from modeler.graph import PoseGraph, solve
from modeler.types import Mode, PoseGaussian


def _graph() -> PoseGraph:
    """A loop with an edge of two modes, whose wrong one is the heavier, and a closure that lies."""
    graph, truth = ring(12, np.random.default_rng(1), [(0, 11), (0, 6), (3, 9)])
    quarter = spin([0.0, np.pi / 2, 0.0])
    several, right = graph.edges[4], graph.edges[4].posterior.pose
    wrong = PoseGaussian(right.mean @ quarter, right.covariance)
    modes = [Mode(0.6, wrong), Mode(0.4, right)]
    lie = PoseGaussian(se3.inverse(truth[1]) @ truth[8] @ quarter, right.covariance)
    edges = [*graph.edges, edge(1, 8, lie, "closure")]
    edges[4] = edge(several.target, several.source, wrong, modes=modes)
    return PoseGraph(tuple(edges))


def test_solved_graph_is_the_optimum_of_its_own_file(tmp_path: Path) -> None:
    """GTSAM, given the file alone, finds the error that the solution has, and nothing to improve."""
    graph = _graph()
    solution = solve(graph, {})
    (tmp_path / "graph.g2o").write_text(g2o_text(graph.edges, solution))
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    assert factors.size() == len(graph.edges) - len(solution.outliers) == 14
    error = 0.0
    for taken in graph.edges:
        if taken in solution.outliers:
            continue
        pose = solution.edge_poses.get((taken.source, taken.target), taken.posterior.pose)
        xi = se3.log(se3.inverse(pose.mean) @ solution.relative(taken.target, taken.source))
        error += 0.5 * float(xi @ np.linalg.solve(pose.covariance, xi))
    assert factors.error(values) == pytest.approx(error, rel=1e-6)
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    best = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    assert factors.error(best) == pytest.approx(error, rel=1e-4)
    for frame, pose in solution.trajectory.items():
        np.testing.assert_allclose(best.atPose3(frame).matrix(), pose, atol=1e-4)


def test_trajectory_passes_the_checks_of_evo() -> None:
    """`evo_traj tum FILE --full_check` (1.38): eight columns, rising times, unit quaternions, rigid matrices."""
    solution = solve(_graph(), {})
    times_s = {frame: 1305031102.0 + frame / 30.0 for frame in solution.trajectory}
    columns = np.array([line.split(" ") for line in tum_text(solution.trajectory, times_s).splitlines()], dtype=float)
    assert columns.shape == (12, 8)
    assert np.all(np.diff(columns[:, 0]) > 0.0)
    np.testing.assert_allclose(np.linalg.norm(columns[:, 4:], axis=1), 1.0, atol=1e-12)
    for pose in solution.trajectory.values():
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
