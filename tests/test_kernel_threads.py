"""Rows of a kernel in threads: the same results, whatever the other threads do."""

import threading

import numpy as np
import pytest

from modeler.kernels.threads import over_rows

ROWS = np.arange(50.0)[:, None] * [1.0, 10.0]


@pytest.fixture(autouse=True)
def two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("numba.get_num_threads", lambda: 2)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 17, 50])
@pytest.mark.parametrize("in_place", [False, True])
def test_results_are_those_of_all_rows_at_once(count: int, *, in_place: bool) -> None:
    rows = ROWS[:count]
    np.testing.assert_array_equal(over_rows(lambda some, by: some * by, rows, 3.0, in_place=in_place), 3.0 * rows)
    once, twice = over_rows(lambda some: (some, 2.0 * some), rows, in_place=in_place)
    np.testing.assert_array_equal(np.stack([once, twice]), [rows, 2.0 * rows])


def test_what_another_thread_does_not_end_is_computed_here() -> None:
    here, go_on = threading.get_ident(), threading.Event()

    def kernel(some: np.ndarray) -> np.ndarray:
        if threading.get_ident() != here:
            go_on.wait()
        return some + 1.0

    try:
        np.testing.assert_array_equal(over_rows(kernel, ROWS), ROWS + 1.0)
    finally:
        go_on.set()


def test_what_a_kernel_writes_in_place_it_writes_once() -> None:
    for _ in range(20):
        sums = np.zeros(len(ROWS))

        def kernel(some: np.ndarray, sums: np.ndarray = sums) -> np.ndarray:
            sums[some] += 1.0
            return some

        over_rows(kernel, np.arange(len(ROWS)), in_place=True)
        np.testing.assert_array_equal(sums, 1.0)


def test_an_error_of_a_kernel_is_raised() -> None:
    def kernel(some: np.ndarray) -> np.ndarray:
        raise ValueError("no rows")

    with pytest.raises(ValueError, match="no rows"):
        over_rows(kernel, ROWS)
