"""Which edges count wherever edges are asked, the chain of odometry, and when a loop is closed."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from prior_cases import edges, solution
from ring_graphs import OBJECT_M, covariance, edge, measured, ring, spin, spun, turntable
from scipy.spatial.transform import Rotation
from turning_box import steps

from modeler import se3
from modeler.closure import Thresholds
from modeler.closure.map_view import PathNetwork
from modeler.export import RunFolder, RunMeta, edge_record, edges_of
from modeler.graph import PoseGraph, Smoother, dead_reckoning, solve
from modeler.priors import TurntablePrior
from modeler.types import Array, Edge, EdgeKind, Mode, PoseGaussian, Solution, loop_closure_error, loops_closed
from modeler.types.solution import Chains
from modeler.viz.report.run_data import Result

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
    chain, opened = dead_reckoning(graph), dead_reckoning(PoseGraph(graph.edges[: COUNT - 1]))
    for frame, pose in opened.items():
        np.testing.assert_array_equal(chain[frame].mean, pose.mean)
        np.testing.assert_array_equal(chain[frame].covariance, pose.covariance)
    solution = solve(PoseGraph(graph.edges[: COUNT - 1]), {})
    for frame in range(1, COUNT):
        np.testing.assert_allclose(
            chain[frame].covariance, solution.covariances[frame], atol=1e-6 * np.abs(chain[frame].covariance).max()
        )


def test_the_report_shows_the_chain_of_odometry_txt(tmp_path: Path) -> None:
    graph = _graph(np.random.default_rng(2))
    step = replace(list(steps(COUNT))[-1], edges_so_far=graph.edges, solution=solve(graph, {}))
    RunFolder.open(tmp_path / "run").write(step, RunMeta(sequence="made up", seed=0, prior="general"))
    chain, written = Result.read(tmp_path / "run").chain, np.loadtxt(tmp_path / "run" / "odometry.txt")
    assert len(chain) == len(written) == COUNT
    for pose, line in zip(chain.values(), written, strict=True):
        np.testing.assert_allclose(pose.mean[:3, 3], line[1:4], atol=1e-8)
        assert se3.rotation_angle(pose.mean @ se3.inverse(_pose(line))) < 1e-7


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
        error = loop_closure_error(graph.edges, Solution(), {})
        assert (error.source, error.target, error.edges) == (COUNT - 1, 0, COUNT - 1)
        squares.append(error.sigmas**2)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.15)  # sd of the mean 0.033, and first order


def test_the_opening_of_a_loop_is_what_a_closure_was_turned_by() -> None:
    rng = np.random.default_rng(6)
    truth = turntable(COUNT)
    exact = [edge(k, k + 1, PoseGaussian(_true(truth, k, k + 1), covariance(rng))) for k in range(COUNT - 1)]
    closure = edge(0, 7, PoseGaussian(_true(truth, 0, 7) @ spin([0.0, 0.1, 0.0]), covariance(rng)), "closure")
    centroid_m = {7: OBJECT_M}
    error = loop_closure_error([*exact, closure], Solution(), centroid_m)
    assert error.rotation_rad == pytest.approx(0.1)
    assert error.translation_m == pytest.approx(0.0, abs=1e-9)
    refused = edge(0, 7, closure.posterior.pose, "closure", accepted=False)
    assert loop_closure_error([*exact, refused], Solution(), centroid_m) is None
    assert loop_closure_error([*exact[1:], closure], Solution(), centroid_m) is None, "no chain joins its ends"


def test_motions_along_chains_are_those_composed_edge_by_edge() -> None:
    """In two trees of many branches, with edges taken along and against their direction."""
    rng = np.random.default_rng(7)
    parents = {frame: int(rng.integers(max(frame - 4, 0), frame)) for frame in range(1, 40) if frame != 20}
    motions = {frame: PoseGaussian(spin(rng.normal(size=3)), covariance(rng)) for frame in parents}
    given = [(parents[k], k, pose) if k % 3 else (k, parents[k], pose.inverse()) for k, pose in motions.items()]
    chains = Chains.of([given[k] for k in rng.permutation(len(given))])

    def to_root(frame: int) -> list[int]:
        return [frame, *(to_root(parents[frame]) if frame in parents else ())]

    pairs = [(target, source) for target in range(40) for source in range(40) if target != source]
    joined = [(target, source) for target, source in pairs if to_root(target)[-1] == to_root(source)[-1]]
    assert [pair for pair in pairs if chains.joined(*pair)] == joined
    assert not chains.joined(0, 40)
    assert 40 < len(joined) < len(pairs)
    for (target, source), found, length in zip(joined, *chains.motions(joined), strict=True):
        up, down = (
            [k for k in to_root(one) if k not in to_root(other)] for one, other in ((target, source), (source, target))
        )
        steps = [motions[k].inverse() for k in up] + [motions[k] for k in reversed(down)]
        mean, spread = np.eye(4), np.zeros((6, 6))
        for step in steps:
            mean, spread = mean @ step.mean, se3.composed_covariance(spread, step.mean, step.covariance)
        assert length == len(steps)
        np.testing.assert_allclose(found.mean, mean, atol=1e-12)
        np.testing.assert_allclose(found.covariance, spread, rtol=1e-9, atol=1e-12 * np.abs(spread).max())


def _true(truth: Mapping[int, Array], target: int, source: int) -> Array:
    return se3.inverse(truth[target]) @ truth[source]


# Which edges count wherever edges are asked: those accepted that the optimisation did not leave out since.

HERE = np.eye(4)
SURE = PoseGaussian(HERE, 1e-6 * np.eye(6))


def of_evidence(of: Edge, log_marginal_likelihood: float) -> Edge:
    return replace(of, posterior=replace(of.posterior, log_marginal_likelihood=log_marginal_likelihood))


def test_an_edge_takes_part_unless_it_was_refused_or_left_out() -> None:
    good, refused, lying = edge(0, 1, SURE), edge(0, 2, SURE, accepted=False), edge(0, 3, SURE, "closure")
    poses = Solution(outliers=(lying,))
    assert [poses.takes_part(of) for of in (good, refused, lying)] == [True, False, False]
    assert poses.takes_part(edge(0, 3, SURE, "closure"))  # its like, but another


def test_an_edge_took_part_by_the_pose_that_the_solution_names() -> None:
    chosen = PoseGaussian(se3.exp(np.full(6, 0.1)), SURE.covariance)
    first, second = edge(0, 1, SURE), edge(1, 2, SURE)
    poses = Solution(edge_poses={(2, 1): chosen})
    assert poses.pose_of(first) is first.posterior.pose
    assert poses.pose_of(second) is chosen


def test_no_path_leads_over_an_edge_that_was_left_out() -> None:
    chain = [edge(k, k + 1, SURE) for k in range(5)]
    loop = edge(0, 5, SURE, "closure")
    assert PathNetwork.of([*chain, loop], Solution()).shortest_paths(5)[0].edges == 1
    assert PathNetwork.of([*chain, loop], Solution(outliers=(loop,))).shortest_paths(5)[0].edges == 5


def test_a_path_has_the_variance_of_its_edges_as_they_took_part() -> None:
    vague = PoseGaussian(HERE, np.eye(6))
    found = PathNetwork.of([edge(0, 1, vague)], Solution(edge_poses={(1, 0): SURE})).shortest_paths(0)
    assert found[1].variance_rad2 == pytest.approx(3e-6)


def test_median_evidence_is_that_of_edges_between_neighbours_that_take_part() -> None:
    good = [of_evidence(edge(k, k + 1, SURE), 100.0) for k in range(5)]
    lying = [of_evidence(edge(k, k + 1, SURE), -1000.0) for k in range(7)]
    spans = [of_evidence(edge(k, k + 2, SURE, "span"), 50.0) for k in range(9)]
    left_out = Solution(outliers=tuple(lying))
    assert Thresholds().usual([*good, *lying, *spans], left_out).median_nats == 100.0
    assert not np.isfinite(Thresholds().usual(lying, left_out).median_nats)


def test_a_turntable_learns_nothing_from_edges_that_were_left_out() -> None:
    taught, poses = edges(HERE), solution(HERE)
    prior = TurntablePrior(24.0, 2.0)
    assert prior.learned(poses, taught).learned_axis is not None
    assert prior.learned(replace(poses, outliers=taught), taught).learned_axis is None


@pytest.mark.parametrize("kind", get_args(EdgeKind))
def test_reports_name_the_kind_of_an_edge(kind: EdgeKind) -> None:
    record = edge_record(edge(0, 2, SURE, kind), Solution())
    assert record["kind"] == kind
    assert edges_of({"edges": [record]})[0].kind == kind


@pytest.mark.parametrize(
    ("kind", "flags", "meant"),
    [
        ("odometry", {}, "odometry"),
        ("odometry", {"span": True}, "span"),
        ("closure", {"span": False, "join": False}, "closure"),
        ("closure", {"join": True}, "join"),
    ],
)
def test_reports_of_schema_1_have_two_kinds_and_flags(kind: str, flags: dict[str, bool], meant: EdgeKind) -> None:
    record = edge_record(edge(0, 2, SURE), Solution()) | {"kind": kind} | flags
    del record["covariance_given_camera"]
    assert edges_of({"edges": [record]})[0].kind == meant


# A loop is closed where a closure is more than what holds the graph together.


def joining(source: int, target: int, kind: EdgeKind = "odometry") -> Edge:
    return edge(target, source, SURE, kind)


CHAIN = [joining(1, 0), joining(2, 1), joining(3, 2)]


@pytest.mark.parametrize(
    ("edges", "loops"),
    [
        ([], 0),
        (CHAIN, 0),
        ([*CHAIN, joining(3, 1, "span")], 0),
        ([*CHAIN, joining(3, 0, "closure")], 1),
        ([*CHAIN, joining(3, 0, "closure"), joining(2, 0, "closure")], 2),
        ([joining(1, 0), joining(3, 0, "closure"), joining(2, 3)], 0),  # nothing leads from 1 to 2
        ([joining(1, 0), joining(3, 0, "closure"), joining(2, 3), joining(2, 1, "closure")], 1),
        ([joining(1, 0), joining(3, 0, "closure"), joining(2, 3), joining(2, 1, "span")], 1),
    ],
)
def test_closures_that_hold_the_graph_together_close_no_loop(edges: list[Edge], loops: int) -> None:
    assert loops_closed(edges) == loops
    assert loops_closed(edges[::-1]) == loops
