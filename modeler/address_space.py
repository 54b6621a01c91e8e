"""Whether there is room for libraries that end the process, or wait for ever, where there is none."""

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
