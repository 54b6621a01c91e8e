"""Cameras, edges, their uncertainty and the model are drawn where the run has them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from streamed import MERGED, Recording, drawn, record
from turning_box import COUNT, COVARIANCE, LOST

from modeler import se3
from modeler.types import PoseGaussian, Step
from viz import entities, graph_view, model_view
from viz.stream import graph_due


def drawn_factor(label: str) -> float:
    """Return how many times larger than life a caption says that something is drawn."""
    return 1.0 if label.endswith("to scale") else float(label.rpartition("\N{MULTIPLICATION SIGN}")[2])


def test_the_camera_stands_where_its_pose_says(run: list[Step], recording: Recording) -> None:
    currents = drawn(recording, entities.CURRENT, "strips")
    assert set(currents) == set(range(COUNT)) - {LOST}  # a lost frame has no place
    for index, strips in currents.items():
        pose = run[index].solution.trajectory[index]
        np.testing.assert_allclose(strips[0][0], pose[:3, 3], atol=1e-6)
        looks = (strips[0][1:5].mean(axis=0) - strips[0][0]) @ pose[:3, 2]
        assert 0.02 < looks < 0.3
    assert len(drawn(recording, entities.CAMERAS, "strips")[COUNT - 1]) == COUNT - 1


def test_edges_are_told_apart(run: list[Step], recording: Recording) -> None:
    last = run[-1]
    for path, kind, accepted in (
        (entities.ODOMETRY, "odometry", True),
        (entities.CLOSURE, "closure", True),
        (entities.REJECTED, "closure", False),
    ):
        wanted = [edge for edge in last.edges_so_far if edge.kind == kind and edge.accepted == accepted]
        row = recording[path][COUNT - 1]
        ends = [[last.solution.trajectory[k][:3, 3] for k in (edge.target, edge.source)] for edge in wanted]
        np.testing.assert_allclose(np.array(row["strips"]), np.array(ends), atol=1e-6)
    colours = {
        tuple(recording[p][COUNT - 1]["colors"]) for p in (entities.ODOMETRY, entities.CLOSURE, entities.REJECTED)
    }
    assert len(colours) == 3


def test_an_edge_that_the_optimisation_left_out_counts_as_rejected(run: list[Step], tmp_path: Path) -> None:
    last = run[-1]
    outlier = next(edge for edge in last.edges_so_far if edge.kind == "closure" and edge.accepted)
    wary = replace(last, solution=replace(last.solution, outliers=(outlier,)))
    recording = record(tmp_path / "r.rrd", [wary])
    assert "strips" not in recording[entities.CLOSURE][COUNT - 1]
    assert len(recording[entities.REJECTED][COUNT - 1]["strips"]) == 2
    now = recording[entities.NOW][COUNT - 1]["text"][0]
    assert "left out" in now
    assert "loop closures 0, pairs rejected 3" in now


def test_ellipsoids_are_the_covariance_as_magnified(run: list[Step], recording: Recording) -> None:
    for step in run:
        label = recording[entities.MAGNIFICATION][step.frame.index]["labels"][0]
        factor = drawn_factor(label)
        one, three = (recording[p][step.frame.index] for p in (entities.POSITION_1_SIGMA, entities.POSITION_3_SIGMA))
        np.testing.assert_allclose(3.0 * np.array(one["half_sizes"]), three["half_sizes"], rtol=1e-5)
        for n, index in enumerate(sorted(step.solution.covariances)):
            rotation = step.solution.trajectory[index][:3, :3]
            wanted = rotation @ step.solution.covariances[index][3:, 3:] @ rotation.T
            axes = Rotation.from_quat(one["quaternions"][n]).as_matrix()
            got = axes @ np.diag((np.array(one["half_sizes"][n]) / factor) ** 2) @ axes.T
            np.testing.assert_allclose(got, wanted, atol=1e-3 * np.trace(wanted))
            np.testing.assert_allclose(one["centers"][n], step.solution.trajectory[index][:3, 3], atol=1e-6)


def test_closure_makes_the_drawn_ellipsoids_smaller(recording: Recording) -> None:
    half_axes = drawn(recording, entities.POSITION_1_SIGMA, "half_sizes")
    assert half_axes[COUNT - 1][-1].max() < half_axes[COUNT - 2][-1].max()


def test_axis_tips_spread_as_sampled_rotations_do() -> None:
    rng = np.random.default_rng(0)
    rotation = se3.exp(np.array([0.3, -1.0, 0.4, 0.0, 0.0, 0.0]))[:3, :3]
    factor = rng.standard_normal((3, 3)) * 0.02
    omegas = rng.standard_normal((100_000, 3)) @ factor.T
    samples = rotation @ se3.exp(np.concatenate([omegas, np.zeros_like(omegas)], axis=1))[:, :3, :3]
    got = graph_view.axis_tip_covariances(rotation, factor @ factor.T)
    for axis in range(3):
        wanted = np.cov(samples[:, :, axis].T)
        np.testing.assert_allclose(got[axis], wanted, atol=0.03 * np.trace(wanted))


def test_magnification_is_round_and_never_grows(run: list[Step]) -> None:
    edges = run[-1].edges_so_far
    factors = [graph_view.magnification(edges[:k], 0.8) for k in range(1, len(edges) + 1)]
    assert (np.diff(factors) <= 0.0).all()
    for scale in (1e-8, 1e-4, 1.0, 1e6):
        posterior = edges[0].posterior
        sure = replace(posterior, pose=PoseGaussian(posterior.pose.mean, scale * COVARIANCE))
        factor = graph_view.magnification([replace(edges[0], posterior=sure)], 0.8)
        assert 0.1 <= factor <= 1000.0
        assert f"{factor:g}".strip("0.") in "125"
    assert graph_view.magnification([], 0.8) == 1.0


def test_the_model_grows_and_ends_as_a_mesh(run: list[Step], recording: Recording) -> None:
    sizes = {frame: len(points) for frame, points in drawn(recording, entities.CLOUD, "positions").items()}
    assert sorted(sizes) == list(range(COUNT - 1))
    assert sizes[COUNT - 2] > sizes[0]
    mesh = recording[entities.MESH][COUNT - 1]
    assert run[-1].model is not None
    np.testing.assert_allclose(mesh["vertex_positions"], run[-1].model.vertices_m, atol=1e-6)
    np.testing.assert_array_equal(mesh["triangle_indices"], run[-1].model.triangles)


def test_merged_points_lie_along_the_chain_before_closure_and_as_optimised_after(
    run: list[Step], recording: Recording
) -> None:
    last = run[-1]
    for entity, poses in zip(MERGED, (last.solution.odometry, last.solution.trajectory), strict=True):
        ((frame, points),) = drawn(recording, entity, "positions").items()
        assert frame == max(last.views)
        own = [se3.transform(poses[k], last.views[k].points_m) for k in sorted(poses)]
        assert len(points) == sum(map(len, own))
        np.testing.assert_allclose(points, np.concatenate(own), atol=1e-5)
        colours = np.unique(np.array(recording[entity][frame]["colors"]))
        assert len(colours) == len(own)


def test_a_coarsened_mesh_keeps_its_shape() -> None:
    count = 200
    u, v = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count), indexing="ij")
    vertices = np.stack([u, v, 0.1 * np.sin(3 * u), u + v], axis=-1).reshape(-1, 4)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).reshape(-1)
    triangles = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + count], 1),
            np.stack([corner + 1, corner + count + 1, corner + count], 1),
        ]
    )
    coarse, kept = model_view.coarsened(vertices, triangles, 5_000)
    assert 500 < len(kept) <= 5_000
    np.testing.assert_allclose(coarse[:, 2], 0.1 * np.sin(3 * coarse[:, 0]), atol=1e-3)
    np.testing.assert_allclose(coarse[:, 3], coarse[:, 0] + coarse[:, 1], atol=1e-9)
    one, other = coarse[kept[:, 1]] - coarse[kept[:, 0]], coarse[kept[:, 2]] - coarse[kept[:, 0]]
    assert (np.cross(one[:, :3], other[:, :3])[:, 2] <= 1e-12).all()  # all still face the same way
    same, all_of_them = model_view.coarsened(vertices, triangles, len(triangles))
    assert same is vertices
    assert all_of_them is triangles


def test_the_whole_graph_is_drawn_a_number_of_times_that_hardly_grows(run: list[Step]) -> None:
    view = run[0].views[0]
    steps = [replace(run[1], views=dict.fromkeys(range(count), view)) for count in range(1, 1001)]
    due = [count for count, step in enumerate(steps, 1) if graph_due(step)]
    assert due[:99] == list(range(1, 100))  # every frame of a short run
    assert len(due) < 300
    assert max(np.diff(due[98:]) / due[99:]) <= 1 / 50  # never far behind
    assert graph_due(replace(steps[-2], last=True))
