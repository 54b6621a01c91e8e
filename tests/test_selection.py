"""Frames are selected by number, as slices are."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_scene import CAMERA, INDICES

from modeler.types import Frame, InputError
from sequences import frame_range
from sequences.base import AbstractSequence


@given(
    every=st.integers(1, 4),
    start=st.none() | st.integers(0, 14),
    stop=st.none() | st.integers(0, 14),
)
def test_selection_is_a_slice_of_frame_numbers(every: int, start: int | None, stop: int | None) -> None:
    whole = Numbers(INDICES)
    wanted = [i for i in INDICES if i in range(0 if start is None else start, 99 if stop is None else stop)][::every]
    if not wanted:
        with pytest.raises(InputError, match=r"leaves nothing .* 3 to 12, 3 frames"):
            whole.select(every, slice(start, stop))
        return
    part = whole.select(every, slice(start, stop))
    assert list(part.indices) == wanted == [f.index for f in part]
    assert part.name == whole.name
    part_truth = part.truth()
    assert part_truth is not None
    assert list(part_truth) == wanted
    for index in set(INDICES) - set(wanted):
        with pytest.raises(InputError, match="not among the selected"):
            part.frame(index)


class Numbers(AbstractSequence):
    """Empty frames of given numbers."""

    def __init__(self, numbers: tuple[int, ...]) -> None:
        self.numbers = numbers

    @property
    def name(self) -> str:
        return "numbers"

    @property
    def indices(self) -> tuple[int, ...]:
        return self.numbers

    def frame(self, index: int) -> Frame:
        return Frame(index, float(index), np.zeros((30, 40), np.float32), CAMERA)

    def truth(self) -> dict[int, np.ndarray] | None:
        return {index: np.eye(4) for index in self.numbers}

    def sensor(self) -> None:
        return None

    @property
    def motion(self) -> None:
        return None

    @property
    def robot_path(self) -> None:
        return None

    @property
    def model_path(self) -> None:
        return None


@pytest.mark.parametrize(
    ("text", "expected"),
    [("3:9", slice(3, 9)), (":4", slice(None, 4)), ("2:", slice(2, None)), (":", slice(None, None))],
)
def test_ranges_of_frames_are_read(text: str, expected: slice) -> None:
    assert frame_range(text) == expected


@pytest.mark.parametrize("text", ["", "3", "a:b", "1:2:3", "-1:3", "1.5:2", "\u0661:\u0662"])
def test_other_ranges_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="A:B"):
        frame_range(text)


def test_every_zeroth_frame_is_refused() -> None:
    with pytest.raises(InputError, match="at least 1"):
        Numbers(INDICES).select(0)
