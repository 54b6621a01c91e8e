"""What hides the object: neither object nor empty space, whoever says where it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bop_scenes import INDICES, META, random_frames
from PIL import Image
from segmentation_worlds import OBJECT, World, filmed, iou, least_iou, segmented
from test_visibility import flashlight  # noqa: F401  a fixture

from modeler import se3
from modeler.evaluation import rotation_error_deg
from modeler.fusion.depth_views import Cropping, crop
from modeler.kernels.planes import KIND, RAGGED
from modeler.kernels.point_likelihood import UNKNOWN
from modeler.pipeline.pairs import prepare
from modeler.priors import TablePrior
from modeler.registration import VisibilityRegistrar
from modeler.registration.visibility import VisibilityLikelihood
from modeler.segmentation import Scene, Segmenter
from modeler.sequences import BopSequence, open_sequence, write_bop
from modeler.types import BoolArray, Frame, InputError, Outcome, SensorNoise
from modeler.views import Sensor
from studies.formats.image_folders import write_open3d, write_tum


def rod(frame: Frame, column: int) -> BoolArray:
    """A rod from top to bottom, 12 px wide."""
    place = np.zeros(frame.depth_m.shape, dtype=bool)
    place[:, column - 6 : column + 6] = True
    return place


def middle(frame: Frame) -> int:
    assert frame.mask is not None
    return int(np.median(np.nonzero(frame.mask)[1]))


def held(frame: Frame, depth_m: float, *, in_mask: bool) -> Frame:
    """A rod before the object, said to be there, at a depth and as object or not."""
    place = rod(frame, middle(frame))
    depth = np.where(place, np.float32(depth_m), frame.depth_m)
    return replace(frame, depth_m=depth, mask=frame.mask & ~place | (place & in_mask), occluder=place)


def test_nothing_that_an_occluder_measures_counts(flashlight, rng) -> None:  # noqa: F811
    """Whatever it measured, and whether the mask holds it: the same view, likelihood and fused pixels, to the bit."""
    frames, plane, sensor, truth = flashlight
    source = sensor.ray_image(frames[1], plane)
    views = [
        sensor.ray_image(held(frames[0], depth_m, in_mask=in_mask), plane)
        for depth_m, in_mask in ((0.5, False), (0.5, True), (3.0, False), (np.nan, True))
    ]
    whole = slice(0, frames[0].camera.height), slice(0, frames[0].camera.width)
    parts = [crop(view, whole, Cropping(2, 0.15, 0.1)) for view in views]
    likes = [
        VisibilityLikelihood().between(source, view, np.random.default_rng(0)).scores(truth[None], 0.001, stride=1)
        for view in views
    ]
    place = rod(frames[0], middle(frames[0]))
    for view, part, like in zip(views, parts, likes, strict=True):
        assert (view.layers["cells"][place][:, KIND] == RAGGED).all()
        np.testing.assert_array_equal(view.layers["cells"], views[0].layers["cells"])
        assert like == likes[0]
        for image in (part.free_m, part.background_m):
            assert (image[place] == 0.0).all()
        assert (part.index[place] == -1).all()


def test_points_behind_an_occluder_count_nothing(flashlight) -> None:  # noqa: F811
    """Under the true pose, and under one that takes the surface far away."""
    frames, plane, sensor, truth = flashlight
    hidden = sensor.ray_image(held(frames[0], 0.5, in_mask=False), plane)
    pair = VisibilityLikelihood().between(sensor.ray_image(frames[1]), hidden, np.random.default_rng(0))
    camera, place = frames[0].camera, rod(frames[0], middle(frames[0]))
    for pose in (truth, se3.translation(np.array([0.0, 0.0, 0.3])) @ truth):
        x, y, z = se3.transform(pose, pair.forward.points[:, :3]).T
        columns, rows = np.rint(camera.fx * x / z + camera.cx), np.rint(camera.fy * y / z + camera.cy)
        inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
        behind = np.flatnonzero(inside)[place[rows[inside].astype(int), columns[inside].astype(int)]]
        assert len(behind) > 20
        points = replace(replace(pair.forward, image=replace(hidden, plane=None)), points=pair.forward.points[behind])
        assert (points.classify(se3.rows(pose)) == UNKNOWN).all()
        behind_camera = np.array([[0.0, 0.0, -5.0, 0.0, 0.0, -1.0, 1e-6, 0.0, 0.0, 0.0]])
        averted = replace(points, points=behind_camera)  # counts 0, too
        one_way = replace(pair, forward=points, backward=averted)
        plain, explained, _ = one_way.scores(pose[None], 0.001, stride=1)
        assert plain[0] == 0.0
        assert explained[0] == 0.0


def test_a_hand_in_the_mask_does_no_harm_where_it_is_said_to_be_one(flashlight) -> None:  # noqa: F811
    """It moves against the object: taken for object, it leads poses astray."""
    frames, plane, sensor, truth = flashlight
    errors_deg = {}
    for said in (False, True):
        both = []
        for frame, shift_px in zip(frames, (-8, 8), strict=True):
            place = rod(frame, middle(frame) + shift_px)
            place[:, : middle(frame) + shift_px + 6] |= place[:, -1:]
            depth_m = np.where(place, np.float32(np.nanmedian(frame.depth_m[frame.mask]) - 0.03), frame.depth_m)
            mask = frame.mask | place
            both.append(replace(frame, depth_m=depth_m, mask=mask, occluder=place if said else None))
        target, source = (sensor.ray_image(frame, plane) for frame in both)
        prior = TablePrior().between(source, target)
        posterior = VisibilityRegistrar().register(source, target, prior, rng=np.random.default_rng(0))
        errors_deg[said] = rotation_error_deg(posterior.pose.mean, truth)
    assert errors_deg[True] < 3.0
    assert errors_deg[False] > 2.0 * errors_deg[True]


def test_colours_beside_an_occluder_may_be_its_own(flashlight) -> None:  # noqa: F811
    frames, plane, sensor, _ = flashlight
    whole = slice(0, frames[0].camera.height), slice(0, frames[0].camera.width)
    part = crop(sensor.ray_image(held(frames[0], 0.5, in_mask=False), plane), whole, Cropping(2, 0.15, 0.1))
    beside = part.index[:, middle(frames[0]) + 6]
    assert (part.clearance[beside[beside >= 0]] < 0.3).all()


def standing(k: int) -> World:
    """A box on a table, turned by 25° from frame to frame."""
    return World().table().box((0.0, 0.0, 0.07), (0.06, 0.035, 0.07), turn_deg=25.0 * k, label=OBJECT)


def test_an_arm_that_comes_before_the_object_now_and_then_is_no_part_of_it(rng) -> None:
    """While a person walks behind; nobody says where the arm is."""

    def world(k):
        passed = standing(k).box((-0.4 + 0.05 * k, 0.35, 0.2), (0.06, 0.02, 0.2))
        return passed.box((0.2, -0.2, 0.1 + 0.01 * k), (0.19, 0.02, 0.02)) if k % 4 == 2 else passed

    frames, masks = filmed(8, rng, world)
    assert least_iou(segmented(frames), masks) > 0.94


def test_an_arm_in_every_frame_is_no_part_of_the_object(rng) -> None:
    """It reaches over the table and hides another part in every frame, some in two; nobody says where it is."""

    def world(k):
        return standing(k).box((0.17 + 0.01 * (k % 3), -0.12, arms_m[k]), (0.2, 0.02, 0.02))

    for lowest_m, highest_m in ((0.05, 0.09), (0.09, 0.11)):
        arms_m = rng.uniform(lowest_m, highest_m, 8)
        frames, masks = filmed(8, rng, world)
        found = segmented(frames)
        assert [one.outcome for one in found] == [Outcome.CONVERGED] * len(frames)
        assert least_iou(found, masks) > 0.9


def test_a_frame_that_shows_only_an_arm_shows_no_object(rng) -> None:
    def world(k):
        some = World().table().box((0.17, -0.08, 0.05 + 0.01 * (k % 4)), (0.2, 0.02, 0.02))
        return some if k == 3 else some.box((0.0, 0.0, 0.05), (0.05, 0.035, 0.05), turn_deg=25.0 * k, label=OBJECT)

    assert segmented(filmed(8, rng, world)[0])[3].outcome is not Outcome.CONVERGED


def test_a_hand_that_touches_the_object_is_no_part_of_it_where_it_is_marked(rng) -> None:
    seen, masks = filmed(6, rng, lambda k: standing(k).box((0.13, 0.0, 0.12), (0.1, 0.02, 0.02), label=2))
    _, bare = filmed(6, rng, lambda k: World().box((0.13, 0.0, 0.12), (0.1, 0.02, 0.02), label=OBJECT))
    hands = [hand & ~mask for hand, mask in zip(bare, masks, strict=True)]
    frames = [replace(frame, occluder=hand) for frame, hand in zip(seen, hands, strict=True)]
    segmenter = Segmenter()
    scene = segmenter.scene(frames)
    for frame, mask, hand in zip(frames, masks, hands, strict=True):
        prepared = prepare(frame, scene, segmenter, Sensor(SensorNoise(0.001, 0.001)))
        assert iou(prepared.segmentation.mask, mask) > 0.94
        assert np.isnan(prepared.view.frame.depth_m[hand]).all()
        assert np.isfinite(prepared.frame.depth_m[hand]).any()  # as read, for whoever looks at it
    marked = segmenter.segment(replace(frames[0], mask=masks[0] | hands[0]), Scene())
    assert not (marked.mask & hands[0]).any()


def hand_image(frame: Frame) -> BoolArray:
    return rod(frame, 20)


def test_hands_of_a_scene_folder_are_read_and_written(tmp_path: Path) -> None:
    frames = random_frames()
    said = [replace(frame, occluder=hand_image(frame)) for frame in frames]
    write_bop(tmp_path / "s", said, None, META)
    for frame, wrote in zip(BopSequence(tmp_path / "s"), said, strict=True):
        np.testing.assert_array_equal(frame.occluder, hand_image(frame))
        np.testing.assert_array_equal(frame.mask, wrote.mask)


def test_the_value_128_of_a_mask_is_a_hand(tmp_path: Path) -> None:
    write_bop(tmp_path / "s", random_frames(), None, META)
    labels = np.zeros((30, 40), np.uint8)
    labels[5:10], labels[10:20], labels[20:25] = 255, 128, 1
    Image.fromarray(labels).save(tmp_path / "s/mask_visib" / f"{INDICES[0]:06d}_000000.png")
    first, *others = BopSequence(tmp_path / "s")
    np.testing.assert_array_equal(first.mask, labels == 255)  # graded: the middle of the range decides
    np.testing.assert_array_equal(first.occluder, labels == 128)
    assert all(frame.occluder is None for frame in others)


def test_a_hand_of_another_size_or_of_no_frame_is_reported(tmp_path: Path) -> None:
    write_bop(tmp_path / "s", random_frames(), None, META)
    (tmp_path / "s/mask_hand").mkdir()
    path = tmp_path / "s/mask_hand/left.png"
    Image.fromarray(np.zeros((20, 40), np.uint8)).save(path)
    (note,) = BopSequence(tmp_path / "s").notes
    assert "mask_hand" in note
    assert "left.png; a name such as" in note
    path.rename(path.with_name(f"{INDICES[0]:06d}_000000.png"))
    with pytest.raises(InputError, match="40 x 20"):
        BopSequence(tmp_path / "s").frame(INDICES[0])


@pytest.mark.parametrize("write", [write_tum, write_open3d])
def test_hands_of_other_folders_are_read(tmp_path: Path, frames: list[Frame], write) -> None:
    write(tmp_path / "s", frames)
    depth = sorted((tmp_path / "s/depth").iterdir())
    (tmp_path / "s/mask_hand").mkdir()
    for path, frame in zip(depth, frames, strict=True):
        Image.fromarray(hand_image(frame).astype(np.uint8)).save(tmp_path / "s/mask_hand" / path.name)
    for frame in open_sequence(tmp_path / "s"):
        np.testing.assert_array_equal(frame.occluder, hand_image(frame))
