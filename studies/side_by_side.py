"""Work done side by side, each piece in a process with one thread, to leave the cores to the others."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

import numba

T = TypeVar("T")


def results(work: Sequence[Callable[[], T]], jobs: int) -> Iterator[T]:
    """Yield what functions return, as they end; of one job in order, in this process.

    Args:
        work: functions that other processes can import: none of a `__main__`.
        jobs: how many at a time.
    """
    if jobs == 1:
        numba.set_num_threads(1)
        yield from (one() for one in work)
        return
    context = multiprocessing.get_context("spawn")  # kernels' threads do not survive a fork
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=numba.set_num_threads, initargs=(1,)) as pool:
        for future in as_completed([pool.submit(one) for one in work]):
            yield future.result()
