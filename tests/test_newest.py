"""A source that is faster than the registration: nothing is lost, and a slow one is followed frame by frame."""

import os
import signal
import threading
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from test_pipeline import FRAMES, modeler, trajectory_error

from modeler.cli.console import Console, Interrupt
from modeler.export import RunFolder
from modeler.export.report import RunMeta
from modeler.pipeline import NewestFrames
from modeler.segmentation import Scene
from modeler.system.disk_arrays import ViewStore
from modeler.types import Frame, InputError, Step

WAIT_S = 20.0  # never reached unless the test fails


def at(times_s: list[float]) -> list[Frame]:
    return [replace(FRAMES[0], index=number, time_s=time_s) for number, time_s in enumerate(times_s)]


def numbers(frames: list[Frame]) -> list[int]:
    return [frame.index for frame in frames]


def test_a_slow_source_is_yielded_frame_by_frame() -> None:
    asked = threading.Semaphore(0)

    def slow() -> Iterator[Frame]:
        for frame in at([0.1 * k for k in range(6)]):
            assert asked.acquire(timeout=WAIT_S)
            yield frame

    asked.release()
    newest, seen = NewestFrames(slow(), lambda frame: frame), []
    for frame in newest:
        seen.append(frame.index)
        asked.release()
    assert seen == list(range(6))
    assert newest.skipped == []


def test_of_a_fast_source_the_newest_is_yielded_and_nothing_is_lost() -> None:
    read, kept = threading.Event(), []

    def fast() -> Iterator[Frame]:
        yield from at([0.1 * k for k in range(12)])
        read.set()

    def keep(frame: Frame) -> Frame:
        kept.append(frame.index)
        return frame

    newest, seen = NewestFrames(fast(), lay_aside=keep, max_gap_s=0.25), []
    for frame in newest:
        seen.append(frame)
        assert read.wait(WAIT_S)
    # Never more than 0.25 s at once, and neither the first nor the last is skipped.
    assert numbers(seen) == [0, 2, 4, 6, 8, 10, 11]
    assert numbers(newest.skipped) == [1, 3, 5, 7, 9]
    assert kept  # what waits is moved out of memory


def test_frames_that_come_late_are_filled_in_with_those_skipped() -> None:
    frames = at([float(k) for k in range(4)])
    newest = NewestFrames((frames[k] for k in (0, 2, 3, 1)), lambda frame: frame)
    assert numbers(list(newest)) == [0, 2, 3]
    assert numbers(newest.skipped) == [1]


def test_frames_far_apart_in_time_are_never_skipped() -> None:
    read = threading.Event()

    def folder() -> Iterator[Frame]:
        yield from at([float(k) for k in range(5)])
        read.set()

    newest, seen = NewestFrames(folder(), lambda frame: frame), []
    for frame in newest:
        seen.append(frame)
        assert read.wait(WAIT_S)
    assert numbers(seen) == list(range(5))


def test_the_error_of_a_source_follows_its_frames() -> None:
    def broken() -> Iterator[Frame]:
        yield from at([0.0, 1.0])
        raise InputError("unplugged")

    frames = iter(NewestFrames(broken(), lambda frame: frame))
    assert numbers([next(frames), next(frames)]) == [0, 1]
    with pytest.raises(InputError, match="unplugged"):
        next(frames)


def test_skipped_frames_are_filled_in_where_they_belong(tmp_path) -> None:
    run = modeler().start(Scene())
    folder, meta = RunFolder.open(tmp_path / "run"), RunMeta("sequence", 0, "general")
    steps = [event for event in run.track(FRAMES[::4], live=True) if isinstance(event, Step)]
    skipped = [frame for frame in FRAMES if frame.index % 4]
    filled = [event for event in run.fill(skipped) if isinstance(event, Step)]
    assert [step.frame.index for step in filled] == numbers(skipped)
    assert all(step.accepted for step in filled)
    assert run.state.places == {frame.index: place for place, frame in enumerate(FRAMES)}
    last = [event for event in run.finish() if isinstance(event, Step)][-1]
    assert last.frame.index == FRAMES[-1].index
    assert sorted(last.solution.trajectory) == numbers(FRAMES)
    assert trajectory_error(last) < 1e-6
    reports = [folder.write(step, meta) for step in (*steps, *filled, last)]
    assert [frame["id"] for frame in reports[-1]["frames"]] == numbers(FRAMES)
    neighbours = {edge.target for step in filled for edge in step.edges if edge.source == 1}
    assert neighbours == {0}  # the nearest in time


def test_skipped_frames_are_filled_in_where_a_single_one_was_tracked() -> None:
    run = modeler().start(Scene())
    assert list(run.track(FRAMES[:1], live=True))
    assert [isinstance(event, Step) and event.accepted for event in run.fill(FRAMES[1:3])] == [True, True]


def test_a_frame_that_was_read_is_not_filled_in_again() -> None:
    run = modeler().start(Scene())
    assert list(run.track(FRAMES[:2], live=True))
    with pytest.raises(InputError, match="twice"):
        list(run.fill(FRAMES[1:2]))


def test_images_of_waiting_frames_go_to_disk_once_memory_is_full() -> None:
    size = FRAMES[0].depth_m.nbytes + np.asarray(FRAMES[0].mask).nbytes + 64
    store = ViewStore(memory_bytes=2 * size, chunk_bytes=2**20)
    kept = [store.keep_frame(frame) for frame in FRAMES]
    assert [one.depth_m is frame.depth_m for one, frame in zip(kept, FRAMES, strict=True)][-1] is False
    for one, frame in zip(kept, FRAMES, strict=True):
        np.testing.assert_array_equal(one.depth_m, frame.depth_m)
        np.testing.assert_array_equal(one.mask, frame.mask)


def test_ctrl_c_ends_reading_and_a_second_one_filling_in(capsys) -> None:
    before = signal.getsignal(signal.SIGINT)

    def pressing(after: int, count: int = 10) -> Iterator[int]:
        for number in range(count):
            yield number
            if number == after:
                os.kill(os.getpid(), signal.SIGINT)

    with Interrupt() as interrupt:
        assert list(interrupt.until(pressing(3))) == [0, 1, 2, 3]
        assert interrupt.ended_early
        assert list(interrupt.until_next(range(4))) == [0, 1, 2, 3]
        assert list(interrupt.until_next(pressing(2))) == [0, 1, 2]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert "finishing" in capsys.readouterr().err
    with Interrupt() as interrupt:  # after the last one it changes nothing
        assert list(interrupt.until(pressing(1, 2))) == [0, 1]
        assert not interrupt.ended_early
    assert signal.getsignal(signal.SIGINT) is before


def test_a_frame_without_the_object_leaves_some_hundred_bytes() -> None:
    """Its number, time and reason, as a stand is watched all day; its images take 80,000."""
    height, width = FRAMES[0].depth_m.shape
    nothing = np.zeros((height, width), dtype=bool)

    def seen() -> Iterator[Frame]:
        yield from FRAMES[:3]
        for number in range(1000, 1600):
            depth_m = np.full((height, width), 0.9, dtype=np.float32)
            yield replace(FRAMES[0], index=number, time_s=float(number), depth_m=depth_m, mask=nothing)

    held = []
    with Console(None, None) as console:
        tracemalloc.start()
        for event in modeler().start(Scene()).track(seen(), live=True):
            console(event)
            held.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    assert (held[-1] - held[100]) / (len(held) - 101) < 1000
