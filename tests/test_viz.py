"""The recording holds what was promised, whatever a run brings."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.chunk
from PIL import Image
from streamed import MERGED, Recording, drawn, read, record
from turning_box import CENTRE_M, HALF_M, LOST, steps

from modeler.types import Failed, Outcome, Plane, PoseGaussian, Segmentation, Solution, Step
from viz import blueprint, entities, images, pair_view
from viz.stream import open_stream

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
    (depth,) = [archetype for path, archetype in images.draw_frame(step) if path == entities.DEPTH]
    assert isinstance(depth, rr.EncodedDepthImage)
    assert depth.blob is not None
    assert decoded(depth.blob.as_arrow_array().to_pylist()).shape == (240, 320)
    (mask,) = [archetype for path, archetype in images.draw_frame(step) if path == entities.MASK]
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
    bare = Step(blind, nothing, None, (), (), Failed(Outcome.TOO_FEW_POINTS), Solution(), None)
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
