"""Closures lead to keyframes alone, so that each further turn costs what the one before did."""

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest
from closure_runs import Run

from modeler import se3
from modeler.closure import Closer
from modeler.types import Edge

KEYFRAME_DEG = 25.0
A_TURN = 24  # frames
TURNS = 8


@pytest.fixture(scope="module")
def turns() -> Run:
    """Return what eight turns at 15° a frame left, registered by the truth."""
    run = Run(list(15.0 * np.arange(TURNS * A_TURN))).run(Closer(keyframe_deg=KEYFRAME_DEG))
    return run


def _size(edges: Sequence[Edge]) -> int:
    """Return how many numbers the square root of the information of edges holds."""
    unit = gtsam.noiseModel.Unit.Create(6)
    linear = gtsam.GaussianFactorGraph()
    linear.add(gtsam.JacobianFactor(0, np.eye(6), np.zeros(6), unit))
    for edge in edges:
        linear.add(gtsam.JacobianFactor(edge.target, -np.eye(6), edge.source, np.eye(6), np.zeros(6), unit))
    net = linear.eliminateSequential(gtsam.Ordering.OrderingType.METIS)
    return sum(net.at(k).R().size + net.at(k).S().size for k in range(net.size()))


def test_keyframes_are_apart_and_one_is_near_every_view(turns: Run) -> None:
    poses = turns.map_view.poses(turns.keyframes)
    all_poses = turns.solution.trajectory.values()
    apart_deg = [np.degrees(se3.rotation_angle(se3.inverse(poses) @ pose)) for pose in all_poses]
    tolerance_deg = 1.0  # poses have moved since
    assert max(angles.min() for angles in apart_deg) < KEYFRAME_DEG + tolerance_deg
    among = np.degrees(se3.rotation_angle(se3.inverse(poses[:, None]) @ poses))
    assert among[~np.eye(len(poses), dtype=bool)].min() > KEYFRAME_DEG - tolerance_deg
    assert turns.keyframes[0] == 0
    assert max(turns.keyframes) < A_TURN


def test_closures_and_spans_lead_to_keyframes(turns: Run) -> None:
    assert {edge.target for edge in turns.graph.edges if edge.kind != "odometry"} <= set(turns.keyframes)
    pairs = Closer().span_pairs(turns.map_view)
    assert len(pairs) > A_TURN
    assert {target for _, target in pairs} <= set(turns.keyframes)
    tried = {(edge.source, edge.target) for edge in turns.graph.edges}
    assert tried.isdisjoint(pairs)
    assert all(source > target for source, target in pairs)


def test_further_turns_cost_as_much_as_earlier_ones(turns: Run) -> None:
    """Both in edges and in what their solution holds. Closures on views of every turn would add more with each."""
    by_turn = [[edge for edge in turns.graph.edges if edge.source <= turn * A_TURN] for turn in range(1, TURNS + 1)]
    new_edges = np.diff([len(edges) for edges in by_turn])
    sizes = np.diff([_size(edges) for edges in by_turn])
    for costs in (new_edges, sizes):
        assert np.mean(costs[-3:]) < 1.2 * np.mean(costs[1:4])
