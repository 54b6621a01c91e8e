"""Kernels in several threads, because Numba's parallel loops take several times as long to compile."""

import contextlib
import os
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np

_BLOCKS = 4  # for each thread: in two, pairs took 0.88 of the time with halves on busy cores; a call takes 15 µs
_WORTH_S = 4e-4  # that one thread takes, from which others help: to wake one and to join its results takes 0.2 ms
_pools: dict[int, ThreadPoolExecutor] = {}
os.register_at_fork(after_in_child=_pools.clear)  # a child process has none of its parent's threads


def over_rows(
    kernel: Callable[..., Any], rows: np.ndarray, *arguments: Any, least: int = 4, in_place: bool = False
) -> Any:
    """Return a kernel's result for `rows`, one array or several, computed in blocks of rows and concatenated.

    Threads take blocks until none is left, this one from the first on, others, if it is worth it, from the last. While
    other programs keep the cores busy, a thread may be stopped for milliseconds: what others have not begun this one
    does, and what they do not end soon it does once more.

    Args:
        kernel: releases the GIL (`nogil=True`); takes rows and the arguments, each row independently.
        rows: (m, ...).
        arguments: the same for all rows.
        least: least number of rows per thread.
        in_place: whether the kernel writes into its arguments: no block is then computed twice.
    """
    threads = min(numba.get_num_threads(), len(rows) // least)
    if threads <= 1:
        return kernel(rows, *arguments)
    if threads not in _pools:
        _pools[threads] = ThreadPoolExecutor(threads, thread_name_prefix="kernel")
    count = min(_BLOCKS * threads, len(rows) // least)
    first, began_s = max(len(rows) // (2 * count), 1), time.perf_counter()
    parts = {0: kernel(rows[:first], *arguments)}
    took_s = time.perf_counter() - began_s
    blocks = [rows[:first], *np.array_split(rows[first:], count if 2 * count * took_s > _WORTH_S else 1)]
    left = deque(range(1, len(blocks)))

    def help_out() -> None:
        with contextlib.suppress(IndexError):  # none is left
            while True:
                number = left.pop()
                parts[number] = kernel(blocks[number], *arguments)

    helpers = [_pools[threads].submit(help_out) for _ in range(min(threads, len(left)) - 1)]
    with contextlib.suppress(IndexError):
        while True:
            number, began_s = left.popleft(), time.perf_counter()
            parts[number] = kernel(blocks[number], *arguments)
            took_s = time.perf_counter() - began_s
    for helper in helpers:
        if not helper.cancel():  # it has begun
            with contextlib.suppress(TimeoutError):
                helper.result(None if in_place else took_s)
    found = [parts[number] if number in parts else kernel(block, *arguments) for number, block in enumerate(blocks)]
    if isinstance(found[0], tuple):
        return tuple(np.concatenate(column) for column in zip(*found, strict=True))
    return np.concatenate(found)
