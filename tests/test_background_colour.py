"""Masks by depth that hold more than the object, and what the colours of the static background take off them."""

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from modeler.segmentation.background_colour import BackgroundColour, without_background
from modeler.types import BoolArray, Camera, Frame

CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
WALL, FLOOR, RED = (150, 140, 60), (170, 170, 175), (180, 40, 30)
ROWS, COLUMNS = np.mgrid[:120, :160]


def frames_of(
    rgb: tuple[int, int, int], rng: np.random.Generator, shade: float = 1.0
) -> tuple[list[Frame], list[BoolArray], list[BoolArray]]:
    """Return frames of two posts that turn about an axis between them, before a wall and a floor.

    With the true masks, and those of a depth camera that widens outlines and closes narrow gaps.
    """
    frames, true, filled = [], [], []
    for k in range(12):
        across = 45.0 * np.cos(np.pi * k / 12.0)
        mask = np.minimum(np.abs(COLUMNS - 80.0 - across), np.abs(COLUMNS - 80.0 + across)) < 10.0
        mask &= np.abs(ROWS - 60) < 40
        colour = np.where((ROWS < 60)[..., None], WALL, FLOOR).astype(np.float64)
        shadow = ndimage.binary_dilation(mask, iterations=5) & ~mask
        colour[shadow] *= shade
        colour[mask] = rgb
        colour = np.clip(colour + rng.normal(0.0, 2.0, colour.shape), 0.0, 255.0).astype(np.uint8)
        wide = ndimage.binary_closing(ndimage.binary_dilation(mask, iterations=6), iterations=6)
        depth_m = np.where(wide, 0.6, 1.2).astype(np.float32)
        frames.append(Frame(k, float(k), depth_m, CAMERA, colour=colour))
        true.append(mask)
        filled.append(wide)
    return frames, true, filled


def share(some: BoolArray, of: BoolArray) -> float:
    return float(np.count_nonzero(some & of) / max(np.count_nonzero(of), 1))


@pytest.mark.parametrize("shade", [1.0, 0.8])
def test_what_depth_holds_too_much_goes_and_the_object_stays(shade: float, rng: np.random.Generator) -> None:
    frames, true, filled = frames_of(RED, rng, shade)
    background = BackgroundColour.learned(frames, filled)
    known = np.zeros(ROWS.shape, dtype=np.bool_)
    known[background.window] = background.known
    for frame, object_px, wide in zip(frames, true, filled, strict=True):
        found = without_background(wide, frame, background)
        rim = np.asarray(ndimage.binary_dilation(object_px, iterations=2), dtype=np.bool_)  # colours are smoothed
        assert share(found, wide & known & ~rim) < 0.05  # but along the line between wall and floor
        assert share(found, object_px) > 0.995


def test_an_object_of_the_backgrounds_colours_stays_whole(rng: np.random.Generator) -> None:
    for rgb in (WALL, FLOOR):
        frames, true, filled = frames_of(rgb, rng)
        background = BackgroundColour.learned(frames, filled)
        for frame, object_px, wide in zip(frames, true, filled, strict=True):
            assert share(without_background(wide, frame, background), object_px) > 0.97


def test_without_colours_or_with_few_frames_masks_are_as_depth_has_them(rng: np.random.Generator) -> None:
    frames, _, filled = frames_of(RED, rng)
    grey = [Frame(frame.index, frame.time_s, frame.depth_m, CAMERA) for frame in frames]
    assert BackgroundColour.learned(grey, filled) is None
    assert BackgroundColour.learned(frames[:2], filled[:2]) is None
    background = BackgroundColour.learned(frames, filled)
    for frame, wide in zip(grey, filled, strict=True):
        np.testing.assert_array_equal(without_background(wide, frame, background), wide)


def test_where_the_background_is_never_seen_depth_decides(rng: np.random.Generator) -> None:
    frames, _, filled = frames_of(RED, rng)
    always = [mask | (np.hypot(ROWS - 60, COLUMNS - 80) < 6.0) for mask in filled]  # as between legs
    background = BackgroundColour.learned(frames, always)
    for frame, wide in zip(frames, always, strict=True):
        assert without_background(wide, frame, background)[57:64, 77:84].all()


def test_colours_behind_an_object_are_those_that_other_frames_show(rng: np.random.Generator) -> None:
    frames, _, filled = frames_of(RED, rng)
    background = BackgroundColour.learned(frames, filled)
    rows, _ = background.window
    expected: npt.NDArray[np.int64] = np.where((ROWS < 60)[..., None], WALL, FLOOR)[background.window]
    assert rows.start > 0
    assert 0.3 < background.known.mean() < 1.0
    assert np.abs(background.mean - expected)[background.known].max() < 8.0
