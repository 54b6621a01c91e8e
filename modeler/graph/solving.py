"""The solution of a whole graph at once."""

from __future__ import annotations

from collections.abc import Mapping

from modeler.graph.axis import CommonAxis
from modeler.graph.pose_graph import PoseGraph
from modeler.graph.smoother import Smoother
from modeler.types import Array, Solution


def solve(
    graph: PoseGraph,
    guess: Mapping[int, Array],
    *,
    outlier_distance: float = 14.2,
    shared: float = 0.0,
    common: float = 0.0,
    axis: CommonAxis | None = None,
) -> Solution:
    """Optimise the poses of all frames that accepted edges connect with the first.

    Edges that reach a frame nothing else has reached, odometry before closures, cannot be contradicted and are trusted.
    The others close loops; those that the rest contradicts are left out, see `optimise`. Of an edge whose posterior has
    several modes the loops choose one, see `modes`. A graph that grows is solved faster by `Smoother`.

    Args:
        graph: the edges.
        guess: object_from_camera (4, 4) by frame number, to start from; frames without one start on the chain.
        outlier_distance: see `Smoother`.
        shared: see `Smoother`.
        common: see `Smoother`.
        axis: the turntable, where there is one.

    Raises:
        ValueError: where an accepted edge's covariance is not positive definite.
    """
    return Smoother(outlier_distance, shared, common, axis, solution=Solution(guess)).to(graph).solution
