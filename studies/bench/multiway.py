"""A whole model by Open3D's recipes: `python -m studies bench.multiway SEQUENCE MESH.ply`.

Consecutive frames, and the last with the first, by multi-scale ICP; poses by global optimisation; mesh by TSDF. Masks
are those of the sequence.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import open3d as o3d

from modeler.sequences import open_sequence
from modeler.types import Array, Frame
from studies.bench.reference import PYRAMID_M, icp, icp_view, tsdf

_registration = o3d.pipelines.registration
_REACH_M = 2.0 * PYRAMID_M[-1]


def trajectory(frames: list[Frame]) -> list[Array]:
    """Return object_from_camera (4, 4) of each frame."""
    views = [icp_view(frame) for frame in frames]
    graph, pose = _registration.PoseGraph(), np.eye(4)
    graph.nodes.append(_registration.PoseGraphNode(pose))
    for number in range(1, len(views) + 1):
        source, target = number % len(views), number - 1
        found = icp(views[source], views[target])
        information = _registration.get_information_matrix_from_point_clouds(
            views[source].levels[-1], views[target].levels[-1], _REACH_M, found
        )
        closing = number == len(views)
        graph.edges.append(_registration.PoseGraphEdge(source, target, found, information, uncertain=closing))
        if not closing:
            pose = pose @ found
            graph.nodes.append(_registration.PoseGraphNode(pose))
    _registration.global_optimization(
        graph,
        _registration.GlobalOptimizationLevenbergMarquardt(),
        _registration.GlobalOptimizationConvergenceCriteria(),
        _registration.GlobalOptimizationOption(_REACH_M, edge_prune_threshold=0.25, reference_node=0),
    )
    return [np.asarray(node.pose) for node in graph.nodes]


def main() -> None:
    """Make the mesh."""
    parser = argparse.ArgumentParser(prog="python -m studies bench.multiway", description=__doc__)
    parser.add_argument("sequence", type=Path, help="with masks")
    parser.add_argument("mesh", type=Path, help="PLY file to write")
    options = parser.parse_args()
    sequence = open_sequence(options.sequence)
    frames = [sequence.frame(index) for index in sequence.indices]
    mesh = tsdf(frames, trajectory(frames), PYRAMID_M[-1], 4.0 * PYRAMID_M[-1])
    o3d.t.io.write_triangle_mesh(options.mesh, mesh)


if __name__ == "__main__":
    main()
