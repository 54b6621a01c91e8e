"""A robot's hand drawn from its poses: what lies within its capsules is marked, what lies before or behind is not."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modeler import se3
from modeler.sequences import open_sequence, write_bop
from modeler.sequences.base import AbstractDerived
from modeler.sequences.hand_shapes import HandMarkedSequence, HandShape
from modeler.types import Camera, Frame, HandPoses, InputError

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
FINGER = HandShape(np.array([[[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]]), np.array([0.02]), 0.005)
AHEAD = se3.translation(np.array([0.0, 0.0, 0.5]))  # a bar across the image, half a metre away
ROBOT = "".join(f"{k} 0 0 0.5 0 0 0 1\n" for k in range(3))
HAND = {"capsules": [{"from_m": [-0.1, 0, 0], "to_m": [0.1, 0, 0], "radius_m": 0.02}], "margin_m": 0.005}


def frame(depth_m: float, index: int = 0) -> Frame:
    return Frame(index, float(index), np.full((48, 64), depth_m, dtype=np.float32), CAMERA)


def test_what_is_measured_within_the_hand_is_marked_and_nothing_before_or_behind_it() -> None:
    marks = FINGER.marked(frame(0.5), AHEAD)
    rows, columns = np.nonzero(marks)
    assert np.all(np.abs(rows - 23.5) / 60.0 * 0.5 <= 0.025)
    assert marks[23, 31]
    assert marks.sum() == pytest.approx((0.25 + 2 * 0.0125) * 120.0 * 0.05 * 120.0, rel=0.15)
    assert columns.min() == 31 - (columns.max() - 32)  # alike on both sides
    for depth_m in (0.45, 0.55):
        assert not FINGER.marked(frame(depth_m), AHEAD).any()


def test_where_nothing_was_measured_the_ray_decides() -> None:
    """A hand that is shiny or too near has no depth; a ray as far as its radius from the bar meets it."""
    blind = FINGER.marked(frame(np.nan), AHEAD)
    elevation = np.arctan((np.nonzero(blind[:, 31])[0] - 23.5) / 60.0)
    assert np.abs(0.5 * np.sin(elevation)).max() == pytest.approx(0.025, abs=0.5 / 60.0)
    assert np.all(blind[FINGER.marked(frame(0.5), AHEAD)])
    behind = se3.translation(np.array([0.0, 0.0, -0.5]))
    assert not FINGER.marked(frame(np.nan), behind).any()


def test_the_marks_go_with_the_camera(rng: np.random.Generator) -> None:
    """Ends turned in the hand's frame, and the pose turned back, mark the same; a point is a ball."""
    turn = se3.exp(rng.normal(size=6))
    turned = HandShape(se3.transform(turn, FINGER.ends_m[0])[None], FINGER.radii_m, FINGER.margin_m)
    np.testing.assert_array_equal(
        FINGER.marked(frame(0.5), AHEAD), turned.marked(frame(0.5), AHEAD @ se3.inverse(turn))
    )
    ball = replace(FINGER, ends_m=np.zeros((1, 2, 3)))
    assert ball.marked(frame(0.5), AHEAD).sum() == pytest.approx(np.pi * (0.025 * 120.0) ** 2, rel=0.2)


class Marked(AbstractDerived):
    """A sequence in whose frames a corner is marked."""

    def frame(self, index: int) -> Frame:
        corner = np.zeros((48, 64), dtype=bool)
        corner[0, 0] = True
        return replace(self.whole.frame(index), occluder=corner)


def test_marks_of_masks_remain(tmp_path: Path) -> None:
    poses = HandPoses(np.arange(2.0), np.stack([AHEAD, AHEAD]))
    plain = open_sequence(written(tmp_path / "scene", None))
    occluder = HandMarkedSequence(Marked(plain), FINGER, poses).frame(1).occluder
    assert occluder[0, 0]
    assert occluder[23, 31]


def written(folder: Path, hand: object, robot: str | None = ROBOT) -> Path:
    frames = [frame(0.5, k) for k in range(3)]
    files = {} if robot is None else {"robot.txt": robot.encode()}
    write_bop(folder, frames, None, {"name": "gripped", "hand": hand}, files=files)
    return folder


def test_a_sequence_that_states_the_hand_marks_it(tmp_path: Path) -> None:
    sequence = open_sequence(written(tmp_path / "scene", HAND))
    for read in sequence:
        np.testing.assert_array_equal(read.occluder, FINGER.marked(frame(0.5), AHEAD))
    assert sequence.select(2).indices == (0, 2)


@pytest.mark.parametrize(
    ("hand", "robot", "says"),
    [
        (HAND, None, "no robot.txt"),
        (HAND, "0 0 0 0.5 0 0 0 1\n", "no pose for frame 1"),
        ({"capsules": HAND["capsules"]}, ROBOT, 'lacks "margin_m"'),
        ({**HAND, "capsules": []}, ROBOT, "a list of 1 to 100 capsules"),
        ({**HAND, "mesh": 1}, ROBOT, '"mesh" is not known'),
        (
            {"capsules": [{"from_m": [0, 0], "to_m": [0, 0, 0], "radius_m": 1}], "margin_m": 0},
            ROBOT,
            "3 finite numbers",
        ),
        ({"capsules": [{"from_m": [0, 0, 0], "to_m": [0, 0, 0], "radius_m": 20}], "margin_m": 0}, ROBOT, "0.0001 to 1"),
    ],
)
def test_a_hand_that_cannot_be_is_refused_by_place(tmp_path: Path, hand: object, robot: str | None, says: str) -> None:
    folder = written(tmp_path / "scene", hand, robot)
    with pytest.raises(InputError) as refused:
        list(open_sequence(folder))
    assert says in str(refused.value), json.dumps(hand)
