"""Files that are either there and whole, or not there."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import threading
from collections.abc import Iterator
from pathlib import Path

from modeler.system.regular_files import left_behind
from modeler.types import InputError

PART = ".part"  # ending of a file that is still being written


def write_atomically(path: Path, content: str | bytes, *, lasting: bool = False, tidy: bool = True) -> None:
    """Write a file atomically: at any moment, also after a kill, the old or the new one is complete.

    A missing folder is created.

    Args:
        path: the file.
        content: all of it.
        lasting: wait until it is on the disk, for safety against power cuts.
        tidy: remove partial files of killed processes, by listing the folder.
    """
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content  # names need not be text
    part = path.with_name(f".{path.name}.{os.getpid()}{PART}")
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            for left in left_behind(path, PART) if tidy else ():
                left.unlink(missing_ok=True)
            part.write_bytes(data)
            if lasting:
                settle(part)
            os.replace(part, path)
            if lasting:
                settle(path.parent)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place") from error


def settle(*paths: Path) -> None:
    """Wait until files, and the names in folders, are on the disk.

    Raises:
        OSError: if one cannot be brought there.
    """
    for path in paths:
        opened = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        try:
            os.fsync(opened)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some file systems have no such thing
                raise
        finally:
            os.close(opened)


def settle_soon(*paths: Path) -> threading.Thread:
    """Do so without waiting; files removed by then are ignored."""

    def settled() -> None:
        with contextlib.suppress(OSError):
            settle(*paths)

    thread = threading.Thread(target=settled, daemon=True)
    thread.start()
    return thread


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Make a folder, if it is not there, and keep other programs that ask for the same out of it."""
    try:
        str(folder).encode()
        folder.mkdir(parents=True, exist_ok=True)
        held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise InputError(f"{folder}: no run folder can be made ({error.strerror}); choose another place") from error
    except UnicodeEncodeError:
        raise InputError(f"{folder}: its name is not UTF-8; rename it, or choose another place") from None
    try:
        with contextlib.suppress(OSError):  # not every file system has locks
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    f"{folder}: another run is writing to it; wait until it ends, or choose another place"
                ) from None
        yield
    finally:
        os.close(held)  # which a killed program does, too
