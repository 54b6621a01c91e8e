"""Processes: address space, one heap for all threads, where children find modules; and optional packages."""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import mmap
import os
import shlex
import sys
import threading
from collections.abc import Iterator
from typing import IO

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
