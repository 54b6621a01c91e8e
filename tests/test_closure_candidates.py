"""Which edges to earlier views are tried: those that are expected to add information, by the shortest paths."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from closure_runs import CENTROID_M, Run, posterior_of, turned
from ring_graphs import edge

from modeler import se3
from modeler.closure import Closer, ConsistencyModel, MapView
from modeler.closure.information_gain import Candidate, InformationGain
from modeler.closure.map_view import PathNetwork, ShortestPaths, composed
from modeler.graph import solve
from modeler.types import Edge, PoseGaussian, Solution

SYSTEMATIC = ConsistencyModel().systematic(1, CENTROID_M)


def chain(angles_deg: Sequence[float]) -> tuple[MapView, Run]:
    """Return what is known after frames at angles, each registered against the one before alone."""
    run = Run(list(angles_deg)).run(Closer(max_closures=0))
    return run.map_view, run


FRAMES = [0, 1, 2, 3, 4]


def gains(map_view: MapView, angle_deg: npt.ArrayLike, max_angle_deg: float = 90.0, **how: Any) -> dict[int, Candidate]:
    """Return what an edge from frame 6 to earlier ones should add, by frame, if it turned by these angles."""
    given = {"systematic": 1e-9 * SYSTEMATIC, "has_own_edge": False} | how
    information_gain = InformationGain(
        map_view, 6, map_view.solution.trajectory[6], max_angle_deg=max_angle_deg, **given
    )
    found = information_gain.candidates(FRAMES, np.broadcast_to(np.asarray(angle_deg, dtype=np.float64), 5), 0.0)
    assert [candidate.gain_nats for candidate in found] == sorted((c.gain_nats for c in found), reverse=True)
    assert {candidate.frame for candidate in found} == set(FRAMES)
    return {candidate.frame: candidate for candidate in found}


def test_the_expected_gain_is_what_the_pose_graph_gains_by_such_an_edge() -> None:
    """Half of what the log-determinant of the motion's covariance falls by, where the edge is sure to be found."""
    map_view, run = chain([8.0 * k for k in range(7)])
    mean_covariance = np.mean([edge.posterior.pose.covariance for edge in map_view.edges], axis=0)
    for frame, candidate in gains(map_view, 0.0).items():
        pose = PoseGaussian(map_view.solution.relative(frame, 6), mean_covariance / candidate.overlap)
        closed = solve(run.graph.plus([edge(frame, 6, pose, "closure")]), {})
        before, after = (
            np.linalg.slogdet(solution.relative_covariance(frame, 6))[1] for solution in (map_view.solution, closed)
        )
        assert candidate.gain_nats == pytest.approx(0.5 * (before - after), rel=1e-3)


def test_the_expected_gain_falls_with_rotation_and_with_the_doubt_that_the_edge_is_found() -> None:
    map_view, _ = chain([8.0 * k for k in range(7)])
    by_angle = [gains(map_view, angle_deg) for angle_deg in (10.0, 20.0, 40.0)]
    within, on_the_limit = by_angle[2], gains(map_view, 40.0, max_angle_deg=40.0)
    steeper, given = gains(map_view, 40.0, power=6.0), gains(map_view, 40.0, has_own_edge=True)
    drifting = gains(map_view, 40.0, systematic=30.0 * SYSTEMATIC)
    for frame in FRAMES:
        assert by_angle[0][frame].gain_nats > by_angle[1][frame].gain_nats > within[frame].gain_nats
        assert on_the_limit[frame].gain_nats == pytest.approx(0.5 * within[frame].gain_nats, rel=1e-3)
        assert steeper[frame].gain_nats < within[frame].gain_nats < given[frame].gain_nats
        # Drift as long as the path, and in the new edge, is like noise of edges: more of both changes nothing.
        assert drifting[frame].gain_nats == pytest.approx(within[frame].gain_nats, rel=1e-5)


def test_systematic_error_grows_with_the_length_of_the_path() -> None:
    map_view, run = chain([20.0 * k for k in range(6)])
    model, base = ConsistencyModel(drift_deg=2.0), posterior_of(6, 5, run.truth_between(4, 5))
    posterior = posterior_of(6, 2, se3.inverse(turned(40.0)) @ turned(121.0))
    predicted = composed(base.pose, map_view.solution.relative_gaussian(2, 5))
    found = model.consistency_through(base, posterior, map_view, map_view.shortest_paths(5))
    centroid_m = se3.transform(se3.inverse(base.pose.mean), CENTROID_M[None])[0]
    over_four = model.consistency(posterior, [(1.0, predicted)], length=4, centroid_m=centroid_m)  # 6, 5, 4, 3, 2
    assert found.distance == pytest.approx(over_four.distance)
    assert found.angle_deg == pytest.approx(1.0, abs=0.8)


def test_coming_back_depends_on_the_path_not_on_frame_numbers() -> None:
    """A frame that was lost hangs on a view far round; its number lies beside that of the first."""
    run = Run([0.0, 0.0, *(40.0 * np.arange(1, 5))], [0, 1, 2, 3, 4, 5]).run(
        Closer(max_closures=0), lambda posterior: posterior
    )
    map_view = run.map_view
    assert map_view.came_back(0, 1, map_view.shortest_paths(5), away_deg=90.0)
    assert not map_view.came_back(0, 1, map_view.shortest_paths(1), away_deg=90.0)


def test_closure_on_the_first_view_is_preferred() -> None:
    run = Run(list(16.0 * np.arange(26))).run(Closer(max_closures=1))
    assert [run.tried[frame][1:] for frame in range(20, 24) if len(run.tried[frame]) > 1] == [(0,), (0,)]


def test_a_frame_has_one_span_at_most() -> None:
    run = Run(list(2.0 * np.arange(45))).run(Closer(max_closures=3, min_gain_nats=3.0))
    spans = [sum(edge.kind == "span" for edge in edges) for edges in run.judged.values()]
    assert max(spans) == 1


# Shortest paths through the graph: as sure as the surest, however many edges lie between two frames.


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


def test_the_least_variance_of_a_frame_is_that_of_its_best_edge() -> None:
    variances = {(0, 1): 4.0, (1, 2): 1.0, (2, 3): 9.0}
    edges = [edge(*ends, PoseGaussian(np.eye(4), scale * np.eye(6))) for ends, scale in variances.items()]
    found = PathNetwork.of(edges, Solution()).least_variances_rad2([0, 1, 2, 3, 7])
    np.testing.assert_allclose(found, [12.0, 3.0, 3.0, 27.0, np.inf])


def test_a_network_that_grew_is_that_of_all_edges() -> None:
    """Also where an edge no longer takes part, or enters with another pose."""
    run = Run(list(20.0 * np.arange(24))).run(Closer())
    edges, solution = run.graph.edges, run.solution
    closure = run.closures()[0]
    pose = PoseGaussian(closure.posterior.pose.mean, 0.5 * closure.posterior.pose.covariance)
    posed = replace(solution, edge_poses={(closure.source, closure.target): pose})
    network = PathNetwork()
    for count, newer in [
        *((count, solution) for count in range(0, len(edges) + 1, 5)),
        (len(edges), replace(solution, outliers=(closure,))),
        (len(edges), posed),
        (len(edges), replace(posed, edge_poses={**posed.edge_poses, (-1, -2): pose})),
        (8, solution),
    ]:
        network, wholly = network.plus(edges[:count], newer), PathNetwork.of(edges[:count], newer)
        assert network.index == wholly.index
        np.testing.assert_array_equal(
            np.stack(network.shortest_paths(3).to(run.numbers)), np.stack(wholly.shortest_paths(3).to(run.numbers))
        )
