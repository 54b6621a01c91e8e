"""Kernels in several threads, because Numba's parallel loops take several times as long to compile."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np

_pools: dict[int, ThreadPoolExecutor] = {}
os.register_at_fork(after_in_child=_pools.clear)  # a child process has none of its parent's threads


def over_rows(kernel: Callable[..., Any], rows: np.ndarray, *arguments: Any, least: int = 4) -> Any:
    """Return a kernel's result for `rows`, one array or several, computed in blocks of rows and concatenated.

    Args:
        kernel: releases the GIL (`nogil=True`); takes rows and the arguments, each row independently.
        rows: (m, ...).
        arguments: the same for all rows.
        least: least number of rows per thread.
    """
    threads = min(numba.get_num_threads(), len(rows) // least)
    if threads <= 1:
        return kernel(rows, *arguments)
    if threads not in _pools:
        _pools[threads] = ThreadPoolExecutor(threads, thread_name_prefix="kernel")
    first, *others = np.array_split(rows, threads)
    waiting = [_pools[threads].submit(kernel, block, *arguments) for block in others]
    parts = [kernel(first, *arguments), *(future.result() for future in waiting)]
    if isinstance(parts[0], tuple):
        return tuple(np.concatenate(column) for column in zip(*parts, strict=True))
    return np.concatenate(parts)
