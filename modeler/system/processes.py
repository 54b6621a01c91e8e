"""Processes and threads: address space, one heap, where children find modules, extras, and work done concurrently."""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import mmap
import os
import shlex
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, TypeVar

_DIVERTED = threading.Lock()


def share_one_heap() -> None:
    """Let all new threads allocate from one heap, instead of one per thread as in the C library.

    What a thread frees stays in its heap. With two threads, 500 frames took 210 MiB more than with one heap; kernels
    allocate too seldom to wait for each other.
    """
    if sys.platform == "linux" and (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(-8, 1)  # M_ARENA_MAX of mallopt(3)


def check_room(size: int) -> None:
    """Reject limits of the address space (`ulimit -v`) that leave too few bytes; no memory is used.

    Native code does not report such limits: OpenBLAS retries forever to get its buffers, or ends the process, as Rerun
    does.

    Raises:
        OSError: if there is too little.
    """
    if sys.platform == "linux":
        mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, prot=mmap.PROT_READ).close()


def environment() -> dict[str, str]:
    """Return the environment in which Python finds the modules of this process, and none in the current folder."""
    return {**os.environ, "PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(filter(os.path.isabs, sys.path))}


@contextlib.contextmanager
def diverted(stream: int, into: IO[bytes] | None = None) -> Iterator[None]:
    """Keep what compiled code writes to stdout (1) or stderr (2), one for all threads: in a file, or nowhere."""
    with _DIVERTED, open(os.devnull, "wb") as nowhere:
        sys.stdout.flush()
        kept = os.dup(stream)
        try:
            os.dup2((nowhere if into is None else into).fileno(), stream)
            yield
        finally:
            ctypes.CDLL(None).fflush(None)  # buffered output of C
            os.dup2(kept, stream)
            os.close(kept)


def install_command(extra: str) -> str:
    """Return the command that installs an extra for the interpreter that runs, of a clone and of a package alike."""
    return f"{shlex.quote(sys.executable)} -m pip install 'modeler[{extra}]'"


def check_installed(module: str, package: str, extra: str) -> None:
    """Reject work that needs a package that is not installed."""
    from modeler.types import InputError  # not with the command line's help

    if importlib.util.find_spec(module) is None:
        raise InputError(f"{package} is not installed; {install_command(extra)}")


S = TypeVar("S")
T = TypeVar("T")

_NO_TIME_S = 0.01  # no one notices less


@dataclass
class Pace:
    """Limits repeated work to a share of the time."""

    share: float = 0.1
    """At most this share of the time is spent."""
    resting_until_s: float = 0.0
    """By `time.monotonic`."""

    @property
    def rests(self) -> bool:
        """Whether it is too early to do it again."""
        return time.monotonic() < self.resting_until_s

    def took(self, seconds: float) -> None:
        """Record that it was done and its duration; fast work is always allowed."""
        if seconds > _NO_TIME_S:
            self.resting_until_s = time.monotonic() + (1.0 / self.share - 1.0) * seconds


def cores() -> int:
    """Return how many cores this process may use; all of the machine where the system does not tell (macOS)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def is_parallel() -> bool:
    """Return whether more than one thread may compute: as NUMBA_NUM_THREADS says, or else the number of cores."""
    return int(os.environ.get("NUMBA_NUM_THREADS") or cores()) > 1


def in_parallel(first: Callable[[], S], second: Callable[[], T]) -> tuple[S, T]:
    """Return the results of two functions, computed at the same time."""
    if not is_parallel():
        return first(), second()
    with ThreadPoolExecutor(1, thread_name_prefix="parallel") as thread:
        other = thread.submit(second)
        return first(), other.result()


def parallel_map(function: Callable[[S], T], items: Iterable[S]) -> Generator[T, None, None]:
    """Yield the results of a function of each item, in order, computed two at a time.

    While one runs Python, the other may compute. If the generator is closed early, the rest is not started.
    """
    if not is_parallel():
        yield from map(function, items)
        return
    with ThreadPoolExecutor(2, thread_name_prefix="map") as threads:
        yield from threads.map(function, items)


@contextmanager
def in_background(
    consume: Callable[[T], None], may_drop: Callable[[T], bool] = lambda item: False, share: float = 1.0
) -> Iterator[Callable[[T], None]]:
    """Return a function that passes an item to another thread, after waiting until the one before is consumed.

    An error of `consume` is raised with the next item, or at the end.

    Args:
        consume: what is done with an item.
        may_drop: whether an item may be dropped instead of waiting.
        share: of the time that consuming takes at most, as long as items may be dropped. Threads take turns in running
            Python, so that it delays what runs beside it.
    """
    pace = Pace(share)

    def timed(item: T) -> None:
        began_s = time.monotonic()
        consume(item)
        pace.took(time.monotonic() - began_s)

    if not is_parallel():
        yield lambda item: None if pace.rests and may_drop(item) else timed(item)
        return
    with ThreadPoolExecutor(1, thread_name_prefix="background") as thread:
        consumed = thread.submit(lambda: None)

        def put(item: T) -> None:
            nonlocal consumed
            if (pace.rests or not consumed.done()) and may_drop(item):
                return
            consumed.result()
            consumed = thread.submit(timed, item)

        yield put
        consumed.result()


@contextmanager
def prefetching(make: Callable[[S], T]) -> Iterator[Callable[[S], Callable[[], T]]]:
    """Return a function that starts `make` of an item in another thread and returns a function that waits for it.

    Results are made in the order in which they are started; with a single thread, when they are waited for.
    """
    if not is_parallel():
        yield lambda item: lambda: make(item)
        return
    with ThreadPoolExecutor(1, thread_name_prefix="prefetch") as thread:
        yield lambda item: thread.submit(make, item).result
