"""Cycles: their residuals depend neither on the root of the tree nor on the direction of edges."""

from dataclasses import replace

import numpy as np
import pytest
from ring_graphs import covariance, edge, ring, spin

from modeler import se3
from modeler.graph.modes import cycles
from modeler.graph.pose_graph import Factor, SpanningTree, collapse_modes
from modeler.types import Array, Edge, Mode, PoseGaussian

COUNT = 8
OPEN = (2, 5, 6)  # sources of the edges with two modes


def _two_modes(one: Edge) -> Edge:
    pose = one.posterior.pose
    modes = (Mode(0.6, pose), Mode(0.4, PoseGaussian(pose.mean @ spin([0.0, np.pi / 2, 0.0]), pose.covariance)))
    return replace(one, posterior=replace(one.posterior, modes=modes))


def _edges() -> list[Edge]:
    graph, _ = ring(COUNT, np.random.default_rng(0), [(0, 7), (1, 6)])
    return [_two_modes(one) if one.source in OPEN and one.kind == "odometry" else one for one in graph.edges]


def _reversed(one: Edge) -> Edge:
    posterior = one.posterior
    modes = tuple(Mode(mode.weight, mode.pose.inverse()) for mode in posterior.modes)
    ends = {"source": posterior.target, "target": posterior.source}
    return replace(one, posterior=replace(posterior, **ends, pose=posterior.pose.inverse(), modes=modes))


def _gaps(edges: list[Edge], root: int) -> dict[int, tuple[Array, Array]]:
    """Return the gaps of loops, by the number of the frames that they span, for all hypotheses in the same order."""
    frames = SpanningTree.of([Factor(one, collapse_modes(one.posterior)) for one in edges], root)
    columns, found = cycles(frames.tree, frames.loops, root, {})
    order = [sorted((one.source, one.target))[1] for one in columns]
    assert sorted(order) == list(OPEN)
    several = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
    hypotheses = several[:, [OPEN.index(source) for source in order]]
    spans = [abs(loop.source - loop.target) for loop in frames.loops]
    return {span: cycle.residual(hypotheses) for span, cycle in zip(spans, found, strict=True)}


@pytest.mark.parametrize("root", [0, 4, 7])
@pytest.mark.parametrize("written_back", [(), (2, 3, 6), tuple(range(1, COUNT))])
def test_residuals_do_not_depend_on_root_and_direction_of_edges(root: int, written_back: tuple[int, ...]) -> None:
    edges = _edges()
    other = [_reversed(one) if one.source in written_back and one.kind == "odometry" else one for one in edges]
    wanted, found = _gaps(edges, 0), _gaps(other, root)
    assert found.keys() == wanted.keys() == {7, 5}
    for span, (error, log_volume) in wanted.items():
        assert np.argmin(error) == 0  # the true modes close the loop
        np.testing.assert_allclose(found[span][0], error, rtol=1e-6)
        np.testing.assert_allclose(found[span][1], log_volume, atol=1e-9)


def test_a_residual_has_the_covariance_of_both_paths() -> None:
    rng = np.random.default_rng(1)
    first, second = (PoseGaussian(se3.exp(0.01 * rng.normal(size=6)), covariance(rng)) for _ in range(2))
    edges = [_two_modes(edge(0, 1, first)), edge(0, 1, second, "closure")]
    factors = [Factor(one, collapse_modes(one.posterior)) for one in edges]
    _, (cycle,) = cycles(factors[:1], factors[1:], 0, {})
    error, log_volume = cycle.residual(np.array([[0]]))
    xi, spread = se3.log(se3.inverse(second.mean) @ first.mean), first.covariance + second.covariance
    assert error[0] == pytest.approx(0.5 * xi @ np.linalg.solve(spread, xi))
    assert log_volume[0] == pytest.approx(0.5 * np.linalg.slogdet(spread)[1])


def test_settled_edges_are_not_hypotheses() -> None:
    edges = _edges()
    settled = {one: np.array([0.0, 1.0]) for one in edges if one.source in OPEN[:2] and one.posterior.modes}
    frames = SpanningTree.of([Factor(one, collapse_modes(one.posterior)) for one in edges], 0)
    columns, found = cycles(frames.tree, frames.loops, 0, settled)
    assert [one.source for one in columns] == [OPEN[2]]
    whole = _gaps(edges, 0)[7][0]
    np.testing.assert_allclose(found[0].residual(np.array([[0], [1]]))[0], whole[[6, 7]], rtol=1e-9)
