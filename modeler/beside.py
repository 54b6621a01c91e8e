"""Work in a thread of its own beside other work, where there is more than one thread; results are the same."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

S = TypeVar("S")
T = TypeVar("T")


def several() -> bool:
    """Return whether more than one thread may compute, by what Numba goes by: its variable, or else the cores."""
    return int(os.environ.get("NUMBA_NUM_THREADS") or len(os.sched_getaffinity(0))) > 1


def both(first: Callable[[], S], second: Callable[[], T]) -> tuple[S, T]:
    """Return what two functions return, computed side by side where there is more than one thread."""
    if not several():
        return first(), second()
    with ThreadPoolExecutor(1, thread_name_prefix="beside") as thread:
        other = thread.submit(second)
        return first(), other.result()


def each(make: Callable[[S], T], items: Iterable[S]) -> Generator[T, None, None]:
    """Yield what a function makes of items, in their order; two at a time where there is more than one thread.

    While one runs Python, the other may compute. Where nobody waits for the rest, it is not begun.
    """
    if not several():
        yield from map(make, items)
        return
    with ThreadPoolExecutor(2, thread_name_prefix="each") as threads:
        yield from threads.map(make, items)


@contextmanager
def behind(use: Callable[[T], None]) -> Iterator[Callable[[T], None]]:
    """Use items in a thread of its own, one item late at most; at once where there is one thread only.

    What it raises is raised with the next item, or at the end.
    """
    if not several():
        yield use
        return
    with ThreadPoolExecutor(1, thread_name_prefix="behind") as thread:
        used = thread.submit(lambda: None)

        def put(item: T) -> None:
            nonlocal used
            used.result()
            used = thread.submit(use, item)

        yield put
        used.result()


@contextmanager
def ahead(make: Callable[[S], T]) -> Iterator[Callable[[S], Callable[[], T]]]:
    """Begin to make things in a thread of its own, in the order in which they are begun, and ask for each later.

    Where there is one thread only, each is made when it is asked for.
    """
    if not several():
        yield lambda item: lambda: make(item)
        return
    with ThreadPoolExecutor(1, thread_name_prefix="ahead") as thread:
        yield lambda item: thread.submit(make, item).result
