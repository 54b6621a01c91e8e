"""Models of an object that lies still among others before a camera that moves."""

from dataclasses import replace

import numpy as np
import pytest
from segmentation_worlds import CAMERA, OBJECT, World, iou

import modeler
from modeler.pipeline.correcting import Majority
from modeler.runs.joining import edit
from modeler.runs.reopening import reopened
from modeler.segmentation import Segmenter
from modeler.types import Camera, Frame, Outcome, Step
from modeler.views import Sensor
from studies.formats.image_folders import raw_depth, save
from studies.formats.other_programs import write_camera


@pytest.fixture(scope="module")
def going_round():
    """Frames of a camera that is led round a table with three things, and the true pixels of the middle one."""
    views, rng = [], np.random.default_rng(0)
    for k in range(8):
        world = World(tilt_deg=35.0 + 4.0 * np.sin(k), distance_m=0.7 + 0.05 * np.cos(2.0 * k), turn_deg=12.0 * k)
        world.table().box((0.0, 0.0, 0.05), (0.05, 0.03, 0.05), label=OBJECT)
        world.box((0.17, 0.05, 0.04), (0.03, 0.05, 0.04)).box((-0.12, 0.15, 0.03), (0.04, 0.02, 0.03), turn_deg=40.0)
        views.append(world.frame(k, rng))
    return [frame for frame, _ in views], [mask for _, mask in views]


def test_a_view_holds_what_stands_beside_the_object(going_round):
    frames, masks = going_round
    segmenter = Segmenter()
    scene = segmenter.scene(frames)
    assert scene.camera_moves
    for frame, mask in zip(frames, masks, strict=True):
        found = segmenter.segment(frame, scene)
        seen = segmenter.with_surroundings(frame, found, scene)
        assert np.count_nonzero(seen.mask & ~mask) > np.count_nonzero(mask)
        assert np.count_nonzero(seen.mask & mask) > 0.9 * np.count_nonzero(mask)
        assert seen.plane is not None
        nothing = replace(found, mask=np.zeros_like(mask), outcome=Outcome.TOO_FEW_POINTS)
        assert (segmenter.with_surroundings(frame, nothing, scene).mask & mask).any()
        given = replace(frame, mask=mask)
        single = segmenter.segment(given, scene)
        assert segmenter.with_surroundings(given, single, scene) is single


def test_a_model_is_of_the_object_alone_and_stays_so_when_its_run_is_opened_again(going_round, tmp_path):
    frames, masks = going_round
    for frame in frames:
        save(tmp_path / "scan" / "depth" / f"{frame.index:06d}.png", raw_depth(frame, 0.1))
    write_camera(tmp_path / "scan", CAMERA, depth_scale=0.1)
    found = modeler.build(tmp_path / "scan", tmp_path / "run")
    assert sorted(found.solution.trajectory) == list(range(8))
    again = reopened(tmp_path / "run")
    for frame, mask in zip(frames, masks, strict=True):
        assert iou(again.views[frame.index].frame.mask, mask) > 0.85
    edit(tmp_path / "run", [3], tmp_path / "fewer", overwrite=False)
    fewer = reopened(tmp_path / "fewer").views
    assert sorted(fewer) == [0, 1, 2, 4, 5, 6, 7]
    for frame, view in fewer.items():
        np.testing.assert_array_equal(np.asarray(view.frame.mask), np.asarray(again.views[frame].frame.mask))
    (tmp_path / "fewer" / "masks.npz").write_bytes(b"no archive")
    with pytest.raises(modeler.InputError, match=r"masks\.npz: cannot be read"):
        reopened(tmp_path / "fewer")


def test_masks_that_most_frames_are_unsure_of_stay_unsure(going_round, monkeypatch):
    frames, _ = going_round
    segment = Segmenter.segment
    scene = Segmenter().scene(frames)
    for few in (range(1), range(3)):
        monkeypatch.setattr(
            Segmenter,
            "segment",
            lambda self, frame, scene, few=few: replace(
                segment(self, frame, scene), outcome=Outcome.UNSURE_MASK if frame.index in few else Outcome.CONVERGED
            ),
        )
        *_, last = modeler.Modeler().run(frames[:4], scene)
        assert isinstance(last, Step)
        assert ("unsure_masks" in [fault.code for fault in last.verdict.shortcomings]) == (len(few) > 2)


def true_and_wrong():
    """Return the pixels (h, w) of an object and of another thing."""
    true, wrong = np.zeros((2, 48, 64), dtype=np.bool_)
    true[15:30, 20:40], wrong[5:12, 45:60] = True, True
    return true, wrong


def majority(seen, found):
    """Return what most views say that see masks `seen` of a wall, and find `found` to be the object."""
    camera, rng = Camera(64, 48, 60.0, 60.0, 31.5, 23.5), np.random.default_rng(0)
    depth_m = np.full((48, 64), 0.5, np.float32) + rng.normal(0.0, 1e-4, (48, 64)).astype(np.float32)
    views = {k: Sensor().ray_image(Frame(k, float(k), depth_m, camera, mask)) for k, mask in enumerate(seen)}
    return Majority(views, found.__getitem__, dict.fromkeys(views, np.eye(4)), 0.01)


def test_masks_are_those_of_most_views():
    true, wrong = true_and_wrong()
    found = [true, true, true, wrong, true]
    most = majority([np.ones_like(true)] * 5, found)
    for frame in range(5):
        assert iou(most.mask(frame), true) > 0.9
    assert most.sure
    other = [true, true, wrong, wrong.T[:48, :48].repeat(2, axis=1)[:, :64], ~true & ~wrong]
    assert not majority([np.ones_like(true)] * 5, other).sure


def test_a_thing_that_few_views_take_for_the_object_is_no_part_of_it():
    true, wrong = true_and_wrong()
    seen = [~wrong] * 3 + [np.ones_like(true)] * 2  # who alone sees it
    most = majority(seen, [true, true, true, wrong, wrong])
    for frame in range(5):
        assert not (most.mask(frame) & wrong).any()
        assert iou(most.mask(frame), true) > 0.9
