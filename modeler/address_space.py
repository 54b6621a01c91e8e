"""Memory as the operating system sees it: whether there is room for libraries, and what a run no longer needs."""

import ctypes
import mmap
import sys


def check_room(size: int) -> None:
    """Refuse limits of the address space (`ulimit -v`) that leave less than so many bytes; no memory is used.

    Native code does not tell of such limits: OpenBLAS tries for ever to get its buffers, or ends the process, as Rerun
    does.

    Raises:
        OSError: where there is no such room.
    """
    if sys.platform == "linux":
        mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, prot=mmap.PROT_READ).close()


def return_free_memory() -> None:
    """Return to the operating system what was allocated and is free again, where the C library keeps it (glibc).

    Matrices of a graph that grows are larger with every frame, so that those that are free seldom fit for new ones.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
