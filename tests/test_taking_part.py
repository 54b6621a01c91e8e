"""Which edges count wherever edges are asked: those accepted that the optimisation did not leave out since."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from prior_cases import edges, solution
from rings import edge

from modeler import se3
from modeler.closure import Thresholds
from modeler.closure.map_view import PathNetwork
from modeler.export import edge_record, edges_of
from modeler.priors import TurntablePrior
from modeler.types import Edge, EdgeKind, PoseGaussian, Solution

HERE = np.eye(4)
SURE = PoseGaussian(HERE, 1e-6 * np.eye(6))


def of_evidence(of: Edge, log_evidence: float) -> Edge:
    return replace(of, posterior=replace(of.posterior, log_evidence=log_evidence))


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


def test_median_evidence_is_that_of_edges_that_take_part() -> None:
    good = [of_evidence(edge(k, k + 1, SURE), 100.0) for k in range(5)]
    lying = [of_evidence(edge(k, k + 1, SURE), -1000.0) for k in range(7)]
    left_out = Solution(outliers=tuple(lying))
    assert Thresholds().evidence_bound([*good, *lying], left_out).median_nats == 100.0
    assert not np.isfinite(Thresholds().evidence_bound(lying, left_out).median_nats)


def test_spans_do_not_count_for_the_median_evidence_between_neighbours() -> None:
    good = [of_evidence(edge(k, k + 1, SURE), 100.0) for k in range(5)]
    wide = [of_evidence(edge(k, k + 2, SURE, "span"), 50.0) for k in range(9)]
    assert Thresholds().evidence_bound([*good, *wide], Solution()).median_nats == 100.0


def test_a_turntable_learns_nothing_from_edges_that_were_left_out() -> None:
    taught, poses = edges(HERE), solution(HERE)
    prior = TurntablePrior(24.0, 2.0)
    assert prior.learned(poses, taught).learned_axis is not None
    assert prior.learned(replace(poses, outliers=taught), taught).learned_axis is None


@pytest.mark.parametrize(("kind", "told"), [("odometry", "odometry"), ("span", "odometry"), ("closure", "closure")])
def test_reports_tell_two_kinds_and_which_edges_are_spans(kind: EdgeKind, told: str) -> None:
    record = edge_record(edge(0, 2, SURE, kind), Solution())
    assert (record["kind"], record["span"]) == (told, kind == "span")
    assert edges_of({"edges": [record]})[0].kind == kind
    del record["span"]  # as reports were
    assert edges_of({"edges": [record]})[0].kind == told
