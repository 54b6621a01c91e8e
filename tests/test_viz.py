"""The recording holds what was promised, truly drawn; and no viewer can stop a run."""

from __future__ import annotations

import io
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import rerun as rr
import rerun.chunk
from PIL import Image
from scipy.spatial.transform import Rotation
from turning_box import CENTRE_M, COVARIANCE, HALF_M, object_from_camera, steps

from modeler import se3
from modeler.types import Array, Mode, Outcome, Plane, PoseGaussian, Segmentation, Solution, Step
from viz import (
    blueprint,
    clouds,
    entities,
    ghosts,
    images,
    readings,
    spread,
    uncertainty,
    viewer,
    visibility,
)
from viz.stream import RerunStream, graph_due, open_stream

Recording = dict[str, dict[int, dict[str, Any]]]
COUNT, LOST = 6, 3
MERGED = (entities.MERGED_BEFORE, entities.MERGED_AFTER)
PAIR_CLOUDS = (entities.PAIR_TARGET, entities.PAIR_BEFORE, entities.PAIR_AFTER)
GHOSTS = (entities.GHOSTS, entities.GHOST_MEANS, entities.GHOST_TIPS)
CAPTIONS = (
    entities.MAGNIFICATION,
    entities.BEFORE_MAGNIFICATION,
    entities.EDGES_MAGNIFICATION,
    entities.GHOST_LABELS,
    entities.PAIR_CAPTION,
    entities.VISIBILITY_CAPTION,
)
SPREADS = (
    entities.POSITION_1_SIGMA,
    entities.POSITION_3_SIGMA,
    entities.AXIS_TIPS_1_SIGMA,
    entities.BEFORE_POSITION_1_SIGMA,
    entities.BEFORE_POSITION_3_SIGMA,
    entities.BEFORE_AXIS_TIPS_1_SIGMA,
)
EDGES = (entities.ODOMETRY, entities.CLOSURE, entities.REJECTED)


def read(path: Path) -> Recording:
    """Return the rows of a recording by entity and frame (-1: static), each by component; rows of a frame merge."""
    rows: Recording = defaultdict(lambda: defaultdict(dict))
    for chunk in rerun.chunk.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        columns = {name: batch[name].to_pylist() for name in batch.schema.names if name == "frame" or ":" in name}
        frames = columns.pop("frame", [-1] * chunk.num_rows)
        for row, frame in enumerate(frames):
            values = {name: column[row] for name, column in columns.items()}
            entity = rows[chunk.entity_path.removeprefix("/")][frame]
            entity |= {name.partition(":")[2]: value for name, value in values.items() if value is not None}
    return {entity: dict(frames) for entity, frames in rows.items()}


def record(path: Path, run: list[Step]) -> Recording:
    """Stream a run to a file and read it back."""
    stream = open_stream("box", save=path)
    for step in run:
        stream(step)
    stream.close()
    return read(path)


@pytest.fixture(scope="module")
def run() -> list[Step]:
    return list(steps(COUNT, lost=LOST))


@pytest.fixture(scope="module")
def recording(run: list[Step], tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record(tmp_path_factory.mktemp("viz") / "recording.rrd", run)


def drawn(recording: Recording, entity: str, component: str) -> dict[int, Array]:
    """Return a component by frame, without the frames that cleared it."""
    return {
        frame: np.array(row[component], dtype=np.float64)
        for frame, row in recording[entity].items()
        if component in row
    }


def drawn_factor(label: str) -> float:
    """Return how many times larger than life a caption says that something is drawn."""
    return 1.0 if label.endswith("to scale") else float(label.rpartition("\N{MULTIPLICATION SIGN}")[2])


def decoded(blob: list[list[int]]) -> npt.NDArray[Any]:
    return np.asarray(Image.open(io.BytesIO(bytes(blob[0]))))


def test_every_promised_entity_is_recorded(recording: Recording) -> None:
    promised = {
        "blob": [entities.COLOUR, entities.DEPTH],
        "buffer": [entities.MASK, entities.VISIBILITY_AREAS],
        "positions": [*PAIR_CLOUDS, entities.PAIR_DRAWS, entities.CLOUD, *GHOSTS, entities.VISIBILITY_AGREES, *MERGED],
        "vertex_positions": [entities.MESH],
        "strips": [entities.CAMERAS, entities.CURRENT, entities.CHAIN, entities.BEFORE_CAMERAS, *EDGES],
        "vectors": [entities.AXES, entities.PAIR_AXES],
        "half_sizes": [*SPREADS, entities.EDGES_1_SIGMA, entities.GHOST_CENTRE_1_SIGMA, entities.GHOST_CENTRE_3_SIGMA],
        "labels": CAPTIONS,
        "scalars": [f"{path}/{kind}" for path in entities.READINGS for kind in ("odometry", "closure")]
        + [f"{path}/pose" for path in entities.POSE_READINGS],
        "text": [entities.NOW, entities.LOG, entities.LEGEND, entities.RUN],
        "xyz": [entities.PAIR, entities.WORLD],
    }
    for component, paths in promised.items():
        for path in paths:
            values = [np.array(row[component]) for row in recording[path].values() if component in row]
            assert values, path
            assert all(value.size > 0 for value in values), path
            assert all(np.isfinite(value).all() for value in values if value.dtype.kind == "f"), path


def test_both_timelines_run_forward(run: list[Step], tmp_path: Path) -> None:
    record(tmp_path / "r.rrd", run)
    for chunk in rerun.chunk.RrdReader(tmp_path / "r.rrd").stream():
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            order = np.argsort(batch["frame"].to_numpy(), kind="stable")
            elapsed_s = batch["elapsed"].to_numpy()[order] / np.timedelta64(1, "s")
            assert elapsed_s[0] >= 0.0
            assert (np.diff(elapsed_s) >= 0.0).all()


def test_what_a_frame_tried_again_brings_stands_at_the_latest_frame(run: list[Step], tmp_path: Path) -> None:
    last = run[-1]
    again = replace(last, frame=run[LOST].frame, view=run[LOST].view)
    recording = record(tmp_path / "r.rrd", [*run[:-1], again, last])
    assert f"Frame {LOST}: left out" in recording[entities.NOW][LOST]["text"][0]
    assert len(drawn(recording, entities.CLOUD, "positions")[LOST]) < len(
        drawn(recording, entities.CLOUD, "positions")[4]
    )


def test_a_recording_opens_with_a_layout(tmp_path: Path, run: list[Step]) -> None:
    record(tmp_path / "r.rrd", run)
    reader = rerun.chunk.RrdReader(tmp_path / "r.rrd")
    waiting, knowing = sorted((list(reader.stream(store=entry)) for entry in reader.blueprints()), key=len)
    views = [sum(str(chunk.entity_path).endswith("/ViewContents") for chunk in layout) for layout in (waiting, knowing)]
    assert views == [21, 21]
    eyes = [c.to_record_batch() for c in knowing if str(c.entity_path).endswith("/EyeControls3D")]
    targets = np.array([batch["EyeControls3D:look_target"][0].as_py()[0] for batch in eyes])
    assert len(targets) == 9
    assert np.linalg.norm(targets - CENTRE_M, axis=1).max() < HALF_M.max()


def test_captions_lie_below_the_object_where_its_support_is_seen(run: list[Step]) -> None:
    view = run[0].view
    assert view is not None
    normal = np.array([0.0, -np.cos(0.6), -np.sin(0.6)])
    on_table = replace(view, plane=Plane(normal, 0.5, 0.01, 0.001))
    below_m = clouds.below_m(on_table) - view.centroid_m
    np.testing.assert_allclose(below_m, -normal * np.linalg.norm(below_m), atol=1e-9)


def test_images_survive_compression(run: list[Step], recording: Recording) -> None:
    for step in run:
        index, frame = step.frame.index, step.frame
        row = recording[entities.DEPTH][index]
        depth_m = decoded(row["blob"]) / row["meter"][0]
        np.testing.assert_allclose(depth_m, np.nan_to_num(frame.depth_m), atol=0.51e-3)
        near, far = row["depth_range"][0]
        of_object = frame.depth_m[step.segmentation.mask] * row["meter"][0]
        assert near < np.median(of_object) < far
        mask = np.array(recording[entities.MASK][index]["buffer"][0], dtype=bool).reshape(frame.depth_m.shape)
        np.testing.assert_array_equal(mask, step.segmentation.mask)
        assert frame.colour is not None
        luma = np.array([0.299, 0.587, 0.114])  # JPEG keeps colour at half the resolution
        difference = (decoded(recording[entities.COLOUR][index]["blob"]).astype(float) - frame.colour) @ luma
        assert np.abs(difference).mean() < 5.0


def test_a_frame_without_colour_has_none_in_the_recording(tmp_path: Path) -> None:
    grey = record(tmp_path / "r.rrd", list(steps(2, colour=False)))
    assert "blob" not in grey[entities.COLOUR][0]
    assert "blob" in grey[entities.DEPTH][0]
    assert len(grey[entities.CLOUD][0]["positions"]) > 100


def test_large_images_are_shown_smaller(run: list[Step]) -> None:
    depth_m = np.ones((960, 1280), dtype=np.float32)
    frame = replace(run[0].frame, depth_m=depth_m, colour=None)
    step = replace(run[0], frame=frame, segmentation=replace(run[0].segmentation, mask=depth_m > 0.0))
    (depth,) = [archetype for path, archetype in images.drawing(step) if path == entities.DEPTH]
    assert isinstance(depth, rr.EncodedDepthImage)
    assert depth.blob is not None
    assert decoded(depth.blob.as_arrow_array().to_pylist()).shape == (240, 320)
    (mask,) = [archetype for path, archetype in images.drawing(step) if path == entities.MASK]
    assert isinstance(mask, rr.SegmentationImage)
    assert mask.buffer is not None
    assert len(mask.buffer.as_arrow_array().to_pylist()[0]) == 480 * 640


def test_the_depth_view_opens_around_the_object_at_any_size(run: list[Step]) -> None:
    view = run[0].view
    assert view is not None
    depth_m = np.kron(view.frame.depth_m, np.ones((10, 10), dtype=np.float32))
    large = replace(view, frame=replace(view.frame, depth_m=depth_m), pixels=10 * view.pixels)
    for shown, shrunk in ((view, 1), (large, 3)):
        bounds = blueprint.around(shown).range
        assert bounds is not None
        (ranges,) = bounds.as_arrow_array().to_pylist()
        rows, columns = shown.pixels.T / shrunk
        for (low, high), pixels in ((ranges["x_range"], columns), (ranges["y_range"], rows)):
            assert low < pixels.min() < pixels.max() < high < 5 * pixels.max()


def test_alignment_brings_the_pair_together(recording: Recording) -> None:
    targets = drawn(recording, entities.PAIR_TARGET, "positions")
    before, after = (drawn(recording, path, "positions") for path in (entities.PAIR_BEFORE, entities.PAIR_AFTER))
    assert set(targets) == set(before) == set(after) == set(range(1, COUNT))
    for index in targets:
        # The box moved into the target's frame fills the target's box: compare in the box's own axes.
        box_from_target = object_from_camera(index - 1 if index - 1 != LOST else LOST - 1)
        for clouds_m, inside in ((targets, True), (after, True), (before, False)):
            in_box = np.abs(se3.transform(box_from_target, clouds_m[index]) - CENTRE_M) - HALF_M
            assert (np.percentile(in_box.max(axis=1), 95) < 0.004) == inside


def test_draws_stand_for_the_posterior(run: list[Step]) -> None:
    rng = np.random.default_rng(0)
    posterior = run[1].posteriors[0]
    mean = posterior.pose.mean
    sigma_points = se3.log(se3.inverse(mean) @ spread.draws(posterior))
    np.testing.assert_allclose(sigma_points.T @ sigma_points / 2.0, posterior.pose.covariance, atol=1e-9)
    # Two modes, the lighter by three to one: the draws keep the proportion, and are the same every time.
    offsets = np.zeros((400, 6))
    offsets[:, 1] = np.where(np.arange(400) < 200, 1.0, -1.0)
    samples = mean @ se3.exp(offsets + 0.01 * rng.standard_normal((400, 6)))
    weights = np.where(offsets[:, 1] > 0, 0.75, 0.25) / 200.0
    modal = replace(posterior, samples=samples, weights=weights)
    drawn_poses = spread.draws(modal)
    share = np.mean(se3.log(se3.inverse(mean) @ drawn_poses)[:, 1] > 0)
    assert share == pytest.approx(0.75, abs=1 / 80)
    np.testing.assert_array_equal(drawn_poses, spread.draws(modal))


def test_the_ends_of_the_axes_gather_about_the_mean(recording: Recording, run: list[Step]) -> None:
    for step in run[1:]:
        arrows = recording[entities.PAIR_AXES][step.frame.index]
        ends = np.array(arrows["origins"]) + np.array(arrows["vectors"])
        dots = np.array(recording[entities.PAIR_DRAWS][step.frame.index]["positions"]).reshape(-1, 3, 3)
        distance_m = np.linalg.norm(dots - ends, axis=-1)
        assert 0.0 < distance_m.max() < 0.01


def test_the_visibility_picture_has_the_three_areas(run: list[Step], recording: Recording) -> None:
    target = run[0].view
    assert target is not None
    shape = target.frame.depth_m.shape
    areas = np.array(recording[entities.VISIBILITY_AREAS][1]["buffer"][0], dtype=np.uint8).reshape(shape)
    assert target.frame.mask is not None
    np.testing.assert_array_equal(areas == visibility.OBJECT, target.frame.mask)
    np.testing.assert_array_equal(areas == visibility.MISSING, np.isnan(target.frame.depth_m))


def test_points_hang_in_front_only_where_the_motion_is_wrong(run: list[Step]) -> None:
    source, target = run[1].view, run[0].view
    assert source is not None
    assert target is not None
    truth = se3.inverse(object_from_camera(0)) @ object_from_camera(1)

    def share(verdict: int, offset_m: list[float]) -> float:
        verdicts = visibility.projection(source, target, se3.translation(np.array(offset_m)) @ truth).verdicts
        judged = verdicts[verdicts != visibility.NO_SAY]
        assert len(judged) > 0.6 * len(verdicts)
        return float(np.mean(judged == verdict))

    assert share(visibility.VIOLATION, [0.0, 0.0, 0.0]) < 0.01
    assert share(visibility.AGREES, [0.0, 0.0, 0.0]) > 0.6
    assert share(visibility.VIOLATION, [0.0, 0.0, -0.05]) > 0.9
    assert share(visibility.HIDDEN, [0.0, 0.0, 0.05]) > 0.9
    assert share(visibility.VIOLATION, [0.25, 0.0, 0.0]) > 0.9  # before the background
    beyond = visibility.projection(source, target, se3.translation(np.array([5.0, 0.0, 0.0])) @ truth)
    assert len(beyond.pixels) == 0


def test_points_are_drawn_by_what_is_said_of_them(run: list[Step]) -> None:
    step = run[1]
    (posterior,) = step.posteriors

    def drawn_at(offset_m: list[float]) -> dict[str, Any]:
        mean = se3.translation(np.array(offset_m)) @ posterior.pose.mean
        moved = replace(posterior, pose=replace(posterior.pose, mean=mean))
        return dict(visibility.drawing(replace(step, posteriors=(moved,))))

    for path, offset_m in (
        (entities.VISIBILITY_AGREES, [0.0, 0.0, 0.0]),
        (entities.VISIBILITY_HIDDEN, [0.0, 0.0, 0.05]),
        (entities.VISIBILITY_VIOLATIONS, [0.0, 0.0, -0.05]),
    ):
        points = drawn_at(offset_m)[path]
        assert isinstance(points, rr.Points2D)
        assert points.positions is not None
        assert len(points.positions.as_arrow_array()) > 100


def test_where_nothing_was_measured_no_point_is_judged(run: list[Step]) -> None:
    source, target = run[1].view, run[0].view
    assert source is not None
    assert target is not None
    nowhere = np.zeros_like(target.layers["cells"])  # cells of the kind MISSING
    blind = replace(target, layers=dict(target.layers) | {"cells": nowhere})
    verdicts = visibility.projection(source, blind, np.eye(4)).verdicts
    assert len(verdicts) > 100
    assert (verdicts == visibility.NO_SAY).all()


def test_ghosts_stay_with_their_mode_and_spread_about_it(run: list[Step]) -> None:
    step, rng = run[1], np.random.default_rng(2)
    posterior, view = step.posteriors[0], step.view
    assert view is not None
    centre = se3.translation(view.centroid_m)
    turned = posterior.pose.mean @ centre @ se3.exp(np.array([0.0, 1.5, 0.0, 0.0, 0.0, 0.0])) @ se3.inverse(centre)
    tight = 0.01 * COVARIANCE
    modes = (Mode(0.75, PoseGaussian(posterior.pose.mean, tight)), Mode(0.25, PoseGaussian(turned, tight)))
    draws = np.concatenate(
        [
            mode.pose.mean @ se3.exp(rng.multivariate_normal(np.zeros(6), tight, round(400 * mode.weight)))
            for mode in modes
        ]
    )
    modal = replace(posterior, modes=modes, samples=draws, weights=np.full(400, 1 / 400))
    shown = ghosts.magnified(modal, view)
    assert np.mean(shown.mode_of == 0) == pytest.approx(0.75, abs=1 / 20)
    assert shown.factor > 1.0
    for number, mode in enumerate(modes):
        apart_m = [
            np.linalg.norm(se3.transform(pose, view.centroid_m[None]) - se3.transform(mode.pose.mean, view.centroid_m))
            for pose in shown.poses[shown.mode_of == number]
        ]
        assert 0.0 < max(apart_m) < 0.3 * HALF_M.max()
    recording_of = dict(ghosts.drawing(replace(step, posteriors=(modal,))))
    labels = recording_of[entities.GHOST_LABELS]
    assert isinstance(labels, rr.Points3D)
    assert labels.labels is not None
    assert [text.partition(",")[0] for text in labels.labels.as_arrow_array().to_pylist()] == [
        "mode 1: 75 %",
        "mode 2: 25 %",
    ]


def test_the_run_is_described_in_words(run: list[Step], tmp_path: Path) -> None:
    stream = open_stream("box", save=tmp_path / "r.rrd", facts={"prior": "table", "roi": (1, 2, 3, 4), "odd": "a|b"})
    stream(run[0])
    stream.close()
    text = read(tmp_path / "r.rrd")[entities.RUN][-1]["text"][0]
    assert "box" in text
    assert "| prior | table |" in text
    assert "| roi | 1 2 3 4 |" in text
    assert "a\\|b" in text


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
    got = uncertainty.axis_tip_covariances(rotation, factor @ factor.T)
    for axis in range(3):
        wanted = np.cov(samples[:, :, axis].T)
        np.testing.assert_allclose(got[axis], wanted, atol=0.03 * np.trace(wanted))


def test_magnification_is_round_and_never_grows(run: list[Step]) -> None:
    edges = run[-1].edges_so_far
    factors = [uncertainty.magnification(edges[:k], 0.8) for k in range(1, len(edges) + 1)]
    assert (np.diff(factors) <= 0.0).all()
    for scale in (1e-8, 1e-4, 1.0, 1e6):
        posterior = edges[0].posterior
        sure = replace(posterior, pose=PoseGaussian(posterior.pose.mean, scale * COVARIANCE))
        factor = uncertainty.magnification([replace(edges[0], posterior=sure)], 0.8)
        assert 0.1 <= factor <= 1000.0
        assert f"{factor:g}".strip("0.") in "125"
    assert uncertainty.magnification([], 0.8) == 1.0


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
    coarse, kept = clouds.coarsened(vertices, triangles, 5_000)
    assert 500 < len(kept) <= 5_000
    np.testing.assert_allclose(coarse[:, 2], 0.1 * np.sin(3 * coarse[:, 0]), atol=1e-3)
    np.testing.assert_allclose(coarse[:, 3], coarse[:, 0] + coarse[:, 1], atol=1e-9)
    one, other = coarse[kept[:, 1]] - coarse[kept[:, 0]], coarse[kept[:, 2]] - coarse[kept[:, 0]]
    assert (np.cross(one[:, :3], other[:, :3])[:, 2] <= 1e-12).all()  # all still face the same way
    same, all_of_them = clouds.coarsened(vertices, triangles, len(triangles))
    assert same is vertices
    assert all_of_them is triangles


def test_readings_are_those_of_the_posterior(run: list[Step], recording: Recording) -> None:
    posterior = run[1].posteriors[0]
    values = {path: recording[f"{path}/odometry"][1]["scalars"][0] for path in entities.READINGS}
    assert values[entities.EFFECTIVE_SAMPLES] == pytest.approx(posterior.effective_samples)
    assert values[entities.OVERLAP] == pytest.approx(100 * posterior.overlap)
    assert values[entities.SECONDS] == pytest.approx(posterior.seconds)
    samples = np.random.default_rng(0).multivariate_normal(np.zeros(6), posterior.pose.covariance, 50_000)
    turned = np.linalg.eigvalsh(np.cov(samples[:, :3].T))[-1] ** 0.5
    assert values[entities.ROTATION_SD] == pytest.approx(np.rad2deg(turned), rel=0.02)
    assert run[1].view is not None
    centre = np.append(run[1].view.centroid_m, 1.0)
    shifted = np.linalg.eigvalsh(np.cov((se3.exp(samples) @ centre)[:, :3].T))[-1] ** 0.5
    assert values[entities.TRANSLATION_SD] == pytest.approx(1000 * shifted, rel=0.02)


def test_every_pair_is_put_into_words(run: list[Step], recording: Recording) -> None:
    for step in run:
        now = recording[entities.NOW][step.frame.index]["text"][0]
        assert now.startswith(f"### Frame {step.frame.index}: {'left out' if step.frame.index == LOST else 'accepted'}")
        for edge in step.edges:
            assert readings.pair_words(edge, step) in now
            assert edge.posterior.outcome.advice in now
            assert ("rejected" in readings.pair_words(edge, step)) == (not edge.accepted)
            assert now.count(edge.posterior.outcome.advice) == sum(
                other.posterior.outcome is edge.posterior.outcome for other in step.edges
            )
    assert "nan" not in " ".join(row["text"][0] for row in recording[entities.NOW].values())


def test_what_the_graph_leaves_to_the_modes_of_a_pair_is_told(run: list[Step]) -> None:
    step = run[1]
    pair = (step.edges[0].source, step.edges[0].target)
    wary = replace(step, solution=replace(step.solution, mode_weights={pair: np.array([0.9, 0.1])}))
    assert "leave to its modes 90%, 10%" in readings.now_words(wary)
    assert "modes" not in readings.now_words(step)


def test_readings_that_a_method_does_not_give_are_left_out(run: list[Step]) -> None:
    edge = run[1].edges[0]
    poor = replace(edge, posterior=replace(edge.posterior, effective_samples=float("nan"), seconds=float("nan")))
    assert "nan" not in readings.pair_words(poor, run[1])
    paths = {path for path, _ in readings.drawing(replace(run[1], edges=(poor,)))}
    assert f"{entities.OVERLAP}/odometry" in paths
    assert f"{entities.SECONDS}/odometry" not in paths


def odd_steps(run: list[Step]) -> list[Step]:
    """Return steps that lack what steps may lack."""
    step = run[1]
    nothing = Segmentation(np.zeros_like(step.segmentation.mask), None, Outcome.TOO_FEW_POINTS)
    blind = replace(step.frame, depth_m=np.full_like(step.frame.depth_m, np.nan))
    assert step.model is not None
    empty = replace(
        step.model,
        points_m=np.zeros((0, 3)),
        normals=np.zeros((0, 3)),
        colours=None,
        triangles=np.zeros((0, 3), dtype=np.int64),
    )
    unknown = Solution(step.solution.trajectory, {1: np.full((6, 6), np.nan)}, {})
    posterior = step.posteriors[0]
    lost = replace(posterior, pose=PoseGaussian(posterior.pose.mean, np.full((6, 6), np.inf)))
    bare = Step(blind, nothing, None, (), (), Outcome.TOO_FEW_POINTS.label, Solution(), None)
    return [
        bare,
        replace(bare, last=True),
        replace(step, model=empty, last=True),
        replace(step, solution=unknown),
        replace(step, posteriors=(lost,), edges=(replace(step.edges[0], posterior=lost),)),
        replace(run[1], views={}),
    ]


def test_every_step_is_accepted_and_none_is_changed(run: list[Step], tmp_path: Path) -> None:
    everything = [*run, *odd_steps(run)]
    before = [repr(step) + str([p.pose.mean.tobytes() for p in step.posteriors]) for step in everything]
    recording = record(tmp_path / "r.rrd", everything)
    assert before == [repr(step) + str([p.pose.mean.tobytes() for p in step.posteriors]) for step in everything]
    assert entities.NOW in recording


def test_a_recording_stays_small(tmp_path: Path) -> None:
    run = list(steps(3, width=640))
    record(tmp_path / "r.rrd", run)
    assert (tmp_path / "r.rrd").stat().st_size / len(run) < 15e6 / 14


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_run_that_is_killed_leaves_a_readable_recording(run: list[Step], tmp_path: Path) -> None:
    stream = open_stream("box", save=tmp_path / "r.rrd")
    stream(run[0])
    stream(run[1])
    stream.recording.flush()
    (tmp_path / "cut.rrd").write_bytes((tmp_path / "r.rrd").read_bytes())
    stream.close()
    assert set(read(tmp_path / "cut.rrd")[entities.NOW]) == {0, 1}


def listeners(process: subprocess.Popen[bytes]) -> set[str]:
    """Return the local addresses, as the kernel writes them, on which a process listens."""
    inodes = set()
    for descriptor in Path(f"/proc/{process.pid}/fd").iterdir():
        link = os.readlink(descriptor)
        if link.startswith("socket:["):
            inodes.add(link[8:-1])
    lines = [
        line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]
    ]
    return {line[1].partition(":")[0] for line in lines if line[3] == "0A" and line[9] in inodes}


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_page_is_served_on_this_machine_alone(run: list[Step], tmp_path: Path) -> None:
    stream = open_stream("box", save=tmp_path / "r.rrd", web=True)
    stream(run[0])
    assert stream.address is not None
    assert stream.address.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(stream.address, timeout=5.0) as page:
        assert b"<html" in page.read()
    (server,) = stream.viewers
    assert listeners(server.process) == {"0100007F"}
    stream.close()
    assert server.process.poll() is not None


def test_a_viewer_that_dies_does_not_stop_the_run(
    run: list[Step], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stream = open_stream("box", save=tmp_path / "r.rrd", web=True)
    stream(run[0])
    stream.viewers[0].stop()
    for step in run[1:]:
        stream(step)
    stream.close()
    assert "the viewer was closed" in caplog.text
    assert set(read(tmp_path / "r.rrd")[entities.NOW]) == set(range(COUNT))


def test_a_viewer_that_is_already_open_may_be_closed_while_the_run_goes_on(run: list[Step], tmp_path: Path) -> None:
    served = viewer.start_web()
    stream = open_stream("box", save=tmp_path / "r.rrd", connect=served.sink)
    assert stream.viewers == ()  # it is not ours to end
    stream(run[0])
    assert served.process.poll() is None
    served.stop()
    for step in run[1:]:
        stream(step)
    stream.close()
    assert set(read(tmp_path / "r.rrd")[entities.NOW]) == set(range(COUNT))


def test_a_viewer_that_freezes_does_not_stop_the_run(
    run: list[Step], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("viz.stream._PATIENCE_S", 0.5)
    monkeypatch.setattr("viz.viewer._STOP_S", 0.2)
    stream = open_stream("box", save=tmp_path / "r.rrd", web=True)
    stream(run[0])
    stream.viewers[0].process.send_signal(signal.SIGSTOP)
    for step in run[1:]:
        stream(step)
    stream.close()
    assert set(read(tmp_path / "r.rrd")[entities.NOW]) == set(range(COUNT))


@dataclass
class SlowDisk:
    """A recording that takes its time to write its file."""

    file: Path

    def flush(self, timeout_sec: float) -> None:
        raise RuntimeError("not everything was sent in time")

    def disconnect(self) -> None:
        for _ in range(10):
            with self.file.open("ab") as file:
                file.write(b"more")
            time.sleep(0.05)
        self.file.write_bytes(b"whole")


@pytest.mark.parametrize("watched", [False, True])
def test_a_recording_is_waited_for_as_long_as_it_grows(
    watched: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("viz.stream._PATIENCE_S", 0.2)
    recording: Any = SlowDisk(tmp_path / "r.rrd")
    RerunStream(recording, (), 0.0, recording.file, watched=watched).close()
    assert recording.file.read_bytes() == b"whole"


def test_the_whole_graph_is_drawn_a_number_of_times_that_hardly_grows(run: list[Step]) -> None:
    view = run[0].views[0]
    steps = [replace(run[1], views=dict.fromkeys(range(count), view)) for count in range(1, 1001)]
    due = [count for count, step in enumerate(steps, 1) if graph_due(step)]
    assert due[:99] == list(range(1, 100))  # every frame of a short run
    assert len(due) < 300
    assert max(np.diff(due[98:]) / due[99:]) <= 1 / 50  # never far behind
    assert graph_due(replace(steps[-2], last=True))


def closed_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_viewer_that_is_not_there_is_reported_and_left_out(
    run: list[Step], tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    address = f"rerun+http://127.0.0.1:{closed_port()}/proxy"
    with caplog.at_level(logging.WARNING):
        stream: RerunStream = open_stream("box", save=tmp_path / "r.rrd", spawn=True, connect=address)
    assert address in caplog.text
    assert "no display" in caplog.text
    assert stream.address is None
    stream(run[0])
    stream.close()
    assert set(read(tmp_path / "r.rrd")[entities.NOW]) == {0}


def test_a_stream_to_nowhere_takes_steps(run: list[Step]) -> None:
    stream = open_stream("box", save=None)
    stream(run[0])
    stream.close()
    assert stream.address is None


@pytest.mark.parametrize("address", ["localhost", "http://127.0.0.1:9876", "rerun+http://127.0.0.1:x/proxy"])
def test_a_wrong_address_is_refused(address: str) -> None:
    with pytest.raises(viewer.InputError, match=r"--connect .*rerun\+http://127\.0\.0\.1:9876/proxy"):
        open_stream("box", save=None, connect=address)


@pytest.mark.parametrize("place", [f"{'a' * 300}:9876", "localhost:99999", "no such host:9876"])
def test_nobody_listens_where_nobody_can(place: str) -> None:
    assert not viewer.reachable(f"rerun+http://{place}/proxy")


def test_a_recording_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(viewer.InputError, match=r"r\.rrd"):
        open_stream("box", save=tmp_path / "missing" / "r.rrd")


def test_viewing_a_folder_without_a_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(viewer.InputError, match=r"no recording\.rrd .*build --out"):
        viewer.view(tmp_path)


def test_a_recording_is_viewed_in_the_browser(run: list[Step], tmp_path: Path) -> None:
    record(tmp_path / "recording.rrd", run[:2])
    served = viewer.view(tmp_path, web=True)
    with urllib.request.urlopen(served.address, timeout=5.0) as page:
        assert b"<html" in page.read()
    served.stop()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_server_ends_with_the_command_that_waits_for_it(run: list[Step], tmp_path: Path, number: int) -> None:
    record(tmp_path / "recording.rrd", run[:1])
    program = (
        "import sys, pathlib; from viz import viewer; served = viewer.view(pathlib.Path(sys.argv[1]), web=True);"
        "print(served.process.pid, flush=True); served.wait()"
    )
    with subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE) as command:
        assert command.stdout is not None
        server = int(command.stdout.readline())
        time.sleep(0.2)  # from the line to the wait
        command.send_signal(number)
        assert command.wait(timeout=10.0) == 0
    with pytest.raises(ProcessLookupError):
        os.kill(server, 0)


def test_a_run_that_is_terminated_leaves_a_whole_recording_and_no_server(tmp_path: Path) -> None:
    program = (
        "import sys, pathlib, time; from modeler.cli.interrupt import terminable; from turning_box import steps;"
        "from viz.stream import open_stream\n"
        "with terminable():\n"
        "    stream = open_stream('box', save=pathlib.Path(sys.argv[1]), web=True)\n"
        "    try:\n"
        "        stream(next(steps(1)))\n"
        "        print(stream.viewers[0].process.pid, flush=True)\n"
        "        time.sleep(60)\n"
        "    finally:\n"
        "        stream.close()\n"
    )
    arguments = [sys.executable, "-c", program, str(tmp_path / "r.rrd")]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, env=environment) as command:
        assert command.stdout is not None
        server = int(command.stdout.readline())
        command.terminate()
        assert command.wait(timeout=20.0) == 128 + signal.SIGTERM
    with pytest.raises(ProcessLookupError):
        os.kill(server, 0)
    assert set(read(tmp_path / "r.rrd")[entities.NOW]) == {0}


def test_rerun_is_not_imported_before_it_is_needed() -> None:
    program = "import sys, viz.stream, viz.viewer, viz.entities; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_the_notebook_runs_and_embeds_the_viewer(monkeypatch: pytest.MonkeyPatch) -> None:
    display = pytest.importorskip("IPython.display")
    shown: list[Any] = []
    monkeypatch.setattr(display, "display", shown.append)
    notebook = json.loads((Path(__file__).parents[1] / "docs" / "watch.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    whole = 'open_sequence(bundled("box"))'
    assert sum(whole in cell for cell in cells) == 1
    names: dict[str, Any] = {}
    for cell in cells:
        exec(cell.replace(whole, f"{whole}.select(frames=slice(0, 3))"), names)
    (frame,) = shown
    assert frame.src.startswith("http://127.0.0.1:")
    assert len(names["step"].views) == 3
    assert names["stream"].viewers[0].process.poll() is not None
