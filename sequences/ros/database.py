"""SQLite files of ROS 2 bags, which are databases that anybody may have made: their tables are read, and no more."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import apsw
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from modeler.types import InputError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

_MOST_BYTES = 1 << 30  # of a value
_STEP = 1_000_000  # instructions of the database between two looks at their number
_STEPS = 100  # for one message of a small file: some seconds
_STEPS_PER_BYTE = 1e-4  # and more in large ones: a row of ten bytes or more takes fewer than a thousand instructions
_PRAGMAS = ("table_info", "table_xinfo")
_FUNCTIONS = ("count", "min", "max")


def database(path: Path) -> Sqlite3Reader:
    """Return the library's reader of a file, which is not open yet.

    What a hostile file would have computed, such as a view that never ends, is refused.

    Raises:
        InputError: when it is opened, if part of its messages lies beside it.
    """
    reader: Any = Sqlite3Reader(Path(quote(str(path))))  # quoted for an address, as the library expects it
    opening, reading, work = reader.open, reader.messages, _Work(path)

    def open_guarded() -> None:
        for beside in (Path(f"{path}-wal"), Path(f"{path}-journal")):
            if beside.exists() and beside.stat().st_size:
                raise InputError(
                    f'{beside}: the recorder ended before this was moved into the bag; run: sqlite3 "{path}" '
                    '"PRAGMA wal_checkpoint; SELECT count(*) FROM messages"'
                )
        apsw.connection_hooks.append(work.guard)
        try:
            opening()
        finally:
            apsw.connection_hooks.remove(work.guard)
        for table in ("messages", "topics"):
            if any(column[6] > 1 for column in reader.dbconn.execute(f"PRAGMA table_xinfo({table})")):
                raise ValueError("it has generated columns")

    def messages(
        connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        work.renew()
        for message in reading(connections, start, stop):
            yield message
            work.renew()

    reader.open, reader.messages = open_guarded, messages
    return reader


class _Work:
    """Limits what a database does for one message."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._left = 0.0
        self.renew()

    def renew(self) -> None:
        """Begin with another message."""
        self._left = _STEPS + _STEPS_PER_BYTE * (os.path.getsize(self._path) if self._path.is_file() else 0)

    def guard(self, connection: apsw.Connection) -> None:
        """Restrict a connection that is being opened."""
        connection.authorizer = _permission
        connection.set_progress_handler(self._is_over, _STEP)
        connection.limit(apsw.SQLITE_LIMIT_LENGTH, _MOST_BYTES)

    def _is_over(self) -> bool:
        self._left -= 1.0
        return self._left < 0.0


def _permission(action: int, first: str | None, second: str | None, name: str | None, within: str | None) -> int:
    """Permit reading tables; not views, whatever they hold, nor functions."""
    permitted = within is None and (
        action in (apsw.SQLITE_SELECT, apsw.SQLITE_READ)
        or (action == apsw.SQLITE_FUNCTION and second in _FUNCTIONS)
        or (action == apsw.SQLITE_PRAGMA and first in _PRAGMAS)
    )
    return apsw.SQLITE_OK if permitted else apsw.SQLITE_DENY
