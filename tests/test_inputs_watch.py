"""Frames taken while another program writes them."""

import shutil
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from modeler.sequences import (
    AbstractSequence,
    BopSequence,
    Overrides,
    WatchLimits,
    open_sequence,
    opening,
    watch,
    write_bop,
)
from modeler.sequences.base import AbstractDerived
from modeler.sequences.opening import POLL_S, _state, arriving
from modeler.types import Frame, InputError
from studies.formats.image_folders import small_frames, write_bundlesdf, write_tum

QUICK = WatchLimits(idle_s=1.0, settle_s=0.2, first=2)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return small_frames(5)


@pytest.fixture
def writing() -> Iterator[Callable[[Callable[[], None]], None]]:
    """Return what runs a function beside the test, and make sure that it comes to an end."""
    threads: list[threading.Thread] = []

    def start(target: Callable[[], None]) -> None:
        threads.append(threading.Thread(target=target))
        threads[-1].start()

    yield start
    for thread in threads:
        thread.join(timeout=20)
        assert not thread.is_alive()


def copy_in_halves(source: Path, target: Path) -> None:
    """Write a file as slow programs do: half of it first."""
    target.parent.mkdir(parents=True, exist_ok=True)
    content = source.read_bytes()
    with target.open("wb") as file:
        file.write(content[: len(content) // 2])
        file.flush()
        time.sleep(0.03)
        file.write(content[len(content) // 2 :])


def test_frames_are_taken_whole_as_they_come(
    tmp_path: Path, frames: list[Frame], writing: Callable[[Callable[[], None]], None]
) -> None:
    """Depth first, then mask and colour, the camera entries last, every file in two halves."""
    done, live = tmp_path / "done", tmp_path / "live"
    write_bop(done, frames, depth_scale_mm=1.0)

    def write() -> None:
        time.sleep(0.1)  # the folder is not there yet
        for index in range(len(frames)):
            copy_in_halves(done / "depth" / f"{index:06d}.png", live / "depth" / f"{index:06d}.png")
            copy_in_halves(done / "rgb" / f"{index:06d}.png", live / "rgb" / f"{index:06d}.png")
            name = f"{index:06d}_000000.png"
            copy_in_halves(done / "mask_visib" / name, live / "mask_visib" / name)
            copy_in_halves(done / "scene_camera.json", live / "scene_camera.json")

    writing(write)
    sequence = watch(live, patience=QUICK)
    assert sequence.live
    assert 2 <= len(sequence) <= len(frames)
    taken = list(sequence)
    assert [frame.index for frame in taken] == [0, 1, 2, 3, 4]
    for read, wrote in zip(taken, frames, strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, atol=1e-6)
        np.testing.assert_array_equal(read.mask, wrote.mask)  # type: ignore[arg-type]
        np.testing.assert_array_equal(read.colour, wrote.colour)  # type: ignore[arg-type]


def test_a_folder_is_opened_anew_only_once_it_has_changed(
    tmp_path: Path, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Path] = []

    def counted(path: Path, *more: Any) -> AbstractSequence:
        opened.append(path)
        return open_sequence(path, *more)

    monkeypatch.setattr(opening, "open_sequence", counted)
    write_bop(tmp_path / "s", frames, depth_scale_mm=1.0)
    arrived = arriving(tmp_path / "s", Overrides(), QUICK, lambda: False)
    assert [frame.index for frame in arrived] == [0, 1, 2, 3, 4]
    assert len(opened) == 2  # once more for the newest, which others of its files may have followed


def test_a_list_that_grows_is_followed(
    tmp_path: Path, frames: list[Frame], writing: Callable[[Callable[[], None]], None]
) -> None:
    write_tum(tmp_path / "s", frames)
    lines = (tmp_path / "s" / "depth.txt").read_text().splitlines()

    def write() -> None:
        for count in range(4, len(lines) + 1):
            (tmp_path / "s" / "depth.txt").write_text("\n".join(lines[:count]))
            time.sleep(0.15)
        (tmp_path / "s" / "done").touch()

    (tmp_path / "s" / "depth.txt").write_text("\n".join(lines[:4]))
    writing(write)
    began = time.monotonic()
    sequence = watch(tmp_path / "s", patience=WatchLimits(idle_s=15.0, settle_s=0.05, first=2))
    assert [frame.index for frame in sequence] == [0, 1, 2, 3, 4]
    assert time.monotonic() - began < 10.0  # `done` ends it, not patience


def test_what_was_there_before_comes_first_and_selection_holds(tmp_path: Path, frames: list[Frame]) -> None:
    write_bundlesdf(tmp_path / "s", frames)
    (tmp_path / "s" / "done").touch()
    sequence = watch(tmp_path / "s", patience=QUICK)
    assert [frame.index for frame in sequence.select(every=2)] == [0, 2, 4]
    assert [frame.index for frame in sequence.select(frames=slice(1, 4)).select(every=2)] == [1, 3]
    assert sequence.select(every=2).indices == (0,)  # of the two that were awaited
    assert sequence.name == "s"
    assert "being written" in sequence.layout
    with pytest.raises(InputError, match="at least 1"):
        sequence.select(every=0)


def test_it_ends_when_asked(tmp_path: Path, frames: list[Frame]) -> None:
    write_bop(tmp_path / "s", frames)
    sequence = watch(tmp_path / "s", patience=WatchLimits(idle_s=60.0, settle_s=0.0, first=1))
    taken: list[int] = []
    for frame in sequence.until(lambda: len(taken) == 2):
        taken.append(frame.index)
    assert taken == [0, 1]


def test_nothing_or_nothing_readable_is_one_line(tmp_path: Path, frames: list[Frame]) -> None:
    brief = WatchLimits(idle_s=0.3, settle_s=0.05, first=2)
    with pytest.raises(InputError, match="no such folder"):
        watch(tmp_path / "nowhere", patience=brief)
    write_bop(tmp_path / "s", frames)
    for depth in (tmp_path / "s" / "depth").iterdir():
        depth.write_bytes(b"\x89PNG half")
    with pytest.raises(InputError, match=r"000000\.png: is not a readable"):
        watch(tmp_path / "s", patience=brief)
    shutil.rmtree(tmp_path / "s" / "depth")
    (tmp_path / "s" / "depth").mkdir()
    with pytest.raises(InputError, match="holds no depth image"):
        watch(tmp_path / "s", patience=brief)


def test_what_cannot_be_read_in_the_end_is_left_out_and_said(
    tmp_path: Path, frames: list[Frame], caplog: pytest.LogCaptureFixture
) -> None:
    """The writer died in its last frame, and another one is damaged."""
    write_bop(tmp_path / "s", frames)
    sequence = watch(tmp_path / "s", patience=QUICK)
    for name in ("000003.png", "000004.png"):
        depth = tmp_path / "s" / "depth" / name
        depth.write_bytes(depth.read_bytes()[:200])
    assert [frame.index for frame in sequence] == [0, 1, 2]
    for name in ("000003.png", "000004.png"):
        assert name in caplog.text
    assert caplog.text.count("continuing with the frames so far") == 2


def test_frames_behind_one_that_cannot_be_read_are_not_lost_at_the_end(tmp_path: Path, frames: list[Frame]) -> None:
    """The mark of the end comes before the damaged frame was looked at for the first time."""
    write_tum(tmp_path / "s", frames, {})
    damaged = sorted((tmp_path / "s" / "depth").iterdir())[3]
    damaged.write_bytes(damaged.read_bytes()[:40])
    (tmp_path / "s" / "done").touch()
    found = [frame.index for frame in arriving(tmp_path / "s", Overrides(), QUICK, lambda: False)]
    assert found == [0, 1, 2, 4]


@pytest.mark.parametrize("lost", ["s", "s/scene_camera.json"])
def test_what_goes_away_ends_the_sequence(
    tmp_path: Path, frames: list[Frame], caplog: pytest.LogCaptureFixture, lost: str
) -> None:
    write_bop(tmp_path / "s", frames)
    coming = iter(watch(tmp_path / "s", patience=QUICK))
    assert next(coming).index == 0
    (tmp_path / lost).rename(tmp_path / "away")
    rest = [frame.index for frame in coming]
    assert rest == [1, 2, 3, 4][: len(rest)]
    assert "continuing with the frames so far" in caplog.text


def test_frames_that_come_late_are_not_lost(tmp_path: Path, frames: list[Frame]) -> None:
    write_bop(tmp_path / "s", frames)
    late = tmp_path / "s" / "depth" / "000002.png"
    late.rename(tmp_path / "late.png")
    taken = []
    for frame in watch(tmp_path / "s", patience=QUICK):
        taken.append(frame.index)
        if frame.index == 4:
            (tmp_path / "late.png").rename(late)
    assert taken == [0, 1, 3, 4, 2]


def test_the_state_of_a_folder_is_another_once_a_file_in_it_is(tmp_path: Path, frames: list[Frame]) -> None:
    folder = tmp_path / "s"
    write_bop(folder, frames)
    for place in (folder, folder / "rgb"):
        (place / ".#lock").symlink_to("nobody@nowhere.1")  # as editors lock files
    new = folder / "depth" / "000009.png"
    states = [_state(folder)]
    for act in (
        new.touch,
        lambda: new.write_bytes(b"more"),
        lambda: new.rename(new.with_name("000010.png")),
        (folder / "rgb" / "000000.png").unlink,
        (folder / "scene_camera.json").touch,
        lambda: shutil.rmtree(folder),
    ):
        act()
        states.append(_state(folder))
        assert _state(folder) == states[-1]
    assert len({*states}) == len(states)


def test_a_damaged_frame_is_tried_less_and_less_often(
    tmp_path: Path, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    """But before the end, and it is taken if it was mended."""
    now_s, tried = 0.0, []

    def rest(seconds: float) -> None:
        nonlocal now_s
        now_s += seconds
        if now_s > 300.0 and not (tmp_path / "s" / "done").exists():
            damaged.write_bytes(content)
            (tmp_path / "s" / "done").touch()

    def noted(path: Path, *more: Any) -> AbstractSequence:
        found = open_sequence(path, *more)
        assert isinstance(found, BopSequence)
        return Noted(found, tried)

    write_bop(tmp_path / "s", frames, depth_scale_mm=1.0)
    damaged = tmp_path / "s" / "depth" / "000001.png"
    content = damaged.read_bytes()
    damaged.write_bytes(content[:40])
    monkeypatch.setattr(opening, "time", SimpleNamespace(monotonic=lambda: now_s, sleep=rest))
    monkeypatch.setattr(opening, "open_sequence", noted)
    arrived = arriving(tmp_path / "s", Overrides(), WatchLimits(idle_s=1000.0), lambda: False)
    assert [frame.index for frame in arrived] == [0, 2, 3, 4, 1]
    assert tried.count(1) <= 4 + np.log2(300.0 / POLL_S)


@dataclass(frozen=True)
class Noted(AbstractDerived):
    """Another sequence, with the numbers of the frames that were asked for."""

    tried: list[int]

    def frame(self, index: int) -> Frame:
        self.tried.append(index)
        return self.whole.frame(index)


def test_frames_that_were_taken_or_cannot_be_read_leave_their_names_alone(tmp_path: Path) -> None:
    """Some hundred bytes of memory each, where an image takes 80,000; one of ten is damaged."""
    count, pixels = 400, np.random.default_rng(0).integers(500, 600, (100, 200), dtype=np.uint16)
    (tmp_path / "depth").mkdir()
    Image.fromarray(pixels).save(tmp_path / "depth" / "000000.png")
    content = (tmp_path / "depth" / "000000.png").read_bytes()
    for number in range(1, count):
        whole = len(content) // (2 if number % 10 == 0 else 1)
        (tmp_path / "depth" / f"{number:06d}.png").write_bytes(content[:whole])
    (tmp_path / "camera.json").write_text('{"fx": 200, "fy": 200, "cx": 100, "cy": 50}')
    held: list[int] = []
    tracemalloc.start()
    for _ in arriving(tmp_path, Overrides(), WatchLimits(settle_s=0.0), lambda: len(held) > 300):
        held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert (held[300] - held[100]) / 200 < 400
