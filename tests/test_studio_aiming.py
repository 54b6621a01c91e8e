"""What is said of the newest view of a capture, and the outline of the next one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modeler import se3
from modeler.segmentation import Segmenter
from modeler.sequences import open_sequence
from modeler.studio.capture import ghost, is_filled, nothing_near, suggested_turn_deg, too_far
from modeler.types import Camera, Frame, SensorNoise
from modeler.views import Sensor

BOX = Path(__file__).parents[1] / "sequences" / "bundled" / "box"
SENSOR = Sensor(SensorNoise(sigma_r_m=None))
STEPS = np.full((60, 80), 1.0, np.float32)
STEPS[20:40, 30:50] = 0.7


def at(distance_m: float) -> Frame:
    """Return a frame of the same object, whose image becomes smaller with the distance."""
    side = round(24.0 / distance_m)
    depth_m = np.full((96, 96), np.nan, np.float32)
    rows = np.arange(side, dtype=np.float32)[:, None]
    depth_m[40 : 40 + side, 40 : 40 + side] = distance_m + 0.1 * np.abs(rows / side - 0.5)
    return Frame(0, 0.0, depth_m, Camera(96, 96, 240.0, 240.0, 47.5, 47.5), depth_m > 0.0)


def test_holes_that_were_filled_are_noticed() -> None:
    holes = STEPS.copy()
    holes[20:40, 28:30] = np.nan
    assert is_filled(STEPS)
    assert not is_filled(holes)
    assert not is_filled(np.ones_like(STEPS))  # a plane has no edges
    assert not is_filled(open_sequence(BOX).frame(0).depth_m)


def test_an_object_below_the_cameras_range_leaves_no_depth_in_the_middle() -> None:
    near = STEPS.copy()
    near[10:50, 15:65] = np.nan
    assert nothing_near(near)
    assert not nothing_near(STEPS)


def test_an_object_is_too_far_until_it_is_as_near_as_advised() -> None:
    assert too_far(SENSOR.ray_image(at(0.5))) == ""
    far = too_far(SENSOR.ray_image(at(2.4)))
    assert far.startswith("too far for its size: at 2.")
    advised_m = float(far.split("nearer, to ")[1].split(" m")[0])
    assert too_far(SENSOR.ray_image(at(0.95 * advised_m))) == ""


def alike(one: np.ndarray, other: np.ndarray) -> float:
    """Return the intersection over the union of two masks (h, w), the first moved onto the second."""
    shift = np.rint(np.mean(np.nonzero(other), axis=1) - np.mean(np.nonzero(one), axis=1)).astype(int)
    moved = np.roll(one, tuple(shift), axis=(0, 1))
    return float(np.count_nonzero(moved & other) / np.count_nonzero(moved | other))


@pytest.mark.parametrize(
    ("words", "turn_deg"),
    [
        ("next: turn by 40° (counter-clockwise from above)", 40.0),
        ("next: turn by 40° (clockwise from above)", -40.0),
        ("next: turn by 25° (either way)", 25.0),
        ("nothing more to gain", None),
        ("next: lay it on its side, as a separate run to join", None),
    ],
)
def test_the_turn_is_read_from_what_a_build_says(words: str, turn_deg: float | None) -> None:
    assert suggested_turn_deg(words) == turn_deg


def test_the_next_view_covers_its_outline() -> None:
    sequence = open_sequence(BOX)
    truth, indices = sequence.truth(), sequence.indices
    frames = [sequence.frame(index) for index in indices]
    scene = Segmenter().scene([replace(frame, mask=None) for frame in frames])
    masks = {frame.index: Segmenter().segment(frame, scene).mask for frame in frames}
    seen, following = frames[:-1], frames[-1]
    poses = [{"id": frame.index, "object_from_camera": se3.inverse(truth[frame.index])} for frame in seen]
    turn = se3.log(se3.inverse(truth[following.index]) @ truth[seen[-1].index])[:3]
    step = float(np.linalg.norm(turn))
    # The new camera is the old one turned the other way.
    report = {"poses": poses, "up": [*turn / step]}
    expected = ghost({frame.index: (frame, masks[frame.index]) for frame in seen}, report, -np.degrees(step))
    found, still = masks[following.index], masks[seen[-1].index]
    # The object was moved by the way, which no suggestion knows: outlines are compared, not places.
    assert alike(expected, found) > 0.93 > 0.88 > alike(still, found)
    assert not ghost({0: (frames[0], masks[0])}, {"poses": []}, 20.0).any()  # none is placed yet
