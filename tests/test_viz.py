"""The recording holds what was promised, whatever a run brings."""

import io
import itertools
import math
import re
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.chunk
from PIL import Image
from rerun_recordings import MERGED, Recording, drawn, read, record
from scipy.spatial.transform import Rotation
from turning_box import CENTRE_M, COUNT, COVARIANCE, HALF_M, LOST, steps

from modeler import se3
from modeler.graph import PoseGraph, dead_reckoning
from modeler.types import Failed, Outcome, Plane, PoseGaussian, Segmentation, Solution, Step
from modeler.viz import blueprint, entities, graph_view, images, model_view, pair_view
from modeler.viz.readings import pose_table, sd_of
from modeler.viz.stream import all_due, open_stream

PAIR_CLOUDS = (entities.PAIR_TARGET, entities.PAIR_BEFORE, entities.PAIR_AFTER)
GHOSTS = (entities.GHOSTS, entities.GHOST_MEANS, entities.GHOST_TIPS)
CAPTIONS = (
    entities.MAGNIFICATION,
    entities.EDGES_MAGNIFICATION,
    entities.GHOST_LABELS,
    entities.PAIR_CAPTION,
    entities.VISIBILITY_CAPTION,
)
SPREADS = (entities.POSITION_1_SIGMA, entities.POSITION_3_SIGMA, entities.BEFORE_POSITION_3_SIGMA)
EDGES = (entities.ODOMETRY, entities.CLOSURE, entities.REJECTED)


def decoded(blob: list[list[int]]) -> npt.NDArray[Any]:
    return np.asarray(Image.open(io.BytesIO(bytes(blob[0]))))


def test_every_promised_entity_is_recorded(recording: Recording) -> None:
    promised = {
        "blob": [entities.COLOUR, entities.DEPTH],
        "buffer": [entities.MASK, entities.VISIBILITY_AREAS],
        "positions": [*PAIR_CLOUDS, entities.PAIR_DRAWS, entities.CLOUD, *GHOSTS, entities.VISIBILITY_AGREES, *MERGED],
        "vertex_positions": [entities.MESH],
        "strips": [
            *(entities.CAMERAS, entities.CURRENT, entities.CHAIN, entities.OUTLINE, entities.DEPTH_OUTLINE),
            *EDGES,
        ],
        "vectors": [entities.AXES, entities.PAIR_AXES],
        "half_sizes": [*SPREADS, entities.EDGES_1_SIGMA, entities.GHOST_CENTRE_1_SIGMA, entities.GHOST_CENTRE_3_SIGMA],
        "labels": CAPTIONS,
        "scalars": [f"{path}/{kind}" for path in entities.READINGS for kind in ("odometry", "closure")]
        + [f"{path}/pose" for path in entities.POSE_READINGS],
        "text": [entities.NOW, entities.POSES, entities.LOG, entities.LEGEND, entities.RUN],
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
    points = drawn(recording, entities.CLOUD, "positions")
    assert len(points[LOST]) < len(points[4])


def test_a_recording_opens_with_a_layout(tmp_path: Path, run: list[Step]) -> None:
    record(tmp_path / "r.rrd", run)
    reader = rerun.chunk.RrdReader(tmp_path / "r.rrd")
    waiting, knowing = sorted((list(reader.stream(store=entry)) for entry in reader.blueprints()), key=len)
    views = [sum(str(chunk.entity_path).endswith("/ViewContents") for chunk in layout) for layout in (waiting, knowing)]
    assert views == [22, 22]
    eyes = [c.to_record_batch() for c in knowing if str(c.entity_path).endswith("/EyeControls3D")]
    targets = np.array([batch["EyeControls3D:look_target"][0].as_py()[0] for batch in eyes])
    assert len(targets) == 8
    assert np.linalg.norm(targets - CENTRE_M, axis=1).max() < HALF_M.max()


def test_captions_lie_below_the_object_where_its_support_is_seen(run: list[Step]) -> None:
    view = run[0].view
    assert view is not None
    normal = np.array([0.0, -np.cos(0.6), -np.sin(0.6)])
    on_table = replace(view, plane=Plane(normal, 0.5, 0.01, 0.001))
    below_m = pair_view.below_m(on_table) - view.centroid_m
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
    camera = replace(run[0].frame.camera, width=1280, height=960)
    frame = replace(run[0].frame, depth_m=depth_m, camera=camera, mask=None, colour=None)
    step = replace(run[0], frame=frame, segmentation=replace(run[0].segmentation, mask=depth_m > 0.0))
    (depth,) = [archetype for path, archetype in images.draw_frame(step) if path == entities.DEPTH]
    assert isinstance(depth, rr.EncodedDepthImage)
    assert decoded(depth.blob.as_arrow_array().to_pylist()).shape == (240, 320)
    coloured = replace(step, frame=replace(frame, colour=np.zeros((960, 1280, 3), dtype=np.uint8)))
    for shown, size in ((step, 240 * 320), (coloured, 480 * 640)):  # laid over the depth, or over the colours
        (mask,) = [archetype for path, archetype in images.draw_frame(shown) if path == entities.MASK]
        assert isinstance(mask, rr.SegmentationImage)
        assert len(mask.buffer.as_arrow_array().to_pylist()[0]) == size


def test_the_depth_view_opens_around_the_object_at_any_size(run: list[Step]) -> None:
    view = run[0].view
    assert view is not None
    depth_m = np.kron(view.frame.depth_m, np.ones((10, 10), dtype=np.float32))
    camera = replace(view.frame.camera, width=depth_m.shape[1], height=depth_m.shape[0])
    frame = replace(view.frame, depth_m=depth_m, camera=camera, mask=None, colour=None)
    large = replace(view, frame=frame, pixels=10 * view.pixels)
    for shown, shrunk in ((view, 1), (large, 3)):
        bounds = blueprint.around(shown).range
        assert bounds is not None
        (ranges,) = bounds.as_arrow_array().to_pylist()
        rows, columns = shown.pixels.T / shrunk
        for (low, high), pixels in ((ranges["x_range"], columns), (ranges["y_range"], rows)):
            assert low < pixels.min() < pixels.max() < high < 5 * pixels.max()


def test_the_run_is_described_in_words(run: list[Step], tmp_path: Path) -> None:
    stream = open_stream("box", save=tmp_path / "r.rrd", facts={"prior": "table", "roi": (1, 2, 3, 4), "odd": "a|b"})
    stream(run[0])
    stream.close()
    text = read(tmp_path / "r.rrd")[entities.RUN][-1]["text"][0]
    assert "box" in text
    assert "| prior | table |" in text
    assert "| roi | 1 2 3 4 |" in text
    assert "a\\|b" in text


def odd_steps(run: list[Step]) -> list[Step]:
    """Return steps that lack what steps may lack."""
    step = run[1]
    nothing = Segmentation(np.zeros_like(step.segmentation.mask), None, Outcome.TOO_FEW_POINTS)
    blind = replace(step.frame, depth_m=np.full_like(step.frame.depth_m, np.nan))
    none = np.zeros((0, 3))
    assert step.model is not None
    empty = replace(step.model, points_m=none, normals=none, colours=None, triangles=none.astype(np.int64))
    unknown = Solution(step.solution.trajectory, {1: np.full((6, 6), np.nan)}, {})
    posterior = step.posteriors[0]
    lost = replace(posterior, pose=PoseGaussian(posterior.pose.mean, np.full((6, 6), np.inf)))
    bare = Step(blind, nothing, None, (), (), Failed(Outcome.TOO_FEW_POINTS), Solution())
    return [
        bare,
        replace(bare, last=True),
        replace(step, make_model=lambda: empty, last=True),
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


# Cameras, edges, their uncertainty and the model are drawn where the run has them.


def drawn_factor(label: str) -> float:
    """Return how many times larger than life a caption says that something is drawn."""
    found = re.search("\N{MULTIPLICATION SIGN}([0-9.]+)", label)
    assert found or "to scale" in label
    return float(found[1]) if found else 1.0


def test_the_camera_stands_where_its_pose_says(run: list[Step], recording: Recording) -> None:
    currents = drawn(recording, entities.CURRENT, "strips")
    assert set(currents) == set(range(COUNT)) - {LOST}  # a lost frame has no place
    for index, strips in currents.items():
        pose = run[index].solution.trajectory[index]
        np.testing.assert_allclose(strips[0][0], pose[:3, 3], atol=1e-6)
        looks = (strips[0][1:5].mean(axis=0) - strips[0][0]) @ pose[:3, 2]
        assert 0.02 < looks < 0.3
    assert len(drawn(recording, entities.CAMERAS, "strips")[COUNT - 1]) == COUNT - 1


def test_edges_are_distinguished(run: list[Step], recording: Recording) -> None:
    last = run[-1]
    for path, kind, accepted in zip(EDGES, ("odometry", "closure", "closure"), (True, True, False), strict=True):
        wanted = [edge for edge in last.edges_so_far if edge.kind == kind and edge.accepted == accepted]
        row = recording[path][COUNT - 1]
        ends = [[last.solution.trajectory[k][:3, 3] for k in (edge.target, edge.source)] for edge in wanted]
        np.testing.assert_allclose(np.array(row["strips"]), np.array(ends), atol=1e-6)
    assert len({tuple(recording[path][COUNT - 1]["colors"]) for path in EDGES}) == 3


def test_an_edge_that_the_optimisation_left_out_counts_as_rejected(run: list[Step], tmp_path: Path) -> None:
    last = run[-1]
    outlier = next(edge for edge in last.edges_so_far if edge.kind == "closure" and edge.accepted)
    wary = replace(last, solution=replace(last.solution, outliers=(outlier,)))
    recording = record(tmp_path / "r.rrd", [wary])
    assert "strips" not in recording[entities.CLOSURE][COUNT - 1]
    assert len(recording[entities.REJECTED][COUNT - 1]["strips"]) == 2
    now = recording[entities.NOW][COUNT - 1]["text"][0]
    assert "left out" in now
    assert "closures 0" in now
    assert "rejected 3" in now


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


def test_poses_before_closure_and_after_and_edges_are_magnified_alike(run: list[Step], recording: Recording) -> None:
    last, row = run[-1], COUNT - 1
    captions = [recording[path][row]["labels"][0] for path in (entities.MAGNIFICATION, entities.EDGES_MAGNIFICATION)]
    (factor,) = set(map(drawn_factor, captions))
    chain = dead_reckoning(PoseGraph(last.edges_so_far, min(last.solution.odometry)))
    drawn_axes = np.sort(recording[entities.BEFORE_POSITION_3_SIGMA][row]["half_sizes"], axis=1)
    frames = [frame for frame in sorted(last.solution.covariances) if frame in chain]
    sds = [np.sqrt(np.linalg.eigvalsh(chain[frame].covariance[3:, 3:])) for frame in frames]
    np.testing.assert_allclose(drawn_axes[:, 2], 3.0 * factor * np.array(sds)[:, 2], rtol=1e-4)
    edges = [edge for edge in last.edges_so_far if last.solution.takes_part(edge)]
    of_edges = np.max(recording[entities.EDGES_1_SIGMA][row]["half_sizes"], axis=1)
    sds = [math.sqrt(np.linalg.eigvalsh(edge.posterior.pose.covariance[3:, 3:])[-1]) for edge in edges]
    np.testing.assert_allclose(of_edges, factor * np.array(sds), rtol=1e-4)


def test_the_table_states_every_pose_before_closure_and_after(run: list[Step], recording: Recording) -> None:
    last = run[-1]
    rows = [line for line in recording[entities.POSES][COUNT - 1]["text"][0].splitlines() if re.match(r"\| \d", line)]
    assert [int(row.split("|")[1]) for row in rows] == list(range(COUNT - 1, -1, -1))
    assert "lost: " in rows[COUNT - 1 - LOST]
    assert "first" in rows[-1]
    newest = last.views[COUNT - 1].centroid_m
    after = sd_of(PoseGaussian(np.eye(4), last.solution.covariances[COUNT - 1]), newest)
    assert f"\N{RIGHTWARDS ARROW} {after.rotation_deg:.2g}**°" in rows[0]
    assert f"\N{RIGHTWARDS ARROW} {after.translation_mm:.2g}** mm" in rows[0]
    # A frame that other edges place than that to the view before.
    closed = [edge for edge in last.edges_so_far if (edge.source, edge.kind) != (COUNT - 1, "odometry")]
    by_others = pose_table(replace(last, edges_so_far=tuple(closed)), {}, [COUNT - 1])
    assert f"\N{RIGHTWARDS ARROW} {after.rotation_deg:.2g}**°" in by_others
    assert "No frame" in pose_table(replace(last, solution=Solution()), {}, [])


def sides(mask: npt.NDArray[np.bool_]) -> set[tuple[int, ...]]:
    """Return the sides of pixels between a mask and the rest: column and row of both ends."""
    padded = np.pad(mask, 1)
    level = {(x - 1, y - 1, x, y - 1) for y, x in np.argwhere(padded[1:] != padded[:-1]) + np.array([1, 0])}
    upright = {(x - 1, y - 1, x - 1, y) for y, x in np.argwhere(padded[:, 1:] != padded[:, :-1]) + np.array([0, 1])}
    return level | upright


def test_the_outline_of_a_mask_is_every_side_between_it_and_the_rest() -> None:
    rng = np.random.default_rng(0)
    for shape in ((1, 1), (7, 11), (20, 5)):
        for share in (0.0, 0.1, 0.5, 1.0):
            mask = rng.random(shape) < share
            found = set()
            for start, end in images.outline(mask).astype(int):
                step = (end - start) // np.abs(end - start).max()
                ends = [start + k * step for k in range(np.abs(end - start).max() + 1)]
                pieces = {(*map(int, one), *map(int, other)) for one, other in itertools.pairwise(ends)}
                assert not pieces & found
                found |= pieces
            assert found == sides(mask)


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
    places = np.array([[0, 1, count], [1, count + 1, count]])
    triangles = (corner[:, None, None] + places).reshape(-1, 3)
    coarse, kept = model_view.coarsened(vertices, triangles, 5_000)
    assert 500 < len(kept) <= 5_000
    np.testing.assert_allclose(coarse[:, 2], 0.1 * np.sin(3 * coarse[:, 0]), atol=1e-3)
    np.testing.assert_allclose(coarse[:, 3], coarse[:, 0] + coarse[:, 1], atol=1e-9)
    one, other = coarse[kept[:, 1]] - coarse[kept[:, 0]], coarse[kept[:, 2]] - coarse[kept[:, 0]]
    assert (np.cross(one[:, :3], other[:, :3])[:, 2] <= 1e-12).all()  # all still face the same way
    same, all_of_them = model_view.coarsened(vertices, triangles, len(triangles))
    assert same is vertices
    assert all_of_them is triangles


def test_model_and_graph_are_drawn_a_number_of_times_that_hardly_grows(run: list[Step]) -> None:
    view = run[0].views[0]
    steps = [replace(run[1], views=dict.fromkeys(range(count), view)) for count in range(1, 1001)]
    due = [count for count, step in enumerate(steps, 1) if all_due(step)]
    assert due[:99] == list(range(1, 100))  # every frame of a short run
    assert len(due) < 300
    assert max(np.diff(due[98:]) / due[99:]) <= 1 / 50  # never far behind
    assert all_due(replace(steps[-2], last=True))


def test_between_those_times_no_model_is_made(run: list[Step], tmp_path: Path) -> None:
    made: list[int] = []

    def counted(count: int) -> None:
        made.append(count)

    view = run[0].views[0]
    with closing(open_stream("long", save=tmp_path / "long.rrd")) as stream:
        for count in range(100, 106):
            views = dict.fromkeys(range(count), view)
            stream(replace(run[1], views=views, make_model=partial(counted, count)))
    assert made == [100, 102, 104]
