"""Shortest paths through the graph: as sure as the surest, however many edges lie between two frames."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from rings import edge

from modeler.closure.map_view import PathNetwork, ShortestPaths
from modeler.types import Edge, PoseGaussian, Solution

COUNT = 12


def _edges(rng: np.random.Generator) -> list[Edge]:
    """Random edges between the even frames and between the odd ones, some of them twice and some refused."""
    edges = []
    for _ in range(4 * COUNT):
        one, apart = int(rng.integers(COUNT)), 2 * int(rng.integers(1, COUNT // 2))
        other = (one + apart) % COUNT
        pose = PoseGaussian(np.eye(4), rng.uniform(0.1, 3.0) * np.eye(6))
        edges.append(edge(one, other, pose, accepted=bool(rng.random() < 0.8)))
    return edges


def _naive(edges: list[Edge]) -> np.ndarray:
    """Floyd and Warshall's distances between all frames."""
    distances = np.where(np.eye(COUNT, dtype=bool), 0.0, np.inf)
    for one in edges:
        if one.accepted:
            ends = [[one.source, one.target], [one.target, one.source]]
            distances[tuple(ends)] = np.minimum(distances[tuple(ends)], np.trace(one.posterior.pose.covariance[:3, :3]))
    for k in range(COUNT):
        distances = np.minimum(distances, distances[:, k, None] + distances[k])
    return distances


@pytest.mark.parametrize("seed", range(5))
def test_paths_are_shortest_and_lead_where_they_say(seed: int) -> None:
    edges = _edges(np.random.default_rng(seed))
    network, wanted = PathNetwork.of(edges, Solution()), _naive(edges)
    for start in range(COUNT):
        found = network.shortest_paths(start)
        assert set(found) == set(np.flatnonzero(np.isfinite(wanted[start])))
        assert len(found) == len(list(found))
        variances, lengths = found.to(range(COUNT))
        np.testing.assert_allclose(variances, wanted[start])
        for frame, way in found.items():
            along = found.along(frame)
            assert (along[0], along[-1], len(along)) == (start, frame, way.edges + 1)
            assert way.before == (along[-2] if way.edges else start)
            assert way.edges == lengths[frame]
            steps = [wanted[one, other] for one, other in itertools.pairwise(along)]
            assert way.variance_rad2 == pytest.approx(sum(steps))


def test_there_is_no_path_between_frames_that_no_edges_connect() -> None:
    found = PathNetwork.of([edge(0, 2, PoseGaussian(np.eye(4), np.eye(6)))], Solution()).shortest_paths(0)
    assert 1 not in found
    assert found.along(1) == ShortestPaths().along(1) == []
    assert PathNetwork.of([], Solution()).shortest_paths(7)[7].edges == 0
    np.testing.assert_array_equal(found.to([1, 0])[0], [np.inf, 0.0])
