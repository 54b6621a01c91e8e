"""Regular files: the only place that opens files named by a user, or in a folder named by a user.

A FIFO, a socket or a device can block or never end; only regular files are read.
"""

from __future__ import annotations

import errno
import glob
import json
import os
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from modeler.types import InputError

MAX_BYTES = 1 << 30  # larger files are not read into memory at once, nor unpacked to more
PIECE_BYTES = 1 << 20  # read at a time of larger ones: far above a system call's cost, and no burden for memory
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading, without blocking.

    The file is checked before it is opened, because opening a device can have effects, and again once it is open,
    because another program may have replaced it in between.

    Raises:
        InputError: if it is anything else than a regular file, missing, or cannot be opened.
    """
    try:
        _check(path, os.stat(path).st_mode)
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except OSError as error:
        if error.errno == errno.ENXIO:  # a socket
            _check(path, stat.S_IFSOCK)
        raise unreadable(path, error) from None
    try:
        _check(path, os.fstat(descriptor).st_mode)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def check_regular(path: Path) -> None:
    """Reject other than regular files, for libraries that open paths themselves.

    Raises:
        InputError: if it is anything else, missing, or cannot be opened.
    """
    open_regular(path).close()


def create_regular(path: Path) -> None:
    """Create an empty regular file, or empty the one that is there.

    Raises:
        InputError: if something else has its name.
        OSError: if it cannot be created or written to.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC, 0o666)
    try:
        _check(path, os.fstat(descriptor).st_mode)
        os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)


def left_behind(path: Path, ending: str) -> Iterator[Path]:
    """Yield partial files left by killed processes next to a path, named `.NAME.PROCESS` and the suffix."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*{ending}"):
        try:
            os.kill(int(left.name.removesuffix(ending).rpartition(".")[2]), 0)
        except (ProcessLookupError, OverflowError):
            yield left
        except (ValueError, PermissionError):
            pass  # not ours, or still running


def read_regular(path: Path, most_bytes: int = MAX_BYTES) -> bytes:
    """Return the content of a regular file.

    Raises:
        InputError: if it is anything else, larger than `most_bytes`, missing, or cannot be read.
    """
    try:
        with open_regular(path) as file:
            size, content = os.fstat(file.fileno()).st_size, None
            if size <= most_bytes:
                content = file.read(size + 1)  # takes so much memory, however little there is to read
                content += file.read(most_bytes - size) if len(content) > size else b""  # it grew, or states no size
    except OSError as error:
        raise unreadable(path, error) from None
    if content is None or len(content) > most_bytes:
        raise InputError(f"{path}: is larger than {most_bytes // 1_000_000} MB; is it the right file?")
    return content


def read_json(path: Path, most_bytes: int = MAX_BYTES) -> Any:
    """Return the contents of a JSON file.

    Raises:
        InputError: if it is no regular file, too large, missing, cannot be read, or is not valid JSON.
    """
    return parse_json(read_regular(path, most_bytes), path)


def json_lines(content: Mapping[str, object]) -> str:
    """Return an object as JSON with an entry a line, which keeps files both small and readable."""
    lines = ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
    return f"{{\n{lines}\n}}\n"


def parse_json(content: str | bytes, path: Path) -> Any:
    """Return the contents of JSON text; `path` is its source, for messages.

    Raises:
        InputError: if it is not valid JSON, or nested too deeply.
    """
    try:
        return json.loads(content)
    except json.JSONDecodeError as error:
        why = f"line {error.lineno}, column {error.colno}: {error.msg}"
    except RecursionError:
        why = "nested too deeply"
    except ValueError as error:  # numbers of too many digits, bytes that are not UTF-8
        why = " ".join(str(error).split())
    raise InputError(f"{path}: is not valid JSON ({why}); correct it there.")


def unreadable(path: Path, error: OSError) -> InputError:
    """Return the error for a file that could not be opened or read."""
    if isinstance(error, FileNotFoundError):
        broken = os.path.islink(path)
        why = "is a link to nothing; put the file itself there" if broken else "no such file; check the path"
        return InputError(f"{path}: {why}.")
    return InputError(f"{path}: cannot be read ({error.strerror or error}); check the path and its permissions.")


def _check(path: Path, mode: int) -> None:
    """Reject other than regular files by mode."""
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "something else")
        raise InputError(f"{path}: is {kind}, not a regular file; put the file itself there.")
