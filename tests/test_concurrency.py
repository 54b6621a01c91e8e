"""Concurrent work gives the same results in the same order, whatever the number of threads."""

import multiprocessing
import threading
import time

import pytest
from slow_cases import quick_first

from modeler.cli import main
from modeler.sequences import bundled
from modeler.system import processes
from modeler.system.processes import in_background, in_parallel, parallel_map, prefetching


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """How many threads there may be."""
    monkeypatch.setenv("NUMBA_NUM_THREADS", str(request.param))
    return request.param


def test_two_results_are_in_order(threads: int) -> None:
    where = in_parallel(threading.get_ident, threading.get_ident)
    assert where[0] == threading.get_ident()
    assert (where[1] == where[0]) == (threads == 1)
    with pytest.raises(ZeroDivisionError):
        in_parallel(lambda: 1, lambda: 1 / 0)


def test_items_are_consumed_in_the_background_one_late_at_most(threads: int) -> None:
    go, used = threading.Event(), list[int]()

    def use(item: int) -> None:
        assert threads == 1 or go.wait(5.0)
        used.append(item)

    with in_background(use) as put:
        put(0)
        assert used == ([0] if threads == 1 else [])
        go.set()
        put(1)
        assert used[0] == 0
    assert used == [0, 1]


def test_an_item_that_may_be_dropped_is_not_waited_for(threads: int) -> None:
    go, begun, used = threading.Event(), threading.Event(), list[int]()

    def use(item: int) -> None:
        begun.set()
        assert threads == 1 or go.wait(5.0)
        used.append(item)

    with in_background(use, lambda item: item != 3) as put:
        put(0)
        assert begun.wait(5.0)
        put(1)
        put(2)
        go.set()
        put(3)
    assert used == ([0, 1, 2, 3] if threads == 1 else [0, 3])


def test_items_that_may_be_dropped_take_a_share_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    monkeypatch.setattr(processes, "_NO_TIME_S", 0.0)
    now_s, used = 0.0, list[int]()
    monkeypatch.setattr(time, "monotonic", lambda: now_s)

    def use(item: int) -> None:
        nonlocal now_s
        now_s += 1.0
        used.append(item)

    with in_background(use, lambda item: item != 20, share=0.25) as put:
        for item in range(21):
            put(item)
            now_s += 0.5
    assert used == [0, 6, 12, 18, 20]  # a second in four, and the last


@pytest.mark.usefixtures("threads")
def test_an_error_in_the_background_is_raised_at_the_end_at_the_latest() -> None:
    def use(item: int) -> None:
        raise OSError(f"{item} cannot be drawn")

    with pytest.raises(OSError, match="1 cannot"), in_background(use) as put:
        put(1)


def test_prefetched_results_are_made_in_order_and_errors_are_raised_when_waited_for(threads: int) -> None:
    made = list[int]()

    def make(item: int) -> float:
        made.append(item)
        return 1.0 / item

    with prefetching(make) as making:
        waiting = [making(item) for item in (2, 0, 4)]
        assert threads > 1 or made == []
        assert waiting[0]() == 0.5
        with pytest.raises(ZeroDivisionError):
            waiting[1]()
        assert waiting[2]() == 0.25
    assert made == [2, 0, 4]


def test_a_parallel_map_keeps_the_order_and_does_not_start_the_rest_once_closed(threads: int) -> None:
    go, made = threading.Event(), list[int]()

    def make(item: int) -> int:
        assert threads == 1 or item == 0 or go.wait(5.0)
        made.append(item)
        return -item

    results = parallel_map(make, range(9))
    assert next(results) == 0
    threading.Timer(0.1, go.set).start()
    results.close()
    assert made[0] == 0
    assert len(made) <= (1 if threads == 1 else 3)
    assert list(parallel_map(make, range(4))) == [0, -1, -2, -3]


@pytest.mark.parametrize("method", quick_first(["spawn", "forkserver", "fork"]))
def test_processes_register_however_they_are_started(method: str) -> None:
    """Also where this process has registered before, and runs threads."""
    command = ["register", str(bundled("box")), "0", "1", "--prior", "table", "--method", "icp"]
    assert main(command) == 0
    with multiprocessing.get_context(method).Pool(1) as pool:
        assert pool.apply_async(main, [command]).get(120.0) == 0
